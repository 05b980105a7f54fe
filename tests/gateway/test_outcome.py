"""An outcome is settled once: its counts, its notes in order, and what a session reports only once."""

from __future__ import annotations

from typing import Any

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.outcome import (
    MAX_NOTED,
    Bookkeeper,
    Finding,
    Item,
    Outcome,
    Tally,
    conversion_failure,
    warning_findings,
)
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peers
from tests.tables import table

IN = Entry(1, 10, Kind.IGTL_IN, "STRING/A", "STRING", (b"",), (1,))


def bookkeeper(*links: int) -> Bookkeeper:
    peers = Peers(Config())
    for link in links:
        peers.up(link, {"peer": f"h:{link}"}, 0)
    return Bookkeeper(peers)


def codes(outputs: list[Output]) -> list[str]:
    return [Note.unpack(b"".join(map(bytes, each.payload))).code for each in outputs if each.kind is Kind.NOTE]


def finding(code: str = "odd", **more: Any) -> Finding:
    return Finding(Level.WARN, code, f"text of {code}", "STRING/A", (1,), **more)


@table(
    "kind, fate, decoded, expected",
    [
        (Kind.IGTL_IN, CONVERTED, True, {"received": 1, "decoded": 1, CONVERTED: 1}),
        (Kind.ROS_IN, CONVERTED, False, {"received": 1, CONVERTED: 1}),
        (Kind.IGTL_IN, "denied", False, {"received": 1, "dropped": {"denied": 1}}),
        (Kind.LINK, "", False, None),
    ],
)
def test_the_fate_of_a_message_is_counted(
    kind: Kind, fate: str, decoded: bool, expected: dict[str, Any] | None
) -> None:
    book = bookkeeper()
    book.settle(Entry(1, 10, kind, "STRING/A", "STRING", (b"",), (1,)), Outcome([], fate, decoded))
    counts = dict(book.ledger.counter(kind.value, "STRING/A"))
    dropped = book.ledger.drops().get(kind.value, {}).get("STRING/A")
    assert (counts | ({"dropped": dropped} if dropped else {})) == (expected or {})


def test_outputs_and_notes_keep_their_order_and_are_counted() -> None:
    book = bookkeeper(1, 2)
    sent = Output(Kind.IGTL_OUT, "STATUS/B", "STATUS", (b"",), (1, 2))
    published = Output(Kind.ROS_OUT, "/b", "std_msgs/msg/String", (b"",))
    loss = finding(loss=("IMAGE/C", "denied"))
    items: list[Item] = [published, loss, sent]
    tallies = [Tally("peers", "1", "asked", 3), Tally("igtl_out", "IMAGE/D", "late", 2, dropped=True)]
    outputs = book.settle(IN, Outcome(items, CONVERTED, tallies=tallies))
    assert [each.kind for each in outputs] == [Kind.ROS_OUT, Kind.NOTE, Kind.IGTL_OUT]
    assert book.ledger.counter("igtl_out", "STATUS/B")["sent"] == 2
    assert book.ledger.counter("ros_out", "/b")["published"] == 1
    assert book.ledger.counter("peers", "1")["asked"] == 3
    assert book.ledger.drops()["igtl_out"] == {"IMAGE/C": {"denied": 1}, "IMAGE/D": {"late": 2}}


def test_a_subject_is_reported_once_by_each_link_and_a_finding_without_one_always() -> None:
    book = bookkeeper(1, 2)

    def settled(*items: Item) -> list[str]:
        return codes(book.settle(IN, Outcome(list(items), CONVERTED)))

    assert settled(finding(), finding()) == ["odd", "odd"]
    assert settled(finding(subject="x", by=1), finding(subject="x", by=1), finding(subject="x", by=2)) == ["odd"] * 2
    assert settled(finding("even", subject="x", by=1), finding(subject="y", by=1)) == ["even", "odd"]
    loss = finding(subject="x", by=1, loss=("IMAGE/C", "denied"))
    assert settled(loss) == [] and book.ledger.drops()["igtl_out"] == {"IMAGE/C": {"denied": 1}}


def test_a_link_that_has_gone_may_report_again_and_none_fills_the_log_for_others() -> None:
    book = bookkeeper(1)

    def settled(entry: Entry, *items: Item) -> list[str]:
        return codes(book.settle(entry, Outcome(list(items), "")))

    there, gone = (Entry(2, 20, Kind.LINK, links=(link,)) for link in (1, 2))
    assert settled(there, finding(subject="x", by=1), finding(subject="x", by=2)) == ["odd", "odd"]
    settled(gone)
    assert settled(there, finding(subject="x", by=1), finding(subject="x", by=2)) == ["odd"]
    many = [finding(subject=f"{number}", by=1) for number in range(MAX_NOTED + 10)]
    assert MAX_NOTED - 1 <= len(settled(there, *many)) <= MAX_NOTED
    assert settled(there, finding(subject="other", by=3)) == ["odd"]


def test_a_defect_loses_a_message_by_name() -> None:
    book = bookkeeper()
    (output,) = book.fail(IN, KeyError("x"))
    note = Note.unpack(bytes(output.payload[0]))
    assert (note.level, note.code, note.stream, output.links) == (Level.ERROR, "internal_error", "STRING/A", (1,))
    assert "KeyError: 'x'" in note.text
    assert book.ledger.counter("igtl_in", "STRING/A") == {"received": 1}
    assert book.ledger.drops() == {"igtl_in": {"STRING/A": {"internal_error": 1}}}


def test_warnings_are_subjects_of_their_stream_and_failures_are_not() -> None:
    (found,) = warning_findings([("odd", "text")], IN)
    assert found == Finding(Level.WARN, "odd", "text", "STRING/A", (1,), "STRING/A")
    failed = conversion_failure(ValueError("why"), "not sent", IN)
    assert failed == Finding(Level.ERROR, "conversion", "not sent: why", "STRING/A", (1,))

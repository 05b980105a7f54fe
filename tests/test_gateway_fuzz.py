"""No input makes the gateway stumble over itself: whatever comes, it answers with messages or with reasons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert.express import COMPILED
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, ConversionToIgtl
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.dialogue import answers
from igtl_gateway.gateway.fastpath.compiled_to_ros import CompiledToRos
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_igtl import sender
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import Status
from tests import strategies
from tools import fuzz_gateway

# A number too large for float32 is a fact about the message; numpy must not print it on the user's console.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

OWN: tuple[type[RosMessage], ...] = (LinkStatusList, Metadata, RawMessage, CommandReply)
MESSAGES = (*(row.message for row in TO_ROS), *(row.message for row in TO_IGTL), *OWN)
CLASSES = {message.TYPE: message for message in MESSAGES}
NOW_NS = 1_700_000_000_000_000_000


def opened(config: Config) -> Session:
    """A session with one link of each header version."""
    session = Session(Gateway(config))
    session.input(NOW_NS, Kind.LINK, (Note(Level.INFO, LINK_UP, "up").pack(),), links=(1, 2))
    newer = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))
    session.input(NOW_NS, Kind.IGTL_IN, (newer,), links=(2,))
    return session


def check(entries: list[Entry]) -> None:
    """No defect, only outputs that can be read again."""
    for entry in entries:
        if entry.kind is Kind.NOTE:
            note = Note.unpack(entry.data())
            assert note.code != "internal_error", note.text
        elif entry.kind is Kind.IGTL_OUT:
            message = decode(entry.data())
            assert message.ticks != 0  # outgoing messages are always stamped
        elif entry.kind is Kind.ROS_OUT:
            CLASSES[entry.type].unpack(entry.data())


@given(st.lists(strategies.wire_bytes() | strategies.damaged_wire_bytes, min_size=1, max_size=4), st.booleans())
def test_igtl_in(inputs: list[bytes], check_crc: bool) -> None:
    session = opened(Config(check_crc=check_crc))
    for data in inputs:
        if len(data) >= 58:  # what the framer guarantees
            check(session.input(NOW_NS, Kind.IGTL_IN, (data,), links=(1,)))


@pytest.mark.parametrize("row", TO_IGTL, ids=lambda row: f"{row.message.__name__}-{row.igtl_type}")
def test_ros_in(row: ConversionToIgtl) -> None:
    kind = row.message.TYPE
    config = Config(to_igtl=(ToIgtlRow(topic="/t", device="Name with a length above 20", type=row.igtl_type),))

    @given(st.lists(strategies.packed(kind), min_size=1, max_size=3))
    def run(inputs: list[bytes]) -> None:
        session = opened(config)
        for data in inputs:
            entries = session.input(NOW_NS, Kind.ROS_IN, (data,), channel="/t", type_name=kind)
            counts = session.gateway.ledger.to_dict()["ros_in"]["/t"]
            assert len(entries) > 1 or counts["dropped"]  # an answer or a reason, never nothing
            check(entries)

    run()


def test_every_ros_type_is_covered() -> None:
    assert set(CLASSES) <= {*strategies.ros_messages(), *strategies.STRUCTS}


def test_a_defect_would_be_seen() -> None:
    """The check above can fail."""
    note = Note(Level.ERROR, "internal_error", "lost").pack()
    with pytest.raises(AssertionError, match="lost"):
        check([Entry(1, 1, Kind.NOTE, payload=(note,))])


# -- tools/fuzz_gateway.py: a short part of every run, and that it would notice ---------------------------------------


def test_the_gateway_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_gateway, "YOUNG", 700)
    monkeypatch.setattr(fuzz_gateway, "LOOK", 1_000)
    said: list[str] = []
    figures = fuzz_gateway.run(7, 3_000, said.append, every_s=0.0)
    assert figures.broken == ""
    assert figures.bent >= 3_000 and figures.stages >= 3 and figures.planned > (300 if COMPILED else 100)
    # all kinds of ends are met
    assert {"igtl_in converted", "igtl_in malformed", "igtl_in bad_crc", "ros_in conversion"} <= set(figures.fates)
    assert "3,0" in said[-1] and "mutated messages: 3,0" in fuzz_gateway.report(figures)


def test_the_seed_decides() -> None:
    one, again, other = (fuzz_gateway.run(seed, 200) for seed in (1, 1, 2))
    assert (one.inputs, one.outputs, one.notes) == (again.inputs, again.outputs, again.notes)
    assert one.notes != other.notes


def broken(count: int = 2_000) -> str:
    """The judge's result of a run."""
    figures = fuzz_gateway.run(1, count)
    assert figures.broken
    return figures.broken


def crash(*_: object) -> None:
    raise IndexError("crashed")


def test_a_defect_is_noticed_and_can_be_repeated(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(answers, "start_stream", crash)
    figures = fuzz_gateway.run(1, 2_000)
    assert "IndexError: crashed" in figures.broken and figures.culprit
    fuzz_gateway.write_culprit(tmp_path / "culprit", figures.culprit)
    assert "IndexError: crashed" in fuzz_gateway.repeat(tmp_path / "culprit")[-1]
    monkeypatch.undo()
    assert fuzz_gateway.repeat(tmp_path / "culprit") == []


def test_what_never_ends_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def endless(*_: object) -> None:
        while True:
            pass

    monkeypatch.setattr(fuzz_gateway, "HANG_S", 0.3)
    monkeypatch.setattr(answers, "start_stream", endless)
    assert "Hang" in broken()


def test_a_ledger_with_a_gap_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ledger, "drop", lambda *_: None)
    assert "the ledger does not close: igtl_in" in broken(300)


def test_what_nobody_can_read_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "encode", lambda message: [join(encode(message))[:-1] + b"?"])
    assert "CRC" in broken()


def test_a_fast_path_that_gives_something_else_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = CompiledToRos.__call__

    def other(self: CompiledToRos, *given: Any) -> list[Entry] | None:
        entries = compiled(self, *given)
        return entries and [replace(entry, source_ns=7) for entry in entries]

    monkeypatch.setattr(CompiledToRos, "__call__", other)
    assert "replayed without the fast path, the outputs of the session differ" in broken(600)


def test_memory_that_grows_is_told_from_peaks() -> None:
    flat = [(count * 25_000, 100.0 + (50.0 if count % 7 == 0 else 0.0)) for count in range(100)]
    assert abs(fuzz_gateway.growth(flat)) < 1.0
    assert fuzz_gateway.growth([(count, mib + count * 5e-6) for count, mib in flat]) == pytest.approx(5.0, abs=1.0)
    assert fuzz_gateway.growth([(0, 50.0)]) == 0.0

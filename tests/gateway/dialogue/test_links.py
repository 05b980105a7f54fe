"""Links that come and go: the late joiner's latched messages, pings, and the account of a link that has closed."""

from __future__ import annotations

from typing import Any

import pytest

from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.igtl_msgs import Command
from igtl_gateway.gateway import LINK_DOWN
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.text import Status
from tests.script import T0_NS, Script

TOOL = rosmsg.TransformStamped(rosmsg.Header(T0_NS, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
PLUS = Message("USMESSAGE", "", Status(1))


def closed(script: Script, link: int, **counts: Any) -> list[str]:
    """The link goes, with the counts that its edge kept."""
    return script.feed(Kind.LINK, (Note(Level.INFO, LINK_DOWN, "down", data=counts).pack(),), link=link)


def peers_of(script: Script) -> dict[str, Any]:
    return dict(script.gateway.ledger.to_dict().get("peers", {}))


@pytest.mark.parametrize("dropped", [1, {"TRANSFORM/Tool": 1}])
def test_what_was_sent_to_a_link_is_accounted_for_when_it_closes(dropped: object) -> None:
    script = Script()
    script.up(1, peer="10.0.0.1:5")
    for _ in range(5):
        script.ros("/igtl/out/Tool", TOOL)
    closed(script, 1, sent_messages=3, dropped=dropped)
    assert peers_of(script) == {"1 10.0.0.1:5": {"sent": 5, "delivered": 3, "dropped": {"queue": 1, "link_closed": 1}}}


def test_a_link_that_took_everything_has_no_losses() -> None:
    script = Script()
    script.up(1, peer="10.0.0.1:5")
    script.ros("/igtl/out/Tool", TOOL)
    closed(script, 1, sent_messages=1)
    assert peers_of(script) == {"1 10.0.0.1:5": {"sent": 1, "delivered": 1}}


def test_without_counts_there_is_no_account() -> None:
    script = Script()
    script.up(1, peer="10.0.0.1:5")
    script.ros("/igtl/out/Tool", TOOL)
    closed(script, 1)
    closed(script, 2, sent_messages=3)
    assert peers_of(script) == {}


def test_no_ping_where_queries_of_the_status_are_denied() -> None:
    for config, due in ((Config(), True), (Config(deny_out=("GET_STATUS",)), False)):
        script = Script(config)
        script.up(1)
        script.igtl(PLUS)
        assert (script.gateway.due_ns is not None) is due
        assert bool(script.tick(60.0)) is due


def test_only_the_peers_that_are_due_are_pinged() -> None:
    script = Script()
    for link in (1, 2):
        script.up(link)
        script.igtl(PLUS, link)
    script.tick(0.3)
    script.now_ns += 200_000_000
    script.igtl(Message("GET_STATUS", "", Status(1)), link=2)  # answered, so that 2 is not silent
    assert script.tick(0.06) == ["igtl GET_STATUS/ v2 to 1"]


def test_a_late_joiner_is_not_sent_an_old_command() -> None:
    """A command is for the peers of its time, even where its topic is latched."""
    latched = Qos(depth=1, latched=True)
    script = Script(Config(to_igtl=(ToIgtlRow(topic="/command", type="COMMAND", qos=latched), ToIgtlRow())))
    script.up(1)
    order = Command(rosmsg.Header(), "Robot", 0, "Start", 3, "<Command/>")
    assert script.ros("/command", order) == ["igtl COMMAND/Robot v1 to 1"]
    assert script.up(2) == []


def test_a_defect_while_a_link_opens_is_no_lost_message(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script()

    def broken(*_: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(Peers, "up", broken)
    assert script.up(1) == ["note internal_error"]
    assert "received" not in str(script.gateway.ledger.to_dict())


KEPT = ToIgtlRow(topic="/plan", device="Plan", qos=Qos(depth=1, latched=True))
LATCHED = "igtl STRING/Plan v1 to 1"


def with_a_plan(*, live: bool = True) -> Script:
    config = Config(to_igtl=(KEPT,))
    script = Script(config.watched() if live else config)
    script.ros("/plan", rosmsg.String("a plan"))
    return script


def test_latched_messages_wait_for_the_answer_of_a_peer_that_asks() -> None:
    script = with_a_plan()
    script.ros("/igtl/out/Text", rosmsg.String("x"))
    assert script.up(1) == []
    asked = script.igtl(Message("GET_STRING", "Text", EmptyQuery()))
    assert [line for line in asked if line.startswith("igtl")] == ["igtl STRING/Text v1 to 1"]
    script.tick(0.5)
    asked = script.igtl(Message("GET_STRING", "Text", EmptyQuery()))
    assert [line for line in asked if line.startswith("igtl")] == ["igtl STRING/Text v1 to 1"], "it asks on"
    assert script.tick(1.9) == []
    assert script.tick(0.2) == [LATCHED]
    assert script.tick(5.0) == []


def test_a_peer_that_says_anything_else_gets_them_at_once() -> None:
    script = with_a_plan()
    script.up(1)
    assert script.igtl(Message("STATUS", "", Status(1)))[-1] == LATCHED
    assert script.tick(3.0) == [] and script.gateway.due_ns is None


def test_a_silent_peer_gets_them_after_a_moment() -> None:
    script = with_a_plan()
    script.up(1)
    assert script.tick(0.2) == []
    assert script.tick(0.1) == [LATCHED]


def test_a_peer_that_leaves_first_holds_back_nothing() -> None:
    script = with_a_plan()
    script.up(1)
    script.down(1)
    assert script.gateway.due_ns is None


def test_old_recordings_have_latched_messages_at_once() -> None:
    assert with_a_plan(live=False).up(1) == [LATCHED]


@pytest.mark.parametrize(
    "asked, answer",
    [
        (Message("GET_STATUS", "", EmptyQuery()), "igtl STATUS/ v1 to 1"),
        (Message("GET_CAPABIL", "", EmptyQuery()), "igtl CAPABILITY/ v1 to 1"),
        (Message("STT_TDATA", "", StartTracking(0, "")), "igtl RTS_TDATA/ v1 to 1"),
    ],
    ids=["GET_STATUS", "GET_CAPABIL", "STT_TDATA"],
)
def test_what_is_no_question_for_data_is_answered_first_too(asked: Message, answer: str) -> None:
    script = with_a_plan()
    script.up(1)
    assert [line for line in script.igtl(asked) if line.startswith("igtl")] == [answer, LATCHED]

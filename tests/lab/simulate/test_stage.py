"""The offline stage: tiny actors through the real gateway, with exact times."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import pytest

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.config.configuration import Config, PeerRow
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, LINKS_TOPIC, TICK
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import String as WireString
from igtl_gateway_lab.simulate.actor import (
    Actor,
    ActorProtocol,
    ActorReport,
    Publishes,
    Received,
    RosReceived,
    RosSent,
    Sent,
)
from igtl_gateway_lab.simulate.stage import IGTL_NS, ROS_NS, START_NS, play_offline
from tests.places import ROOT

OUT, IN, ASIDE = "/igtl/out/Robot/string", "/igtl/in/Planner/string", "/robot/internal"
Answer = Callable[[int, str], Iterable[str]]


class Teller:
    """Sends its lines, one every 10 ms, and keeps the received ones; ``answer`` gives its reply to each."""

    def __init__(
        self, name: str, side: ActorProtocol, lines: Iterable[str] = (), waits_for: int = 0, topic: str = OUT
    ) -> None:
        self.name, self.side = name, side
        self.subscribes = {IN: String.TYPE, ASIDE: String.TYPE} if side is ActorProtocol.ROS else {}
        self.publishes = {topic: Publishes(String.TYPE)} if side is ActorProtocol.ROS else {}
        self.answer: Answer = lambda _now_ns, _text: ()
        self.heard: list[tuple[int, str]] = []
        self.began_ns = self.due_at_ns = 0
        self._lines, self._waits_for, self._topic = list(lines), waits_for, topic

    def begin(self, now_ns: int) -> None:
        self.began_ns = self.due_at_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        return self.due_at_ns if self._lines else None

    def act(self, now_ns: int) -> Iterable[Sent]:
        self.due_at_ns = now_ns + 10 * NS_PER_MS
        return [self._say(self._lines.pop(0))]

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        if isinstance(heard, RosReceived):
            text = String.unpack(heard.cdr).data
        else:
            assert isinstance(heard.content, WireString)
            text = heard.content.text
        self.heard.append((now_ns, text))
        return [self._say(answer) for answer in self.answer(now_ns, text)]

    def _say(self, text: str) -> Sent:
        if self.side is ActorProtocol.ROS:
            return RosSent(self._topic, String(text))
        return Message("STRING", "Planner", WireString.of(text))

    @property
    def done(self) -> bool:
        return not self._lines and len(self.heard) >= self._waits_for

    def report(self) -> ActorReport:
        return ActorReport(self.done)


def pair() -> tuple[Teller, Teller]:
    """A planner that asks twice, and a robot that answers."""
    planner, robot = Teller("planner", ActorProtocol.IGTL, ["one", "two"], 2), Teller("robot", ActorProtocol.ROS, (), 2)
    robot.answer = lambda _now_ns, text: [text.upper()]
    return planner, robot


_CONFIG = Config()


def played(*actors: Actor, config: Config = _CONFIG, limit_s: float = 5.0) -> list[Entry]:
    return list(play_offline(actors, config, limit_s=limit_s))


def test_what_one_says_the_other_hears_after_its_way_through_the_gateway() -> None:
    planner, robot = pair()
    log = played(planner, robot)
    asked = [planner.began_ns, planner.began_ns + 10 * NS_PER_MS]
    # the output is the entry behind its cause, a nanosecond or two later
    assert [(round((at - IGTL_NS - ROS_NS) / 1000) * 1000, text) for at, text in robot.heard] == [
        (asked[0], "one"), (asked[1], "two"),
    ]  # fmt: skip
    assert [text for _, text in planner.heard] == ["ONE", "TWO"]
    assert all(
        abs(at - start - 2 * (IGTL_NS + ROS_NS)) < 100 for (at, _), start in zip(planner.heard, asked, strict=True)
    )
    sent = next(entry for entry in log if entry.kind is Kind.ROS_IN)
    assert sent.stamp_ns - sent.source_ns == ROS_NS


def test_the_session_is_a_real_one_links_first_and_last() -> None:
    log = played(*pair())
    assert [entry.seq for entry in log] == list(range(1, len(log) + 1))
    assert log[0].stamp_ns == START_NS
    assert Note.unpack(log[0].data()).code == "synthetic"
    inputs = [entry for entry in log if entry.kind.is_input]
    assert Note.unpack(inputs[1].data()).code == LINK_UP
    assert Note.unpack(inputs[-1].data()).code == LINK_DOWN
    report = verify(log, Config())
    assert report.good and report.outputs > 4


def test_equal_actors_give_equal_bytes() -> None:
    first, second = (
        [(e.seq, e.stamp_ns, e.kind, e.channel, e.links, e.source_ns, e.data()) for e in played(*pair())]
        for _ in range(2)
    )
    assert first == second


def test_ros_actors_hear_each_other_past_the_gateway() -> None:
    """Topics that the gateway does not use are not in the session; no actor receives its own messages."""
    camera = Teller("camera", ActorProtocol.ROS, ["frame"], topic=ASIDE)
    robot = Teller("robot", ActorProtocol.ROS, (), 1)
    log = played(camera, robot)
    assert robot.heard == [(camera.began_ns + ROS_NS, "frame")]
    assert camera.heard == []
    assert not [entry for entry in log if entry.channel == ASIDE]


def test_each_planner_has_a_link_of_its_own() -> None:
    one, other = Teller("one", ActorProtocol.IGTL, (), 1), Teller("other", ActorProtocol.IGTL, ["hello"], 1)
    robot = Teller("robot", ActorProtocol.ROS, ["to all"], 1)
    log = played(one, other, robot)
    assert [text for _, text in one.heard] == [text for _, text in other.heard] == ["to all"]
    assert [entry.links for entry in log if entry.kind is Kind.IGTL_IN] == [(2,)]
    assert [entry.links for entry in log if entry.kind is Kind.IGTL_OUT] == [(1, 2)]


def test_it_ends_when_nobody_would_act_again() -> None:
    planner = Teller("planner", ActorProtocol.IGTL, (), 1)
    log = played(planner)
    assert not planner.done
    assert log[-1].stamp_ns - START_NS < NS_PER_S


def test_it_ends_at_its_limit() -> None:
    """Two that never stop talking."""
    planner, robot = (
        Teller("planner", ActorProtocol.IGTL, ["ball"], 10**9),
        Teller("robot", ActorProtocol.ROS, (), 10**9),
    )
    planner.answer = robot.answer = lambda _now_ns, text: [text]
    log = played(planner, robot, limit_s=0.1)
    assert 10 < len(planner.heard) < 100
    assert log[-1].stamp_ns - START_NS < NS_PER_S // 5
    assert Note.unpack(next(e for e in reversed(log) if e.kind is Kind.LINK).data()).code == LINK_DOWN


def test_what_is_on_its_way_when_all_are_done_arrives() -> None:
    robot, planner = Teller("robot", ActorProtocol.ROS, ["last word"]), Teller("planner", ActorProtocol.IGTL)
    played(robot, planner)
    assert [text for _, text in planner.heard] == ["last word"]


class Pinged(Teller):
    """Receives messages of any type."""

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        self.heard.append((now_ns, heard.type))
        return ()


def test_the_gateway_gets_its_ticks() -> None:
    """A peer of the profile plus is pinged when it is silent."""
    config = replace(Config(), peers=(PeerRow("**", "plus"),))
    planner = Pinged("planner", ActorProtocol.IGTL, (), 1)
    log = played(planner, config=config, limit_s=20.0)
    ticks = [e for e in log if e.kind is Kind.EDGE_NOTE and Note.unpack(e.data()).code == TICK]
    assert ticks and planner.heard[0][1] == "GET_STATUS"


def test_a_topic_that_nobody_bridges_is_in_the_recording_where_the_actor_wants_it() -> None:
    robot = Teller("robot", ActorProtocol.ROS, ["calibration"], topic=ASIDE)
    assert [entry for entry in played(robot) if entry.kind is Kind.ROS_IN] == []
    robot = Teller("robot", ActorProtocol.ROS, ["calibration"], topic=ASIDE)
    robot.publishes = {ASIDE: Publishes(String.TYPE, recorded=True)}
    assert [entry.channel for entry in played(robot) if entry.kind is Kind.ROS_IN] == [ASIDE]


def test_a_topic_that_an_actor_did_not_name_is_refused() -> None:
    robot = Teller("robot", ActorProtocol.ROS, ["word"])
    robot.publishes = {"/other": Publishes(String.TYPE)}
    with pytest.raises(ValueError, match=r"robot: publishes on /igtl/out/Robot/string, expected one of /other"):
        played(robot)


def test_an_actor_that_never_lets_time_pass_is_named() -> None:
    class Stuck(Teller):
        def act(self, now_ns: int) -> Iterable[Sent]:
            return ()

    with pytest.raises(RuntimeError, match="stuck: due at"):
        played(Stuck("stuck", ActorProtocol.ROS, ["never sent"]))


def test_ros_hears_who_is_connected() -> None:
    planner, robot = pair()
    log = played(planner, robot)
    assert next(entry.kind for entry in log if entry.channel == LINKS_TOPIC) is Kind.ROS_OUT


def test_the_example_of_the_page_plays() -> None:
    page = (ROOT / "lab" / "README.md").read_text("utf-8")
    names: dict[str, Any] = {}
    exec(page.partition("```python\n")[2].partition("```")[0], names)
    cast = names["QUESTION"].cast()
    log = list(names["QUESTION"].entries(cast=cast))
    assert cast[0].report() == ActorReport(True, ("the robot reports: ready",))
    assert verify(log, Config()).good

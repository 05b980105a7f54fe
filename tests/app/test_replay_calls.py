"""Recorded services and actions in a replay, on an edge of lists: what is answered, called, reported and counted."""

from __future__ import annotations

import struct
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast
from unittest.mock import patch

import pytest

from igtl_gateway.app import replay_calls
from igtl_gateway.app.replay_account import CALLED
from igtl_gateway.app.replay_calls import AnsweredCalls, Calls, open_calls
from igtl_gateway.base.errors import RosError
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.exchanges import REQUEST_RECEIVED
from igtl_gateway.edges.ros.calls import Answer, Caller
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_calls import NO_CONTENTS, NO_GOALS
from tests import exchanges
from tests.calls import Goal, rows_of
from tests.exchanges import ACTION_TYPE, HEAD, MS, SERVICE, SERVICE_TYPE, event
from tests.tables import table

ON, ON_EVENTS = struct.pack("<?", True), f"{SERVICE}/_service_event"
ID = b"g" * 16
WAIT_S = 20.0


class FakeCaller(Caller):
    """A client whose server answers at once, or not."""

    def __init__(self, name: str, *, answers: bool, is_there: bool) -> None:
        self.name, self.sent, self.answered = name, 0, 0
        self._answers, self._is_there = answers, is_there

    @property
    def is_ready(self) -> bool:
        return self._is_there

    def call(self, event: bytes) -> None:
        if not self._is_there:
            raise RosError("no node offers the service")
        self.sent += 1
        self.answered += self._answers


class FakeEdge:
    """What a replay asks of the ROS edge, in lists."""

    def __init__(self, *, taken: str = "", answers: bool = True, is_there: bool = True, unknown: str = "") -> None:
        self.served: dict[str, tuple[str, Callable[[bytes, Answer], None]]] = {}
        self.published: list[tuple[str, bytes]] = []
        self.advertised: dict[str, Qos] = {}
        self.came = threading.Condition()
        self._taken, self._answers, self._is_there, self._unknown = taken, answers, is_there, unknown

    def serve_later(self, name: str, type_name: str, on_request: Callable[[bytes, Answer], None]) -> str:
        if name == self._taken:
            return "another node offers it"
        self.served[name] = type_name, on_request
        return ""

    def caller(self, name: str, event_type: str, _goals: object) -> Caller | str:
        if name == self._unknown:
            return f"unknown type, found {event_type}"
        return FakeCaller(name, answers=self._answers, is_there=self._is_there)

    def advertise(self, topic: str, _type: str, qos: Qos) -> None:
        self.advertised[topic] = qos

    def publish(self, topic: str, _type: str, data: bytes, _qos: Qos) -> str:
        self.take(topic.rpartition("/")[2], data)
        return ""

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        return condition()

    def take(self, what: str, data: bytes) -> None:
        with self.came:
            self.published.append((what, data))
            self.came.notify_all()

    def ask(self, name: str, request: bytes) -> None:
        self.served[name][1](request, lambda data: self.take(name.rpartition("/")[2], data))

    def until(self, what: str, count: int = 1) -> list[bytes]:
        """The messages of a kind, once there are as many."""
        with self.came:
            assert self.came.wait_for(lambda: self.count(what) >= count, WAIT_S), self.published
            return [data for each, data in self.published if each == what]

    def count(self, what: str) -> int:
        return sum(each == what for each, _ in self.published)


def begun(
    mode: str, path: Path, edge: FakeEdge, rate: float | None = None, rows: list[exchanges.Row] | None = None
) -> tuple[Calls, list[str], list[Entry]]:
    """What replays a recording, its lines of text, and the entries of the recording."""
    with SessionFile.open(exchanges.write(path, rows)) as file:
        topics = [channel.topic for channel in file.channels]
        calls = open_calls(mode, file, topics, cast(RosEdge, edge))
        entries = list(file.entries())
    assert calls
    said: list[str] = []
    calls.start(rate, said.append)
    return calls, said, entries


def ended(calls: Calls) -> dict[str, tuple[str, dict[str, int]]]:
    calls.finish(threading.Event())
    return {name: (each.text, each.left) for name, each in calls.counts().items()}


def test_requests_and_goals_are_answered(tmp_path: Path) -> None:
    edge = FakeEdge()
    calls, said, entries = begun("answer", tmp_path / "a.mcap", edge)
    assert said == ["answers as recorded: /arm/enable (3 answers), /fib (4 goals) (--services call sends them instead)"]
    assert edge.served.keys() == {
        SERVICE,
        *(f"/fib/_action/{part}" for part in ("send_goal", "cancel_goal", "get_result")),
    }
    assert {name: type_ for name, (type_, _) in edge.served.items()}[
        "/fib/_action/get_result"
    ] == f"{ACTION_TYPE}_GetResult"
    assert edge.advertised == {"/fib/_action/feedback": Qos(10), "/fib/_action/status": Qos(1, latched=True)}
    # what is published is as ever
    assert (calls.instead, list(calls.select(entries, Counter()))) == (frozenset(), entries)
    edge.ask(SERVICE, HEAD + ON)
    assert edge.until("enable") == [HEAD + struct.pack("<?3xI3s", True, 3, b"on\0")]
    edge.ask("/fib/_action/send_goal", HEAD + ID + struct.pack("<i", 9))
    edge.until("status", 2)
    edge.ask("/fib/_action/get_result", HEAD + ID)
    (result,) = edge.until("get_result")
    assert (result[4], edge.count("feedback"), edge.until("send_goal")[0][4]) == (6, 2, 1)
    assert ended(calls) == {SERVICE: ("1 request answered", {}), "/fib": ("1 goal answered", {})}


def test_what_is_not_recorded_is_counted(tmp_path: Path) -> None:
    edge = FakeEdge()
    calls, _, _ = begun("answer", tmp_path / "a.mcap", edge)
    for _ in range(3):  # the second one of these was never answered, and stands for those that follow
        edge.ask(SERVICE, HEAD + b"\0")
    edge.until("enable")
    edge.ask("/fib/_action/send_goal", HEAD + ID + struct.pack("<i", 42))
    assert edge.until("send_goal")[0][4] == 0
    edge.ask("/fib/_action/send_goal", HEAD + ID + struct.pack("<i", 7))
    edge.until("feedback", 2)
    assert ended(calls) == {
        SERVICE: ("1 request answered", {"requests that the recording has no answer to": 2}),
        "/fib": (
            "0 goals answered",
            {"goals that are not in the recording": 1, "goals that did not end before the replay": 1},
        ),
    }


def test_delays_are_recorded_ones_at_the_rate(tmp_path: Path) -> None:
    edge = FakeEdge()
    calls, _, _ = begun("answer", tmp_path / "a.mcap", edge, rate=2.0)
    assert isinstance(calls, AnsweredCalls)
    assert [calls._lasts(3), calls._lasts(2_000)] == [2, 1_000]
    edge.ask(SERVICE, HEAD + ON)
    assert ended(calls) == {SERVICE: ("1 request answered", {})}
    assert edge.count("enable") == 1  # the end has waited for it


def test_the_end_waits_for_some_seconds_only(tmp_path: Path) -> None:
    edge = FakeEdge()
    rows = list(rows_of("/drive", [Goal(bytes(16), 1, MS, 3_600 * 10**9)]))
    calls, _, _ = begun("answer", tmp_path / "a.mcap", edge, rate=1.0, rows=rows)
    edge.ask("/drive/_action/send_goal", HEAD + ID + struct.pack("<i", 1))
    edge.until("status", 2)
    assert ended(calls) == {"/drive": ("0 goals answered", {"goals that did not end before the replay": 1})}


def test_a_server_that_is_there_stays_the_only_one(tmp_path: Path) -> None:
    for taken, name in ((SERVICE, SERVICE), ("/fib/_action/send_goal", "/fib")):
        _, said, _ = begun("answer", tmp_path / "a.mcap", FakeEdge(taken=taken))
        assert said[1] == f"! {name} is not answered: another node offers it"
        assert name not in said[0]


def test_a_response_that_ros_refuses_is_counted(tmp_path: Path) -> None:
    edge = FakeEdge()
    calls, _, _ = begun("answer", tmp_path / "a.mcap", edge)

    def refuse(_data: bytes) -> None:
        raise ValueError("no such client")

    edge.served[SERVICE][1](HEAD + ON, refuse)
    assert ended(calls) == {SERVICE: ("0 requests answered", {"not sent: no such client": 1})}


@table(
    ("rows", "name", "why"),
    [
        ([(0, ON_EVENTS, f"{SERVICE_TYPE}_Event", event(REQUEST_RECEIVED, 0, 1))], SERVICE, NO_CONTENTS),
        (list(rows_of("/drive", [Goal(bytes(16), 3, MS, 9 * MS)], events=False)), "/drive", NO_GOALS),
    ],
)
def test_what_was_recorded_without_contents(rows: list[Any], name: str, why: str, tmp_path: Path) -> None:
    for mode, what in (("answer", "answered"), ("call", "called")):
        calls, said, _ = begun(mode, tmp_path / "a.mcap", FakeEdge(), rows=rows)
        assert (said, calls.instead) == ([f"! {name} is not {what}: {why}"], frozenset())  # so its topics are published


def test_requests_are_sent_at_their_times(tmp_path: Path) -> None:
    calls, said, entries = begun("call", tmp_path / "a.mcap", FakeEdge())
    assert said == ["calls as recorded: /arm/enable (4 requests), /fib (4 goals)"]
    assert calls.instead == {entry.channel for entry in entries}
    passed_over: Counter[str] = Counter()
    sent = list(calls.select(entries, passed_over))
    assert (len(sent), passed_over) == (13, {CALLED: len(entries) - 13})
    assert calls.wait_for_servers(0) and all(map(calls.send, sent))
    assert {name: text for name, (text, _) in ended(calls).items()} == {
        SERVICE: "4 responses",
        "/fib/_action/send_goal": "4 responses",
        "/fib/_action/get_result": "4 responses",
        "/fib/_action/cancel_goal": "1 response",
    }


def test_a_part_that_begins_within_goals_asks_nothing_about_them(tmp_path: Path) -> None:
    calls, _, entries = begun("call", tmp_path / "a.mcap", FakeEdge())
    sent = list(calls.select(entries[18:], Counter()))  # the first goal of four is before
    assert all(map(calls.send, sent))
    counts = ended(calls)
    assert counts["/fib/_action/get_result"] == ("3 responses", {"requests about goals that were not sent": 1})
    assert counts["/fib/_action/send_goal"] == ("3 responses", {})
    assert counts["/fib/_action/cancel_goal"] == ("1 response", {})


def test_servers_that_never_answer_and_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_calls, "_LINGER_S", 0.05)
    calls, _, entries = begun("call", tmp_path / "a.mcap", FakeEdge(answers=False))
    for entry in calls.select(entries, Counter()):
        calls.send(entry)
    assert ended(calls)[SERVICE] == ("0 responses", {"requests without a response": 4})
    calls, _, entries = begun("call", tmp_path / "a.mcap", FakeEdge(is_there=False))
    assert not calls.wait_for_servers(0.01)
    with pytest.raises(RosError, match="no node offers the service"):
        calls.send(next(iter(calls.select(entries, Counter()))))
    assert ended(calls) == {}


def test_a_service_whose_type_is_not_installed_is_published(tmp_path: Path) -> None:
    calls, said, _ = begun("call", tmp_path / "a.mcap", FakeEdge(unknown=SERVICE))
    assert said == [
        "calls as recorded: /fib (4 goals)",
        f"! /arm/enable is not called: unknown type, found {SERVICE_TYPE}_Event",
    ]
    assert ON_EVENTS not in calls.instead and "/fib/_action/status" in calls.instead


def test_topics_only_and_recordings_without_services(tmp_path: Path) -> None:
    with SessionFile.open(exchanges.write(tmp_path / "a.mcap")) as file:
        edge = cast(RosEdge, FakeEdge())
        assert open_calls("topics", file, [ON_EVENTS], edge) is None
        with patch.object(replay_calls, "recorded_calls", side_effect=AssertionError("it is not read")):
            assert open_calls("answer", file, ["/chatter"], edge) is None

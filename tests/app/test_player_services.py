"""The services of a player, answered without ROS; ``tests/integration/test_replay_ros.py`` calls them."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

from igtl_gateway.app.player import Player
from igtl_gateway.app.player_services import PlayerServices
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RosError
from igtl_gateway.gateway.log.entry import Entry, Kind

S = 1_000_000_000
ENTRIES = [Entry(n, n * S, Kind.ROS_OUT, "/a") for n in range(1, 5)]


def test_every_service_does_what_its_name_says() -> None:
    stop, sent = threading.Event(), list[int]()

    def send(entry: Entry) -> bool:
        sent.append(entry.seq)
        return True

    player = Player(
        lambda start: (entry for entry in ENTRIES if entry.stamp_ns >= (start or 0)),
        send,
        SystemClock(),
        stop,
        rate=None,
        paused=True,
        span=(S, 4 * S),
    )
    thread = threading.Thread(target=player.run)
    thread.start()
    services = PlayerServices(player)

    def call(name: str, **request: Any) -> SimpleNamespace:
        answer = getattr(services, name)(SimpleNamespace(**request), SimpleNamespace())
        assert isinstance(answer, SimpleNamespace)
        return answer

    def time(sec: int) -> SimpleNamespace:
        return SimpleNamespace(sec=sec, nanosec=0)

    try:
        assert call("is_paused").paused
        assert call("get_rate").rate == float("inf")
        assert call("set_rate", rate=0.001).success and not call("set_rate", rate=0.0).success
        assert call("get_rate").rate == 0.001
        assert call("play_next").success
        assert call("burst", num_messages=2).actually_burst == 2
        assert sent == [1, 2, 3]
        assert call("seek", time=time(2)).success and not call("seek", time=time(9)).success
        assert call("play_next").success
        assert sent == [1, 2, 3, 2]
        call("resume")
        assert not call("is_paused").paused
        assert not call("play_next").success
        assert call("burst", num_messages=1).actually_burst == 0
        call("pause")
        assert call("is_paused").paused
        call("toggle_paused")
        assert not call("is_paused").paused
    finally:
        stop.set()
        thread.join(30)
    assert not thread.is_alive()


def test_services_that_cannot_be_offered_are_told_with_the_reason() -> None:
    asked: list[tuple[str, str]] = []

    class Edge:
        def __init__(self, missing: str = "") -> None:
            self._missing = missing

        def message_class(self, _name: str) -> None:
            if self._missing:
                raise RosError(self._missing)

        def serve(self, name: str, type_name: str, _answer: Any) -> bool:
            asked.append((name, type_name))
            return len(asked) < 2

    services = PlayerServices(Player(lambda _: (), lambda _: True, SystemClock(), threading.Event()))
    assert services.serve(Edge("no compiler")) == "no compiler"  # type: ignore[arg-type]
    assert asked == []
    assert services.serve(Edge()) == "~/resume is refused"  # type: ignore[arg-type]
    assert asked == [("~/pause", "rosbag2_interfaces/srv/Pause"), ("~/resume", "rosbag2_interfaces/srv/Resume")]
    asked.clear()
    services.close()
    assert services.serve(Edge()) == "" and asked == [], "too late"  # type: ignore[arg-type]

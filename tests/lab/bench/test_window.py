"""How many messages may be on their way."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Gateway
from igtl_gateway_lab.bench.cases import PAYLOADS, BenchStream, Direction, payload
from igtl_gateway_lab.bench.window import SendWindow, progress, window


@pytest.mark.parametrize("direction", Direction)
def test_there_is_no_more_on_the_way_than_memory_for_it(direction: Direction) -> None:
    sizes = {kind: window(kind, direction) for kind in PAYLOADS}
    assert sizes["transform"] == 256
    assert all(size == 2 or (2 < size <= 256 and size * payload(kind).size <= 64 << 20) for kind, size in sizes.items())


def test_no_window_is_wider_than_the_queue_that_the_gateway_asks_for() -> None:
    way, gateway = Direction.ROS_TO_IGTL, Gateway(Config())
    for kind in PAYLOADS:
        qos = gateway.subscription(BenchStream(kind, 30.0).topic(way), payload(kind).ros_type)
        assert qos and window(kind, way) <= max(2, qos.depth)


def test_it_opens_as_messages_arrive() -> None:
    heard = progress()
    open_to = SendWindow(heard, 8, ManualClock())
    assert open_to.room(0) == 8
    assert open_to.room(8) == 0
    heard[0] = 1
    assert open_to.room(8) == 0  # one is not worth the while
    heard[0] = 6
    assert open_to.room(8) == 6


def test_what_is_lost_does_not_close_it_for_ever() -> None:
    clock = ManualClock()
    clock.advance(NS_PER_S)
    open_to = SendWindow(progress(), 8, clock)
    assert (open_to.room(0), open_to.room(8)) == (8, 0)
    clock.advance(3 * NS_PER_S)
    assert open_to.room(8) == 8


def test_both_programs_see_the_same_number(tmp_path: Path) -> None:
    path = str(tmp_path / "progress")
    one, other = progress(path), progress(path)
    one[0] = 12_345
    assert other[0] == 12_345

"""When the keeper looks at the graph: at changes, and hardly ever otherwise."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.edges.ros.graph_watch import BlindWatch, GraphWatch, watch_graph
from igtl_gateway.edges.ros.keeper import LookTimes
from igtl_gateway.edges.ros.middleware import import_rclpy
from tests.timing import WAIT_S, at_once

pytest.importorskip("rclpy", reason='needs ROS 2: pip install "igtl-gateway[ros]", or source an installation')


def test_a_change_is_looked_at_soon_and_once_more_when_it_has_settled() -> None:
    times = LookTimes(0, sees_changes=True)
    times.looked(NS_PER_S)
    times.changed(2 * NS_PER_S)
    assert times.look_ns == 2 * NS_PER_S + 10 * NS_PER_MS
    times.looked(times.look_ns)
    assert times.look_ns == 2 * NS_PER_S + 250 * NS_PER_MS
    times.looked(times.look_ns)
    assert times.look_ns > 7 * NS_PER_S, "nothing has changed since"


def test_a_graph_that_never_rests_is_looked_at_twenty_times_a_second() -> None:
    times = LookTimes(0, sees_changes=True)
    looks = 0
    for now_ns in range(0, NS_PER_S, NS_PER_MS):
        times.changed(now_ns)
        if now_ns >= times.look_ns:
            times.looked(now_ns)
            looks += 1
    assert 18 <= looks <= 21


def test_looks_at_a_large_graph_take_a_twentieth_of_the_time() -> None:
    times = LookTimes(0, sees_changes=True)
    times.looked(NS_PER_S)
    times.took(10 * NS_PER_MS)
    times.changed(NS_PER_S)
    assert times.look_ns == NS_PER_S + 190 * NS_PER_MS


def test_where_changes_are_not_seen_it_looks_four_times_a_second() -> None:
    times = LookTimes(0, sees_changes=False)
    times.looked(NS_PER_S)
    assert times.look_ns == NS_PER_S + 250 * NS_PER_MS


@pytest.fixture
def watched() -> Iterator[tuple[GraphWatch, object]]:
    """What waits for the graph of a node, and the node."""
    rclpy = import_rclpy()
    context = rclpy.context.Context()
    context.init(args=[])
    node = rclpy.node.Node("watched", context=context, enable_rosout=False)
    watch = watch_graph(rclpy, context, node)
    yield watch, node
    watch.close()
    node.destroy_node()
    context.try_shutdown()
    context.destroy()


def rest(watch: GraphWatch) -> None:
    """Wait until what the start of the node changes has been seen."""
    while watch.wait(500 * NS_PER_MS):
        pass


def test_a_new_publisher_ends_the_wait(watched: tuple[GraphWatch, object]) -> None:
    watch, node = watched
    assert watch.sees_changes
    rest(watch)
    from std_msgs.msg import String

    node.create_publisher(String, "/new", 1)  # type: ignore[attr-defined]
    with at_once():
        assert watch.wait(round(WAIT_S * NS_PER_S)), "of another node it is the same condition"


def test_a_wake_ends_the_wait_and_is_no_change(watched: tuple[GraphWatch, object]) -> None:
    watch, _ = watched
    rest(watch)
    watch.wake()
    with at_once():
        assert not watch.wait(round(WAIT_S * NS_PER_S))
    assert not watch.wait(0), "once only"
    watch.close()
    watch.wake()


def test_without_rcl_there_is_only_the_wake() -> None:
    watch = BlindWatch()
    watch.wake()
    with at_once():
        assert not watch.wait(round(WAIT_S * NS_PER_S))
    begun = time.monotonic()
    assert not watch.wait(50 * NS_PER_MS)
    assert time.monotonic() - begun >= 0.04

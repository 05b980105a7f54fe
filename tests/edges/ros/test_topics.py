"""What the ROS edge keeps of a topic: held messages, own messages, missing messages.  No ROS needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.interface import TopicCounts
from igtl_gateway.edges.ros import topics
from igtl_gateway.edges.ros.topics import BURST_MESSAGES, EchoFilter, TopicPublisher, TopicSubscription

QUICK_NS = 1000  # what a call of publish takes here


class Publisher:
    """Takes some time for each message, as DDS does, and stamps it in between."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.sent: list[bytes] = []
        self.stamps: list[int] = []

    def publish(self, msg: bytes, /) -> None:
        if msg == b"refused":
            raise RuntimeError("no\nmore than one line")
        self.clock.advance(QUICK_NS)
        self.stamps.append(self.clock.utc_ns())
        self.clock.advance(QUICK_NS)
        self.sent.append(msg)

    def get_subscription_count(self) -> int:
        return 0

    def wait_for_all_acked(self, _timeout: Any, /) -> bool:
        return True


def writer_and_publisher() -> tuple[TopicPublisher, Publisher, ManualClock]:
    clock = ManualClock(10**18)
    publisher = Publisher(clock)
    topic = TopicPublisher("/t", "std_msgs/msg/String", Qos(), TopicCounts())
    topic.made(publisher, deadline_ns=0, ready=False)
    return topic, publisher, clock


def test_held_messages_go_in_order_and_then_the_writer_is_ready() -> None:
    writer, publisher, clock = writer_and_publisher()
    for number in range(5):
        writer.hold(bytes([number]))
    assert writer.counts == TopicCounts(held=5)
    assert writer.release(clock, at_most=3) == ""
    assert (publisher.sent, writer.ready) == ([b"\0", b"\1", b"\2"], False)
    assert writer.counts == TopicCounts(held=2, published=3)
    writer.release(clock, at_most=3)
    assert (publisher.sent[3:], writer.ready) == ([b"\3", b"\4"], True)
    assert (writer.counts, writer.held_bytes) == (TopicCounts(published=5), 0)


def test_bursts_are_short_and_twice_what_has_come() -> None:
    writer, publisher, clock = writer_and_publisher()
    for _ in range(20):
        writer.hold(b"")
    writer.release_burst(clock)
    assert len(publisher.sent) == BURST_MESSAGES
    for _ in range(3):
        writer.hold(b"")
    writer.release_burst(clock)
    assert len(publisher.sent) == 2 * BURST_MESSAGES + 6


def test_refused_message_is_counted_and_told_in_one_line() -> None:
    writer, publisher, clock = writer_and_publisher()
    for cdr in (b"refused", b"good"):
        writer.hold(cdr)
    assert writer.release(clock, at_most=9) == "no"
    assert (publisher.sent, writer.counts) == ([b"good"], TopicCounts(published=1, failed=1))


def test_hold_is_bounded_by_messages_and_by_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(topics, "HOLD_MESSAGES", 3)
    monkeypatch.setattr(topics, "HOLD_BYTES", 100)
    for sizes, overflows in (([1] * 3, False), ([1] * 4, True), ([50, 50], False), ([50, 51], True), ([101], False)):
        writer, _, _ = writer_and_publisher()
        for size in sizes:
            writer.hold(bytes(size))
        assert writer.overflows is overflows, sizes


def test_echo_knows_own_messages_by_time_and_bytes() -> None:
    _, publisher, clock = writer_and_publisher()
    echo = EchoFilter()
    assert not echo.is_own(b"x", clock.utc_ns())
    for cdr in (b"first", b"second", b"second"):
        echo.publish(publisher, cdr, clock)
        clock.advance(10 * QUICK_NS)
    first, second, third = publisher.stamps
    for stamp in (0, first - 2 * QUICK_NS, first + 2 * QUICK_NS, third + 2 * QUICK_NS):
        assert not echo.is_own(b"first", stamp)
        assert not echo.is_own(b"second", stamp)
    assert not echo.is_own(b"second", first)
    assert echo.is_own(b"first", first)
    assert echo.is_own(b"second\0\0", second)  # padded
    assert echo.is_own(memoryview(b"second"), third)
    assert not echo.is_own(b"second", third)  # another publisher's, at the same moment


def test_echo_knows_own_messages_also_when_the_clock_was_set_back() -> None:
    _, publisher, clock = writer_and_publisher()
    echo = EchoFilter()
    for _ in range(20):
        echo.publish(publisher, b"before", clock)
    later = ManualClock(clock.utc_ns() - 3600 * 10**9)
    publisher.clock = later
    for _ in range(3):
        echo.publish(publisher, b"behind", later)
    *_, on_its_way, first, second, third = publisher.stamps
    assert [echo.is_own(b"behind", stamp) for stamp in (first, second, third, third)] == [True, True, True, False]
    assert echo.is_own(b"before", on_its_way) and not echo.is_own(b"behind", publisher.stamps[0])


def test_a_latched_publisher_knows_how_much_is_kept() -> None:
    _, middleware, clock = writer_and_publisher()
    publisher = TopicPublisher("/plan", "std_msgs/msg/String", Qos(depth=3, latched=True), TopicCounts())
    publisher.made(cast(Any, middleware), deadline_ns=0, ready=True)
    publisher.send(b"four", clock)
    publisher.measure()
    sent = [[10, 20], [30]]
    publisher.native = cast(Any, SimpleNamespace(take_sizes=lambda: sent.pop(0)))
    publisher.measure()
    assert list(publisher.kept) == [4, 10, 20]
    publisher.measure()
    assert list(publisher.kept) == [10, 20, 30]
    volatile = TopicPublisher("/pose", "std_msgs/msg/String", Qos(), TopicCounts())
    volatile.made(cast(Any, middleware), deadline_ns=0, ready=True)
    volatile.send(b"four", clock)
    assert not volatile.kept


def test_echo_knows_what_the_native_passage_has_sent() -> None:
    _, publisher, clock = writer_and_publisher()
    echo, begun_ns = EchoFilter(), clock.utc_ns()
    sent: Any = [(begun_ns, begun_ns + 5, b"native"), (begun_ns + 10, begun_ns + 15, b"later")]
    echo.add_native(cast(Any, SimpleNamespace(take_own=lambda: [sent.pop(0) for _ in list(sent)])))
    clock.advance(20)
    echo.publish(publisher, b"by Python", clock)
    assert not sent
    assert not echo.is_own(b"native", begun_ns + 10)
    assert echo.is_own(b"native, padded", begun_ns + 3)
    assert not echo.is_own(b"native", begun_ns + 3)
    sent.append((begun_ns + 10**6, begun_ns + 10**6 + 5, b"last"))
    assert echo.is_own(b"last", begun_ns + 10**6 + 5)
    assert echo.is_own(b"by Python", publisher.stamps[-1])


def test_echo_forgets_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(topics, "_ECHO_MEMORY", 2)
    _, publisher, clock = writer_and_publisher()
    echo = EchoFilter()
    for _ in range(5):
        echo.publish(publisher, b"x", clock)
    assert [echo.is_own(b"x", stamp) for stamp in publisher.stamps] == [False, False, True, True, True]


def counted(*events: int | str | None) -> TopicCounts:
    """Counts after sequence numbers, ``"+N"`` (N publishers matched) and ``"-N"`` (N reported lost)."""
    reader = TopicSubscription("/t", "std_msgs/msg/String", TopicCounts(), None)
    for event in events:
        if isinstance(event, str):
            (reader.matched if event[0] == "+" else reader.lost)(int(event[1:]))
        else:
            reader.received(event)
    return reader.counts


def test_gaps_in_the_numbers_of_a_single_publisher_are_losses() -> None:
    assert counted("+1", 7, 8, 9) == TopicCounts(received=3)
    assert counted("+1", 7, 10, 11, 13) == TopicCounts(received=4, lost=3)
    assert counted("+1", 7, "+0", "+1", 90, 91) == TopicCounts(received=3)
    assert counted("+1", 7, "+2", 90, 8, "+1", 9, 10) == TopicCounts(received=5)
    assert counted("+1", 7, "-2", 10) == TopicCounts(received=2, lost=2)


def test_gaps_before_the_publishers_are_known_count_if_it_was_one() -> None:
    assert counted(7, 10, "+1", 11, 13) == TopicCounts(received=4, lost=3)
    assert counted(7, 10, "+2", 11, 13) == TopicCounts(received=4)


def test_without_usable_numbers_only_reported_losses_count() -> None:
    assert counted("+2", 7, 100, 8, "-3") == TopicCounts(received=3, lost=3)
    assert counted("+1", None, None, 0, 0) == TopicCounts(received=4)

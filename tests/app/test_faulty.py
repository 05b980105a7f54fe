"""A feed with fault injection, and the connections that it closes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from igtl_gateway.app.faulty import DISCONNECT, FaultyFeed, all_with_disconnects, with_disconnects
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.config.faults import Fate, Faults
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String

T0_NS = 1_767_225_600_000_000_000
HELLO = join(encode(Message("STRING", "Greeting", String.of("hello"), 7 << 32)))


def recorded(count: int = 60) -> list[Entry]:
    """Every third for ROS, ten milliseconds apart."""
    kinds = (Kind.IGTL_OUT, Kind.IGTL_OUT, Kind.ROS_OUT)
    return [
        Entry(n + 1, T0_NS + n * 10 * NS_PER_MS, kinds[n % 3], "STRING/Greeting", "STRING", (HELLO,), (1,))
        for n in range(count)
    ]


def test_what_is_for_ros_passes_in_its_place() -> None:
    entries = list(FaultyFeed(Faults.parse("delay=15ms"), 0)(recorded(9)))
    assert [entry.seq for entry in entries] == [1, 3, 2, 4, 6, 5, 7, 9, 8]
    assert all(one.stamp_ns <= two.stamp_ns for one, two in pairwise(entries))
    assert [e.stamp_ns - T0_NS for e in entries if e.kind is Kind.ROS_OUT] == [
        20 * NS_PER_MS,
        50 * NS_PER_MS,
        80 * NS_PER_MS,
    ]


def test_every_pass_is_the_same_and_all_is_counted() -> None:
    told: list[Fate[Entry]] = []
    feed = FaultyFeed(Faults.parse("loss=10%,corrupt=20%,disconnect=10%"), 3, told.append)
    first = list(feed(recorded()))
    once = feed.counts.copy()
    assert list(feed(recorded())) == first
    assert {name: 2 * number for name, number in once.items()} == feed.counts
    assert once["messages"] == 40
    assert len(first) == 60 - once["loss"]
    assert sum(entry.links == DISCONNECT for entry in first) == once["disconnect"] > 0
    assert len(told) == 2 * len({fate.message.seq for fate in told})


def test_connections_end_behind_the_entries_that_say_so() -> None:
    course: list[object] = []
    entries = [Entry(n, T0_NS, Kind.IGTL_OUT, links=DISCONNECT if n in (2, 3) else (1,)) for n in range(1, 6)]

    def send(entry: Entry) -> bool:
        course.append(entry.seq)
        return True

    def send_all(several: Sequence[Entry]) -> bool:
        course.extend(entry.seq for entry in several)
        return several[0].seq != 3

    one_by_one = with_disconnects(send, lambda: course.append("cut"))
    assert all([one_by_one(entry) for entry in entries])
    assert course == [1, 2, "cut", 3, "cut", 4, 5]
    course.clear()
    assert not all_with_disconnects(send_all, lambda: course.append("cut"))(entries), "one entry was not received"
    assert course == [1, 2, "cut", 3, "cut", 4, 5]

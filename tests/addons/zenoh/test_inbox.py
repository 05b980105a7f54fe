"""The buffer between Zenoh and the hub: order, bounds, and counts that add up."""

from __future__ import annotations

import threading

from hypothesis import given, settings
from hypothesis import strategies as st

from igtl_gateway.addons.zenoh.inbox import Inbox, Waiting
from tests.timing import WAIT_S


class Reader:
    """Topics whose messages are delivered only after `release`."""

    def __init__(self, depths: list[int], most_bytes: int) -> None:
        self.got: list[tuple[int, int]] = []
        self.released = threading.Event()
        self.inbox = Inbox(most_bytes)
        self.topics = [Waiting(lambda payload, _ns: self._take(payload), depth) for depth in depths]
        self.most = most_bytes

    def _take(self, payload: tuple[int, int]) -> None:
        self.released.wait(WAIT_S)
        self.got.append(payload)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 4), min_size=1, max_size=3),
    st.lists(st.tuples(st.integers(0, 2), st.integers(1, 60)), max_size=40),
)
def test_each_topic_keeps_its_newest(depths: list[int], puts: list[tuple[int, int]]) -> None:
    reader = Reader(depths, 100)
    kept: list[list[int]] = [[] for _ in depths]
    puts = [(topic % len(depths), size) for topic, size in puts]
    for number, (topic, size) in enumerate(puts):  # before the thread runs: all wait
        reader.inbox.put(reader.topics[topic], (topic, number), size, 0)
        kept[topic].append(number)
        total = sum(puts[each][1] for numbers in kept for each in numbers)
        while len(kept[topic]) > depths[topic] or (total > 100 and len(kept[topic]) > 1):
            total -= puts[kept[topic].pop(0)][1]
        if total > 100 and total != size:  # the others leave no room
            kept[topic].pop()
    reader.released.set()
    reader.inbox.start()
    expected = sum(map(len, kept))
    ended = threading.Event()
    while len(reader.got) < expected:
        assert not ended.wait(0.001)
    reader.inbox.stop()
    assert [[number for topic, number in reader.got if topic == each] for each in range(len(depths))] == kept
    assert len(reader.got) + sum(topic.displaced for topic in reader.topics) == len(puts)
    reader.inbox.put(reader.topics[0], (0, 0), 1, 0)  # after the stop nothing is delivered
    assert len(reader.got) == expected


def test_messages_of_several_topics_come_in_order() -> None:
    reader = Reader([10, 10], 1 << 20)
    order = [(0, 1), (1, 2), (1, 3), (0, 4), (1, 5)]
    for topic, number in order:
        reader.inbox.put(reader.topics[topic], (topic, number), 1, 0)
    reader.released.set()
    reader.inbox.start()
    ended = threading.Event()
    while len(reader.got) < len(order):
        assert not ended.wait(0.001)
    reader.inbox.stop()
    assert reader.got == order


def test_what_waits_at_the_stop_counts_as_displaced() -> None:
    reader = Reader([10], 1 << 20)
    for number in range(5):
        reader.inbox.put(reader.topics[0], (0, number), 1, 0)
    reader.inbox.stop()
    assert (reader.got, reader.topics[0].displaced) == ([], 0)  # the thread never ran

    reader = Reader([10], 1 << 20)
    reader.inbox.start()
    for number in range(5):
        reader.inbox.put(reader.topics[0], (0, number), 1, 0)
    stopper = threading.Thread(target=reader.inbox.stop)
    stopper.start()
    threading.Event().wait(0.05)
    reader.released.set()
    stopper.join(WAIT_S)
    assert len(reader.got) + reader.topics[0].displaced == 5

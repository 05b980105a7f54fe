"""The lane for large messages: order, bound and end."""

from __future__ import annotations

import threading

from igtl_gateway.app.lane import LARGE_BYTES, Lane
from igtl_gateway.session.entry import Entry, Kind

TIMEOUT_S = 10.0
PICTURE = bytes(LARGE_BYTES)


def message(seq: int, payload: bytes, topic: str = "/camera") -> Entry:
    return Entry(seq, seq, Kind.ROS_OUT, topic, "sensor_msgs/msg/Image", (payload,))


def test_a_topic_of_large_messages_stays_and_others_never_come() -> None:
    lane = Lane(lambda entry: None)
    assert not lane.is_for(message(1, b"small"))
    assert lane.is_for(message(2, PICTURE))
    assert lane.is_for(message(3, b"small"))
    assert not lane.is_for(message(4, b"small", "/tf"))
    lane.stop()


def test_what_was_put_is_published_in_order_until_the_end() -> None:
    published: list[int] = []
    gate = threading.Event()

    def publish(entry: Entry) -> None:
        assert gate.wait(TIMEOUT_S)
        assert lane.inside()
        published.append(entry.seq)

    lane = Lane(publish)
    for seq in range(20):
        lane.put(message(seq, PICTURE))
    assert not lane.inside()
    gate.set()
    lane.stop()
    assert published == list(range(20))


def test_whoever_puts_more_than_may_wait_waits() -> None:
    begun, gate = threading.Event(), threading.Event()

    def publish(_entry: Entry) -> None:
        begun.set()
        assert gate.wait(TIMEOUT_S)

    lane = Lane(publish)
    large = message(1, bytes(64 * 2**20))
    lane.put(large)
    assert begun.wait(TIMEOUT_S)
    second = threading.Thread(target=lane.put, args=(large,))
    second.start()
    second.join(0.05)
    assert second.is_alive()
    gate.set()
    second.join(TIMEOUT_S)
    assert not second.is_alive()
    lane.stop()

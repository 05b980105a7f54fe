"""Messages with uint8[] over real DDS: who comes late gets the latched ones, who reads late gets the newest.

rmw_fastrtps before 9.4.9 lost such messages where others passed (``doctor/middleware.py``): so these are pictures,
volumes, clouds and arrays, from the edge to a foreign node and back.  The foreign node publishes typed messages and
takes serialised ones, by hand: nothing is taken before a test asks for it.  Fields are compared, and not the bytes of
a message: rclpy leaves what was there before between the fields.
"""

from __future__ import annotations

from array import array
from typing import Any

import pytest

from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.middleware import interface_class
from tests.edges.ros.test_edge import Heard, Peer, _own_graph, edge, heard, peer, wait_known  # noqa: F401 (fixtures)
from tests.tables import all_hold
from tests.timing import WAIT_S

pytest.importorskip("rclpy", reason='needs ROS 2: pip install "igtl-gateway[ros]", or source an installation')
from rclpy.serialization import deserialize_message, serialize_message

#: Type → its field of bytes.
TYPES = {
    "std_msgs/msg/UInt8MultiArray": "data",
    "sensor_msgs/msg/Image": "data",
    "sensor_msgs/msg/CompressedImage": "data",
    "sensor_msgs/msg/PointCloud2": "data",
    "igtl_msgs/msg/Volume": "data",
    "igtl_msgs/msg/VideoFrame": "data",
    "igtl_msgs/msg/ColorTable": "table",
    "igtl_msgs/msg/NdArray": "data",
    "igtl_msgs/msg/RawMessage": "data",
}
#: Fewer than are sent, and more than one.
DEPTH, SENT = 3, 8
LATCHED = Qos(depth=DEPTH, latched=True)
#: The second one is more than a datagram has.
SIZES = (300, 70_000)


def filled(kind: str, number: int, size: int) -> bytes:
    """The bytes of a message, which no other one has."""
    return bytes([(number * 37 + len(kind)) % 256]) * size


def newest(kind: str, size: int = SIZES[0]) -> list[bytes]:
    """The bytes of the last messages of those that are sent."""
    return [filled(kind, number, size) for number in range(SENT)][-DEPTH:]


def serialised(kind: str, number: int, size: int = SIZES[0]) -> bytes:
    message = interface_class(kind)()
    setattr(message, TYPES[kind], array("B", filled(kind, number, size)))
    data: bytes = serialize_message(message)
    return data


def content(kind: str, cdr: bytes) -> bytes:
    return bytes(getattr(deserialize_message(cdr, interface_class(kind)), TYPES[kind]))


def send(peer: Peer, topic: str, kind: str, size: int = SIZES[0]) -> None:  # noqa: F811
    for number in range(SENT):
        peer.publish(topic, {TYPES[kind]: list(filled(kind, number, size))})


def topic_of(test: str, kind: str) -> str:
    return f"/{test}/{kind.rpartition('/')[2].lower()}"


def taken(peer: Peer, topic: str, kind: str) -> list[bytes]:  # noqa: F811
    return [bytes(fields[TYPES[kind]]) for _, fields in peer.take(topic, DEPTH)]


def test_a_late_node_gets_the_latched_messages_of_the_edge(peer: Peer, edge: RosEdge) -> None:  # noqa: F811
    def has_the_newest(kind: str) -> None:
        topic = topic_of("late_node", kind)
        peer.subscribe(topic, kind, {"depth": SENT})  # without one the edge holds its first messages for a while
        wait_known(edge, topic)
        for number in range(SENT):
            edge.publish(topic, kind, serialised(kind, number), LATCHED)
        assert edge.wait_ready(WAIT_S)
        peer.drop(topic)
        peer.subscribe(topic, kind, {"depth": SENT, "latched": True})
        assert taken(peer, topic, kind) == newest(kind)

    all_hold(list(TYPES), has_the_newest)


def test_a_late_edge_gets_the_latched_messages_of_a_node(peer: Peer) -> None:  # noqa: F811
    topics = {kind: topic_of("late_edge", kind) for kind in TYPES}
    for kind, topic in topics.items():
        peer.publisher(topic, kind, {"depth": DEPTH, "latched": True})
        send(peer, topic, kind)
    late = Heard()
    late.wanted = dict.fromkeys(topics.values(), Qos(depth=SENT))
    edge = late.edge(node_name="late")  # noqa: F811
    edge.start()

    def has_the_newest(kind: str) -> None:
        assert late.until(lambda: late.count(topics[kind]) >= DEPTH)
        assert [content(kind, cdr) for cdr in late.of(topics[kind])] == newest(kind)

    try:
        all_hold(list(TYPES), has_the_newest)
    finally:
        edge.stop()


@pytest.mark.parametrize("size", SIZES)
def test_who_reads_late_gets_the_newest_of_a_burst(size: int, peer: Peer, edge: RosEdge) -> None:  # noqa: F811
    """The reader has waited twice, and taken nothing: it is ready both times (rmw_fastrtps#900)."""
    kind = "sensor_msgs/msg/Image"
    topics: dict[str, Any] = {topic: topic_of(f"burst_{topic}_{size}", kind) for topic in ("edge", "node")}
    for topic in topics.values():
        peer.subscribe(topic, kind, {"depth": DEPTH})
    peer.publisher(topics["node"], kind, {"depth": SENT})
    edge.advertise(topics["edge"], kind, Qos(depth=SENT))
    assert peer.readers(topics["node"], 1) and edge.wait_for_subscribers(topics["edge"], 1, WAIT_S)
    for number in range(SENT):
        edge.publish(topics["edge"], kind, serialised(kind, number, size), Qos(depth=SENT))
    send(peer, topics["node"], kind, size)
    assert edge.wait_acked(topics["edge"], WAIT_S) and peer.acked(topics["node"])
    for topic in topics.values():
        assert peer.ready(topic) and peer.ready(topic)
        assert taken(peer, topic, kind) == newest(kind, size)


def test_what_is_lost_below_the_edge_is_counted(peer: Peer, edge: RosEdge, heard: Heard) -> None:  # noqa: F811
    """Best effort drops images that the shared memory has no room for: the numbers of the others show how many.

    From the first one on that has come: a late joiner cannot know what was before.
    """
    topic, kind, large = "/below", "sensor_msgs/msg/CompressedImage", 40
    heard.wanted[topic] = Qos(depth=100)
    peer.publisher(topic, kind, {"depth": 100, "reliable": False})
    assert peer.readers(topic, 1) and heard.until(lambda: "ros_subscribed" in heard.codes(topic))

    def send_small() -> int:
        """Send small ones until one has come; return how many."""
        sent, before = 0, sum(len(cdr) < SIZES[0] for cdr in heard.of(topic))
        while sum(len(cdr) < SIZES[0] for cdr in heard.of(topic)) == before:
            peer.publish(topic, {"data": [7]})
            sent += 1
            with heard.changed:
                heard.changed.wait(0.2)
        return sent

    send_small()
    first = heard.count(topic)
    peer.publish_many(topic, {"data": [7] * 600_000}, "format", large)
    sent = large + send_small()
    edge.sync()
    counts = edge.counters()[topic]
    assert counts["received"] == heard.count(topic)
    assert counts["received"] - first + counts["lost"] == sent

"""Commands to robots over real DDS: written at once to who is there, or not at all."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.ros import graph, publishing
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.orders import Order
from tests.edges.ros.test_edge import STRING, Heard, Peer, carried, string_cdr, wait_known
from tests.timing import WAIT_S

pytest.importorskip("rclpy", reason='needs ROS 2: pip install "igtl-gateway[ros]", or source an installation')

AGE_NS = 500_000_000


@pytest.fixture(scope="module", autouse=True)
def _own_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        yield


@pytest.fixture(scope="module")
def peer(_own_graph: None) -> Iterator[Peer]:
    peer = Peer()
    yield peer
    assert peer.process.stdin
    peer.process.stdin.close()
    assert peer.process.wait(WAIT_S) == 0


@pytest.fixture(scope="module")
def heard() -> Heard:
    return Heard()


@pytest.fixture(scope="module")
def edge(peer: Peer, heard: Heard) -> Iterator[RosEdge]:
    edge = heard.edge()
    edge.start()
    yield edge
    edge.stop()


def order(topic: str, text: str, *, begins: bool = True) -> Order:
    """Return a command without limits of age and speed."""
    return Order(topic.removeprefix("/"), topic, STRING, string_cdr(text), Qos(1), begins=begins)


def code(edge: RosEdge, one: Order) -> str:
    refused = edge.write(one)
    return refused.code if refused else ""


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def expected(edge: RosEdge, topic: str) -> None:
    """Have the publisher of a topic made."""
    edge.expect_orders(topic, STRING, Qos(1), AGE_NS)
    assert edge._node.wait(lambda: edge._publishing._publishers[topic].is_made, WAIT_S)


def test_a_subscriber_that_never_matches_holds_no_command(peer: Peer, edge: RosEdge) -> None:
    """It asks for latched messages: other publishers wait 2 s for it, and send then what they held."""
    topic = "/PSM1/looked_at"
    peer.subscribe(topic, STRING, {"latched": True})
    expected(edge, topic)
    until(lambda: edge._graph.subscriptions_of(topic) == 1)
    assert code(edge, order(topic, "nobody")) == "command_unheard"
    peer.drop(topic)
    peer.subscribe(topic, STRING, {})
    until(lambda: code(edge, order(topic, "first")) == "")
    assert [cdr for cdr, _ in peer.take(topic, 1)] == [carried(string_cdr("first")).hex()]
    assert code(edge, order(topic, "second", begins=False)) == ""
    assert [cdr for cdr, _ in peer.take(topic, 1)] == [carried(string_cdr("second")).hex()]
    counts = edge.counters()[topic]
    assert (counts["published"], counts["held"], counts["failed"]) == (2, 0, 0)
    assert counts["unwritten"] >= 1


def test_what_nobody_heard_is_not_sent_later(peer: Peer, edge: RosEdge) -> None:
    """Not before the publisher is made either, and a stream does not go on for who comes then."""
    topic = "/PSM1/late"
    assert code(edge, order(topic, "no publisher")) == "command_unheard"
    expected(edge, topic)
    assert code(edge, order(topic, "no subscriber")) == "command_unheard"
    peer.subscribe(topic, STRING, {"depth": 100})
    until(lambda: edge.subscriber_count(topic) == 1)
    assert code(edge, order(topic, "goes on", begins=False)) == "command_newcomer"
    until(lambda: code(edge, order(topic, "begins")) == "")
    [[_, fields]] = peer.take(topic, 1)
    assert fields["data"] == "begins"
    assert code(edge, order(topic, "goes on", begins=False)) == ""


def test_who_leaves_and_comes_back_between_two_commands_is_new(peer: Peer, edge: RosEdge) -> None:
    topic = "/PSM1/returns"
    expected(edge, topic)
    peer.subscribe(topic, STRING, {})
    until(lambda: code(edge, order(topic, "first")) == "")
    peer.drop(topic)
    until(lambda: edge.subscriber_count(topic) == 0)
    peer.subscribe(topic, STRING, {})
    until(lambda: edge.subscriber_count(topic) == 1)
    assert code(edge, order(topic, "goes on", begins=False)) == "command_newcomer"
    assert code(edge, order(topic, "begins")) == ""


def test_our_own_subscription_is_no_robot(edge: RosEdge, heard: Heard) -> None:
    """As that of a recording of the topic."""
    topic = "/PSM1/own"
    expected(edge, topic)
    assert edge.subscribe(topic, STRING, Qos())
    publisher = edge._publishing._publishers[topic].publisher
    until(lambda: publisher.get_subscription_count() == 1)
    assert code(edge, order(topic, "x")) == "command_unheard"


def test_the_limits_apply_at_the_write(peer: Peer, edge: RosEdge) -> None:
    topic = "/PSM1/limits"
    expected(edge, topic)
    peer.subscribe(topic, STRING, {})
    until(lambda: code(edge, order(topic, "first")) == "")
    old = replace(order(topic, "old"), stamp_ns=time.time_ns() - AGE_NS, max_age_ns=AGE_NS)
    assert code(edge, old) == "command_late"
    assert code(edge, replace(order(topic, "fast"), needs_ns=3_600_000_000_000)) == "command_speed"
    [[_, fields]] = peer.take(topic, 1)
    assert fields["data"] == "first"


def test_the_middleware_passes_nothing_on_that_is_too_old(peer: Peer, edge: RosEdge) -> None:
    """Lifespan, and one message of history: what a reader that lags would get again."""
    expected(edge, topic := "/PSM1/lifespan")
    (info,) = edge._node.host.node.get_publishers_info_by_topic(topic)
    assert info.qos_profile.lifespan.nanoseconds == AGE_NS
    (made,) = [each for each in edge._node.handle.publishers if each.topic_name == topic]
    assert (made.qos_profile.depth if hasattr(made, "qos_profile") else 1) == 1


def test_a_reader_of_another_vendor_is_given_time(peer: Peer, edge: RosEdge, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ignores what comes before its own match, which it does not report: the stream begins after that."""
    monkeypatch.setattr(publishing, "FOREIGN_NS", 1 << 60)
    monkeypatch.setattr(graph, "FAST_DDS", (0x01, 0x10))  # Cyclone DDS: the peer is of another vendor than we
    expected(edge, topic := "/PSM1/foreign")
    peer.subscribe(topic, STRING, {})
    until(lambda: edge.subscriber_count(topic) == 1)
    refused = edge.write(order(topic, "x"))
    assert refused is not None and "not ready yet" in refused.text
    monkeypatch.setattr(publishing, "FOREIGN_NS", 0)
    assert code(edge, order(topic, "goes on", begins=False)) == "command_newcomer"
    assert code(edge, order(topic, "begins")) == ""


def test_other_messages_on_the_topic_of_a_robot_are_not_held_either(peer: Peer, edge: RosEdge) -> None:
    edge.expect_orders(topic := "/PSM1/others", STRING, Qos(1), 0)
    edge.publish(topic, STRING, string_cdr("at once or never"), Qos())
    assert edge.counters()[topic]["held"] == 0


def test_a_type_that_is_not_there_refuses_each_command(edge: RosEdge) -> None:
    topic = "/PSM1/no_type"
    one = replace(order(topic, "x"), type="no_package/msg/None")
    assert code(edge, one) == "command_unheard", "its publisher is being made"
    until(lambda: code(edge, one) == "command_failed")


def test_what_is_held_is_not_sent_when_it_is_too_old(
    peer: Peer, edge: RosEdge, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stream with a maximum age, whose publisher waits for its subscribers."""
    released = threading.Event()
    monkeypatch.setattr(publishing.Publishing, "_can_send", lambda *_: released.is_set())
    topic = "/aged/held"
    peer.subscribe(topic, STRING, {"depth": 20})
    wait_known(edge, topic)
    now_ns = time.time_ns()
    for text, until_ns in (("old", now_ns + 1), ("in time", now_ns + 3_600_000_000_000), ("without", 0)):
        edge.publish(topic, STRING, string_cdr(text), Qos(), until_ns)
    edge.publish(topic, STRING, string_cdr("old, too"), Qos(), now_ns + 1)
    assert edge.wait_for_subscribers(topic, 1, WAIT_S)
    released.set()
    assert [fields["data"] for _, fields in peer.take(topic, 2)] == ["in time", "without"]
    assert edge.wait_ready(WAIT_S)
    counts = edge.counters()[topic]
    assert (counts["published"], counts["unwritten"], counts["held"], counts["failed"]) == (2, 2, 0, 0)
    assert heard.until(lambda: "ros_held_old" in heard.codes(topic))

"""The edge on live routers, with plain sessions of Zenoh at the other end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zenoh

from igtl_gateway.addons.zenoh import names
from igtl_gateway.addons.zenoh.edge import ZenohEdge
from igtl_gateway.addons.zenoh.names import Kind, Node
from igtl_gateway.addons.zenoh.own_node import TypeHashes
from igtl_gateway.addons.zenoh.traffic import Traffic
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.orders import Order
from tests.addons.zenoh.routers import client, free_port, router
from tests.processes import TIMEOUT_S

HASH = TypeHashes().of(String.TYPE)
GID = bytes(range(16))
DOMAIN = 7
#: Attachment of a right message or call.
VALID = names.attachment(7, 1, GID)


class Side:
    """An edge, and what it has reported."""

    def __init__(
        self,
        port: int,
        topics: tuple[str, ...] = (),
        depth: int = 10,
        name: str = "igtl_gateway",
        scheme: str = "tcp",
        **more: Any,
    ) -> None:
        self.messages: list[tuple[str, str, bytes, int]] = []
        self.notes: list[Note] = []
        self.heard: list[str] = []
        self.changed = threading.Condition()
        self.edge = ZenohEdge(
            node_name=name,
            on_message=lambda *message: self._add(self.messages, message),
            wants=lambda topic, _type: Qos(depth) if topic in topics else None,
            on_note=lambda note: self._add(self.notes, note),
            on_listener=lambda topic: self._add(self.heard, topic),
            endpoint=f"{scheme}/127.0.0.1:{port}",
            **more,
        )

    def _add(self, to: list[Any], item: object) -> None:
        with self.changed:
            to.append(item)
            self.changed.notify_all()

    def wait(self, condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, timeout_s), (self.messages, self.notes, self.edge.counters())

    def wait_code(self, code: str) -> None:
        self.wait(lambda: code in self.codes())

    def codes(self) -> list[str]:
        return [note.code for note in self.notes]


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    monkeypatch.setattr("igtl_gateway.addons.zenoh.connection.ATTEMPT_MS", 300)
    return free_port()


@pytest.fixture
def sides() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def started(sides: ExitStack, *args: Any, **more: Any) -> Side:
    side = Side(*args, **more)
    sides.callback(side.edge.stop)
    side.edge.start()
    return side


def until(condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> None:
    """Wait for what nothing notifies of."""
    ends, clock = threading.Event(), SystemClock()
    started_ns = clock.monotonic_ns()
    while not condition():
        assert clock.monotonic_ns() - started_ns < timeout_s * NS_PER_S
        ends.wait(0.01)


def text(word: str) -> bytes:
    return String(word).pack()


def key(topic: str) -> str:
    return names.data_key(DOMAIN, topic, String.TYPE, HASH)


#: What plain sessions have declared: Zenoh undeclares what has no reference.
held: list[Any] = []


def token(session: Any, kind: Kind, topic: str, *, latched: bool = False, type_hash: str = HASH) -> Any:
    node, qos = Node(DOMAIN, str(session.info.zid()), 0, "plain"), Qos(latched=latched)
    held.append(session.liveliness().declare_token(node.entity_token(1, kind, topic, String.TYPE, type_hash, qos)))
    return held[-1]


def test_messages_pass_both_ways_with_stamp_number_and_gid(port: int, sides: ExitStack) -> None:
    with router(port), client(port) as plain:
        got: list[Any] = []
        held.append(plain.declare_subscriber(key("/out"), got.append))
        side = started(sides, port, ("/in",))
        assert side.edge.publish("/out", String.TYPE, text("one"), Qos(5)) == ""
        until(lambda: bool(got))
        assert got[0].payload.to_bytes() == text("one")
        tokens = [str(reply.ok.key_expr) for reply in plain.liveliness().get(f"{names.SPACE}/{DOMAIN}/**") if reply.ok]
        ours = next(each for each in tokens if names.read_token(each).topic == "/out")
        sequence, stamp_ns, gid = names.read_attachment(got[0].attachment.to_bytes())
        assert (sequence, gid) == (1, names.gid(ours))
        assert stamp_ns > 0
        assert names.read_token(ours).qos == Qos(5)
        assert {names.read_token(each).kind for each in tokens} >= {Kind.NODE, Kind.PUBLISHER}

        token(plain, Kind.PUBLISHER, "/in")
        side.wait(lambda: "ros_subscribed" in side.codes())
        put(plain, "/in", "two", 1, 123)
        side.wait(lambda: len(side.messages) == 1)
        assert side.messages == [("/in", String.TYPE, text("two"), 123)]
        assert [(each.topic, each.node, each.publishes) for each in side.edge.endpoints()] == [("/in", "/plain", True)]


def put(session: Any, topic: str, word: str, sequence: int, stamp_ns: int = 1, gid: bytes = GID) -> None:
    session.put(
        key(topic),
        text(word),
        attachment=names.attachment(sequence, stamp_ns, gid),
        congestion_control=zenoh.CongestionControl.BLOCK,  # by default, a busy router loses messages
    )


def test_a_late_joiner_gets_latched_messages_both_ways(port: int, sides: ExitStack) -> None:
    latched = Qos(2, latched=True)
    side = started(sides, port, ("/in",))  # before there is a router
    assert side.codes() == ["zenoh_no_router"]
    for word in ("a", "b", "c"):
        side.edge.publish("/out", String.TYPE, text(word), latched)
    with router(port), client(port) as plain:
        side.wait(lambda: "zenoh_connected" in side.codes())
        got: list[bytes] = []
        subscriber = zenoh.ext.declare_advanced_subscriber(
            plain,
            key("/out"),
            lambda sample: got.append(sample.payload.to_bytes()),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=2),
            subscriber_detection=True,
        )
        held.append(subscriber)
        until(lambda: len(got) > 1)
        assert got == [text("b"), text("c")]

        cache = zenoh.ext.CacheConfig(2)
        publisher = zenoh.ext.declare_advanced_publisher(plain, key("/in"), cache=cache, publisher_detection=True)
        for number, word in enumerate(("x", "y", "z"), 1):
            publisher.put(text(word), attachment=names.attachment(number, number, GID))
        token(plain, Kind.PUBLISHER, "/in", latched=True)
        side.wait(lambda: len(side.messages) > 1)
        assert [message[2] for message in side.messages] == [text("y"), text("z")]
    assert side.edge.counters()["/out"] == counts(published=2, unheard=1)


def counts(**values: int) -> dict[str, int]:
    names = ("received", "published", "held", "lost", "failed", "unheard", "over_budget", "unwritten", "forgotten")
    return dict.fromkeys(names, 0) | values


def test_latched_messages_of_all_topics_have_a_bound(port: int, sides: ExitStack) -> None:
    """Before there is a router, and in the caches of Zenoh."""
    latched, large = Qos(1, latched=True), "x" * 600_000
    side = started(sides, port, (), latched_mib=1)
    for topic in ("/a", "/b"):
        side.edge.publish(topic, String.TYPE, text(large), latched)
    side.wait(lambda: side.edge.counters()["/a"]["forgotten"] == 1)
    with router(port), client(port) as plain:
        side.wait(lambda: "zenoh_connected" in side.codes())
        side.edge.publish("/c", String.TYPE, text(large), latched)
        side.wait(lambda: side.edge.counters()["/b"]["forgotten"] == 1)
        got: list[bytes] = []
        for topic in ("/b", "/c"):
            subscriber = zenoh.ext.declare_advanced_subscriber(
                plain,
                key(topic),
                lambda sample: got.append(sample.payload.to_bytes()),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=2),
                subscriber_detection=True,
            )
            held.append(subscriber)
        until(lambda: len(got) > 0)
        side.wait(lambda: side.edge.has_subscriber("/b"))
        side.edge.publish("/b", String.TYPE, text("live"), latched)
        until(lambda: len(got) > 1)
        assert got == [text(large), text("live")]
    assert side.edge.counters()["/a"] == counts(unheard=1, forgotten=1)
    assert [note.code for note in side.notes if note.stream in ("/a", "/b")] == ["latched_forgotten"] * 2


def test_losses_and_foreign_messages_are_counted_and_noted(port: int, sides: ExitStack) -> None:
    with router(port), client(port) as plain:
        side = started(sides, port, ("/in",))
        token(plain, Kind.PUBLISHER, "/in")
        side.wait(lambda: "ros_subscribed" in side.codes())
        plain.put(key("/in"), text("no attachment"))
        plain.put(key("/in"), text("short"), attachment=b"12345")
        plain.delete(key("/in"))
        other = bytes(16)
        for sequence, gid in (
            (5, GID),
            (1, other),
            (6, GID),
            (9, GID),
            (2, other),
            (1 << 62, other),
            (1, GID),
            (2, GID),
        ):
            put(plain, "/in", "x", sequence, -5, gid)
        side.wait(lambda: "ros_lost" in side.codes() and "ros_bad_attachment" in side.codes())
        until(lambda: side.edge.counters()["/in"]["received"] == 8)  # some come after the note of the loss
        assert side.edge.counters()["/in"] == counts(received=8, lost=2, failed=2)
        assert {message[3] for message in side.messages} == {0}  # a time before 1970


def test_the_graph_of_strangers_does_no_harm(port: int, sides: ExitStack) -> None:
    with router(port), client(port) as plain:
        side = started(sides, port, ("/in", "/secret"))
        for bad in (
            "x",
            "7",
            "0/zz/1/1/NN/%/%/n",
            f"0/{plain.info.zid()}/0/1/MP/%/%/n/%in/a::msg::dds_::B_/none/::,:,:,:,,",
        ):
            held.append(plain.liveliness().declare_token(f"{names.SPACE}/{DOMAIN}/{bad}"))
        token(plain, Kind.PUBLISHER, "/in", type_hash="RIHS01_" + 64 * "a")
        side.wait(lambda: {"ros_bad_token", "ros_type_hash"} <= {*side.codes()})
        node = Node(DOMAIN, str(plain.info.zid()), 0, "plain")
        unknown = node.entity_token(9, Kind.PUBLISHER, "/secret", "lab_msgs/msg/Secret", HASH, Qos())
        held.append(plain.liveliness().declare_token(unknown))
        side.wait(lambda: "ros_unknown_type" in side.codes())
        assert side.edge.subscriptions() == [("/in", String.TYPE)]


def test_subscribers_are_known_and_reported(port: int, sides: ExitStack) -> None:
    with router(port), client(port) as plain:
        side = started(sides, port)
        side.edge.advertise("/out", String.TYPE, Qos(5))
        until(lambda: not side.edge.has_subscriber("/out"))  # at first it might have one
        assert side.edge.count_if_unsubscribed("/out")
        subscriber = plain.declare_subscriber(key("/out"), lambda _sample: None)
        side.wait(lambda: side.heard == ["/out"])
        assert side.edge.has_subscriber("/out")
        assert not side.edge.count_if_unsubscribed("/out")
        mine = token(plain, Kind.SUBSCRIPTION, "/out")
        assert side.edge.wait_for_subscribers("/out", 1, 5)
        mine.undeclare()
        subscriber.undeclare()
        assert side.edge.counters()["/out"] == counts(unheard=1)


def test_a_router_that_restarts_is_found_again(port: int, sides: ExitStack) -> None:
    with router(port):
        one, two = started(sides, port, name="one"), started(sides, port, ("/out",), name="two")
        one.edge.advertise("/out", String.TYPE, Qos(5))
        one.wait(lambda: "/out" in one.heard)
        one.edge.publish("/out", String.TYPE, text("before"), Qos(5))
        two.wait(lambda: len(two.messages) == 1)
    one.wait(lambda: "zenoh_lost" in one.codes())
    assert one.edge.publish("/out", String.TYPE, text("lost"), Qos(5)) == ""
    with router(port):
        one.wait(lambda: one.codes().count("zenoh_connected") == 2)
        two.wait(lambda: two.codes().count("zenoh_connected") == 2)
        until(lambda: one.edge.subscriber_count("/out") == 1 and one.edge.has_subscriber("/out"))
        one.edge.publish("/out", String.TYPE, text("after"), Qos(5))
        two.wait(lambda: len(two.messages) == 2)
    assert [message[2] for message in two.messages] == [text("before"), text("after")]
    two.wait(lambda: "ros_lost" in two.codes())
    assert two.edge.counters()["/out"] == counts(received=2, lost=1)


@pytest.mark.parametrize(
    ("name", "value", "place"),
    [
        ("ZENOH_SESSION_CONFIG_URI", "/nonexistent.json5", "ZENOH_SESSION_CONFIG_URI"),
        ("ZENOH_SESSION_CONFIG_URI", "/dev/zero", "a device, expected a file"),
        ("ZENOH_CONFIG_OVERRIDE", "connect/endpoints=[" + ",".join(["'tcp/a:1'"] * 300) + "]", "300 endpoints"),
        ("ZENOH_CONFIG_OVERRIDE", "mode", "key/path=value"),
        ("ZENOH_CONFIG_OVERRIDE", "nonsense/x=1", "nonsense/x"),
        ("ZENOH_CONFIG_OVERRIDE", 'transport/link/tls/connect_certificate="/nonexistent.pem"', "connect_certificate"),
        ("ROS_DOMAIN_ID", "-1", "ROS_DOMAIN_ID"),
    ],
)
def test_a_wrong_environment_is_one_line(
    name: str, value: str, place: str, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match=place) as error:
        Side(port).edge.start()
    assert "\n" not in str(error.value)


def test_a_command_to_a_robot_is_sent_at_once_or_never(port: int, sides: ExitStack) -> None:
    """Neither held, nor by the thread that waits for the line, whatever the classes of the site are."""
    traffic = Traffic(("/PSM1/*=commands",), 1)
    side = started(sides, port, (), site="here", traffic=traffic)

    def code(word: str, *, begins: bool = True) -> str:
        order = Order("PSM1/do", "/PSM1/do", String.TYPE, text(word), Qos(1), begins=begins)
        refused = side.edge.write(order)
        return refused.code if refused else ""

    assert code("no router") == "command_unheard"
    with router(port), client(port) as plain:
        side.wait(lambda: "zenoh_connected" in side.codes())
        assert code("no subscriber") == "command_unheard"
        got: list[bytes] = []
        held.append(plain.declare_subscriber(key("/PSM1/do"), lambda sample: got.append(sample.payload.to_bytes())))
        until(lambda: side.edge.has_subscriber("/PSM1/do"))
        until(lambda: code("goes on", begins=False) == "command_newcomer")
        assert code("begins") == ""
        token(plain, Kind.SUBSCRIPTION, "/PSM1/do")  # another one
        until(lambda: code("goes on for a newcomer", begins=False) == "command_newcomer")
        assert code("begins again") == ""
        until(lambda: got[-1:] == [text("begins again")])
        assert got[0] == text("begins")
        assert text("no router") not in got and text("no subscriber") not in got
    until(lambda: code("the router is gone") == "command_unheard")
    assert side.edge.counters()["/PSM1/do"]["over_budget"] == 0

"""Middlewares whose subscribers and stamps are known, on manual time: what the publishing edges write, and who gets it.

A ``Wire`` stands for the middleware of one session.  The publishing half of the edge over DDS, or of the one over
Zenoh, is the real one; below it there is no network.  A reader is matched by the writer at one time and matches the
writer at another, may be incompatible, of another vendor, lossy, may leave and come back.  As in DDS, a reader that
lags gets from a reliable writer what its history has, within the lifespan; one of another vendor gets nothing that was
written before its own match.
"""

from __future__ import annotations

import heapq
import random
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest import mock

from igtl_gateway.addons.zenoh import publishing as zenoh_publishing
from igtl_gateway.addons.zenoh.traffic import Traffic
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.edges.interface import Publishers, Reports
from igtl_gateway.edges.ros import distributions as of_distribution
from igtl_gateway.edges.ros import publishing as dds_publishing
from igtl_gateway.edges.ros.topics import TopicPublisher, Topics
from igtl_gateway.gateway.log.note import Note

_KEEPER_NS = 10 * NS_PER_MS
NEVER_NS = 1 << 62
#: Topics of robots.
ROBOTS = "/PSM"


@dataclass
class Got:
    """A message that reached a reader: its source stamp, when it came (both UTC ns), and its bytes."""

    stamp_ns: int
    at_ns: int
    cdr: bytes


@dataclass
class Reader:
    """A subscriber of a topic; times are UTC ns.

    Attributes:
        known_ns: the graph shows it.
        writer_ns, reader_ns: the writer has matched it, it has matched the writer.
        left_ns: it is gone.
        fits: its QoS is compatible; if not, it is known and never matched.
        foreign: of another vendor.
        deaf: times from and to which nothing reaches it.
        got: what reached it.
    """

    topic: str
    known_ns: int
    writer_ns: int
    reader_ns: int
    left_ns: int = NEVER_NS
    fits: bool = True
    foreign: bool = False
    deaf: tuple[int, int] = (0, 0)
    got: list[Got] = field(default_factory=list)

    def is_matched(self, now_ns: int) -> bool:
        """Return whether the writer sends to it."""
        return self.fits and self.writer_ns <= now_ns < self.left_ns

    def hears(self, now_ns: int) -> bool:
        """Return whether a message that is written now reaches it at once."""
        deaf = self.deaf[0] <= now_ns < self.deaf[1]
        return self.is_matched(now_ns) and self.reader_ns <= now_ns and not deaf


class Wire:
    """The middleware of a world.

    Attributes:
        readers: all of them.
        written: topic, stamp and bytes of each message that the edge wrote.
    """

    def __init__(self, clock: ManualClock, rng: random.Random, stalls: float) -> None:
        self.clock, self.readers = clock, list[Reader]()
        self.written: list[tuple[str, int, bytes]] = []
        self._rng, self._stalls = rng, stalls
        self._planned: list[tuple[int, int, Callable[[], object]]] = []
        self._count = 0

    def plan(self, at_ns: int, action: Callable[[], object]) -> None:
        """Let something happen at a time, or at once if it is over."""
        self._count += 1
        heapq.heappush(self._planned, (at_ns, self._count, action))

    def run(self, until_ns: int = NEVER_NS) -> None:
        """Let happen what is planned."""
        while self._planned and self._planned[0][0] <= until_ns:
            at_ns, _, action = heapq.heappop(self._planned)
            self.clock.set(max(at_ns, self.clock.utc_ns()))
            action()

    def matched(self, topic: str) -> list[Reader]:
        """Return the readers that a writer of a topic has matched now."""
        now_ns = self.clock.utc_ns()
        return [each for each in self.readers if each.topic == topic and each.is_matched(now_ns)]

    def stand_still(self) -> None:
        """Now and then the process gets no time before a write, or the writer waits after the stamp."""
        if self._rng.random() < self._stalls:
            self.clock.advance(self._rng.randint(1, 700) * NS_PER_MS)

    def write(self, topic: str, cdr: bytes, history: deque[tuple[int, bytes]], lifespan_ns: int, reliable: bool) -> int:
        """Take a message of a writer; return its source stamp."""
        is_robot = topic.startswith(ROBOTS)  # only there, so that a recording changes no time
        if is_robot:
            self.clock.advance(self._rng.randint(2_000, 40_000))
        stamp_ns = self.clock.utc_ns()
        self.written.append((topic, stamp_ns, cdr))
        history.append((stamp_ns, cdr))
        for reader in self.matched(topic):
            if reader.hears(stamp_ns):
                reader.got.append(Got(stamp_ns, stamp_ns, cdr))
            elif reliable and not (reader.foreign and stamp_ns < reader.reader_ns):
                deaf_ns = reader.deaf[1] if reader.deaf[0] <= stamp_ns < reader.deaf[1] else 0
                at_ns = max(reader.reader_ns, deaf_ns)
                self.plan(at_ns, partial(self._repeat, reader, at_ns, history, lifespan_ns))
        if is_robot:
            self.stand_still()
            self.clock.advance(self._rng.randint(2_000, 40_000))
        return stamp_ns

    @staticmethod
    def _repeat(reader: Reader, at_ns: int, history: deque[tuple[int, bytes]], lifespan_ns: int) -> None:
        """A reader that receives again gets what the history of the writer has."""
        last_ns = reader.got[-1].stamp_ns if reader.got else 0
        for stamp_ns, cdr in history:
            expired = lifespan_ns and at_ns > stamp_ns + lifespan_ns
            if last_ns < stamp_ns <= at_ns < reader.left_ns and stamp_ns >= reader.writer_ns and not expired:
                reader.got.append(Got(stamp_ns, at_ns, cdr))


class Side:
    """The publishing half of an edge over a `Wire`, with what the application needs of a side.

    Args:
        publishing: of DDS or Zenoh.
        notes: takes the notes of the edge.
    """

    full_name = "/igtl_gateway"

    def __init__(self, publishing: Publishers[Any], stop: Callable[[], None]) -> None:
        self.publishing = publishing
        self.publish, self.write = publishing.publish, publishing.write
        self.has_subscriber = publishing.has_subscriber
        self.count_if_unsubscribed = publishing.count_if_unsubscribed
        self.expect_orders, self.advertise = publishing.expect_orders, publishing.advertise
        self.stop = stop
        self.log: Callable[..., None] = lambda *_: None

    def start(self) -> None:
        """There is no thread to start."""


# -- DDS --------------------------------------------------------------------------------------------------------------


class DdsWriter:
    """A publisher of rclpy, as far as the edge uses it."""

    event_handlers: tuple[()] = ()

    def __init__(self, wire: Wire, topic: str, profile: Any) -> None:
        self._wire, self._topic = wire, topic
        qos, self._lifespan_ns = profile
        self._reliable = qos.reliable
        self._history: deque[tuple[int, bytes]] = deque(maxlen=qos.depth)
        self._seen: set[int] = set()

    def publish(self, cdr: bytes) -> None:
        self._wire.write(self._topic, cdr, self._history, self._lifespan_ns, self._reliable)

    def get_subscription_count(self) -> int:
        if self._topic.startswith(ROBOTS):
            self._wire.stand_still()
        return len(self._wire.matched(self._topic))

    def wait_for_all_acked(self, _timeout: Any) -> bool:
        return True

    def came(self) -> int:
        """Return how many more have ever been matched than at the last call."""
        now_ns = self._wire.clock.utc_ns()
        ever = {
            number
            for number, each in enumerate(self._wire.readers)
            if each.topic == self._topic and each.fits and each.writer_ns <= now_ns
        }
        new, self._seen = ever - self._seen, ever
        return len(new)


class _Graph:
    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def _known(self, topic: str) -> list[Reader]:
        now_ns = self._wire.clock.utc_ns()
        return [each for each in self._wire.readers if each.topic == topic and each.known_ns <= now_ns < each.left_ns]

    def subscriptions_of(self, topic: str) -> int:
        return len(self._known(topic))

    def has_foreign_subscription(self, topic: str) -> bool:
        return any(each.foreign for each in self._known(topic))

    def readers_of(self, topic: str, _offered: Qos) -> set[int]:
        return {id(each) for each in self._known(topic) if each.fits}


class _DdsPublishing(dds_publishing.Publishing):
    """Makes its publishers at a manual time instead of in a thread."""

    def __init__(self, wire: Wire, rng: random.Random, node: Any, reports: Reports) -> None:
        graph: Any = _Graph(wire)
        super().__init__(node, Topics(), graph, reports, None, 1 << 20)
        self._wire, self._seed, self._making = wire, rng.random(), set[str]()

    def _first(self, topic: str, type_name: str, qos: Qos) -> TopicPublisher | None:
        publisher = Publishers.advertise(self, topic, type_name, qos)
        if publisher and not publisher.is_made and topic not in self._making:
            self._making.add(topic)
            takes_ms = random.Random(f"{self._seed} {topic}").choice((1, 5, 60, 900))
            at_ns = self._clock.utc_ns() + takes_ms * NS_PER_MS
            self._wire.plan(at_ns, lambda: self._complete(topic, publisher))
        return publisher


def dds(wire: Wire, rng: random.Random, on_note: Callable[[Note], None], *, counts_events: bool = True) -> Side:
    """Return the edge over DDS; ``counts_events``: this rclpy reports matches."""
    names = SimpleNamespace(full=str, asked=str, in_graph=str)
    node = SimpleNamespace(
        clock=wire.clock,
        lock=threading.RLock(),
        is_running=True,
        handle=None,
        names=names,
        started_ns=wire.clock.monotonic_ns() - rng.choice((0, 2, 30)) * 1_000_000_000,
        graph=SimpleNamespace(wake=lambda: None),
        stopping=threading.Event(),
        rclpy=SimpleNamespace(duration=SimpleNamespace(Duration=lambda **_: None), wire=wire, events=counts_events),
    )
    publishing = _DdsPublishing(wire, rng, node, Reports(on_note))

    def keep() -> None:
        if node.is_running:
            publishing.send_held()
            wire.plan(wire.clock.utc_ns() + _KEEPER_NS, keep)

    def stop() -> None:
        node.is_running = False
        publishing.close()

    keep()
    return Side(publishing, stop)


def simulated() -> ExitStack:
    """Return a context in which the edge over DDS makes its publishers on the `Wire` of its node."""

    def create(rclpy: Any, _node: Any, _class: Any, topic: str, profile: Any, **_: Any) -> DdsWriter:
        return DdsWriter(rclpy.wire, topic, profile)

    stack = ExitStack()
    stack.enter_context(mock.patch.object(of_distribution, "create_publisher", create))
    stack.enter_context(
        mock.patch.object(
            of_distribution, "match_events", lambda rclpy, made, _group: made.came if rclpy.events else None
        )
    )
    stack.enter_context(mock.patch.object(dds_publishing, "interface_class", lambda _name: None))
    stack.enter_context(
        mock.patch.object(dds_publishing, "profile_of", lambda _rclpy, qos, lifespan_ns=None: (qos, lifespan_ns or 0))
    )
    return stack


# -- Zenoh ------------------------------------------------------------------------------------------------------------


class _ZenohSession:
    """A session of Zenoh: its publishers route at once, and keep nothing."""

    def __init__(self, wire: Wire, topics: dict[str, str]) -> None:
        self._wire, self._topics = wire, topics
        self.info = SimpleNamespace(zid=lambda: "ab")

    def declare_publisher(self, key: str, **_: Any) -> Any:
        return _ZenohWriter(self._wire, self._topics[key])

    def liveliness(self) -> Any:
        return SimpleNamespace(declare_token=lambda token: token)


class _ZenohWriter:
    def __init__(self, wire: Wire, topic: str) -> None:
        self._wire, self._topic = wire, topic

    @property
    def matching_status(self) -> Any:
        return SimpleNamespace(matching=bool(self._wire.matched(self._topic)))

    def declare_matching_listener(self, called: Callable[[Any], None]) -> Any:
        for reader in self._wire.readers:
            if reader.topic == self._topic and reader.fits:
                for at_ns in (reader.writer_ns, reader.left_ns):
                    if self._wire.clock.utc_ns() < at_ns < NEVER_NS:
                        self._wire.plan(at_ns, lambda: called(None))
        return called

    def put(self, cdr: bytes, attachment: bytes) -> None:
        assert attachment
        self._wire.write(self._topic, cdr, deque(maxlen=1), 0, reliable=False)


def zenoh(wire: Wire, rng: random.Random, on_note: Callable[[Note], None]) -> Side:
    """Return the edge over Zenoh; readers join it when they are known."""
    topics: dict[str, str] = {}
    session = _ZenohSession(wire, topics)
    enums = SimpleNamespace(
        RELIABLE=0, BEST_EFFORT=0, DROP=0, BLOCK=0, REMOTE=0, REAL_TIME=0, INTERACTIVE_HIGH=0, DATA=0
    )
    module = SimpleNamespace(Reliability=enums, CongestionControl=enums, Locality=enums, Priority=enums)
    connection = SimpleNamespace(
        lock=threading.RLock(), is_open=True, zenoh=module, declare=lambda declare: declare(session)
    )
    entity = SimpleNamespace(entity_token=lambda number, *_: f"token{number}")

    def key(topic: str, _type: str) -> tuple[str, str]:
        topics[topic] = topic
        return topic, "hash"

    node: Any = SimpleNamespace(connection=connection, key=key, next=lambda _session: (entity, len(topics)))
    traffic = Traffic(("/PSM1/servo_cp=commands",), 1_000) if rng.random() < 0.5 else None
    publishing = zenoh_publishing.Publishing(node, Reports(on_note), wire.clock, lambda _topic: None, traffic, 1 << 20)

    def joins() -> None:
        for reader in wire.readers:
            if reader.fits:
                at_ns = max(reader.writer_ns + rng.choice((-30, 0, 5)) * NS_PER_MS, wire.clock.utc_ns())
                wire.plan(at_ns, partial(publishing.joined, reader.topic))

    wire.plan(wire.clock.utc_ns(), joins)
    return Side(publishing, publishing.close)

"""The state of one topic at the ROS edge: messages held for subscribers, our own that come back, and losses.

Nothing here needs rclpy: publishers are anything with ``publish(bytes)``, times are arguments or a clock.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import first_line
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text
from igtl_gateway.edges.interface import TopicCounts
from igtl_gateway.edges.ros.direct import RclPublisher, refusing_publisher
from igtl_gateway.native.passage import Publisher as NativePublisher
from igtl_gateway.native.passage import Subscription as NativeSubscription

#: Messages held for one topic until its subscribers are matched: 2 s of a 1 kHz stream.
HOLD_MESSAGES = 2000
#: Bytes held for one topic: ten Full HD RGB images.
HOLD_BYTES = 64 << 20
#: Bytes held for all topics together, beside what comes within a turn of the keeper.
HOLD_ALL_BYTES = 4 * HOLD_BYTES
#: Held messages that are sent at once, beside those that come meanwhile: half of the depth that readers usually have.
BURST_MESSAGES = 5

_NEVER_NS = 1 << 63  # a monotonic time that does not come
_ECHO_MEMORY = 4096  # own messages remembered per topic: more than a reader has in its queue
_ECHO_PREFIX = 256  # enough to hold the header with its stamp; whole images need not be kept
_CAME_BACK = (0, b"")
_DDS_STAMP_NS = 1  # DDS stamps are 32.32 fixed point: a nanosecond is lost at most


class EchoFilter:
    """Recognises our own messages on a topic that others publish as well.

    rclpy hides the publisher of a message.  But DDS stamps the message within our call of publish, and in that time no
    other publisher of the topic sends a message that begins with the same bytes.  (Begins: DDS might pad it.)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun_ns: list[int] = []
        self._sent: list[tuple[int, bytes]] = []  # (end of the call, how the message begins)
        # both, from before the host's clock was set back: messages on their way at that time have the old stamps
        self._before: tuple[list[int], list[tuple[int, bytes]]] = [], []
        self._native: list[NativePublisher] = []

    def add_native(self, publisher: NativePublisher) -> None:
        """Recognise what a latched publisher of the native passage sends, too."""
        with self._lock:
            self._native.append(publisher)

    def publish(self, publisher: RclPublisher, cdr: bytes, clock: Clock) -> None:
        """Send, and remember; the lock makes the receiver wait until the end of the call is known."""
        with self._lock:
            self._take_over()
            begun_ns = clock.utc_ns()
            publisher.publish(cdr)
            self._remember(begun_ns, clock.utc_ns(), cdr[:_ECHO_PREFIX])

    def _take_over(self) -> None:
        """Remember what was sent natively; with the lock."""
        for publisher in self._native:
            for begun_ns, ended_ns, prefix in publisher.take_own():
                self._remember(begun_ns, ended_ns, prefix)

    def _remember(self, begun_ns: int, ended_ns: int, prefix: bytes) -> None:
        """Remember a message; with the lock."""
        if self._begun_ns and begun_ns < self._begun_ns[-1]:
            self._before = self._begun_ns, self._sent
            self._begun_ns, self._sent = [], []
        self._begun_ns.append(begun_ns)
        self._sent.append((ended_ns, prefix))
        if len(self._sent) > 2 * _ECHO_MEMORY:
            del self._begun_ns[:_ECHO_MEMORY], self._sent[:_ECHO_MEMORY]

    def is_own(self, cdr: Buffer, source_ns: int) -> bool:
        with self._lock:
            self._take_over()
            return _is_echo(self._begun_ns, self._sent, cdr, source_ns) or _is_echo(*self._before, cdr, source_ns)


def _is_echo(begun_ns: list[int], sent: list[tuple[int, bytes]], cdr: Buffer, source_ns: int) -> bool:
    """Whether a message is one of those that were sent."""
    index = bisect_right(begun_ns, source_ns + _DDS_STAMP_NS) - 1
    if index < 0:
        return False
    ended_ns, prefix = sent[index]
    own = source_ns <= ended_ns + _DDS_STAMP_NS and cdr[: len(prefix)] == prefix
    if own:
        # Each comes back once: should another node send the same bytes at this moment, its message passes.
        sent[index] = _CAME_BACK
    return own


class TopicSubscription:
    """One subscription: what was received, and what was lost.

    While only one publisher is matched, its sequence numbers show every loss.  With several, rclpy hides whose number
    it is; then only the losses count that the middleware reports (those on the network, not those of an overflowing
    queue).
    """

    def __init__(self, topic: str, type_name: str, counts: TopicCounts, echo: EchoFilter | None) -> None:
        self.topic = topic
        self.type_name = type_name
        self.counts = counts
        self.echo = echo
        self.in_graph = topic
        self.noted_lost = 0
        self.subscription: Any = None
        self.native: NativeSubscription | None = None
        self._publishers = 0
        self._last = 0
        self._unconfirmed = 0

    def matched(self, publishers: int) -> None:
        """The number of matched publishers has changed.  Called by another thread, perhaps after the first messages."""
        self.sync()
        if self._publishers == 0 and publishers == 1:
            self.counts.lost += self._unconfirmed
        else:
            self._set_last(0)  # another publisher counts from another number
        self._unconfirmed = 0
        self._publishers = publishers

    def lost(self, messages: int) -> None:
        """The middleware reports a loss."""
        if self._publishers != 1:
            self.counts.lost += messages

    def received(self, sequence: int | None) -> None:
        """A message with its publisher's number (None or 0 where the middleware gives none)."""
        self.sync()
        self.counts.received += 1
        if not sequence:
            return
        missing = sequence - self._last - 1 if self._last else 0
        self._set_last(sequence)
        self._count_missing(missing)

    def sync(self) -> None:
        """Take over what the native passage has counted."""
        if self.native:
            received, missing, self._last = self.native.collect()
            self.counts.received += received
            self._count_missing(missing)

    def _set_last(self, sequence: int) -> None:
        self._last = sequence
        if self.native:
            self.native.last_number = sequence

    def _count_missing(self, missing: int) -> None:
        if missing > 0:
            if self._publishers == 1:
                self.counts.lost += missing
            elif self._publishers == 0:
                self._unconfirmed += missing


class Joins:
    """Whether a subscriber has joined a topic since it was `forget`-ten, even if another one has left meanwhile.

    Attributes:
        events: returns how many more have ever been there than at its last call; None: only those are known that are
            matched now.
        since_ns: monotonic time at which it was seen; None: none has joined.
    """

    def __init__(self) -> None:
        self.events: Callable[[], int] | None = None
        self.since_ns: int | None = None
        self._count = 0

    def look(self, count: int, now_ns: int) -> bool:
        """Return whether one has joined; ``count`` are matched now."""
        came = (self.events() if self.events else 0) > 0 or count > self._count
        self._count = count
        if came:
            self.since_ns = now_ns
        return self.since_ns is not None

    def forget(self) -> None:
        """A message has reached all of them."""
        self.since_ns = None


class TopicPublisher:
    """One publisher, with the messages that wait until it is made, and for its subscribers.

    ``lifespan_ns`` if it has commands to a robot, which never wait: it is ``ready`` as soon as it is made.

    ``ready`` once they need not wait: from then on `Publishing.publish` sends in the caller's thread.  All attributes
    but ``ready`` are guarded by ``lock``, for which no other thread competes after the first seconds.  ``kept`` has the
    bytes of each message that the middleware keeps for late joiners.
    """

    def __init__(
        self, topic: str, type_name: str, qos: Qos, counts: TopicCounts, lifespan_ns: int | None = None
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.lifespan_ns = lifespan_ns  # of commands to a robot, 0: no limit; None: other messages
        self.joins = Joins()
        self.written_ns: int | None = None
        self.publisher = refusing_publisher("its publisher is not made yet")
        self.is_made = False
        self.native: NativePublisher | None = None
        self.qos = qos
        self.counts = counts
        self.in_graph = topic
        self.echo: EchoFilter | None = None
        self.comes_back = False  # to a subscription of our own node
        self.lock = threading.Lock()
        self.held: deque[tuple[bytes, int]] = deque()  # with the time after which it is too old, UTC ns; 0: none
        self.old = 0  # held too long, and not noted yet
        self.held_bytes = 0
        self.deadline_ns = _NEVER_NS
        self.matched_ns = 0  # when all known subscriptions were matched; 0: not yet
        self.ready = False
        self.left = HOLD_MESSAGES  # of what is held, after the last burst; at first, as many as there may be
        self.burst_ns = 0  # not before this time
        self.kept: deque[int] = deque(maxlen=qos.depth if qos.latched else 0)

    def made(self, publisher: RclPublisher, *, deadline_ns: int, ready: bool) -> None:
        """The middleware's publisher is there; what was held is sent first."""
        with self.lock:
            self.publisher, self.deadline_ns, self.is_made = publisher, deadline_ns, True
            self.ready = (ready and not self.held) or self.lifespan_ns is not None

    def refuse(self, cause: str) -> None:
        """There will be no publisher: the messages that are held, and all further ones, fail."""
        with self.lock:
            self.publisher = refusing_publisher(cause)
            self.counts.failed += len(self.held)
            self.held.clear()
            self.held_bytes = self.counts.held = 0
            self.ready = True

    @property
    def has_subscriber(self) -> bool:
        """Whether a message might reach a subscriber: now, or, where it is held, later."""
        return not self.ready or self.publisher.get_subscription_count() > 0

    def send(self, cdr: bytes, clock: Clock) -> str:
        """Pass a message to the middleware; returns the cause of a failure, or ``""``."""
        try:
            if self.echo is not None:
                self.echo.publish(self.publisher, cdr, clock)
            else:
                self.publisher.publish(cdr)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self.counts.failed += 1
            return first_line(error)
        self.counts.published += 1
        self.kept.append(len(cdr))
        return ""

    def sync(self) -> str:
        """Take over what the native passage has counted; returns a failure, or ``""``."""
        if self.native is None:
            return ""
        published, unheard, failed = self.native.collect()
        self.counts.published += published
        self.counts.unheard += unheard
        self.counts.failed += failed
        return f"rcl refused {count_text(failed, 'message')}" if failed else ""

    def measure(self) -> None:
        """Take over how large the latched messages of the native passage were; for the keeper's thread."""
        if self.native:
            self.kept.extend(self.native.take_sizes())

    def close(self) -> None:
        """The publisher is about to be destroyed: all further messages fail."""
        with self.lock:
            self.publisher = refusing_publisher("the node has stopped")

    def hold(self, cdr: bytes, until_ns: int = 0) -> None:
        """Keep a message for later, but not to send it after ``until_ns`` (UTC; 0: no limit); with ``lock`` held.

        If it then `overflows`, the oldest must be sent.
        """
        self.held.append((cdr, until_ns))
        self.held_bytes += len(cdr)
        self.counts.held = len(self.held)

    @property
    def overflows(self) -> bool:
        """Whether more messages or bytes are held than the bounds allow."""
        return len(self.held) > HOLD_MESSAGES or (self.held_bytes > HOLD_BYTES and len(self.held) > 1)

    def send_oldest(self, clock: Clock) -> str:
        """Send the oldest held message (with ``lock`` held); returns the cause of a failure, or ``""``."""
        cdr, until_ns = self.held.popleft()
        self.held_bytes -= len(cdr)
        self.counts.held = len(self.held)
        if until_ns and clock.utc_ns() > until_ns:
            self.counts.unwritten += 1
            self.old += 1
            return ""
        return self.send(cdr, clock)

    def release_burst(self, clock: Clock) -> str:
        """Send a few of the held messages, and twice as many as have come since the last burst."""
        failure = self.release(clock, BURST_MESSAGES + 2 * max(0, len(self.held) - self.left))
        self.left = len(self.held)
        return failure

    def release(self, clock: Clock, at_most: int) -> str:
        """Send held messages in order; ready when none is left.  Returns the cause of the last failure, or ``""``.

        The lock is released after each message: a caller of publish waits for one message, not for all.
        """
        failure = ""
        for _ in range(at_most):
            with self.lock:
                if not self.held:
                    self.ready = True
                    break
                failure = self.send_oldest(clock) or failure
        return failure


@dataclass(slots=True)
class Topics:
    """The publishers and subscriptions of our node.

    Attributes:
        publishers: by the name as given and by the full name in the gateway.
        subscriptions: by the full name in the gateway.
        echoes: by the name in the graph, which two topics of the gateway may share.
    """

    publishers: dict[str, TopicPublisher] = field(default_factory=dict)
    subscriptions: dict[str, TopicSubscription] = field(default_factory=dict)
    echoes: dict[str, EchoFilter] = field(default_factory=dict)

    def publishers_at(self, in_graph: str) -> list[TopicPublisher]:
        """Return the publishers of a topic in the graph."""
        publishers = list(self.publishers.values())  # at once: others are announced meanwhile
        return list({id(each): each for each in publishers if each.in_graph == in_graph}.values())

    def subscriptions_at(self, in_graph: str) -> list[TopicSubscription]:
        """Return the subscriptions to a topic in the graph."""
        # at once: others are made meanwhile
        return [each for each in list(self.subscriptions.values()) if each.in_graph == in_graph]

    def echo(self, in_graph: str) -> EchoFilter:
        """Return what recognises our own messages on a topic in the graph."""
        return self.echoes.setdefault(in_graph, EchoFilter())

"""Publishers: made on first use, holding their first messages until the subscribers are matched, but no command.

The first message does not wait for its publisher, because the thread that publishes has the sequence lock: rcl needs up
to 60 ms for the first publisher of a type, and a message package that is not compiled yet needs many seconds.  So
another thread makes it, and the messages are held until then.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
from queue import SimpleQueue
from typing import Any

from igtl_gateway.base.errors import first_line
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.interface import DISCOVERY_NS, Publishers, Reports
from igtl_gateway.edges.ros import distributions
from igtl_gateway.edges.ros.direct import clear_history, direct_publisher
from igtl_gateway.edges.ros.graph import Graph
from igtl_gateway.edges.ros.middleware import interface_class, profile_of
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.receiver import EventPolling, UnmanagedCallbackGroup
from igtl_gateway.edges.ros.topics import HOLD_ALL_BYTES, HOLD_BYTES, HOLD_MESSAGES, TopicPublisher, Topics
from igtl_gateway.gateway.kept import beyond, largest_first
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.orders import Heard
from igtl_gateway.native.passage import Publisher as NativePublisher

#: Subscriptions that the graph knows are matched well within this time, or never (incompatible QoS).
HOLD_NS = 2_000_000_000

#: A reader of another vendor's DDS ignores what it receives before it has matched our writer, which it does not report.
FOREIGN_NS = 250_000_000
_BURST_NS = 10_000_000  # between two bursts of held messages: a reader takes the first one meanwhile
_LINGER_NS = 500_000_000  # for acknowledgements at the end; a subscriber that hangs must not delay us
#: For the acknowledgements of what is then forgotten, all in all: a subscriber that hangs keeps no memory.
_FORGET_NS, _FORGET_TRIES = 10_000_000, 10
#: From this size on a latched message is counted at once, and not within a second.
_LARGE_BYTES = 64 << 10
#: Publishers that are made as soon as they are needed; the making of further ones gets a tenth of the time.
_USUAL, _REST, _REST_S = 64, 9, 0.1
_MATCHES_MAX = 10_000  # matches not reported yet: at most those of one turn of the keeper


class Publishing(Publishers[TopicPublisher]):
    """The publishers of a node over DDS; see ``RosEdge`` for what each public method does."""

    def __init__(
        self,
        node: RosNode,
        topics: Topics,
        graph: Graph,
        reports: Reports,
        on_listener: Callable[[str], None] | None,
        latched_bytes: int,
    ) -> None:
        # not the lock of the node: for moments only
        super().__init__(threading.Lock(), reports, topics.publishers, latched_bytes, node.clock)
        self._node = node
        self._topics = topics
        self._graph = graph
        self._on_first_subscriber = on_listener
        self._matches: list[distributions.CountedMatches] = []
        self._group, self._polling = UnmanagedCallbackGroup(), EventPolling()
        self._listened: deque[str] = deque(maxlen=_MATCHES_MAX)  # topics with a new subscriber, not reported yet
        self._to_make: SimpleQueue[tuple[str, TopicPublisher] | None] = SimpleQueue()
        self._maker = threading.Thread(target=self._make_announced, name="igtl-ros-maker", daemon=True)

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def _send(self, publisher: TopicPublisher, cdr: bytes, until_ns: int) -> str:
        failure = ""
        if publisher.qos.latched and len(cdr) >= _LARGE_BYTES:
            self._node.graph.wake()  # the keeper bounds what is kept
        with publisher.lock:
            if publisher.ready:
                return publisher.send(cdr, self._clock)
            if publisher.lifespan_ns is not None:  # a topic of a robot: what waits is late
                publisher.counts.unheard += 1
                return ""
            publisher.hold(cdr, until_ns)
            overflown = publisher.overflows
            # not dropped: the subscribers that are matched by now get it
            while publisher.overflows:
                failure = publisher.send_oldest(self._clock)
        if overflown:  # the failure is of an older message, and counted
            self._reports.publish_failed(publisher.topic, failure)
            self._note_overflow(publisher)
        return ""

    def _note_overflow(self, publisher: TopicPublisher) -> None:
        limit = f"{HOLD_MESSAGES} messages or {HOLD_BYTES >> 20} MiB, or {HOLD_ALL_BYTES >> 20} MiB of all topics,"
        text = f"more than {limit} before all subscribers were matched; the matched ones got the oldest"
        self._reports.note_once(Level.INFO, "ros_hold_overflow", f"{publisher.topic}: {text}", publisher.topic)

    def _note_old(self, publisher: TopicPublisher) -> None:
        old, publisher.old = publisher.old, 0
        if old:
            lost = f"{count_text(old, 'message')} not sent"
            text = f"{publisher.topic}: {lost}, too old (max_age_s) before all subscribers matched"
            self._reports.note(Level.WARN, "ros_held_old", text, publisher.topic, {"dropped": old})

    def native(self, topic: str, type_name: str) -> NativePublisher | None:
        """Return a publisher for the native passage; None: Python publishes, such as while messages are held."""
        publisher = self._publishers.get(topic)
        if publisher is None or publisher.type_name != type_name or not publisher.ready:
            return None
        if publisher.native is None and (pointer := getattr(publisher.publisher, "pointer", 0)):
            publisher.native = NativePublisher(pointer, publisher.qos.latched)
            if publisher.qos.latched and publisher.echo:
                publisher.echo.add_native(publisher.native)
        # asked last: a subscription that is made meanwhile sets it before it asks for the native publisher
        return None if publisher.comes_back else publisher.native

    def sync(self) -> None:
        """Take over what the native passage has counted."""
        for publisher in self.all():
            self._reports.publish_failed(publisher.topic, publisher.sync())

    def advertise(self, topic: str, type_name: str, qos: Qos) -> TopicPublisher | None:
        """The publisher of the topic, made if there is none; None (and a note) if that is impossible."""
        publisher = super().advertise(topic, type_name, qos)
        return publisher if publisher and self._complete(topic, publisher) else None

    def _first(self, topic: str, type_name: str, qos: Qos) -> TopicPublisher | None:
        """A new publisher holds its messages, and another thread makes it."""
        publisher = super().advertise(topic, type_name, qos)
        if publisher and not publisher.is_made:
            with self._lock:
                if self._maker.ident is None:
                    self._maker.start()
            self._to_make.put((topic, publisher))
        return publisher

    def _full(self, topic: str) -> str:
        _ = self._node.handle  # raises if the node does not run
        return self._node.names.full(topic)

    def _new(self, topic: str, type_name: str, qos: Qos) -> TopicPublisher:
        return TopicPublisher(topic, type_name, qos, self._reports.counts(topic), self._lifespans.get(topic))

    def _heard(self, publisher: TopicPublisher) -> Heard:
        if not (publisher.is_made and self._node.is_running):
            return Heard(0)
        now_ns, joins = self._clock.monotonic_ns(), publisher.joins
        own = len(self._topics.subscriptions_at(publisher.in_graph))
        count = int(publisher.publisher.get_subscription_count()) - own
        joined = joins.look(count, now_ns)
        recent = joins.since_ns is not None and now_ns < joins.since_ns + FOREIGN_NS
        unsettled = count > 0 and recent and self._graph.has_foreign_subscription(publisher.topic)
        return Heard(count, joined, unsettled)

    def _write(self, publisher: TopicPublisher, cdr: bytes) -> str:
        publisher.joins.forget()
        with publisher.lock:
            return publisher.send(cdr, self._clock)

    def _make_announced(self) -> None:
        """Make the publishers that messages wait for, one after the other, until the stop.

        Each takes a millisecond with the GIL: beyond a usual number there is a rest after each.
        """
        for made in count():
            if not (announced := self._to_make.get()):
                return
            begun_ns = self._clock.monotonic_ns()
            if self._node.is_running:
                self._complete(*announced)
            if made >= _USUAL:
                took_s = (self._clock.monotonic_ns() - begun_ns) / NS_PER_S
                self._node.stopping.wait(min(_REST * took_s, _REST_S))

    def _complete(self, topic: str, publisher: TopicPublisher) -> bool:
        """Make a publisher, unless it is made; False (and a note): that is impossible, and its messages fail."""
        try:
            message_class = interface_class(publisher.type_name)  # without the lock: it may have to be compiled
            with self._node.lock:
                if not publisher.is_made:
                    self._make(publisher, message_class)
            if not publisher.ready:
                self._node.graph.wake()  # the keeper sends what is held
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._reports.refuse("publish", topic, publisher.type_name, error)
            with self._lock:
                for name in [name for name, each in self._publishers.items() if each is publisher]:
                    del self._publishers[name]
            publisher.refuse(first_line(error))
            return False
        return True

    def subscriber_count(self, topic: str) -> int:
        """The number of matched subscriptions, without our own."""
        with self._node.lock:
            publisher = self._publishers.get(topic)
            if publisher is None or not self._node.is_running:
                return 0
            own = len(self._topics.subscriptions_at(publisher.in_graph))
            return max(0, int(publisher.publisher.get_subscription_count()) - own)

    def wait_for_subscribers(self, topic: str, count: int, timeout_s: float) -> bool:
        """Wait until ``count`` subscriptions are matched; False if that took too long, or at stop."""
        self._node.wait(lambda: self.subscriber_count(topic) >= count, timeout_s)
        return self.subscriber_count(topic) >= count

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait until no publisher holds messages; False if that took too long, or at stop."""
        self._node.wait(lambda: not self.is_holding(), timeout_s)
        return not self.is_holding()

    def wait_acked(self, topic: str, timeout_s: float) -> bool:
        """Wait for the acknowledgements of a topic; False if that took too long."""
        publisher = self._publishers.get(topic)
        if publisher is None or not publisher.qos.reliable:
            return True
        if not self._node.wait(lambda: publisher.ready, timeout_s):
            return False
        if not self._node.is_running:
            return True
        timeout = self._node.rclpy.duration.Duration(nanoseconds=int(timeout_s * NS_PER_S))
        return bool(publisher.publisher.wait_for_all_acked(timeout))

    def is_holding(self) -> bool:
        """Whether any publisher holds messages for subscribers that are not matched yet."""
        return any(not publisher.ready for publisher in self.all())

    # ── for the keeper's thread ───────────────────────────────────────────────────────────────────────────────

    def send_held(self) -> None:
        """Send a burst of the held messages whose subscribers are matched, unless the last one was just now.

        Those of the topics that hold most are sent, too, until all topics together hold no more than they may.
        """
        holding = {one: one.held_bytes for one in self.all() if one.is_made and not one.ready}
        too_many = beyond(HOLD_ALL_BYTES, largest_first(holding, holding.__getitem__), holding.__getitem__)
        for publisher in holding:
            now_ns = self._clock.monotonic_ns()
            if now_ns < publisher.burst_ns:
                continue
            if not self._can_send(publisher):
                if publisher not in too_many:
                    continue
                self._note_overflow(publisher)
            publisher.burst_ns = now_ns + _BURST_NS
            self._reports.publish_failed(publisher.topic, publisher.release_burst(self._clock))
            self._note_old(publisher)

    def bound_latched(self) -> None:
        for publisher in self.all():
            publisher.measure()
        super().bound_latched()

    def _forget(self, publisher: TopicPublisher) -> bool:
        duration = self._node.rclpy.duration.Duration
        for left in reversed(range(_FORGET_TRIES)):
            with publisher.lock:  # no message comes in between
                acked = not publisher.qos.reliable or publisher.publisher.wait_for_all_acked(duration())
                if acked or not left:
                    done = clear_history(publisher.publisher)
                    if done:
                        publisher.kept.clear()
                    return done
            publisher.publisher.wait_for_all_acked(duration(nanoseconds=_FORGET_NS))
        return False

    def poll_matches(self) -> None:
        """Look for new subscribers."""
        try:
            for matches in list(self._matches):  # others are made meanwhile
                matches.poll()
        except Exception as error:  # of rcl, after the shutdown of its context
            self._reports.callback_failed("matches", error, "matches")

    def poll_events(self) -> None:
        """Look for subscribers that cannot be matched."""
        try:
            self._polling.poll_events()
        except Exception as error:  # as above, or of rclpy internals that have changed
            self._reports.callback_failed("events", error, "events")

    def notify_first_subscribers(self) -> None:
        """Report the new subscribers, not under our lock, which another thread of the callee might need."""
        while self._on_first_subscriber and self._listened:
            self._on_first_subscriber(self._listened.popleft())

    def finish_making(self) -> None:
        """Before the stop: wait a moment for the publishers that messages wait for."""
        self._to_make.put(None)
        if self._maker.ident is not None:
            self._maker.join(_LINGER_NS / NS_PER_S)

    def close(self) -> None:
        """At stop: send what is held, wait a moment for the acknowledgements, and refuse all further messages."""
        deadline_ns = self._clock.monotonic_ns() + _LINGER_NS
        publishers = self.all()
        for publisher in publishers:
            self._reports.publish_failed(publisher.topic, publisher.release(self._clock, HOLD_MESSAGES + 1))
            self._note_old(publisher)
        for publisher in publishers:
            left_ns = deadline_ns - self._clock.monotonic_ns()
            if left_ns > 0 and publisher.qos.reliable and publisher.is_made:
                publisher.publisher.wait_for_all_acked(self._node.rclpy.duration.Duration(nanoseconds=left_ns))
        for publisher in publishers:
            publisher.close()

    def _can_send(self, publisher: TopicPublisher) -> bool:
        if not publisher.is_made:  # nor might its topic have a name that the graph can be asked for
            return False
        now_ns = self._clock.monotonic_ns()
        if not self._node.is_running or now_ns >= publisher.deadline_ns:
            return True
        known = self._graph.subscriptions_of(publisher.topic)
        if not 0 < known <= self.subscriber_count(publisher.topic):
            return False
        publisher.matched_ns = publisher.matched_ns or now_ns
        return now_ns >= publisher.matched_ns + FOREIGN_NS or not self._graph.has_foreign_subscription(publisher.topic)

    def _make(self, publisher: TopicPublisher, message_class: Any) -> None:
        """Make the publisher of the middleware; the caller has the lock of the node."""
        rclpy, topic = self._node.rclpy, publisher.topic
        made = distributions.create_publisher(
            rclpy,
            self._node.handle,
            message_class,
            self._node.names.asked(topic),
            profile_of(rclpy, publisher.qos, publisher.lifespan_ns),
            group=self._group,
            incompatible_qos=lambda event: self._note_incompatible(topic, event),
        )
        self._polling.events += made.event_handlers
        direct = direct_publisher(made)
        matched = partial(self._on_matched, topic)
        if publisher.lifespan_ns is not None:
            events = distributions.match_events(rclpy, made, self._group)
            publisher.joins.events = events or self._newcomers(publisher)
        self._matches.append(distributions.CountedMatches(direct.get_subscription_count, matched))
        publisher.in_graph = self._node.names.in_graph(topic)
        subscriptions = self._topics.subscriptions_at(publisher.in_graph)
        # a latched message might also reach a subscription that we make later
        publisher.comes_back = bool(subscriptions)
        if subscriptions or publisher.qos.latched:
            publisher.echo = self._topics.echo(publisher.in_graph)
        for subscription in subscriptions:
            subscription.echo = publisher.echo
        now_ns = self._clock.monotonic_ns()
        discovered_ns = self._node.started_ns + DISCOVERY_NS
        known = self._graph.subscriptions_of(topic)
        publisher.made(
            direct,
            deadline_ns=now_ns + HOLD_NS if known else discovered_ns,
            ready=not known and now_ns >= discovered_ns,
        )

    def _newcomers(self, publisher: TopicPublisher) -> Callable[[], int]:
        """Return what counts the subscriptions in the graph that were not there at its last call.

        For an rclpy without events of matches.
        """
        seen: set[bytes] = set()

        def count() -> int:
            nonlocal seen
            before, seen = seen, self._graph.readers_of(publisher.topic, publisher.qos)
            return len(seen - before)

        return count

    def _on_matched(self, topic: str, event: distributions.Matched) -> None:
        if event.current_count_change > 0 and self._on_first_subscriber:
            self._listened.append(topic)

    def _note_incompatible(self, topic: str, event: Any) -> None:
        policy = self._node.rclpy.qos.qos_policy_name_from_kind(event.last_policy_kind)
        self._reports.incompatible_qos(topic, "a subscriber", policy)

"""Publishers: made on first use.  Zenoh routes by itself, so nothing has to be held for subscribers.

A latched topic has a publisher with a cache, which late subscribers ask.  It does not know whether it has subscribers,
so a second one, which sends nothing, watches that.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from igtl_gateway.addon import Clock
from igtl_gateway.addon.reading import Level, Qos
from igtl_gateway.addon.ros_side import Heard, Publishers, Reports, TopicCounts
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.zenoh.library import first_line
from igtl_gateway.addons.zenoh.names import Kind, Node, attachment, gid
from igtl_gateway.addons.zenoh.own_node import OwnNode
from igtl_gateway.addons.zenoh.traffic import ROBOT, Traffic, how_to_send
from igtl_gateway.addons.zenoh.waiting import Commands

#: From the declaration on until Zenoh knows the subscribers, a publisher counts as one with a subscriber.
_SETTLE_NS = 500_000_000
_HEARTBEAT_S = 0.5
#: The log of the node; its messages are not counted as a stream of the gateway.
ROSOUT = "/rosout"


class TopicPublisher:
    """One publisher.

    Attributes:
        matched: whether Zenoh knows a subscriber.
        joined: whether one has joined since the last command to a robot.
        in_graph: the token is declared with this number.
    """

    def __init__(
        self,
        topic: str,
        type_name: str,
        key: str,
        qos: Qos,
        counts: TopicCounts,
        clock: Clock,
        traffic: Traffic | None = None,
        commands: Commands | None = None,
        *,
        of_robot: bool = False,
    ) -> None:
        self.joined = False
        self.written_ns: int | None = None
        self.topic = topic
        self.type_name = type_name
        self.key = key
        self.qos = qos
        self.counts = counts
        self.matched = False
        self.noted_over_budget = 0
        self._traffic = traffic
        self._class = traffic.class_of(topic, type_name) if traffic else None
        if of_robot:  # at once or never, and no budget: what waits for the line is late
            self._class = ROBOT
        if self._class and qos.latched:  # nothing repeats it for late joiners
            self._class = replace(self._class, debt_s=None)
        self._commands = commands if self._class and self._class.blocks else None
        self._clock = clock
        self.lock = threading.Lock()
        self._looking = threading.Lock()  # guards matched
        self._made_ns = clock.monotonic_ns()
        self._sequence = 0
        self._gid = bytes(16)
        self._publisher: Any = None
        self._watch: Any = None
        self._listener: Any = None
        self._token: Any = None
        #: Latched messages from before the session is open.
        self._early: deque[bytes] = deque(maxlen=qos.depth if qos.latched else 0)
        #: Bytes of each latched message that is kept: there, or by Zenoh.
        self.kept: deque[int] = deque(maxlen=self._early.maxlen)
        self._declare_latched: Callable[[], Any] | None = None

    def declare(
        self, zenoh: Any, session: Any, node: Node, number: int, type_hash: str, matched: Callable[[], None]
    ) -> None:
        """Declare publisher and token; Zenoh calls ``matched`` when a subscriber is there."""
        token = node.entity_token(number, Kind.PUBLISHER, self.topic, self.type_name, type_hash, self.qos)
        how = {
            "reliability": zenoh.Reliability.RELIABLE if self.qos.reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.DROP,
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        if self._class:
            how |= how_to_send(zenoh, self._class)

        def on_matching(_status: Any) -> None:
            # Zenoh's threads call in any order, and while the publisher is declared: what counts is what is true now.
            with self._looking:
                before, self.matched = self.matched, self._watch is not None and self._watch.matching_status.matching
                came = self.matched and not before
                self.joined = self.joined or came
            if came:
                matched()

        with self.lock:
            self._gid = gid(token)
            self._made_ns = self._clock.monotonic_ns()
            self._watch = session.declare_publisher(self.key, **how)
            self._publisher = self._watch
            if self.qos.latched:
                ext = zenoh.ext
                misses = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S)
                self._declare_latched = partial(
                    ext.declare_advanced_publisher,
                    session,
                    self.key,
                    cache=ext.CacheConfig(self.qos.depth),
                    publisher_detection=True,
                    sample_miss_detection=misses if self.qos.reliable else None,
                    **how,
                )
                self._publisher = self._declare_latched()
            self._listener = self._watch.declare_matching_listener(on_matching)
            on_matching(None)  # a subscriber that was there before
            self._token = session.liveliness().declare_token(token)
            while self._early:
                self.counts.held -= 1
                self._pass_on(self._early.popleft())

    @property
    def has_subscriber(self) -> bool:
        """Whether a message might reach a subscriber."""
        return self.matched or (self._publisher is not None and self._clock.monotonic_ns() < self._made_ns + _SETTLE_NS)

    def send(self, cdr: bytes, until_ns: int = 0) -> str:
        """Send a message, if it waits for the line until ``until_ns`` (UTC; 0: no limit); return why that failed, or
        ``""``."""
        if (
            self._traffic
            and self._class
            and not self._traffic.admits(self._class, len(cdr), self._clock.monotonic_ns())
        ):
            self.counts.over_budget += 1
            return ""
        with self.lock:
            if self._publisher is None:  # without a session there is no subscriber
                if self.qos.latched:
                    if len(self._early) == self._early.maxlen:
                        self.counts.unheard += 1
                        self.counts.held -= 1
                    self._early.append(cdr)
                    self.kept.append(len(cdr))
                    self.counts.held += 1
                else:
                    self.counts.unheard += 1
                return ""
            return self._pass_on(cdr, until_ns)

    def write(self, cdr: bytes) -> str:
        """Send a command to a robot at once; return why that failed, or ``""``."""
        with self.lock:
            return self._put(cdr)

    def forget(self) -> None:
        """Forget the latched messages: Zenoh clears no cache, so that another publisher has the next ones."""
        with self.lock:
            self.kept.clear()
            self.counts.unheard += len(self._early)
            self.counts.held -= len(self._early)
            self._early.clear()
            if self._publisher is not None and self._declare_latched:
                _before, self._publisher = self._publisher, self._declare_latched()

    def _pass_on(self, cdr: bytes, until_ns: int = 0) -> str:
        """To Zenoh, or to the thread that may wait for it."""
        if self._commands is None:
            return self._put(cdr)
        self._commands.put(self.topic, self.counts, lambda: self._put_in_time(cdr, until_ns))
        return ""

    def _put_in_time(self, cdr: bytes, until_ns: int) -> str:
        if until_ns and self._clock.utc_ns() > until_ns:
            self.counts.unwritten += 1
            return ""
        return self._put(cdr)

    def _put(self, cdr: bytes) -> str:
        publisher = self._publisher
        if publisher is None:  # stopped while it waited
            self.counts.unheard += 1
            return ""
        self._sequence += 1
        try:
            publisher.put(cdr, attachment=attachment(self._sequence, self._clock.utc_ns(), self._gid))
        except Exception as error:  # zenoh's class is one for all causes
            self.counts.failed += 1
            return first_line(error)
        self.counts.published += 1
        self.kept.append(len(cdr))
        return ""

    def close(self) -> None:
        """At stop: further messages are not sent."""
        with self.lock:
            self.counts.unheard += len(self._early)
            self.counts.held -= len(self._early)
            self._early.clear()
            self._publisher = None
        with self._looking:
            _watch, self._watch = self._watch, None  # released at the end, not while its callback waits for the lock
            self.matched = False


class Publishing(Publishers[TopicPublisher]):
    """The publishers of a node over Zenoh; see ``RosEdge`` for what each public method does."""

    def __init__(
        self,
        node: OwnNode,
        reports: Reports,
        clock: Clock,
        matched: Callable[[str], None],
        traffic: Traffic | None,
        latched_bytes: int,
    ) -> None:
        super().__init__(node.connection.lock, reports, {}, latched_bytes, clock)
        self._node = node
        self._matched = matched
        self._traffic = traffic
        self._commands = Commands(reports, clock)
        self._closed = False

    def _send(self, publisher: TopicPublisher, cdr: bytes, until_ns: int) -> str:
        if self._closed:
            publisher.counts.failed += 1
            return "the node has stopped"
        return publisher.send(cdr, until_ns)

    def _heard(self, publisher: TopicPublisher) -> Heard:
        reached = publisher.matched and not self._closed and self._node.connection.is_open
        return Heard(int(reached), publisher.joined)

    def _write(self, publisher: TopicPublisher, cdr: bytes) -> str:
        publisher.joined = False
        return publisher.write(cdr)

    def joined(self, topic: str) -> None:
        """Take notice of another subscription to a topic: Zenoh itself reports the first one only."""
        if publisher := self._publishers.get(topic):
            publisher.joined = True

    def _forget(self, publisher: TopicPublisher) -> bool:
        publisher.forget()
        return True

    def publisher(self, topic: str) -> TopicPublisher | None:
        """Return the publisher of a topic, if there is one."""
        return self._publishers.get(topic)

    def note_dropped(self) -> None:
        """Note the messages that were dropped since the last call: they exceed the budget, or the line took none."""
        self._commands.note_dropped()
        for one in self.all():
            dropped = one.counts.over_budget - one.noted_over_budget
            if dropped:
                one.noted_over_budget += dropped
                text = f"{one.topic}: {counted(dropped, 'message')} dropped, because the budget of the site is exceeded"
                self._reports.note(Level.WARN, "site_over_budget", text, one.topic, {"dropped": dropped})

    def close(self) -> None:
        """At stop: refuse all further messages; send the commands that wait, for 2 s at most."""
        self._closed = True
        self._commands.stop()
        for publisher in self.all():
            publisher.close()

    def _new(self, topic: str, type_name: str, qos: Qos) -> TopicPublisher:
        key, type_hash = self._node.key(topic, type_name)
        made = TopicPublisher(
            topic,
            type_name,
            key,
            qos,
            TopicCounts() if topic == ROSOUT else self._reports.counts(topic),
            self._clock,
            self._traffic,
            self._commands,
            of_robot=topic in self._lifespans,
        )

        def declare(session: Any) -> None:
            node, number = self._node.next(session)
            zenoh = self._node.connection.zenoh
            made.declare(zenoh, session, node, number, type_hash, lambda: self._matched(topic))

        self._node.connection.declare(declare)
        return made

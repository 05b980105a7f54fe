"""The publishers of a node, whichever middleware carries the messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from contextlib import AbstractContextManager
from typing import Generic, Protocol, TypeVar

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import RosError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import counted
from igtl_gateway.edges.interface.reports import Reports, TopicCounts
from igtl_gateway.gateway.kept import FORGOTTEN, beyond, forgotten_text, largest_first
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.orders import FAILED, Heard, Order, Unwritten, unwritten

#: Within this time after the start a graph without subscribers might only mean that discovery is not complete: a
#: participant whose first announcements are lost sends the next one after 3 s.
DISCOVERY_NS = 4_000_000_000

_CDR_HEADER = 4


class TopicPublisher(Protocol):
    """What is needed of one publisher.

    Attributes:
        lock: guards its counts.
        has_subscriber: whether a message might reach a subscriber.
        kept: bytes of each message that is kept for late joiners; only the last ones of latched topics are.
        written_ns: when the last command to a robot had been written, monotonic ns; None: there was none.
    """

    @property
    def topic(self) -> str: ...

    @property
    def type_name(self) -> str: ...

    @property
    def qos(self) -> Qos: ...

    @property
    def counts(self) -> TopicCounts: ...

    @property
    def lock(self) -> AbstractContextManager[object]: ...

    @property
    def has_subscriber(self) -> bool: ...

    @property
    def kept(self) -> deque[int]: ...

    written_ns: int | None


P = TypeVar("P", bound=TopicPublisher)


class Publishers(ABC, Generic[P]):
    """Publishers are made at, or after, their first use.

    Args:
        lock: guards ``publishers``; only the first message of a topic takes it.
        reports: takes the notes.
        publishers: by the name as given, and by the full name.
        latched_bytes: of the latched messages of all topics; see ``bound_latched``.
        clock: of the host.
    """

    def __init__(
        self,
        lock: AbstractContextManager[object],
        reports: Reports,
        publishers: dict[str, P],
        latched_bytes: int,
        clock: Clock,
    ) -> None:
        self._clock = clock
        self._lifespans: dict[str, int] = {}  # topic of commands to a robot, as given and in full → see expect_orders
        self._lock = lock
        self._reports = reports
        self._publishers = publishers
        self._latched_bytes = latched_bytes

    @abstractmethod
    def _new(self, topic: str, type_name: str, qos: Qos) -> P:
        """Return a new publisher, by its full name; the caller has the lock.  May raise anything."""

    @abstractmethod
    def _send(self, publisher: P, cdr: bytes, until_ns: int) -> str:
        """Send a message, perhaps later, but not after ``until_ns``; return why that failed, or ``""``.  Counts it."""

    @abstractmethod
    def _forget(self, publisher: P) -> bool:
        """Forget the latched messages of a publisher, which its subscribers have; False: the middleware cannot."""

    @abstractmethod
    def _heard(self, publisher: P) -> Heard:
        """Return what is known of the subscribers of a topic of commands to a robot."""

    @abstractmethod
    def _write(self, publisher: P, cdr: bytes) -> str:
        """Send a command to a robot at once, and count it; return why that failed, or ``""``."""

    def _full(self, topic: str) -> str:
        """Return the full name of a topic.  May raise anything."""
        return topic

    def _first(self, topic: str, type_name: str, qos: Qos) -> P | None:
        """Return the publisher for the first message of a topic, as ``advertise``."""
        return self.advertise(topic, type_name, qos)

    def publish(self, topic: str, type_name: str, cdr: bytes, qos: Qos, until_ns: int = 0) -> str:
        """Send CDR bytes (with encapsulation); from any thread.

        The publisher is created after the first use, and ``qos`` counts then.  Never raises for a bad topic or type,
        nor before start or after stop: a note reports that once, and the message counts as failed.

        Args:
            topic, type_name, cdr, qos: of the message.
            until_ns: later, it is too old to be sent (UTC ns); 0: no limit.  Latched messages have none.

        Returns:
            Why the message is not published, or ``""``.  One that is held for its publisher or its subscribers might
            still fail later, which `counters` show.
        """
        publisher = self._publishers.get(topic)
        if publisher is None or publisher.type_name != type_name:
            publisher = self._first(topic, type_name, qos)
            if publisher is None:
                self._reports.counts(topic).failed += 1
                return self._reports.refusal("publish", topic, type_name) or "the node is not running"
        if len(cdr) < _CDR_HEADER:
            # the middleware would carry it, and each subscriber would fail over it
            with publisher.lock:
                publisher.counts.failed += 1
            failure = f"{counted(len(cdr), 'byte')}, expected CDR with {_CDR_HEADER} bytes of encapsulation"
        else:
            failure = self._send(publisher, cdr, 0 if qos.latched else until_ns)
        if failure:
            self._reports.publish_failed(publisher.topic, failure)
        return failure

    def expect_orders(self, topic: str, type_name: str, qos: Qos, lifespan_ns: int) -> P | None:
        """Make the publisher of a topic of commands to a robot, perhaps in another thread, so that robots find it.

        It never holds a message.  None (and a note): that is impossible.

        Args:
            topic, type_name, qos: of the publisher.
            lifespan_ns: after this time since its write the middleware passes on no command; 0: no limit.
        """
        try:
            self._lifespans[topic] = self._lifespans[self._full(topic)] = lifespan_ns
        except Exception as error:  # as in advertise
            self._reports.refuse("publish", topic, type_name, error)
            return None
        return self._first(topic, type_name, qos)

    def write(self, order: Order) -> Unwritten | None:
        """Write a command to a robot now, or never; returns why it is not written.

        Called by one thread at a time: the one that has the sequence lock.
        """
        publisher = self._publishers.get(order.topic)
        if publisher is None or publisher.type_name != order.type:
            publisher = self.expect_orders(order.topic, order.type, order.qos, order.max_age_ns)
        if publisher is None:
            cause = self._reports.refusal("publish", order.topic, order.type) or "the node is not running"
            return Unwritten(FAILED, f"{order.device}: found {order.topic} without a publisher: {cause}")
        heard = self._heard(publisher)
        now_ns, written_ns = self._clock.monotonic_ns(), publisher.written_ns
        passed_ns = None if written_ns is None else now_ns - written_ns
        refused = unwritten(order, heard, self._clock.utc_ns(), passed_ns)
        if refused is None:
            failure = self._write(publisher, order.cdr)
            publisher.written_ns = self._clock.monotonic_ns()  # the end of the call: the stamp of DDS is before it
            if not failure:
                return None
            self._reports.publish_failed(publisher.topic, failure)
            return Unwritten(FAILED, f"{order.device}: found {failure}")
        with publisher.lock:
            publisher.counts.unwritten += 1
        return refused

    def has_subscriber(self, topic: str) -> bool:
        """Whether a message published now might reach a subscriber: cheap, and exact once discovery is complete.

        True, too, while a publisher waits for subscribers.  ``on_listener`` reports those that come later.
        """
        publisher = self._publishers.get(topic)
        return publisher is None or publisher.has_subscriber

    def count_if_unsubscribed(self, topic: str) -> bool:
        """Whether a message of a topic need not be published for want of a subscriber, which is counted then.

        A message that is neither latched nor subscribed to goes nowhere in DDS either, only more slowly (6 µs, after a
        pause 100).
        """
        publisher = self._publishers.get(topic)
        if publisher is None or publisher.qos.latched or publisher.has_subscriber:
            return False
        publisher.counts.unheard += 1
        return True

    def advertise(self, topic: str, type_name: str, qos: Qos) -> P | None:
        """The publisher of the topic, made if there is none; None (and a note) if that is impossible."""
        if self._reports.refusal("publish", topic, type_name):
            return None
        try:
            with self._lock:
                full = self._full(topic)
                publisher = self._publishers.get(full)
                if publisher is None:
                    publisher = self._new(full, type_name, qos)
                if publisher.type_name != type_name:
                    raise RosError(f"the topic has the type {publisher.type_name}")
                self._publishers[topic] = self._publishers[full] = publisher
                return publisher
        except Exception as error:  # rclpy raises a dozen unrelated classes here, and Zenoh one for all causes
            self._reports.refuse("publish", topic, type_name, error)
            return None

    def bound_latched(self) -> None:
        """Forget latched messages beyond the bound, those of the topic that has most first; for one thread.

        Late joiners get none of the topic before its next message.  A plan stays beside volumes without number.
        """
        sizes = {one: sum(one.kept) for one in self.all() if one.kept}
        for publisher in beyond(self._latched_bytes, largest_first(sizes, sizes.__getitem__), sizes.__getitem__):
            topic, messages = publisher.topic, len(publisher.kept)
            if not self._forget(publisher):
                text = (
                    f"latched messages exceed {self._latched_bytes >> 20} MiB (latched_mib); this middleware keeps them"
                )
                self._reports.note_once(Level.WARN, FORGOTTEN, text)
                return
            publisher.counts.forgotten += messages
            text = forgotten_text(topic, sizes[publisher], self._latched_bytes)
            self._reports.note_once(Level.WARN, FORGOTTEN, text, topic)

    def all(self) -> list[P]:
        """Return each publisher once."""
        with self._lock:
            return list(dict.fromkeys(self._publishers.values()))

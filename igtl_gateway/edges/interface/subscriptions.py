"""The subscriptions of a node, whichever middleware carries the messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Generic, Protocol, TypeVar

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text
from igtl_gateway.edges.interface.reports import Reports, TopicCounts
from igtl_gateway.edges.interface.side import OnMessage, Publication, Wants
from igtl_gateway.gateway.log.note import Level

#: Takes the bytes of a message and its source stamp.
Deliver = Callable[[bytes, int], None]


class TopicSubscription(Protocol):
    """What is needed of one subscription.

    Attributes:
        noted_lost: number of lost messages that were noted.
    """

    noted_lost: int

    @property
    def topic(self) -> str: ...

    @property
    def type_name(self) -> str: ...

    @property
    def counts(self) -> TopicCounts: ...

    def sync(self) -> None:
        """Take over what was counted in other threads."""
        ...


S = TypeVar("S", bound=TopicSubscription)


class Subscriptions(ABC, Generic[S]):
    """Subscriptions are made when asked for, or when discovery finds a wanted topic.

    Args:
        lock: guards the making of entities and ``subscriptions``; no message on its way takes it.
        reports: takes the notes.
        publications: returns the topics that others publish.
        subscriptions: by the full name of the topic.
    """

    def __init__(
        self,
        lock: AbstractContextManager[object],
        reports: Reports,
        publications: Callable[[], list[Publication]],
        subscriptions: dict[str, S],
    ) -> None:
        self._lock = lock
        self._reports = reports
        self._publications = publications
        self._subscriptions = subscriptions

    @abstractmethod
    def _make(self, topic: str, type_name: str, qos: Qos) -> Qos:
        """Subscribe (with the lock held); return the resulting QoS.  May raise anything."""

    def _offered(self, topic: str, type_name: str, wanted: Qos) -> Qos:
        """Return the QoS for a topic that discovery has found."""
        return wanted

    def _alias(self, topic: str) -> str:
        """Return what a note adds to the name of a topic."""
        return ""

    def subscribe(self, topic: str, type_name: str, qos: Qos) -> bool:
        """Subscribe now; see ``RosEdge.subscribe``."""
        try:
            with self._lock:
                if topic not in self._subscriptions:
                    self._make(topic, type_name, qos)
        except Exception as error:  # rclpy raises a dozen unrelated classes here, and Zenoh one for all causes
            self._reports.refuse("subscribe", topic, type_name, error)
            return False
        return True

    def topics(self) -> list[tuple[str, str]]:
        """Topic and type of everything that we receive."""
        return sorted((one.topic, one.type_name) for one in self.all())

    def discover(self, wants: Wants) -> None:
        """Subscribe to what is new in the graph and wanted."""
        for publication in self._publications():
            topic, type_name = publication.topic, publication.type
            if topic in self._subscriptions or self._reports.refusal("subscribe", topic, type_name):
                continue
            qos = wants(topic, type_name)
            if qos is None:
                continue
            try:
                with self._lock:
                    offered = self._make(topic, type_name, self._offered(topic, type_name, qos))
            except Exception as error:  # as above
                self._reports.refuse("subscribe", topic, type_name, error)
            else:
                facts = {"type": type_name, **asdict(offered)}
                text = f"subscribed to {topic}{self._alias(topic)} ({type_name}), {describe(offered)}"
                self._reports.note(Level.INFO, "ros_subscribed", text, topic, facts)

    def note_losses(self) -> None:
        """Note the messages that were lost since the last call."""
        for one in self.all():
            one.sync()
            lost = one.counts.lost - one.noted_lost
            if lost:
                one.noted_lost += lost
                why = "queue too short, the network, or a sender with little shared memory for large messages"
                text = f"{one.topic}: {count_text(lost, 'message')} lost before we took them ({why})"
                self._reports.note(Level.WARN, "ros_lost", text, one.topic, {"lost": lost})

    def sync(self) -> None:
        """Take over what was counted in other threads."""
        for one in list(self._subscriptions.values()):
            one.sync()

    def all(self) -> list[S]:
        """Return the subscriptions."""
        with self._lock:
            return list(self._subscriptions.values())


def guarded(topic: str, type_name: str, counts: TopicCounts, on_message: OnMessage, reports: Reports) -> Deliver:
    """Return what passes the messages of a subscription on, in the receiver's thread."""

    def deliver(cdr: bytes, source_ns: int) -> None:
        try:
            on_message(topic, type_name, cdr, source_ns)
        except Exception as error:  # a defect of our own costs this message, not the thread
            counts.failed += 1
            reports.callback_failed(f"{topic}: {type(error).__name__}", error, topic)

    return deliver


def describe(qos: Qos) -> str:
    """Return a QoS in words."""
    reliability = "reliable" if qos.reliable else "best effort"
    return f"{reliability}{', latched' if qos.latched else ''}, depth {qos.depth}"

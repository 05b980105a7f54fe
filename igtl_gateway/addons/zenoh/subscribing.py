"""Subscriptions: made when asked for or when a token shows a wanted topic."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from typing import Any

from igtl_gateway.addon import Clock, RosError
from igtl_gateway.addon.reading import Level, Qos
from igtl_gateway.addon.ros_side import Deliver, OnMessage, Reports, Subscriptions, TopicCounts, Wants, guarded
from igtl_gateway.addons.zenoh.graph import Graph
from igtl_gateway.addons.zenoh.inbox import Inbox, Waiting
from igtl_gateway.addons.zenoh.names import Kind, Node, read_attachment
from igtl_gateway.addons.zenoh.own_node import OwnNode

#: Publishers of one topic whose sequence numbers are followed.
_SENDERS = 1024
#: A larger gap is a publisher that counts otherwise, not a loss.
_LARGEST_GAP = 1_000_000
#: Topics that are subscribed to: tokens of any number of them are quickly written.
_MOST = 4096
_MAX_STAMP_NS = 1 << 63
#: Messages whose age is kept between two looks at it.
_AGES = 4096


class TopicSubscription:
    """One subscription: what was received, and what was lost.

    The sequence numbers of each publisher show every loss on the way; what gives way in our inbox adds to it.
    """

    def __init__(
        self, topic: str, type_name: str, qos: Qos, counts: TopicCounts, inbox: Inbox, deliver: Deliver
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.counts = counts
        self.noted_lost = 0
        self.type_hash = ""
        self.bad = ""  # why the first message was refused that has not been noted
        self.waiting = Waiting(self._deliver, qos.depth)
        self.ages: deque[tuple[bytes, int]] = deque(maxlen=_AGES)  # for the latency of sites
        self.clock: Clock | None = None
        self._inbox = inbox
        self._deliver_bytes = deliver
        self._lock = threading.Lock()
        self._last: OrderedDict[bytes, int] = OrderedDict()
        self._missing = 0
        self._put: Any = None
        self._subscriber: Any = None
        self._token: Any = None

    def declare(self, zenoh: Any, session: Any, node: Node, number: int, key: str, type_hash: str) -> None:
        """Declare subscriber and token."""
        self._put = zenoh.SampleKind.PUT
        remote = zenoh.Locality.REMOTE
        if self.qos.latched:
            ext = zenoh.ext
            recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if self.qos.reliable else None
            self._subscriber = ext.declare_advanced_subscriber(
                session,
                key,
                self._on_sample,
                allowed_origin=remote,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=self.qos.depth),
                recovery=recovery,
                subscriber_detection=True,
            )
        else:
            self._subscriber = session.declare_subscriber(key, self._on_sample, allowed_origin=remote)
        token = node.entity_token(number, Kind.SUBSCRIPTION, self.topic, self.type_name, type_hash, self.qos)
        self._token = session.liveliness().declare_token(token)

    def sync(self) -> None:
        """Take over what was counted in other threads."""
        with self._lock:
            self.counts.lost = self._missing + self.waiting.displaced

    def _on_sample(self, sample: Any) -> None:
        """Called by Zenoh, in its threads."""
        if sample.kind != self._put:
            return
        try:
            found = sample.attachment
            if found is None:
                raise ValueError("found no attachment")
            sequence, stamp_ns, of_gid = read_attachment(found.to_bytes())
        except ValueError as error:
            with self._lock:
                self.counts.failed += 1
            self.bad = self.bad or str(error)
            return
        with self._lock:
            self._count(of_gid, sequence)
            if self.clock and stamp_ns:
                self.ages.append((of_gid, self.clock.utc_ns() - stamp_ns))
        payload = sample.payload
        self._inbox.put(self.waiting, payload, len(payload), stamp_ns if 0 <= stamp_ns < _MAX_STAMP_NS else 0)

    def _count(self, of_gid: bytes, sequence: int) -> None:
        last = self._last.get(of_gid)
        if last is None and len(self._last) >= _SENDERS:
            self._last.popitem(last=False)
        if last is not None and sequence > last:
            gap = sequence - last - 1
            self._missing += gap if gap <= _LARGEST_GAP else 0
        if last is None or sequence > last or sequence <= 1:  # history may come late; 0 and 1 begin again
            self._last[of_gid] = sequence

    def take_ages(self) -> list[tuple[bytes, int]]:
        """Return publisher and age (ns) of the messages since the last call."""
        with self._lock:
            found = list(self.ages)
            self.ages.clear()
            return found

    def _deliver(self, payload: Any, stamp_ns: int) -> None:
        """Called by the inbox, in our thread."""
        self.counts.received += 1
        self._deliver_bytes(payload.to_bytes(), stamp_ns)


class Subscribing(Subscriptions[TopicSubscription]):
    """The subscriptions of a node over Zenoh."""

    def __init__(
        self,
        node: OwnNode,
        graph: Graph,
        reports: Reports,
        inbox: Inbox,
        on_message: OnMessage,
        *,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(node.connection.lock, reports, graph.publications, {})
        self._clock = clock
        self._node = node
        self._graph = graph
        self._inbox = inbox
        self._on_message = on_message

    def ages(self) -> list[tuple[str, list[tuple[bytes, int]]]]:
        """Return topic → publisher and age of the messages since the last call."""
        return [(topic, one.take_ages()) for topic, one in list(self._subscriptions.items())]

    def discover(self, wants: Wants) -> None:
        """Subscribe to what is new in the graph and wanted."""
        self._note_hashes()
        super().discover(wants)

    def note_losses(self) -> None:
        """Note the messages that were lost or refused since the last call."""
        super().note_losses()
        for one in self.all():
            if one.bad:
                bad, one.bad = one.bad, ""
                text = f"{one.topic}: not a message of ROS, it is refused: {bad}"
                self._reports.note_once(Level.WARN, "ros_bad_attachment", text, one.topic)

    def _offered(self, topic: str, type_name: str, wanted: Qos) -> Qos:
        """The QoS that suits the present publishers."""
        ours = self._node.hashes.of(type_name)
        place = topic, type_name, ours
        offered = [each.qos for each in self._graph.publishers() if (each.topic, each.type, each.type_hash) == place]
        return Qos(
            depth=wanted.depth,
            reliable=wanted.reliable and all(qos.reliable for qos in offered),
            latched=any(qos.latched for qos in offered),  # one that is not latched reaches us all the same
        )

    def _note_hashes(self) -> None:
        """Note publishers of our topics whose definition of the type is another one."""
        for each in self._graph.publishers():
            one = self._subscriptions.get(each.topic)
            if one is None or one.type_name != each.type or one.type_hash == each.type_hash:
                continue
            found = f"found {each.type_hash[:15]}… at {each.node.full_name}, expected {one.type_hash[:15]}…"
            text = f"{each.topic}: another definition of {each.type}, its messages do not reach us: {found}"
            self._reports.note_once(Level.WARN, "ros_type_hash", text, each.topic)

    def _make(self, topic: str, type_name: str, qos: Qos) -> Qos:
        if len(self._subscriptions) >= _MOST:
            raise RosError(f"found {_MOST} subscriptions, expected fewer")
        key, type_hash = self._node.key(topic, type_name)
        counts = self._reports.counts(topic)
        deliver = guarded(topic, type_name, counts, self._on_message, self._reports)
        made = TopicSubscription(topic, type_name, qos, counts, self._inbox, deliver)
        made.type_hash = type_hash
        made.clock = self._clock

        def declare(session: Any) -> None:
            made.declare(self._node.connection.zenoh, session, *self._node.next(session), key, type_hash)

        self._node.connection.declare(declare)
        self._subscriptions[topic] = made
        return qos

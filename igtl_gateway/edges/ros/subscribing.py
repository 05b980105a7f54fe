"""Subscriptions: made when asked for or when discovery finds a wanted topic, each with its callback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from igtl_gateway.base.errors import RosError
from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.ros.graph import Graph
from igtl_gateway.edges.ros.middleware import interface_class, profile_of
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.receiver import Receiver
from igtl_gateway.edges.ros.reports import Reports
from igtl_gateway.edges.ros.streams import Topics, TopicSubscription
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.native.passage import Subscription as NativeSubscription

OnMessage = Callable[[str, str, bytes, int], None]
Wants = Callable[[str, str], Qos | None]
#: Takes the bytes of a message and what the middleware knows of it.
Callback = Callable[[bytes, dict[str, Any]], None]


def message_callback(subscription: TopicSubscription, on_message: OnMessage, reports: Reports) -> Callback:
    """Return the callback of a subscription, which every received message passes, in the receiver's thread."""
    topic, type_name = subscription.topic, subscription.type_name

    def receive(cdr: bytes, info: dict[str, Any]) -> None:
        source_ns = info["source_timestamp"]
        if subscription.echo is not None and subscription.echo.is_own(cdr, source_ns):
            return
        subscription.received(info.get("publication_sequence_number"))
        try:
            on_message(topic, type_name, cdr, source_ns)
        except Exception as error:  # a defect of our own costs this message, not the thread
            subscription.counts.failed += 1
            reports.callback_failed(f"{topic}: {type(error).__name__}", error, topic)

    return receive


class Subscribing:
    """The subscriptions of a node.

    Args:
        make_callback: returns the callback of a new subscription.
    """

    def __init__(
        self,
        node: RosNode,
        topics: Topics,
        graph: Graph,
        reports: Reports,
        make_callback: Callable[[TopicSubscription], Callback],
    ) -> None:
        self._node = node
        self._topics = topics
        self._subscriptions = topics.subscriptions
        self._graph = graph
        self._reports = reports
        self._make_callback = make_callback
        self._receiver: Receiver | None = None

    def start(self, receiver: Receiver) -> None:
        """Have this receiver take the messages of all subscriptions."""
        self._receiver = receiver
        receiver.start()

    def stop(self) -> None:
        """No callback runs after this."""
        if self._receiver is not None:
            self._receiver.stop()

    def subscribe(self, topic: str, type_name: str, qos: Qos) -> bool:
        """Subscribe now; see ``RosEdge.subscribe``."""
        try:
            with self._node.lock:
                if topic not in self._subscriptions:
                    self._make(topic, type_name, qos)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._reports.refuse("subscribe", topic, type_name, error)
            return False
        return True

    def topics(self) -> list[tuple[str, str]]:
        """Topic and type of everything that we receive."""
        with self._node.lock:
            return sorted((one.topic, one.type_name) for one in self._subscriptions.values())

    def discover(self, wants: Wants) -> None:
        """Subscribe to what is new in the graph and wanted."""
        for publication in self._graph.publications():
            topic, type_name = publication.topic, publication.type
            if topic in self._subscriptions or self._reports.refusal("subscribe", topic, type_name):
                continue
            qos = wants(topic, type_name)
            if qos is None:
                continue
            try:
                with self._node.lock:
                    offered = self._make(topic, type_name, qos)
            except Exception as error:  # rclpy raises a dozen unrelated classes here
                self._reports.refuse("subscribe", topic, type_name, error)
            else:
                facts = {"type": type_name, **asdict(offered)}
                text = f"subscribed to {topic}{self._alias(topic)} ({type_name}), {describe(offered)}"
                self._reports.note(Level.INFO, "ros_subscribed", text, topic, facts)

    def poll_events(self) -> None:
        """Have the middleware report lost messages and matches since the last call."""
        if self._receiver is None or not self._node.is_running:
            return
        try:
            with self._node.lock:
                self._receiver.poll_events()
        except Exception as error:  # of one callback, or of rclpy internals that have changed
            self._reports.callback_failed("events", error, "events")

    def note_losses(self) -> None:
        """Note the messages that were lost since the last call."""
        with self._node.lock:
            subscriptions = list(self._subscriptions.values())
        for one in subscriptions:
            one.sync()
            lost = one.counts.lost - one.noted_lost
            if lost:
                one.noted_lost += lost
                text = f"{one.topic}: {lost} messages lost before we took them (queue too short, or the network)"
                self._reports.note(Level.WARN, "ros_lost", text, one.topic, {"lost": lost})

    def _make(self, topic: str, type_name: str, wanted: Qos) -> Qos:
        """Subscribe (with the lock held); returns the resulting QoS."""
        node, rclpy, node_names = self._node.handle, self._node.rclpy, self._node.names
        if self._receiver is None:
            raise RosError("the node is not running")
        message_class = interface_class(type_name)
        qos = self._graph.matching_qos(topic, wanted)
        in_graph = node_names.in_graph(topic)
        echo = None
        for publisher in self._topics.publishers_at(in_graph):
            echo = self._topics.echo(in_graph)
            if publisher.echo is None:
                with publisher.lock:
                    publisher.echo = echo
        subscription = TopicSubscription(topic, type_name, self._reports.counts(topic), echo)
        subscription.in_graph = in_graph
        events = rclpy.event_handler.SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._note_incompatible(topic, event),
            message_lost=lambda event: subscription.lost(event.total_count_change),
            matched=lambda event: subscription.matched(event.current_count),
            use_default_callbacks=False,
        )
        subscription.subscription = node.create_subscription(
            message_class,
            node_names.asked(topic),
            self._make_callback(subscription),
            profile_of(rclpy, qos),
            callback_group=self._receiver.group,
            event_callbacks=events,
            raw=True,
        )
        self._subscriptions[topic] = subscription
        subscription.native = self._receiver.add(subscription.subscription)
        return qos

    def native(self, topic: str, type_name: str) -> NativeSubscription | None:
        """Return a subscription as the native passage has it; None: all its messages are Python's."""
        subscription = self._subscriptions.get(topic)
        if subscription is None or subscription.type_name != type_name or subscription.echo is not None:
            return None
        return subscription.native

    def sync(self) -> None:
        """Take over what the native passage has counted."""
        for subscription in list(self._subscriptions.values()):
            subscription.sync()

    def _alias(self, topic: str) -> str:
        """The name of a topic in the graph, where it is another one."""
        in_graph = self._node.names.in_graph(topic)
        return "" if in_graph == topic else f", in the graph {in_graph}"

    def _note_incompatible(self, topic: str, event: Any) -> None:
        policy = self._node.rclpy.qos.qos_policy_name_from_kind(event.last_policy_kind)
        self._reports.incompatible_qos(topic, "a publisher", policy)


def describe(qos: Qos) -> str:
    """Return a QoS in words."""
    reliability = "reliable" if qos.reliable else "best effort"
    return f"{reliability}{', latched' if qos.latched else ''}, depth {qos.depth}"

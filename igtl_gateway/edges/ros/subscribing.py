"""Subscriptions: made when asked for or when discovery finds a wanted topic, each with its callback."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from igtl_gateway.base.errors import RosError
from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.interface import OnMessage, Reports, Subscriptions, guarded
from igtl_gateway.edges.ros import distributions
from igtl_gateway.edges.ros.graph import Graph
from igtl_gateway.edges.ros.middleware import interface_class, profile_of
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.receiver import Receiver
from igtl_gateway.edges.ros.topics import Topics, TopicSubscription
from igtl_gateway.native.passage import Subscription as NativeSubscription

#: Takes the bytes of a message and what the middleware knows of it.
Callback = Callable[[bytes, dict[str, Any]], None]


def message_callback(subscription: TopicSubscription, on_message: OnMessage, reports: Reports) -> Callback:
    """Return the callback of a subscription, which every received message passes, in the receiver's thread."""
    deliver = guarded(subscription.topic, subscription.type_name, subscription.counts, on_message, reports)

    def receive(cdr: bytes, info: dict[str, Any]) -> None:
        source_ns = info["source_timestamp"]
        if subscription.echo is not None and subscription.echo.is_own(cdr, source_ns):
            return
        subscription.received(info.get("publication_sequence_number"))
        deliver(cdr, source_ns)

    return receive


class Subscribing(Subscriptions[TopicSubscription]):
    """The subscriptions of a node; `Subscriptions` has what does not depend on DDS.

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
        super().__init__(node.lock, reports, graph.publications, topics.subscriptions)
        self._node = node
        self._topics = topics
        self._graph = graph
        self._make_callback = make_callback
        self._receiver: Receiver | None = None
        self._matches: list[distributions.CountedMatches] = []  # where the middleware does not report them

    def start(self, receiver: Receiver) -> None:
        """Have this receiver take the messages of all subscriptions."""
        self._receiver = receiver
        receiver.start()

    def stop(self) -> None:
        """No callback runs after this."""
        if self._receiver is not None:
            self._receiver.stop()

    def poll_events(self) -> None:
        """Have the middleware report lost messages and matches since the last call."""
        if self._receiver is None or not self._node.is_running:
            return
        try:
            with self._node.lock:
                self._receiver.poll_events()
                for matches in self._matches:
                    matches.poll()
        except Exception as error:  # of one callback, or of rclpy internals that have changed
            self._reports.callback_failed("events", error, "events")

    def _make(self, topic: str, type_name: str, wanted: Qos) -> Qos:
        node, rclpy, node_names = self._node.handle, self._node.rclpy, self._node.names
        if self._receiver is None:
            raise RosError("the node is not running")
        message_class = interface_class(type_name)
        qos = self._graph.matching_qos(topic, wanted)
        in_graph = node_names.in_graph(topic)
        echo = None
        for publisher in self._topics.publishers_at(in_graph):
            echo = self._topics.echo(in_graph)
            with publisher.lock:
                publisher.echo = echo
            publisher.comes_back = True
            if publisher.native:
                publisher.native.leave()
        subscription = TopicSubscription(topic, type_name, self._reports.counts(topic), echo)
        subscription.in_graph = in_graph
        subscription.subscription, matches = distributions.create_subscription(
            rclpy,
            node,
            message_class,
            node_names.asked(topic),
            self._make_callback(subscription),
            profile_of(rclpy, qos),
            group=self._receiver.group,
            incompatible_qos=lambda event: self._note_incompatible(topic, event),
            message_lost=lambda event: subscription.lost(event.total_count_change),
            matched=lambda event: subscription.matched(event.current_count),
        )
        if matches:
            self._matches.append(matches)
        self._subscriptions[topic] = subscription
        subscription.native = self._receiver.add(subscription.subscription)
        return qos

    def native(self, topic: str, type_name: str) -> NativeSubscription | None:
        """Return a subscription as the native passage has it; None: all its messages are Python's."""
        subscription = self._subscriptions.get(topic)
        if subscription is None or subscription.type_name != type_name or subscription.echo is not None:
            return None
        return subscription.native

    def _alias(self, topic: str) -> str:
        """The name of a topic in the graph, where it is another one."""
        in_graph = self._node.names.in_graph(topic)
        return "" if in_graph == topic else f", in the graph {in_graph}"

    def _note_incompatible(self, topic: str, event: Any) -> None:
        policy = self._node.rclpy.qos.qos_policy_name_from_kind(event.last_policy_kind)
        self._reports.incompatible_qos(topic, "a publisher", policy, publishes=True)

"""``RosEdge``: the interface of the ROS side, composed of the node and its topics.

Three threads work beside the callers of `RosEdge.publish`:

* *receiver*: takes messages and calls ``on_message`` (``receiver``, ``subscribing``);
* *executor*: rclpy's own, for the services and the parameters of the node (``node``);
* *keeper*: waits for changes of the graph, subscribes to what is wanted, sends held messages (``keeper``).

Three rules that DDS leaves to its users:

* **First messages.**  A new publisher reaches no subscriber until discovery has matched it.  Messages are held until
  every subscription that the graph shows has been matched, or a limit has passed (``publishing``).  Commands to robots
  are never held (``edges.interface.publishers``).
* **No echo.**  What we publish does not come back to us: topics that only we publish are not subscribed to, and on
  topics that others publish too our own messages are recognised (``topics.EchoFilter``).
* **Loss is silent.**  A KEEP_LAST queue that overflows raises no event.  Gaps in the publisher's sequence numbers
  show it (``topics.TopicSubscription``).
"""

from __future__ import annotations

import atexit
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any

from igtl_gateway.base.errors import first_line
from igtl_gateway.config.setting import Value
from igtl_gateway.config.settings import DEFAULT_LATCHED_MIB
from igtl_gateway.edges.interface import Change, Halves, OnMessage, OnNote, Reports, Wants
from igtl_gateway.edges.ros.calls import Answer, Caller, serve_later
from igtl_gateway.edges.ros.direct import Rcl
from igtl_gateway.edges.ros.graph import Graph
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.ros.keeper import Keeper
from igtl_gateway.edges.ros.middleware import import_rclpy, interface_class
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.publishing import Publishing
from igtl_gateway.edges.ros.receiver import DirectReceiver, ExecutorReceiver, NativeReceiver, Receiver
from igtl_gateway.edges.ros.subscribing import Callback, Subscribing, message_callback
from igtl_gateway.edges.ros.topics import Topics, TopicSubscription
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.native.passage import Passage
from igtl_gateway.native.passage import Publisher as NativePublisher
from igtl_gateway.native.passage import Subscription as NativeSubscription


class RosEdge(Halves):
    """The gateway's node in the ROS graph.  It moves serialised messages, never message objects.

    Args:
        node_name: name of the node.
        namespace: namespace of the node.
        on_message: called with topic, type ``"pkg/msg/Name"``, CDR bytes with their 4-byte encapsulation, and the
            DDS source stamp in UTC ns (0 = unset).  One call at a time.  The bytes are those that DDS carried:
            between processes that is what was sent, padded with zeros to a multiple of 4.
        wants: called for every topic and type that others publish, until it returns the QoS to subscribe with instead
            of None.  Reliability and durability are weakened to what all publishers offer.
        on_note: called with facts (subscribed, unknown type, losses …), from any thread.
        on_listener: called with the topic when a subscriber joins what we publish, at once.
        direct: receive by our own wait set; False (or an rclpy without its internals) by the executor.
        host: where the node is; default: a node of this edge only, by ``node_name`` and ``namespace``.
        passage: the native passage, whose streams the topics may have; None: there is none.
        latched_mib: bound of the latched messages of all topics.
    """

    def __init__(
        self,
        *,
        node_name: str = "igtl_gateway",
        namespace: str = "",
        on_message: OnMessage,
        wants: Wants,
        on_note: OnNote,
        on_listener: Callable[[str], None] | None = None,
        direct: bool = True,
        host: NodeHost | None = None,
        passage: Passage | None = None,
        latched_mib: int = DEFAULT_LATCHED_MIB,
    ) -> None:
        self._on_message = on_message
        self._direct = direct
        self._passage = passage
        self._topics = Topics()
        self._reports = Reports(on_note)
        self._node = RosNode(host or NodeHost(node_name, namespace), self._reports)
        self._graph = Graph(self._node, self._topics)
        self._publishing = Publishing(
            self._node, self._topics, self._graph, self._reports, on_listener, latched_mib << 20
        )
        self._subscribing = Subscribing(self._node, self._topics, self._graph, self._reports, self._callback)
        self._keeper = Keeper(self._node, self._publishing, self._subscribing, self._reports, wants)
        super().__init__(self._publishing, self._subscribing, self._graph)

    @staticmethod
    def check() -> None:
        """Raises RosError, in one line, if there is no ROS 2 here that a node can be made with."""
        import_rclpy()

    @staticmethod
    def message_class(type_name: str) -> Any:
        """The Python class of a message type.  Raises RosError if it is not installed here."""
        return interface_class(type_name)

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace; only after the start."""
        return self._node.host.full_name

    def start(self) -> None:
        """Join the graph.

        Raises RosError, in one line, if ROS is missing or refuses, and ConfigError for invalid arguments of the host.
        """
        context = self._node.start()
        # The threads wait inside the middleware: it must not be torn down under them at exit.
        atexit.register(self.stop)
        self._subscribing.start(self._make_receiver(context))
        self._keeper.start()

    def follow(self, change: Change | None) -> None:
        """Have the parameters that may change while a bridge runs call this; None: they wait for the next bridge."""
        self._node.host.on_change = change

    @property
    def changing(self) -> AbstractContextManager[object]:
        """The lock of ``NodeHost.changing``."""
        return self._node.host.changing

    def show(self, values: Mapping[str, Value]) -> None:
        """Set parameters to settings that have changed; see ``NodeHost.show``."""
        self._node.host.show(values)

    def log(self, level: Level, text: str, stamp_ns: int) -> None:
        """Publish a line on ``/rosout``; see ``NodeHost.log``."""
        self._node.host.log(level, text, stamp_ns)

    def stop(self) -> None:
        """Send what is held, leave the graph, end the threads.  Further calls do nothing."""
        self._publishing.finish_making()
        leave = self._node.begin_stop()
        if leave is None:
            return
        atexit.unregister(self.stop)
        self._keeper.join()
        self._subscribing.stop()
        self._publishing.close()
        leave()

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Any], Any]) -> bool:
        """Offer a service; ``answer`` fills a response and may wait, in a thread of the executor's.

        Args:
            name: of the service; ``~/`` stands for the node.
            type_name: ``"pkg/srv/Name"``.
            answer: called with request and response, returns the response.

        Returns:
            Whether that was possible; if not, a note reports why.
        """
        return self._node.serve(name, type_name, answer)

    def serve_later(self, name: str, type_name: str, on_request: Callable[[bytes, Answer], None]) -> str:
        """Offer a service of serialised messages that may answer later; see ``calls.serve_later``.

        Returns:
            Why that is impossible, such as that another node offers it; ``""``.
        """
        try:
            if self._node.handle.count_services(name):
                return "another node offers it"
            serve_later(self._node, name, type_name, on_request)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            return first_line(error)
        return ""

    def caller(self, name: str, event_type: str, goals: dict[bytes, bytes]) -> Caller | str:
        """Return a client for the recorded events of a service, or why there is none; see ``calls.Caller``."""
        try:
            return Caller(self._node, name, event_type, goals)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            return first_line(error)

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a condition holds that a response may change; False if that took longer, True at stop."""
        return self._node.wait(condition, timeout_s)

    def subscriber_count(self, topic: str) -> int:
        """The number of subscriptions that our publisher of this topic is matched with, without our own."""
        return self._publishing.subscriber_count(topic)

    def wait_for_subscribers(self, topic: str, count: int, timeout_s: float) -> bool:
        """Wait until ``count`` subscriptions are matched; False if that took longer than ``timeout_s``, or at stop."""
        return self._publishing.wait_for_subscribers(topic, count, timeout_s)

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait until no publisher holds messages back for subscribers that discovery has yet to match.

        True at the latest some seconds after start; False if ``timeout_s`` was shorter, or at stop.
        """
        return self._publishing.wait_ready(timeout_s)

    def wait_acked(self, topic: str, timeout_s: float) -> bool:
        """Wait until every reliable subscriber has acknowledged all that we sent; False if that took too long.

        True for topics without acknowledgements, and at stop.
        """
        return self._publishing.wait_acked(topic, timeout_s)

    def native_subscription(self, topic: str, type_name: str) -> NativeSubscription | None:
        """Return a subscription as the native passage has it; None: all its messages are Python's."""
        return self._subscribing.native(topic, type_name)

    def native_publisher(self, topic: str, type_name: str) -> NativePublisher | None:
        """Return a publisher for the native passage; None: Python publishes."""
        return self._publishing.native(topic, type_name)

    def sync(self) -> None:
        """Take over what the native passage has counted."""
        self._subscribing.sync()
        self._publishing.sync()

    def counters(self) -> dict[str, dict[str, int]]:
        """Per topic: messages received, published, held now, lost (before we took them, or while held), failed."""
        return self._reports.counters()

    def failing(self) -> dict[str, str]:
        """Topic that others publish → why nothing has come from it."""
        return self._reports.failing()

    def _callback(self, subscription: TopicSubscription) -> Callback:
        """The callback of a new subscription."""
        return message_callback(subscription, self._on_message, self._reports)

    def _make_receiver(self, context: Any) -> Receiver:
        if self._direct:
            if self._passage and DirectReceiver.available(self._node.rclpy):
                return NativeReceiver(self._passage, Rcl(), self._on_receive_error)
            if DirectReceiver.available(self._node.rclpy):
                return DirectReceiver(self._node.rclpy, context, self._on_receive_error)
            self._reports.note(Level.WARN, "ros_slow", "this rclpy lacks a wait set: its executor receives, slowly")
        return ExecutorReceiver()

    def _on_receive_error(self, error: Exception) -> None:
        self._reports.note_once(Level.ERROR, "ros_receive_failed", f"taking a message: {first_line(error)}")

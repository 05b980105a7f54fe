"""The ROS 2 edge: a node that moves serialised messages, never message objects.

Three threads work beside the callers of `RosEdge.publish`:

* *receiver*: takes messages and calls ``on_message`` (see `igtl_gateway.edges.ros.receiver`);
* *executor*: rclpy's own, for the parameter services of the node and for the events of the middleware;
* *keeper*: looks at the graph four times a second, subscribes to what is wanted, releases held messages.

Three rules that DDS leaves to its users:

* **First messages.**  A new publisher reaches nobody until discovery has matched it.  Messages are held until
  every foreign subscription that the graph knows has been matched, or a limit has passed; see `Writer`.
* **No echo.**  What we publish does not come back to us: topics that only we publish are not subscribed, and on
  topics that others publish too our own messages are recognised; see `Echo`.
* **Loss is silent.**  A KEEP_LAST queue that overflows raises no event.  Gaps in the publisher's sequence numbers
  show it; see `Reader`.

rclpy is imported by `RosEdge.start` and nowhere else, so that this module loads without any ROS.
"""

from __future__ import annotations

import atexit
import importlib
import os
import re
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros.direct import direct
from igtl_gateway.edges.ros.receiver import DirectReceiver, ExecutorReceiver, Receiver
from igtl_gateway.edges.ros.streams import HOLD_BYTES, HOLD_MESSAGES, Counts, Echo, Reader, Writer, first_line
from igtl_gateway.errors import RosError
from igtl_gateway.extras import missing
from igtl_gateway.qos import Endpoint, Qos
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S

#: Subscriptions that the graph knows are matched well within this time, or never (incompatible QoS).
HOLD_NS = 2_000_000_000
#: So long after the start a graph without subscribers may only mean that discovery is not through.
DISCOVERY_NS = 3_000_000_000

_LOOK_NS = 250_000_000
_RELEASE_S = 0.02  # between two looks at held messages; matching also wakes the keeper at once
_BURST_S = 0.002  # between two bursts of held messages, so that a reader of the same depth can take them
_LINGER_NS = 500_000_000  # for acknowledgements at the end; a reader that hangs must not hold us up
_CDR_HEADER = 4

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv)/([A-Z][A-Za-z0-9]*)")

_LISTENED = 10_000  # matches not told of yet: at most those of a quarter of a second
_CALLS_AT_ONCE = 8  # of services; a call may wait for a peer
_CALLS_WAITING = 100  # of each service; one that is pushed out of DDS's queue is never answered

_RMW_CHECK_S = 60

OnMessage = Callable[[str, str, bytes, int], None]
Wants = Callable[[str, str], Qos | None]
OnNote = Callable[[Note], None]


@dataclass(frozen=True, slots=True)
class Publication:
    """What the edge knows of a topic that others publish.

    Attributes:
        topic: full name.
        type: ``"pkg/msg/Name"``.
        publishers: how many publishers there are besides our own.
    """

    topic: str
    type: str
    publishers: int


@dataclass(slots=True)
class _Running:
    """What exists between start and stop."""

    context: Any
    node: Any
    executor: Any
    receiver: Receiver
    threads: list[threading.Thread] = field(default_factory=list)


class RosEdge:
    """The gateway's place in the ROS graph.

    Args:
        node_name: name of the node.
        namespace: namespace of the node.
        on_message: called with topic, type ``"pkg/msg/Name"``, CDR bytes with their 4-byte encapsulation, and the
            DDS source stamp in UTC ns (0 = unset).  One call at a time.  The bytes are those that DDS carried:
            between processes that is what was sent, padded with zeros to a multiple of 4.
        wants: asked for every topic and type that others publish, until it answers: the QoS to subscribe with,
            else None.  Reliability and durability are weakened to what all publishers offer.
        on_note: called with facts (subscribed, unknown type, losses …), from any thread.
        on_listener: called with the topic when somebody begins to listen to what we publish, within a quarter of a
            second.
        direct: receive by our own wait set; False (or an rclpy without its internals) by the executor.
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
    ) -> None:
        self._node_name = node_name
        self._namespace = namespace
        self._on_message = on_message
        self._wants = wants
        self._on_note = on_note
        self._on_listener = on_listener
        self._listened: deque[str] = deque(maxlen=_LISTENED)  # topics to be told of
        self._direct = direct
        # The stamps of DDS are compared with it, so no other clock would do.
        self._clock = SystemClock()
        self._rclpy: Any = None
        self._running: _Running | None = None
        self._started_ns = 0
        self._stopping = threading.Event()
        self._wake = threading.Event()
        self._matched = threading.Condition()
        # Guards the tables below and the making of entities; not taken on the way of a message.
        self._lock = threading.RLock()
        self._counts: dict[str, Counts] = {}
        self._readers: dict[str, Reader] = {}
        self._writers: dict[str, Writer] = {}  # by the name as given and by the full name
        self._noted: set[tuple[str, ...]] = set()
        self._refusals: dict[tuple[str, str, str], str] = {}  # action, topic, type → why

    # --- life -----------------------------------------------------------------------------------------------------

    @staticmethod
    def check() -> None:
        """Raises RosError, in one line, if there is no ROS 2 here that a node can be made with."""
        _import_rclpy()

    def start(self) -> None:
        """Join the graph.  Raises RosError, in one line, if ROS is missing or refuses."""
        if self._running is not None or self._stopping.is_set():
            raise RosError(f"node {self._node_name!r}: started before, an edge starts once")
        self._rclpy = rclpy = _import_rclpy()
        context = rclpy.context.Context()
        try:
            # Context.init (unlike rclpy.init) leaves the signal handlers alone; [] keeps sys.argv out of ROS.
            context.init(args=[])
            # No /rosout: our own words must not come back as somebody's publication.
            node = rclpy.node.Node(
                self._node_name, namespace=self._namespace or None, context=context, enable_rosout=False
            )
        except Exception as error:
            context.try_shutdown()
            raise RosError(f"node {self._node_name!r} in {self._namespace!r}: {first_line(error)}") from error
        executor = rclpy.executors.MultiThreadedExecutor(_CALLS_AT_ONCE, context=context)
        executor.add_node(node)
        running = _Running(context, node, executor, self._make_receiver(context))
        self._running = running
        self._started_ns = self._clock.monotonic_ns()
        running.threads = [
            threading.Thread(target=self._spin, args=(running,), name="igtl-ros-executor", daemon=True),
            threading.Thread(target=self._keep, name="igtl-ros-keeper", daemon=True),
        ]
        # The threads wait inside the middleware: it must not be torn down under them at exit.
        atexit.register(self.stop)
        running.receiver.start()
        for thread in running.threads:
            thread.start()

    def stop(self) -> None:
        """Send what is held, leave the graph, end the threads.  Again: nothing."""
        running, self._running = self._running, None
        self._stopping.set()
        if running is None:
            return
        atexit.unregister(self.stop)
        self._wake.set()
        running.executor.create_task(lambda: None)  # wakes spin_once and makes it return
        for thread in running.threads:
            thread.join()
        running.receiver.stop()
        self._flush()
        for writer in self._all_writers():
            writer.close()
        running.executor.shutdown()
        if pool := getattr(running.executor, "_executor", None):  # rclpy leaves its threads to the interpreter's end
            pool.shutdown(wait=True)
        with self._lock:
            running.node.destroy_node()
        running.context.try_shutdown()
        running.context.destroy()
        with self._matched:
            self._matched.notify_all()

    def _make_receiver(self, context: Any) -> Receiver:
        if self._direct:
            if DirectReceiver.available(self._rclpy):
                return DirectReceiver(self._rclpy, context, self._on_receive_error)
            self._note(Level.WARN, "ros_slow", "this rclpy has no wait set for us: its executor receives, slowly")
        return ExecutorReceiver()

    def _flush(self) -> None:
        deadline_ns = self._clock.monotonic_ns() + _LINGER_NS
        for writer in self._all_writers():
            self._note_failure(writer.topic, writer.release(self._clock, HOLD_MESSAGES + 1))
        for writer in self._all_writers():
            left_ns = deadline_ns - self._clock.monotonic_ns()
            if left_ns > 0 and writer.qos.reliable:
                writer.publisher.wait_for_all_acked(self._rclpy.duration.Duration(nanoseconds=left_ns))

    # --- publishing -----------------------------------------------------------------------------------------------

    def publish(self, topic: str, type_name: str, cdr: bytes, qos: Qos) -> str:
        """Send CDR bytes (with encapsulation); from any thread.

        The publisher is created on first use, and ``qos`` counts then.  Never raises for a bad topic or type, nor
        before start or after stop: that is noted once and counted as failed.

        Returns:
            Why the message is not published, or ``""``.  One that is held for its subscribers may still fail later,
            which `counters` show.
        """
        writer = self._writers.get(topic)
        if writer is None or writer.type_name != type_name:
            writer = self._writer(topic, type_name, qos)
            if writer is None:
                self._count(topic).failed += 1
                return self._refusals.get(("publish", topic, type_name), "the node is not running")
        if len(cdr) < _CDR_HEADER:
            # DDS would carry it, and each reader would fail over it
            with writer.lock:
                writer.counts.failed += 1
            found = f"{len(cdr)} bytes, expected CDR with {_CDR_HEADER} bytes of encapsulation"
            self._note_failure(writer.topic, found)
            return found
        overflown, failure = False, ""
        with writer.lock:
            if writer.ready:
                failure = writer.send(cdr, self._clock)
            else:
                writer.hold(cdr)
                # not dropped: those subscribers that are matched by now get it
                while writer.overflows:
                    overflown, failure = True, writer.send_oldest(self._clock)
        if failure:
            self._note_failure(writer.topic, failure)
        if overflown:
            self._note_overflow(writer.topic)
            return ""  # the failure is of an older one, and counted
        return failure

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Any], Any]) -> bool:
        """Offer a service; ``answer`` fills a response and may wait, in a thread of the executor's.

        Args:
            name: of the service; ``~/`` stands for the node.
            type_name: ``"pkg/srv/Name"``.
            answer: called with request and response, returns the response.

        Returns:
            Whether that was possible; if not, a note says why.
        """
        try:
            with self._lock:
                if self._running is None:
                    raise RosError("the node is not running")
                group = self._rclpy.callback_groups.ReentrantCallbackGroup()
                qos = self._rclpy.qos.QoSProfile(depth=_CALLS_WAITING)
                self._running.node.create_service(
                    _interface(type_name), name, answer, qos_profile=qos, callback_group=group
                )
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._refuse("serve", name, type_name, error)
            return False
        return True

    @staticmethod
    def message_class(type_name: str) -> Any:
        """The Python class of a message type.  Raises RosError if it is not installed here."""
        return _interface(type_name)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> None:
        """Create the publisher early, so that subscribers find it before the first message."""
        self._writer(topic, type_name, qos)

    def subscriber_count(self, topic: str) -> int:
        """How many readers our publisher of this topic is matched with, our own not counted."""
        with self._lock:
            writer = self._writers.get(topic)
            if writer is None or self._running is None:
                return 0
            own = int(writer.topic in self._readers)
            return max(0, int(writer.publisher.get_subscription_count()) - own)

    def heard(self, topic: str) -> bool:
        """Whether a message published now might reach anybody: cheap, and exact once discovery is through.

        True, too, while subscribers are waited for.  ``on_listener`` tells of those that come later.
        """
        writer = self._writers.get(topic)
        return writer is None or writer.heard

    def pass_over(self, topic: str) -> bool:
        """Whether a message of a topic need not be published, which is counted then.

        What is not latched and has no reader goes nowhere in DDS either, only more slowly (6 µs, after a pause 100).
        """
        writer = self._writers.get(topic)
        if writer is None or writer.qos.latched or writer.heard:
            return False
        writer.counts.unheard += 1
        return True

    def wait_for_subscribers(self, topic: str, count: int, timeout_s: float) -> bool:
        """Wait until ``count`` readers are matched; False if that took longer than ``timeout_s``, or at stop."""
        with self._matched:
            self._matched.wait_for(lambda: self._stopping.is_set() or self.subscriber_count(topic) >= count, timeout_s)
        return self.subscriber_count(topic) >= count

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait until no publisher holds messages back for subscribers that discovery has yet to match.

        True at the latest some seconds after start; False if ``timeout_s`` was shorter, or at stop.
        """
        with self._matched:
            self._matched.wait_for(lambda: self._stopping.is_set() or self._all_ready(), timeout_s)
        return self._all_ready()

    def wait_acked(self, topic: str, timeout_s: float) -> bool:
        """Wait until every reliable reader has acknowledged all that we sent there; False if that took too long.

        True for topics of which nobody acknowledges anything, and at stop.
        """
        writer = self._writers.get(topic)
        if writer is None or not writer.qos.reliable:
            return True
        with self._matched:
            if not self._matched.wait_for(lambda: self._stopping.is_set() or writer.ready, timeout_s):
                return False
        if self._running is None:
            return True
        timeout = self._rclpy.duration.Duration(nanoseconds=int(timeout_s * NS_PER_S))
        return bool(writer.publisher.wait_for_all_acked(timeout))

    def _all_ready(self) -> bool:
        return all(writer.ready for writer in self._all_writers())

    def _writer(self, topic: str, type_name: str, qos: Qos) -> Writer | None:
        """The publisher of the topic, made if there is none; None (and a note) if that is impossible."""
        if ("publish", topic, type_name) in self._refusals:
            return None
        try:
            with self._lock:
                if self._running is None:
                    raise RosError("the node is not running")
                full = self._running.node.resolve_topic_name(topic)
                writer = self._writers.get(full)
                if writer is None:
                    writer = self._make_writer(self._running.node, full, type_name, qos)
                if writer.type_name != type_name:
                    raise RosError(f"the topic has the type {writer.type_name}")
                self._writers[topic] = self._writers[full] = writer
                return writer
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._refuse("publish", topic, type_name, error)
            return None

    def _make_writer(self, node: Any, topic: str, type_name: str, qos: Qos) -> Writer:
        events = self._rclpy.event_handler.PublisherEventCallbacks(
            incompatible_qos=lambda event: self._note_incompatible(topic, "a subscriber", event),
            matched=lambda event: self._on_matched(topic, event.current_count_change),
            use_default_callbacks=False,
        )
        publisher = node.create_publisher(_interface(type_name), topic, self._profile(qos), event_callbacks=events)
        writer = Writer(topic, type_name, direct(publisher), qos, self._count(topic))
        reader = self._readers.get(topic)
        # a latched message may also reach a subscription that we make later
        if reader is not None or qos.latched:
            writer.echo = Echo()
        if reader is not None:
            reader.echo = writer.echo
        now_ns = self._clock.monotonic_ns()
        writer.deadline_ns = now_ns + HOLD_NS
        discovered_ns = self._started_ns + DISCOVERY_NS
        if not self._foreign_subscribers(node, topic):
            writer.deadline_ns = discovered_ns
            writer.ready = now_ns >= discovered_ns
        self._wake.set()
        return writer

    def _foreign_subscribers(self, node: Any, topic: str) -> int:
        """Subscriptions that the graph knows, our own not counted."""
        return int(node.count_subscribers(topic)) - int(topic in self._readers)

    def _release(self) -> bool:
        """Send a burst of the held messages whose subscribers are there; returns whether there were such."""
        bursting = False
        for writer in self._all_writers():
            if writer.ready or not self._may_go(writer):
                continue
            # Each burst is longer than the last, so that we catch up with any publisher in the end.
            self._note_failure(writer.topic, writer.release(self._clock, writer.burst + 1))
            writer.burst *= 2
            bursting = True
        return bursting

    def _may_go(self, writer: Writer) -> bool:
        if self._running is None or self._clock.monotonic_ns() >= writer.deadline_ns:
            return True
        known = self._foreign_subscribers(self._running.node, writer.topic)
        return 0 < known <= self.subscriber_count(writer.topic)

    # --- subscribing ----------------------------------------------------------------------------------------------

    def subscribe(self, topic: str, type_name: str, qos: Qos) -> bool:
        """Subscribe now, before anybody publishes there: a publisher that comes later waits for us with its first
        message.  Without that, topics are subscribed to when they are found, see ``wants``.

        Returns:
            Whether that was possible; if not, a note says why.
        """
        try:
            with self._lock:
                if topic not in self._readers:
                    self._make_reader(topic, type_name, qos)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._refuse("subscribe", topic, type_name, error)
            return False
        return True

    def subscriptions(self) -> list[tuple[str, str]]:
        """Topic and type of everything that we receive."""
        with self._lock:
            return sorted((reader.topic, reader.type_name) for reader in self._readers.values())

    def publications(self) -> list[Publication]:
        """The topics that others publish, as far as discovery has come."""
        with self._lock:
            if self._running is None:
                return []
            node = self._running.node
            own = Counter(publisher.topic_name for publisher in node.publishers)
            return [
                Publication(topic, type_name, count)
                for topic, types in node.get_topic_names_and_types()
                if (count := node.count_publishers(topic) - own[topic]) > 0
                for type_name in types
            ]

    def endpoints(self) -> list[Endpoint]:
        """Publishers and subscriptions of all topics, as far as discovery has come; our own node's left out."""
        with self._lock:
            if self._running is None:
                return []
            node = self._running.node
            own = (node.get_name(), node.get_namespace())
            return [
                Endpoint(
                    topic,
                    info.topic_type,
                    f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                    publishes,
                    self._qos_of(info.qos_profile),
                )
                for topic, _ in node.get_topic_names_and_types()
                for publishes, infos in (
                    (True, node.get_publishers_info_by_topic(topic)),
                    (False, node.get_subscriptions_info_by_topic(topic)),
                )
                for info in infos
                if (info.node_name, info.node_namespace) != own
            ]

    def _qos_of(self, profile: Any) -> Qos:
        """What we know of an rclpy profile."""
        policies = self._rclpy.qos
        return Qos(
            profile.depth,
            profile.reliability == policies.ReliabilityPolicy.RELIABLE,
            profile.durability == policies.DurabilityPolicy.TRANSIENT_LOCAL,
        )

    def _look(self) -> None:
        """Subscribe to what is new in the graph and wanted."""
        for publication in self.publications():
            topic, type_name = publication.topic, publication.type
            if topic in self._readers or ("subscribe", topic, type_name) in self._refusals:
                continue
            qos = self._wants(topic, type_name)
            if qos is None:
                continue
            try:
                with self._lock:
                    offered = self._make_reader(topic, type_name, qos)
            except Exception as error:  # rclpy raises a dozen unrelated classes here
                self._refuse("subscribe", topic, type_name, error)
            else:
                facts = {"type": type_name, **asdict(offered)}
                text = f"subscribed to {topic} ({type_name}), {_describe(offered)}"
                self._note(Level.INFO, "ros_subscribed", text, topic, facts)

    def _make_reader(self, topic: str, type_name: str, wanted: Qos) -> Qos:
        """Subscribe (with the lock held); returns the QoS that it came to."""
        running = self._running
        if running is None:
            raise RosError("the node is not running")
        message_class = _interface(type_name)
        qos = self._offered(running.node, topic, wanted)
        writer = self._writers.get(topic)
        if writer is not None and writer.echo is None:
            with writer.lock:
                writer.echo = Echo()
        reader = Reader(topic, type_name, self._count(topic), writer.echo if writer else None)
        events = self._rclpy.event_handler.SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._note_incompatible(topic, "a publisher", event),
            message_lost=lambda event: reader.lost(event.total_count_change),
            matched=lambda event: reader.matched(event.current_count),
            use_default_callbacks=False,
        )

        def callback(cdr: bytes, info: dict[str, Any]) -> None:
            self._receive(reader, cdr, info)

        reader.subscription = running.node.create_subscription(
            message_class,
            topic,
            callback,
            self._profile(qos),
            callback_group=running.receiver.group,
            event_callbacks=events,
            raw=True,
        )
        self._readers[topic] = reader
        running.receiver.add(reader.subscription)
        return qos

    def _offered(self, node: Any, topic: str, wanted: Qos) -> Qos:
        """The QoS that every present publisher satisfies (the rule of foxglove_bridge and rosbag2)."""
        qos = self._rclpy.qos
        mine = sum(publisher.topic_name == topic for publisher in node.publishers)
        profiles = []
        for info in node.get_publishers_info_by_topic(topic):
            if mine and (info.node_name, info.node_namespace) == (node.get_name(), node.get_namespace()):
                mine -= 1
            else:
                profiles.append(info.qos_profile)
        return Qos(
            depth=wanted.depth,
            reliable=wanted.reliable and all(p.reliability == qos.ReliabilityPolicy.RELIABLE for p in profiles),
            latched=bool(profiles) and all(p.durability == qos.DurabilityPolicy.TRANSIENT_LOCAL for p in profiles),
        )

    def _receive(self, reader: Reader, cdr: bytes, info: dict[str, Any]) -> None:
        """The way of every message that arrives, in the receiver's thread."""
        source_ns = info["source_timestamp"]
        if reader.echo is not None and reader.echo.is_own(cdr, source_ns):
            return
        reader.received(info.get("publication_sequence_number"))
        try:
            self._on_message(reader.topic, reader.type_name, cdr, source_ns)
        except Exception as error:  # a fault of ours costs this message, not the thread
            reader.counts.failed += 1
            text = f"{reader.topic}: {type(error).__name__}: {first_line(error)}"
            self._note_once(Level.ERROR, "ros_callback_failed", text, reader.topic)

    def _on_receive_error(self, error: Exception) -> None:
        self._note_once(Level.ERROR, "ros_receive_failed", f"taking a message: {first_line(error)}", "")

    # --- threads --------------------------------------------------------------------------------------------------

    def _spin(self, running: _Running) -> None:
        # Not spin() and shutdown(): they race for the executor's guard condition.
        while not self._stopping.is_set() and running.context.ok():
            try:
                running.executor.spin_once()
            except Exception as error:  # of one callback
                self._note_once(Level.ERROR, "ros_callback_failed", f"callback: {first_line(error)}", "")

    def _keep(self) -> None:
        next_look_ns = 0
        while not self._stopping.is_set():
            now_ns = self._clock.monotonic_ns()
            if now_ns >= next_look_ns:
                next_look_ns = now_ns + _LOOK_NS
                try:
                    self._look()
                except Exception as error:  # of ``wants``, or of a graph that changes meanwhile: look again
                    text = f"looking at the graph: {first_line(error)}"
                    self._note_once(Level.ERROR, "ros_callback_failed", text, "graph")
                self._poll_events()
                self._tell_of_listeners()
                self._note_losses()
            bursting = self._release()
            with self._matched:
                self._matched.notify_all()
            waiting = any(not writer.ready for writer in self._all_writers())
            left_s = max(0, next_look_ns - self._clock.monotonic_ns()) / 1e9
            self._wake.wait(_BURST_S if bursting else min(_RELEASE_S, left_s) if waiting else left_s)
            self._wake.clear()

    def _poll_events(self) -> None:
        running = self._running
        if running is None:
            return
        try:
            with self._lock:
                running.receiver.poll_events()
        except Exception as error:  # of one callback, or of rclpy internals that have changed
            self._note_once(Level.ERROR, "ros_callback_failed", f"events: {first_line(error)}", "events")

    def _tell_of_listeners(self) -> None:
        """Not under our lock, which those that we tell may need in another thread."""
        while self._on_listener and self._listened:
            self._on_listener(self._listened.popleft())

    def _on_matched(self, topic: str, change: int) -> None:
        if change > 0 and self._on_listener:
            self._listened.append(topic)
        self._wake.set()
        with self._matched:
            self._matched.notify_all()

    # --- notes and counts -----------------------------------------------------------------------------------------

    def counters(self) -> dict[str, dict[str, int]]:
        """Per topic: messages received, published, held now, lost (on the way in, or dropped while held), failed."""
        with self._lock:
            return {topic: asdict(counts) for topic, counts in sorted(self._counts.items())}

    def _count(self, topic: str) -> Counts:
        with self._lock:
            return self._counts.setdefault(topic, Counts())

    def _all_writers(self) -> list[Writer]:
        with self._lock:
            return list({id(writer): writer for writer in self._writers.values()}.values())

    def _note_losses(self) -> None:
        with self._lock:
            readers = list(self._readers.values())
        for reader in readers:
            lost = reader.counts.lost - reader.noted_lost
            if lost:
                reader.noted_lost += lost
                text = f"{reader.topic}: {lost} messages lost before we took them (queue too short, or the network)"
                self._note(Level.WARN, "ros_lost", text, reader.topic, {"lost": lost})

    def _note_incompatible(self, topic: str, peer: str, event: Any) -> None:
        policy = self._rclpy.qos.qos_policy_name_from_kind(event.last_policy_kind)
        text = f"{topic}: {peer} has an incompatible {policy}, nothing passes between it and us"
        self._note(Level.WARN, "ros_incompatible_qos", text, topic, {"policy": policy, "peer": peer})

    def _note_failure(self, topic: str, failure: str) -> None:
        if failure:
            self._note_once(Level.ERROR, "ros_publish_failed", f"{topic}: not published: {failure}", topic)

    def _note_overflow(self, topic: str) -> None:
        limit = f"{HOLD_MESSAGES} messages or {HOLD_BYTES >> 20} MiB"
        text = f"{topic}: more than {limit} before all subscribers were matched, the oldest went to those that were"
        self._note_once(Level.INFO, "ros_hold_overflow", text, topic)

    def _refuse(self, action: str, topic: str, type_name: str, error: Exception) -> None:
        why = f"cannot {action} {type_name}: {first_line(error)}"
        with self._lock:
            if (action, topic, type_name) in self._refusals:
                return
            self._refusals[action, topic, type_name] = why
        code = "ros_unknown_type" if isinstance(error, _UnknownTypeError) else "ros_refused"
        text = f"{topic}: {why}"
        self._note(Level.WARN, code, text, topic, {"action": action, "type": type_name})

    def _note_once(self, level: Level, code: str, text: str, topic: str) -> None:
        with self._lock:
            if (code, topic) in self._noted:
                return
            self._noted.add((code, topic))
        self._note(level, code, text, topic)

    def _note(self, level: Level, code: str, text: str, topic: str = "", data: dict[str, Any] | None = None) -> None:
        self._on_note(Note(level, code, text, topic, data or {}))

    def _profile(self, qos: Qos) -> Any:
        """The rclpy profile of ``qos``."""
        policies = self._rclpy.qos
        return policies.QoSProfile(
            history=policies.HistoryPolicy.KEEP_LAST,
            depth=qos.depth,
            reliability=policies.ReliabilityPolicy.RELIABLE if qos.reliable else policies.ReliabilityPolicy.BEST_EFFORT,
            durability=policies.DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else policies.DurabilityPolicy.VOLATILE,
        )


class _UnknownTypeError(RosError):
    """The Python package of a message type is not installed here."""


def _interface(type_name: str) -> Any:
    """The Python class of ``"pkg/msg/Name"`` or ``"pkg/srv/Name"``.  Raises RosError if it is not installed here."""
    match = _TYPE.fullmatch(type_name)
    if not match:
        raise _UnknownTypeError(f'unknown type, found {type_name!r}, expected "package/msg/Name"')
    package, kind, name = match.groups()
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError) as error:
        raise _UnknownTypeError(f"unknown type, {first_line(error)} (install the package {package} for it)") from error


def _import_rclpy() -> Any:
    """rclpy with the submodules that we use.  Raises RosError if there is none, or not with this middleware."""
    wanted = os.environ.get("RMW_IMPLEMENTATION")
    if wanted and "rclpy" not in sys.modules:
        _check_rmw(wanted)
    try:
        rclpy = importlib.import_module("rclpy")
        for name in (
            *(
                "callback_groups",
                "context",
                "duration",
                "event_handler",
                "executors",
                "guard_condition",
                "node",
                "qos",
                "subscription",
            ),
            "impl.implementation_singleton",
        ):
            importlib.import_module(f"rclpy.{name}")
    except ImportError as error:
        raise RosError(missing("rclpy", error)) from error
    return rclpy


def _check_rmw(wanted: str) -> None:
    """A middleware that is not installed makes the import of rclpy end the whole process: try it in another one."""
    tried = subprocess.run(
        [sys.executable, "-c", "import rclpy.impl.implementation_singleton"],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=_RMW_CHECK_S,
        check=False,
    )
    if tried.returncode and "ImportError" not in tried.stderr and "ModuleNotFoundError" not in tried.stderr:
        said = tried.stderr.strip().splitlines() or [f"exit code {tried.returncode}"]
        raise RosError(f"RMW_IMPLEMENTATION={wanted} does not work here ({said[-1]}); unset it or install it")


def _describe(qos: Qos) -> str:
    reliability = "reliable" if qos.reliable else "best effort"
    return f"{reliability}{', latched' if qos.latched else ''}, depth {qos.depth}"

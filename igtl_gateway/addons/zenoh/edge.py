"""``ZenohEdge``: the ROS side over Zenoh, with the interface of ``edges.ros.edge.RosEdge``.

Threads beside the callers of `ZenohEdge.publish`:

* *Zenoh's own*: they call with messages, tokens and changes of links, and must return soon: messages go to the inbox,
  all else to tables that the keeper looks at;
* *receiver*: passes the messages of the inbox to ``on_message`` (``inbox``);
* *keeper*: opens the session, subscribes to what is wanted, notes what happened;
* those of *calls* of services (``services``);
* *commands*: sends what may have to wait for the line (``waiting``).

What differs from DDS: there are no incompatible QoS; nothing is held for subscribers that are not matched yet, because
Zenoh routes the first message, too; own messages do not come back; and what is sent while the router is away is lost,
except the latched messages, which their publisher keeps.
"""

from __future__ import annotations

import atexit
import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from igtl_gateway.addon import NS_PER_S, ConfigError, RosError, SystemClock, UnknownTypeError
from igtl_gateway.addon.reading import Level, Qos
from igtl_gateway.addon.ros import Log
from igtl_gateway.addon.ros_side import DEFAULT_LATCHED_MIB, Halves, OnMessage, OnNote, PlainSide, Reports, Wants
from igtl_gateway.addons.zenoh.config import domain_of
from igtl_gateway.addons.zenoh.connection import RETRY_NS, Connection
from igtl_gateway.addons.zenoh.graph import Graph
from igtl_gateway.addons.zenoh.inbox import Inbox
from igtl_gateway.addons.zenoh.library import import_zenoh
from igtl_gateway.addons.zenoh.names import Entity, Kind, checked_node, checked_topic
from igtl_gateway.addons.zenoh.own_node import OwnNode
from igtl_gateway.addons.zenoh.publishing import ROSOUT, Publishing
from igtl_gateway.addons.zenoh.services import MESSAGES, SERVICES, Calls
from igtl_gateway.addons.zenoh.site import Sites
from igtl_gateway.addons.zenoh.subscribing import Subscribing
from igtl_gateway.addons.zenoh.traffic import Traffic

_ROSOUT_QOS = Qos(1000, latched=True)
_SERVICE_QOS = Qos(10)
_LOSSES_NS = 1_000_000_000
_WAIT_S = 0.01
#: From a change of the graph to the look at it: what changes together comes within this time.
_GATHER_S = 0.01
#: New subscribers that are not reported yet.
_LISTENED = 10_000


class ZenohEdge(Halves, PlainSide):
    """The gateway's node in the ROS graph, over Zenoh.  It needs no ROS.

    Args:
        node_name, namespace: of the node.
        on_message: called with topic, type ``"pkg/msg/Name"``, CDR bytes and the sender's stamp in UTC ns (0 = unset).
            One call at a time.
        wants: as for `RosEdge`.
        on_note: called with facts, from our own threads.
        on_listener: called with the topic when a subscriber joins what we publish.
        endpoint: of the router, such as ``tcp/localhost:7447``; "": that of the configuration of Zenoh.
        site: name of this site; "": clocks and latencies of other sites are not measured.
        traffic: classes of streams and budget; None: all are sent as ROS does.
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
        endpoint: str = "",
        site: str = "",
        traffic: Traffic | None = None,
        latched_mib: int = DEFAULT_LATCHED_MIB,
    ) -> None:
        self._name = node_name
        self._namespace = namespace or "/"
        self._wants = wants
        self._on_listener = on_listener
        self._clock = SystemClock()
        self._domain = domain_of()
        self._changing = threading.RLock()
        self._tokens: list[Any] = []
        self._changed = threading.Event()
        self._stopping = threading.Event()
        self._started = False
        self._listened: deque[str] = deque(maxlen=_LISTENED)
        self._reports = Reports(on_note)
        self._connection = Connection(endpoint, self._reports, self._changed.set)
        self._node = OwnNode(self._connection, self._domain, self._name, self._namespace)
        self._inbox = self._make_inbox()
        self._graph = Graph(self._reports, self._on_graph)
        self._publishing = Publishing(
            self._node,
            self._reports,
            self._clock,
            self._on_subscriber,
            traffic,
            latched_mib << 20,
        )
        self._subscribing = Subscribing(
            self._node,
            self._graph,
            self._reports,
            self._inbox,
            on_message,
            clock=self._clock if site else None,
        )
        self._sites: Sites | None = None
        if site:
            self._sites = Sites(
                site, self._domain, self._reports, self._clock, self._graph.gids_of, self._subscribing.ages
            )
        self._calls = Calls(self._reports, self._clock)
        self._keeper = threading.Thread(target=self._keep, name="igtl-zenoh-keeper", daemon=True)
        super().__init__(self._publishing, self._subscribing, self._graph)

    @staticmethod
    def check() -> None:
        """Raises RosError, in one line, if Zenoh is not installed."""
        import_zenoh()

    @staticmethod
    def message_class(type_name: str) -> Any:
        """The Python class of a message inside a service.  Raises RosError for any other."""
        if type_name not in MESSAGES:
            raise UnknownTypeError(f"unknown type, found {type_name!r}, expected one of {', '.join(MESSAGES)}")
        return MESSAGES[type_name]

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace."""
        return f"{self._namespace.rstrip('/')}/{self._name}"

    def start(self) -> None:
        """Join the graph, or try until a router answers.

        Raises RosError without Zenoh, and ConfigError for a wrong name, environment or configuration.
        """
        try:
            checked_node(self._name)
            if self._namespace != "/":
                checked_topic(self._namespace)
        except ValueError as error:
            raise ConfigError(f"--node-name: {error}") from None
        if self._started:
            raise RosError(f"node {self._name!r}: started before, an edge starts once")
        self._connection.prepare()
        self._started = True
        self._connection.declare(self._declare_node)
        if self._sites:
            sites = self._sites
            self._connection.declare(lambda session: sites.declare(self._connection.zenoh, session))
        self._publishing.advertise(ROSOUT, Log.TYPE, _ROSOUT_QOS)
        # A process with open sessions would not end.
        atexit.register(self.stop)
        self._connection.try_open()
        self._connection.note_changes()
        self._inbox.start()
        self._keeper.start()

    def stop(self) -> None:
        """Leave the graph, end the threads.  Further calls do nothing."""
        if not self._started or self._stopping.is_set():
            return
        self._stopping.set()
        atexit.unregister(self.stop)
        self._changed.set()
        if self._keeper.ident:
            self._keeper.join()
        self._calls.stop()
        self._publishing.close()
        self._connection.stop()  # before the inbox: no message comes from here on
        self._inbox.stop()
        self._subscribing.note_losses()
        self._publishing.note_dropped()

    @property
    def changing(self) -> AbstractContextManager[object]:
        """A lock for those who change settings."""
        return self._changing

    def log(self, level: Level, text: str, stamp_ns: int) -> None:
        """Publish a line on ``/rosout``, with the time in UTC ns."""
        publisher = self._publishing.publisher(ROSOUT)
        if publisher is not None and not self._stopping.is_set():
            publisher.send(Log(stamp_ns, int(level), self._name, text).pack())

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Any], Any]) -> bool:
        """Offer a service; see ``RosEdge.serve``.  Only the types of ``services.SERVICES`` are known."""
        full = self.full_name + name.removeprefix("~") if name.startswith("~/") else name
        try:
            if type_name not in SERVICES:
                raise UnknownTypeError(f"unknown type, expected one of {', '.join(SERVICES)}")
            key, type_hash = self._node.key(full, type_name)
            handler = self._calls.handler(full, SERVICES[type_name], answer)

            def declare(session: Any) -> None:
                node, number = self._node.next(session)
                token = node.entity_token(number, Kind.SERVER, full, type_name, type_hash, _SERVICE_QOS)
                self._tokens.append(session.declare_queryable(key, handler, complete=True))
                self._tokens.append(session.liveliness().declare_token(token))

            self._connection.declare(declare)
        except Exception as error:  # zenoh's class is one for all causes
            self._reports.refuse("serve", name, type_name, error)
            return False
        return True

    def subscriber_count(self, topic: str) -> int:
        """The number of subscriptions of other nodes to a topic that we publish."""
        publisher = self._publishing.publisher(topic)
        return self._graph.subscriber_count(publisher.key) if publisher else 0

    def wait_for_subscribers(self, topic: str, count: int, timeout_s: float) -> bool:
        """Wait until ``count`` subscriptions are there; False if that took longer than ``timeout_s``, or at stop."""
        ends_ns = self._clock.monotonic_ns() + round(timeout_s * NS_PER_S)
        while self.subscriber_count(topic) < count:
            if self._clock.monotonic_ns() >= ends_ns or self._stopping.wait(_WAIT_S):
                return self.subscriber_count(topic) >= count
        return True

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait for the session; False if that took longer than ``timeout_s``, or at stop."""
        ends_ns = self._clock.monotonic_ns() + round(timeout_s * NS_PER_S)
        while not self._connection.is_open:
            if self._clock.monotonic_ns() >= ends_ns or self._stopping.wait(_WAIT_S):
                return self._connection.is_open
        return True

    def wait_acked(self, topic: str, timeout_s: float) -> bool:
        """True: Zenoh has no acknowledgements."""
        return True

    def sync(self) -> None:
        """Take over what was counted in other threads."""
        self._subscribing.sync()

    def counters(self) -> dict[str, dict[str, int]]:
        """Per topic: messages received, published, held now, lost, failed."""
        self.sync()
        return self._reports.counters()

    def failing(self) -> dict[str, str]:
        """Topic that others publish → why nothing has come from it."""
        return self._reports.failing()

    def _make_inbox(self) -> Inbox:
        return Inbox()

    def _declare_node(self, session: Any) -> None:
        self._tokens.append(session.liveliness().declare_token(self._node.joined(session).token()))
        self._graph.declare(session, self._domain, self._connection.zenoh.SampleKind.PUT)

    def _on_graph(self, entity: Entity | None) -> None:
        """Called by Zenoh, in its threads."""
        if entity is not None and entity.kind is Kind.SUBSCRIPTION:
            self._publishing.joined(entity.topic)
            publisher = self._publishing.publisher(entity.topic)
            if publisher is not None and publisher.matched and publisher.type_name == entity.type:
                self._listened.append(entity.topic)
        self._changed.set()

    def _on_subscriber(self, topic: str) -> None:
        """Called by Zenoh, in its threads."""
        self._listened.append(topic)
        self._changed.set()

    def _keep(self) -> None:
        now_ns = self._clock.monotonic_ns
        retry_ns, losses_ns = now_ns() + RETRY_NS, now_ns() + _LOSSES_NS
        while not self._stopping.is_set():
            self._changed.clear()
            try:
                if not self._connection.is_open and now_ns() >= retry_ns:
                    self._connection.try_open()
                    retry_ns = now_ns() + RETRY_NS
                self._connection.note_changes()
                self._graph.note_bad()
                self._subscribing.discover(self._wants)
                if now_ns() >= losses_ns:
                    losses_ns = now_ns() + _LOSSES_NS
                    self._subscribing.note_losses()
                    self._publishing.note_dropped()
                    self._publishing.bound_latched()
                if self._sites:
                    self._sites.keep()
                while self._on_listener and self._listened:
                    self._on_listener(self._listened.popleft())
            except Exception as error:  # of a callee, or of an entity that Zenoh refuses: try again
                self._reports.callback_failed("looking at the graph", error, "graph")
            due_ns = losses_ns if self._connection.is_open else min(retry_ns, losses_ns)
            if self._changed.wait(max(0, due_ns - now_ns()) / NS_PER_S):
                self._stopping.wait(_GATHER_S)

"""One actor of a scenario on real connections: a ROS 2 node, or an OpenIGTLink program; runs in a process of its own.

The actor itself is pure.  One thread, that of ``ActorProgram.run``, calls it; the edges' threads only queue received
messages.  Before ``begin`` all programs have discovered each other, so that no first message is lost:

* a ROS actor subscribes at once, has its publishers matched with every reader that the scenario has (the gateway, the
  other actors), and has received the gateway's list of connected peers, on a topic to which it subscribes last;
* an OpenIGTLink actor is connected.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, Protocol

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import WireError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.igtl_msgs import LinkStatusList
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway import LINKS_TOPIC, Gateway
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, Preparable, Received, RosReceived, RosSent, Sent

_LOOK_S = 0.25  # how soon an actor that waits for others sees that it is over
_HEARS = Qos(depth=100)

Address = tuple[str, int]
OnEvent = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, slots=True)
class IgtlEndpoint:
    """How an OpenIGTLink actor meets the gateway: as its client, or as the server that it connects to."""

    address: Address
    server: bool = False


class ActorTransport(Protocol):
    """An actor's connection to the world."""

    def open(self) -> dict[str, Any]:
        """Open it; return the fields of its event.  Raises ConfigError or RosError."""

    def missing(self, timeout_s: float) -> str:
        """What it still waits for before the story can begin; waits for so long at most."""

    def send(self, message: Sent) -> str:
        """Send it; the name of its stream."""

    def close(self) -> None:
        """Send what is left and go."""


class ActorProgram:
    """See the module.

    Args:
        actor: who plays.
        others: all actors of the scenario that play.
        config: the gateway's: what it subscribes to.
        peers: how many OpenIGTLink programs have to be connected before it begins.
        connection: of an OpenIGTLink actor.
        clock: its time.
        on_event: callback for its events: ``listening``, ``waiting``, ``ready``, ``done``, ``warning``, ``report``.
    """

    def __init__(
        self,
        actor: Actor,
        others: Sequence[Actor],
        config: Config,
        peers: int,
        connection: IgtlEndpoint,
        clock: Clock,
        on_event: OnEvent,
    ) -> None:
        self._actor = actor
        self._clock = clock
        self._on_event = on_event
        self._heard: SimpleQueue[Received | None] = SimpleQueue()
        self._begin, self._end = threading.Event(), threading.Event()
        self._sent: Counter[str] = Counter()
        self._received: Counter[str] = Counter()
        if actor.side is ActorProtocol.ROS:
            self._transport: ActorTransport = _RosActorTransport(
                actor, others, config, peers, self._heard.put, self._warn
            )
        else:
            self._transport = _IgtlActorTransport(actor, connection, clock, self._heard.put, self._warn)

    def begin(self) -> None:
        """Everybody is ready; from any thread."""
        self._begin.set()
        self._heard.put(None)

    def end(self) -> None:
        """It is over; from any thread."""
        self._end.set()
        self._heard.put(None)

    def run(self) -> None:
        """Connect, play until the end, report.  Raises ConfigError or RosError if it cannot connect."""
        if isinstance(self._actor, Preparable):
            self._actor.prepare()
        if address := self._transport.open():
            self._on_event({"event": "listening", **address})
        try:
            if self._wait_for_others():
                self._on_event({"event": "ready"})
                if self._wait_for_begin():
                    self._play()
        finally:
            self._transport.close()
        report = self._actor.report()
        self._on_event(
            {
                "event": "report",
                "good": report.good,
                "lines": report.lines,
                "facts": report.facts,
                "sent": dict(sorted(self._sent.items())),
                "received": dict(sorted(self._received.items())),
            }
        )

    def _wait_for_others(self) -> bool:
        reported = ""
        while not self._end.is_set():
            missing = self._transport.missing(_LOOK_S)
            if not missing:
                return True
            if missing != reported:
                self._on_event({"event": "waiting", "for": missing})
                reported = missing
        return False

    def _wait_for_begin(self) -> bool:
        while not (self._begin.is_set() or self._end.is_set()):
            self._begin.wait(_LOOK_S)
        return not self._end.is_set()

    def _play(self) -> None:
        actor, done = self._actor, False
        actor.begin(self._clock.utc_ns())
        while not self._end.is_set():
            # received messages go first, as offline: a slow act must not increase the actor's backlog
            for _ in range(self._heard.qsize()):
                self._receive(0)
            now_ns, due_ns = self._clock.utc_ns(), actor.due_ns
            if due_ns is not None and due_ns <= now_ns:
                self._send(actor.act(now_ns))
            if not done and actor.done:
                done = True
                self._on_event({"event": "done"})
            self._receive(actor.due_ns)

    def _receive(self, due_ns: int | None) -> None:
        """What came next; nothing if the actor is due before."""
        left_ns = None if due_ns is None else max(0, due_ns - self._clock.utc_ns())
        try:
            received = self._heard.get(timeout=None if left_ns is None else left_ns / NS_PER_S)
        except Empty:
            return
        if received is not None:
            self._received[_stream(received)] += 1
            self._send(self._actor.receive(self._clock.utc_ns(), received))

    def _send(self, words: Any) -> None:
        for message in words:
            self._sent[self._transport.send(message)] += 1

    def _warn(self, text: str) -> None:
        self._on_event({"event": "warning", "text": text})


def _stream(one: Sent | Received) -> str:
    return f"{one.type}/{one.device_name}" if isinstance(one, Message) else one.topic


class _IgtlActorTransport:
    """A TCP connection, as client or as server."""

    def __init__(
        self,
        actor: Actor,
        connection: IgtlEndpoint,
        clock: Clock,
        on_heard: Callable[[Received], None],
        warn: Callable[[str], None],
    ) -> None:
        self._name = actor.name
        self._connection = connection
        self._on_heard = on_heard
        self._warn = warn
        self._link = 0
        self._edge = TcpEdge(
            on_frame=self._on_frame, on_link=self._on_link, on_note=self._on_note, clock=clock, when_full="block"
        )

    def open(self) -> dict[str, Any]:
        address: dict[str, Any] = {}
        if self._connection.server:
            host, port = self._edge.listen(*self._connection.address)
            address = {"host": host, "port": port}
        else:
            self._edge.connect(*self._connection.address)
        self._edge.start()
        return address

    def missing(self, timeout_s: float) -> str:
        if self._edge.wait_links(1, timeout_s):
            return ""
        host, port = self._connection.address
        return f"{'a client' if self._connection.server else 'a server'} at {host}:{port}"

    def send(self, message: Sent) -> str:
        assert isinstance(message, Message)
        stream = _stream(message)
        self._edge.send((self._link,), encode(message), stream, keep=True)
        return stream

    def close(self) -> None:
        self._edge.stop()

    def _on_link(self, link: int, up: bool, _note: Note) -> None:
        if up:
            self._link = link

    def _on_note(self, _link: int, note: Note) -> None:
        # ``missing`` reports that the server is not there yet
        if note.level >= Level.WARN and note.code != "connect_failed":
            self._warn(f"{self._name}: {note.text}")

    def _on_frame(self, _link: int, frame: Buffer) -> None:
        try:
            self._on_heard(decode(frame))
        except WireError as error:
            self._warn(f"{self._name}: refused a message: {error}")


class _RosActorTransport:
    """A ROS 2 node."""

    def __init__(
        self,
        actor: Actor,
        others: Sequence[Actor],
        config: Config,
        peers: int,
        on_heard: Callable[[Received], None],
        warn: Callable[[str], None],
    ) -> None:
        self._actor = actor
        self._peers = peers
        self._on_heard = on_heard
        self._warn = warn
        gateway = Gateway(config)
        listeners = [other for other in others if other.side is ActorProtocol.ROS and other is not actor]
        self._qos: dict[str, Qos] = {}
        self._readers: dict[str, int] = {}
        for topic, published in actor.publishes.items():
            bridged = gateway.subscription(topic, published.type)
            self._qos[topic] = Qos(depth=bridged.depth if bridged else 10, latched=published.latched)
            heard_by = sum(other.subscribes.get(topic) == published.type for other in listeners)
            self._readers[topic] = int(bridged is not None) + heard_by
        self._linked = threading.Condition()
        self._links = 0
        self._subscribed = threading.Event()
        self._edge = RosEdge(
            node_name=actor.name,
            on_message=self._on_message,
            wants=self._wants,
            on_note=self._on_note,
        )

    def open(self) -> dict[str, Any]:
        self._edge.start()
        # Readers first.  The gateway's topic of links is found, and subscribed to, after all of them: once it has
        # come through, the gateway knows of every one.
        for topic, ros_type in self._actor.subscribes.items():
            self._edge.subscribe(topic, ros_type, _HEARS)
        self._subscribed.set()
        for topic, published in self._actor.publishes.items():
            self._edge.advertise(topic, published.type, self._qos[topic])
        return {}

    def missing(self, timeout_s: float) -> str:
        with self._linked:
            if not self._linked.wait_for(lambda: self._links >= self._peers, timeout_s):
                return f"a gateway with {self._peers} OpenIGTLink peer{'s' * (self._peers > 1)} (it has {self._links})"
        for topic, count in self._readers.items():
            if not self._edge.wait_for_subscribers(topic, count, timeout_s):
                return f"{count} subscriber{'s' * (count > 1)} of {topic}"
        return ""

    def send(self, message: Sent) -> str:
        assert isinstance(message, RosSent)
        content = message.message
        self._edge.publish(message.topic, content.TYPE, content.pack(), self._qos[message.topic])
        return message.topic

    def close(self) -> None:
        self._edge.stop()

    def _wants(self, topic: str, ros_type: str) -> Qos | None:
        links = (topic, ros_type) == (LINKS_TOPIC, LinkStatusList.TYPE)
        return _HEARS if links and self._subscribed.is_set() else None

    def _on_message(self, topic: str, ros_type: str, cdr: bytes, _source_ns: int) -> None:
        if self._actor.subscribes.get(topic) == ros_type:
            self._on_heard(RosReceived(topic, ros_type, cdr))
        if topic == LINKS_TOPIC:
            with self._linked:
                self._links = len(LinkStatusList.unpack(cdr).links)
                self._linked.notify_all()

    def _on_note(self, note: Note) -> None:
        if note.level >= Level.WARN:
            self._warn(f"{self._actor.name}: {note.text}")

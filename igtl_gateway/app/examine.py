"""The examination of a live peer for ``doctor``: connect or listen, observe, and try the other TCP role without a peer.

Received messages pass through hub, session and gateway as in a bridge, so the rules observe the same entries as in a
recording.  The only message sent is one STATUS, and only to a peer that has sent no message at first.  Every
OpenIGTLink program accepts a STATUS, and its text ends with an empty line, so a web server answers, too.  A replay that
waits for its peer recognises it, and goes on waiting.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from igtl_gateway.app.hub import Hub
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.observer import ExpectedLinks, Observer
from igtl_gateway.doctor.protocols import is_openigtlink
from igtl_gateway.doctor.sources import TF_TOPICS
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.tcp import TcpEdge, TlsFiles
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.gateway.dialogue.probing import PROBE, PROBE_DEVICE
from igtl_gateway.gateway.expected import ExpectedSource
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode

#: Share of the time after which the other TCP role is tried if no peer is connected.
PATIENCE = 0.5
#: A peer that has sent nothing for this time is sent a STATUS: a replay waits for longer before it begins.
_SILENT_NS, _LOOK_S = 150 * NS_PER_MS, 0.05

#: Least time for the discovery of the ROS graph, in seconds; with less, the graph would seem empty.
_GRAPH_S = 1.0

_STREAM = f"STATUS/{PROBE_DEVICE}"
_NODE = "igtl_doctor"

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class ExamineOptions:
    """Options of an examination.

    Attributes:
        connect: address of the peer's server.
        servers: those of the configuration, which are connected to, too.
        listen: address to listen on; with it, ``connect`` is tried only if no client connects.
        seconds: longest duration of the observation.
        messages: number of messages after which the observation ends; 0: no such number.
        speak: header version of the STATUS for a silent peer; 0: send none.
        allow: networks (CIDR) whose peers may connect in addition to those of this host; if there is one, the wait for
            a client in place of an absent server listens on all addresses.
        ros: also examine the ROS graph.
        tls: files for TLS.
        tls_listen, tls_connect: whether ``listen`` and ``connect`` use TLS.
        tls_servers: those of ``servers`` that use TLS.
        expected: the sources that are looked for; None: those of the configuration.
    """

    connect: Address | None
    listen: Address | None
    seconds: float
    servers: tuple[Address, ...] = ()
    messages: int = 0
    speak: int = 1
    allow: tuple[str, ...] = ()
    ros: bool = False
    tls: TlsFiles = field(default_factory=TlsFiles)
    tls_listen: bool = False
    tls_connect: bool = False
    tls_servers: frozenset[Address] = frozenset()
    expected: Sequence[ExpectedSource] | None = None


def examine(config: Config, options: ExamineOptions, clock: Clock, stop: threading.Event) -> Observer:
    """Observe for the time of the options, or until ``stop`` is set, and return the observation.

    This function also sets ``stop``, as soon as further messages would not change the result.

    Raises ConfigError for an unusable address, and RosError if the options require ROS and it is not available.
    """
    intent = None
    if options.listen:
        intent = ExpectedLinks("server", _address_text(options.listen))
    elif options.connect:
        intent = ExpectedLinks("client", _address_text(options.connect))
    seen = Observer(config, intent)
    if options.expected is not None:
        seen.sources.expected = list(options.expected)
    examination = _Examination(config, options, clock, stop, seen)
    ros = _graph_edge(examination.transforms if config.tf_out else None) if options.ros else None
    try:
        if ros:
            ros.start()
        begun_ns = clock.monotonic_ns()
        examination.run()
        if ros:
            seen.sources.reads_tf = True
            left_s = _GRAPH_S + (begun_ns - clock.monotonic_ns()) / NS_PER_S
            threading.Event().wait(max(0.0, left_s))
            examination.seen.graph = Graph.of(examination.gateway, examination.seen.published, ros.endpoints())
    finally:
        if ros:
            ros.stop()
    return examination.seen


def _address_text(address: Address | None) -> str:
    host, port = address or ("", 0)
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _graph_edge(on_transforms: Callable[[str, bytes], None] | None) -> RosEdge:
    """Return a ROS edge that discovers the graph, and reads the tf tree."""

    def received(topic: str, _type: str, cdr: bytes, _source_ns: int) -> None:
        if on_transforms:
            on_transforms(topic, cdr)

    return RosEdge(
        node_name=_NODE,
        on_message=received,
        wants=lambda topic, _type: (
            Qos(100, latched=topic == "/tf_static") if on_transforms and topic in TF_TOPICS else None
        ),
        on_note=lambda _note: None,
    )


class _Examination:
    def __init__(
        self, config: Config, options: ExamineOptions, clock: Clock, stop: threading.Event, seen: Observer
    ) -> None:
        self.seen = seen
        self.gateway = Gateway(config)
        self._options = options
        self._clock = clock
        self._stop = stop
        self._lock = threading.Lock()  # guards ``seen``
        self._seen_ns: dict[int, int] = {}  # link → when it was first looked at
        self._announced: set[int] = set()
        self._hub = Hub(Session(self.gateway), clock, [self._on_entry])

    def transforms(self, topic: str, cdr: bytes) -> None:
        """Take a message of the tf tree."""
        with self._lock:
            self.seen.sources.transforms(topic, cdr)

    def run(self) -> None:
        """Observe in the TCP role of the options; if no peer is connected after half of the time, in the other role."""
        listen, connect = self._options.listen, self._options.connect
        edge = self._edge()
        try:
            for server in self._options.servers:
                edge.connect(*server, tls=server in self._options.tls_servers)
            if listen is None:
                free = True
                self._dial(edge, connect, self._options.tls_connect)
            else:
                free = self._serve(edge, listen)
            if self._options.servers and not (listen or connect):
                edge.start()
            if free:
                self._observe(edge, self._options.seconds, needs_peer=True)
            if self._options.servers:
                absent = {link.peer for link in edge.links() if not link.number}
                asked = map(_address_text, (*self._options.servers, *([connect] if connect else ())))
                self.seen.sources.links = {address: address not in absent for address in asked}
        finally:
            edge.stop(0)
        if self.seen.peers or self._stop.is_set():
            return
        edge = self._edge()
        try:
            if listen is None:
                there = self._listen_for(edge, connect)
            else:
                # the program that uses our port might be the peer
                there = self._dial(
                    edge, *((connect, self._options.tls_connect) if free else (listen, self._options.tls_listen))
                )
            if there:
                self._observe(edge, self._options.seconds * PATIENCE)
        finally:
            edge.stop(0)

    def _dial(self, edge: TcpEdge, target: Address | None, tls: bool) -> bool:
        if target is None:
            return False
        edge.connect(*target, tls=tls)
        edge.start()
        return True

    def _serve(self, edge: TcpEdge, listen: Address) -> bool:
        """Listen; return False if the port is in use."""
        try:
            edge.listen(*listen, tls=self._options.tls_listen)
        except Unavailable as error:
            self._hub.note(Note(Level.ERROR, "listen_failed", str(error), _address_text(listen)))
            return False
        edge.start()
        return True

    def _listen_for(self, edge: TcpEdge, target: Address | None) -> bool:
        """Listen on the port of an absent server, for a peer that is a client; return False if that is not possible."""
        if target is None:
            return False
        host, port = target
        here = "0.0.0.0" if self._options.allow else "::1" if host == "::1" else "127.0.0.1"
        try:
            edge.listen(here, port, tls=self._options.tls_connect and self._options.tls.cert is not None)
        except (ConfigError, Unavailable):
            return False  # the port is in use, possibly by a bridge on this host: no further observation is possible
        edge.start()
        return True

    def _observe(self, edge: TcpEdge, seconds: float, *, needs_peer: bool = False) -> None:
        """Wait until the time is over or ``stop`` is set; half of it if ``needs_peer`` and no peer is connected."""
        begun_ns = self._clock.monotonic_ns()
        while (left_s := seconds - (self._clock.monotonic_ns() - begun_ns) / NS_PER_S) > 0:
            if self._stop.wait(min(_LOOK_S, left_s)):
                return
            if needs_peer and left_s < seconds * (1 - PATIENCE) and not self.seen.peers:
                return
            self._announce(edge)

    def _announce(self, edge: TcpEdge) -> None:
        """Send one STATUS to each peer that has sent no message for a while since it connected."""
        version, now_ns = self._options.speak, self._clock.monotonic_ns()
        for link in edge.links():
            if not version or not link.connected or link.number in self._announced:
                continue
            if now_ns - self._seen_ns.setdefault(link.number, now_ns) < _SILENT_NS:
                continue
            self._announced.add(link.number)
            with self._lock:
                silent = not self.seen.peer(link.number).messages
            if silent:
                data = b"".join(bytes(part) for part in encode(Message("STATUS", PROBE_DEVICE, PROBE, 0, version)))
                edge.send((link.number,), (data,), _STREAM, True)
                self._on_entry(
                    Entry(0, self._clock.utc_ns(), Kind.IGTL_OUT, _STREAM, "STATUS", (data,), (link.number,))
                )

    # ── from the edge ─────────────────────────────────────────────────────────────────────────────────────────────

    def _edge(self) -> TcpEdge:
        return TcpEdge(
            on_frame=self._hub.igtl,
            on_link=lambda link, _up, note: self._hub.link(link, note),
            on_note=lambda link, note: self._hub.note(note, link),
            clock=self._clock,
            allow=self._options.allow,
            tls=self._options.tls,
        )

    def _on_entry(self, entry: Entry) -> None:
        with self._lock:
            # answers of the gateway are not sent; the only outgoing message is the STATUS, which has no entry number
            if entry.kind is not Kind.IGTL_OUT or not entry.seq:
                self.seen.add(entry)
            peers = self.seen.peers.values()
            enough = 0 < self._options.messages <= sum(peer.messages for peer in peers)
            # a peer with another protocol sends no OpenIGTLink later
            if enough or any(peer.head and not is_openigtlink(peer.head) for peer in peers):
                self._stop.set()

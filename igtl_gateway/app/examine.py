"""A visit to a peer: connect to it or wait for it, see what comes, and try the other role if nobody is there.

What comes goes through the same door as in a bridge (hub, session, gateway), so what the rules see is what they see in
a recording.  Nothing is sent but one STATUS, and that only to a peer that has said nothing: a message that every
program knows and none minds, and whose text ends with the empty line that makes a web server answer.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from igtl_gateway.app.hub import Hub
from igtl_gateway.clock import Clock
from igtl_gateway.config import Config
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.observer import ExpectedLinks, Observer
from igtl_gateway.doctor.protocols import is_openigtlink
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.tcp import TcpEdge, TlsFiles
from igtl_gateway.errors import ConfigError, Unavailable
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import Status

#: Part of the time after which a silent peer is spoken to, and an absent one is looked for in the other role.
PATIENCE = 0.5

#: What discovery takes on a good day; with less, the graph would look empty.
_GRAPH_S = 1.0

_OK = 1
_STREAM = "STATUS/doctor"
_NODE = "igtl_doctor"

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class ExamineOptions:
    """How to look.

    Attributes:
        connect: the peer's address, as a server.
        listen: our address, to be a server; then ``connect`` is only tried if nobody comes.
        seconds: how long to look, at most.
        messages: so many are enough; 0: no number is.
        speak: header version of what a silent peer is told; 0: nothing.
        allow: networks whose peers may connect beside this host's own; with any, we listen at all addresses for one
            that is not there as a server.
        ros: look at the ROS graph, too.
        tls: files for TLS.
        tls_listen, tls_connect: whether it is spoken at these addresses.
    """

    connect: Address | None
    listen: Address | None
    seconds: float
    messages: int = 0
    speak: int = 1
    allow: tuple[str, ...] = ()
    ros: bool = False
    tls: TlsFiles = field(default_factory=TlsFiles)
    tls_listen: bool = False
    tls_connect: bool = False


def examine(config: Config, options: ExamineOptions, clock: Clock, stop: threading.Event) -> Observer:
    """Look for as long as the options say, or until ``stop``; gives what was seen.

    ``stop`` is set by us, too, once there is nothing more to learn.

    Raises ConfigError for an address that cannot be used, RosError where ROS is wanted and not there.
    """
    intent = (
        ExpectedLinks("server", _address_text(options.listen))
        if options.listen
        else ExpectedLinks("client", _address_text(options.connect))
    )
    visit = _Examination(config, options, clock, stop, Observer(config, intent))
    ros = _graph_edge() if options.ros else None
    try:
        if ros:
            ros.start()
        begun_ns = clock.monotonic_ns()
        visit.run()
        if ros:
            left_s = _GRAPH_S + (begun_ns - clock.monotonic_ns()) / NS_PER_S
            threading.Event().wait(max(0.0, left_s))
            visit.seen.graph = Graph.of(visit.gateway, visit.seen.published, ros.endpoints())
    finally:
        if ros:
            ros.stop()
    return visit.seen


def _address_text(address: Address | None) -> str:
    host, port = address or ("", 0)
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _graph_edge() -> RosEdge:
    """One that only looks."""
    return RosEdge(
        node_name=_NODE,
        on_message=lambda _topic, _type, _cdr, _source: None,
        wants=lambda _topic, _type: None,
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
        self._hub = Hub(Session(self.gateway), clock, [self._on_entry])

    def run(self) -> None:
        """Look in the role that is wanted; if nobody is there by half of the time, in the other one."""
        listen, connect = self._options.listen, self._options.connect
        edge = self._edge()
        try:
            if listen is None:
                free = True
                self._dial(edge, connect, self._options.tls_connect)
            else:
                free = self._serve(edge, listen)
            if free:
                self._observe(edge, self._options.seconds, for_company=True)
        finally:
            edge.stop(0)
        if self.seen.peers or self._stop.is_set():
            return
        edge = self._edge()
        try:
            if listen is None:
                there = self._listen_for(edge, connect)
            else:
                # who has our port may be the one that we wait for
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
        """Be a server; False if the port is taken."""
        try:
            edge.listen(*listen, tls=self._options.tls_listen)
        except Unavailable as error:
            self._hub.note(Note(Level.ERROR, "listen_failed", str(error), _address_text(listen)))
            return False
        edge.start()
        return True

    def _listen_for(self, edge: TcpEdge, target: Address | None) -> bool:
        """Be the server that the absent one might be looking for, at its port."""
        if target is None:
            return False
        host, port = target
        here = "0.0.0.0" if self._options.allow else "::1" if host == "::1" else "127.0.0.1"
        try:
            edge.listen(here, port, tls=self._options.tls_connect and self._options.tls.cert is not None)
        except (ConfigError, Unavailable):
            return False  # taken, by our own bridge perhaps; then nothing can be told
        edge.start()
        return True

    def _observe(self, edge: TcpEdge, seconds: float, *, for_company: bool = False) -> None:
        """Until the time is over or there is nothing more to learn; for company: or nobody is there at half of it."""
        begun_ns = self._clock.monotonic_ns()
        for part in (PATIENCE, 1.0):
            left_s = (begun_ns - self._clock.monotonic_ns()) / NS_PER_S + seconds * part
            if self._stop.wait(max(0.0, left_s)) or (for_company and not self.seen.peers):
                return
            if part < 1.0:
                self._send_status(edge)

    def _send_status(self, edge: TcpEdge) -> None:
        """Say one thing to those that are silent."""
        version = self._options.speak
        for link in edge.links():
            with self._lock:
                silent = link.connected and not self.seen.peer(link.number).messages
            if version and silent:
                content = Status(_OK, 0, "", "igtl-gateway doctor is listening\r\n\r\n")
                data = b"".join(bytes(part) for part in encode(Message("STATUS", "doctor", content, 0, version)))
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
            # what the gateway would answer is not sent; of us there is the word to the silent alone
            if entry.kind is not Kind.IGTL_OUT or not entry.seq:
                self.seen.add(entry)
            peers = self.seen.peers.values()
            enough = 0 < self._options.messages <= sum(peer.messages for peer in peers)
            # another protocol: nothing better will come
            if enough or any(peer.head and not is_openigtlink(peer.head) for peer in peers):
                self._stop.set()

"""The addresses of an edge: where it listens, relays and connects, and the handshakes of its clients."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from functools import partial

from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.extras import in_use
from igtl_gateway.base.quantities import by_count, counted
from igtl_gateway.edges.reserved import ReservedPorts, open_port
from igtl_gateway.edges.tcp.dialer import Dialer
from igtl_gateway.edges.tcp.handshake import Handshake
from igtl_gateway.edges.tcp.layer import AnySocket, Layer
from igtl_gateway.edges.tcp.link_info import LinkInfo, PeerLimits
from igtl_gateway.edges.tcp.link_parts import LinkContext
from igtl_gateway.edges.tcp.listener import Listener
from igtl_gateway.edges.tcp.registry import LinkRegistry
from igtl_gateway.edges.tcp.relay import RelayConnector
from igtl_gateway.edges.tcp.sockets import PORT_MAX, AllowList, address_text, listening_socket, tune_socket
from igtl_gateway.edges.tcp.tls import TlsFiles, TlsSocket

#: Takes a connection and the address of its peer.
Up = Callable[[AnySocket, str], None]
#: Puts a layer on a connection.
Lay = Callable[[AnySocket], Layer]


class Addresses:
    """Listeners, relays and dialers; they hand their connections to the registry.

    Args:
        registry: of the links.
        context: what the links share.
        allow: which peers may connect.
        tls: files for the connections with TLS.
        origins: whose pages may connect over WebSocket, see ``websocket.Origins``.
        reserved: ports that are taken already.
    """

    def __init__(
        self,
        registry: LinkRegistry,
        context: LinkContext,
        allow: AllowList,
        tls: TlsFiles,
        origins: Sequence[str],
        reserved: ReservedPorts | None,
    ) -> None:
        self._registry = registry
        self._loop = context.loop
        self._reporter = context.reporter
        self._refusals = context.refusals
        self._limits: PeerLimits = context.limits
        self._allow = allow
        self._tls = tls
        self._origins = origins
        self._reserved = reserved
        self._listeners: list[Listener] = []
        self._closed: list[socket.socket] | None = []  # ports that open with the edge; None: it has started
        self._dialers: list[Dialer] = []
        self._relays: list[RelayConnector] = []
        self._handshakes: dict[Layer, Handshake] = {}  # of clients that are not links yet

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def listen(self, host: str, port: int, tls: bool, websocket: bool) -> tuple[str, int]:
        """Accept peers at this address; see ``TcpEdge.listen``."""
        return self._listen(host, port, self._registry.up, self._layers(tls, websocket))

    def relay(
        self, host: str, port: int, to: tuple[str, int], tls: bool, tls_to: bool, websocket: bool
    ) -> tuple[str, int]:
        """Accept peers at this address, each with a connection to a server; see ``TcpEdge.relay``."""
        _check_port(*to)
        secure = self._securer(to[0]) if tls_to else None
        relay = RelayConnector(*to, self._registry.pair_up, self._loop, self._reporter, secure)
        bound = self._listen(host, port, relay.take, self._layers(tls, websocket))
        self._relays.append(relay)
        return bound

    def connect(self, host: str, port: int, tls: bool) -> None:
        """Stay connected to this server; see ``TcpEdge.connect``."""
        _check_port(host, port)
        secure = self._securer(host) if tls else None
        dialer = Dialer(host, port, self._registry.up, self._loop, self._reporter, secure=secure)
        with self._registry.changed:
            if self._loop.stopping:
                raise ConfigError(f"connect {dialer.target}: the edge was stopped; a new one is needed")
            self._dialers.append(dialer)
        self._loop.call_soon(dialer.dial, dialer.failed)

    def open(self) -> None:
        """Let peers through from here on.  Raises Unavailable if another program has taken a port meanwhile."""
        with self._registry.changed:
            closed, self._closed = self._closed, None
        for sock in closed or ():
            _open(sock)

    def absent(self) -> list[LinkInfo]:
        """The servers that are not connected."""
        return [LinkInfo(0, dialer.target, "client", False) for dialer in self._dialers if not dialer.link]

    def _layers(self, tls: bool, websocket: bool) -> list[Lay]:
        """What is laid on the connections of clients, the lowest first.  Raises ConfigError, Unavailable."""
        layers: list[Lay] = []
        if tls:
            layers.append(partial(TlsSocket, context=self._tls.server(), server_side=True))
        if websocket:
            with in_use("websocket"):
                from igtl_gateway.edges.tcp.websocket import Origins, WebSocketSocket
            layers.append(partial(WebSocketSocket, origins=Origins(self._origins)))
        return layers

    def _listen(self, host: str, port: int, up: Up, layers: Sequence[Lay]) -> tuple[str, int]:
        sock = listening_socket(host, port, self._allow, self._reserved)
        bound: tuple[str, int] = sock.getsockname()[:2]
        accepted = partial(self._lay, up, layers) if layers else up
        listener = Listener(sock, self._allow, self._over_limit, accepted, self._loop, self._reporter, self._refusals)
        with self._registry.changed:
            if self._loop.stopping:
                sock.close()
                raise ConfigError(f"listen {address_text((host, port))}: the edge was stopped; a new one is needed")
            self._listeners.append(listener)
            if self._closed is not None:
                self._closed.append(sock)
            else:
                _open(sock)
        self._loop.call_soon(listener.open, listener.failed)
        return bound

    def _securer(self, host: str) -> Callable[[socket.socket], Layer]:
        """The function that puts TLS on a connection to that host.  Raises ConfigError."""
        context = self._tls.client()

        def secure(sock: socket.socket) -> Layer:
            tune_socket(sock)
            return TlsSocket(sock, context, server_side=False, host=host)

        return secure

    # ── for the I/O thread ────────────────────────────────────────────────────────────────────────────────────

    def close(self) -> None:
        """Accept no more, and give up the connections that are being made."""
        for listener in self._listeners:
            listener.close()
        for dialer in self._dialers:
            dialer.hang_up()
        for relay in self._relays:
            relay.close()
        for handshake in self._handshakes.values():
            handshake.cancel()

    def _over_limit(self) -> str:
        """Why no further peer may connect, or ``""``."""
        most = self._limits.max_clients
        clients = self._registry.clients() + sum(relay.waiting for relay in self._relays)
        return f"{counted(most, 'client')} {by_count(most, 'is', 'are')} connected already" if clients >= most else ""

    def _lay(self, up: Up, layers: Sequence[Lay], sock: AnySocket, peer: str) -> None:
        """A client connected that has to complete a handshake first: that of the first of these layers.

        Beside the connected clients the same number may be in the handshake.  One more takes the place of the one
        that has been silent for longest: no certificate is needed to be silent, and a client that has one must be
        able to connect.
        """
        if isinstance(sock, socket.socket):
            tune_socket(sock)
        if len(self._handshakes) >= self._limits.max_clients:
            waiting = self._handshakes.values()
            next((one for one in waiting if not one.sock.begun), next(iter(waiting))).yield_to_newer()
        layer = layers[0](sock)

        def done() -> None:
            del self._handshakes[layer]
            if reason := self._over_limit():
                self._refusals.refuse(layer, peer, reason)
            elif rest := layers[1:]:
                self._lay(up, rest, layer, peer)
            else:
                up(layer, peer)

        def refused(reason: str, detail: str) -> None:
            del self._handshakes[layer]
            self._refusals.refuse(layer, peer, reason, detail)

        def failed(exc: Exception) -> None:
            self._reporter.note_error(exc)
            if handshake := self._handshakes.pop(layer, None):
                handshake.cancel()

        self._handshakes[layer] = handshake = Handshake(layer, self._loop, done, refused, failed)
        handshake.begin(self._limits.handshake_s)


def _open(sock: socket.socket) -> None:
    try:
        open_port(sock)
    except OSError as exc:
        place = address_text(sock.getsockname())
        raise Unavailable(f"listen {place}: the port was taken by another program; stop it or choose another") from exc


def _check_port(host: str, port: int) -> None:
    if not 1 <= port <= PORT_MAX:
        raise ConfigError(f"connect {host}: found port {port}, expected 1 to {PORT_MAX}")

"""Relaying: each client of a listener gets a connection of its own to one server."""

from __future__ import annotations

import socket
from collections.abc import Callable

from igtl_gateway.edges.tcp.dialer import Dialer
from igtl_gateway.edges.tcp.layer import AnySocket, Layer
from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.gateway.log.note import Level, Note

#: Socket and address of a client, and of the server.
_UpPair = Callable[[AnySocket, str, AnySocket, str], None]


class RelayConnector:
    """Accepts clients, connects to the server for each, and passes both sockets to ``up``; of the I/O thread alone.

    A client is not read until its server is connected, so that nothing is lost; if the server cannot be reached, the
    client is closed, as the server itself would refuse it.
    """

    def __init__(
        self,
        host: str,
        port: int,
        up: _UpPair,
        loop: Loop,
        reporter: Reporter,
        secure: Callable[[socket.socket], Layer] | None = None,
    ) -> None:
        self._host = host
        self._port = port
        self._link_up = up
        self._loop = loop
        self._reporter = reporter
        self._secure = secure  # puts TLS on the connections to the server
        self._waiting: dict[Dialer, tuple[AnySocket, str]] = {}

    @property
    def waiting(self) -> int:
        """Clients for which a connection is being made."""
        return len(self._waiting)

    def take(self, client: AnySocket, peer: str) -> None:
        """Connect to the server for a new client."""
        dialer = Dialer(self._host, self._port, self._made, self._loop, self._reporter, self._gave_up, self._secure)
        self._waiting[dialer] = (client, peer)
        self._loop.run(dialer.dial, dialer.failed)

    def close(self) -> None:
        """End all attempts that are under way."""
        for dialer in list(self._waiting):
            dialer.hang_up()
            self._gave_up(dialer, "stopped")

    def _made(self, server: AnySocket, target: str, dialer: Dialer) -> None:
        client, peer = self._waiting.pop(dialer)
        self._link_up(client, peer, server, target)

    def _gave_up(self, dialer: Dialer, cause: str) -> None:
        client, peer = self._waiting.pop(dialer, (None, ""))
        if not client:  # both were connected, and a later step failed
            return
        client.close()

        def make(count: int) -> Note:
            data = {"peer": dialer.target, "reason": cause, "client": peer, "count": count}
            text = f"{peer} closed: cannot connect to {dialer.target}: {cause}"
            return Note(Level.WARN, "connect_failed", text, data=data)

        self._reporter.note_rate_limited(f"connect_failed: {dialer.target}: {cause}", make)

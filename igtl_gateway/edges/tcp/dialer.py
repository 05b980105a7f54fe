"""Connecting to a server: tried until the server is there, and again whenever the connection ends."""

from __future__ import annotations

import errno
import os
import socket
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from igtl_gateway.base.once import Once
from igtl_gateway.edges.tcp.handshake import Handshake
from igtl_gateway.edges.tcp.layer import AnySocket, Layer
from igtl_gateway.edges.tcp.link import Link
from igtl_gateway.edges.tcp.loop import WRITE, Loop
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.edges.tcp.sockets import address_text, resolve
from igtl_gateway.gateway.log.note import Level, Note

#: Results of an attempt that has begun.
_BEGUN = {0, errno.EINPROGRESS}
if sys.platform == "win32":
    _BEGUN.add(errno.WSAEWOULDBLOCK)

_CONNECT_TIMEOUT_S = 5.0  # the kernel's own would be two minutes
_RETRY_FIRST_S = 0.1  # as fast as 3D Slicer retries: a server that restarts is back at once
_RETRY_LAST_S = 5.0  # the longest that a user waits after switching the server on
_LIVED_S = 1.0  # after a link that lasted this long, or on which a byte was received, the first retry is fast again


class Dialer:
    """Connects, and passes the connection to ``up`` (socket, address, itself); of the I/O thread alone.

    ``link`` is the connection that is up, if any; the registry sets it.  With ``gave_up`` there is one attempt only,
    and this is called (with itself and the cause) if the attempt fails.  ``secure`` puts TLS on the connection.
    """

    def __init__(
        self,
        host: str,
        port: int,
        up: Callable[[AnySocket, str, Dialer], None],
        loop: Loop,
        reporter: Reporter,
        gave_up: Callable[[Dialer, str], None] | None = None,
        secure: Callable[[socket.socket], Layer] | None = None,
    ) -> None:
        self.target = address_text((host, port))
        self.link: Link | None = None
        self._host = host
        self._port = port
        self._link_up = up
        self._loop = loop
        self._reporter = reporter
        self._gave_up = gave_up
        self._secure = secure
        self._handshake: Handshake | None = None
        self._delay_s = _RETRY_FIRST_S
        self._note_once = Once()  # causes noted in this outage
        self._addresses: list[tuple[int, Any]] = []  # family and address, still to be tried in this attempt
        self._sock: socket.socket | None = None

    def dial(self) -> None:
        """Begin an attempt: find the addresses of the server."""
        if self._loop.stopping or self.link:
            return
        try:
            addresses = resolve(self._host, self._port, numeric=True)
        except OSError:
            # a name server can take seconds: not in this thread
            threading.Thread(target=self._resolve, name="igtl-resolve", daemon=True).start()
        else:
            self._resolved(addresses, "")

    def hang_up(self) -> None:
        """End the attempt that is under way, if any."""
        if self._sock:
            self._loop.unwatch(self._sock)
            self._sock.close()
            self._sock = None
        if self._handshake:
            self._handshake.cancel()
            self._handshake = None

    def redial(self) -> None:
        """The link is down: try again."""
        link, self.link = self.link, None
        if link and link.liveness.was_established(_LIVED_S):
            self._delay_s = _RETRY_FIRST_S
            self._note_once.forget()
        self._retry()

    def failed(self, exc: Exception) -> None:
        """An unexpected error of our own code: it is noted, and ends this attempt."""
        self._reporter.note_error(exc)
        self.hang_up()
        if self._gave_up:
            self._gave_up(self, f"{exc}")
        else:
            self._retry()

    def _resolve(self) -> None:
        try:
            found, cause = resolve(self._host, self._port, numeric=False), ""
        except OSError as exc:
            found, cause = [], f"{exc.strerror or exc}"
        self._loop.call_soon(partial(self._resolved, found, cause), self.failed)

    def _resolved(self, addresses: list[tuple[int, Any]], cause: str) -> None:
        self._addresses = addresses
        self._dial_next(cause)

    def _dial_next(self, cause: str) -> None:
        """Try the next address, or give up this attempt for the cause."""
        if self._loop.stopping:
            return
        if not self._addresses:
            self._give_up(cause)
            return
        family, address = self._addresses.pop(0)
        try:
            self._sock = sock = socket.socket(family, socket.SOCK_STREAM)
        except OSError as exc:
            self._dial_next(f"{exc.strerror}")
            return
        sock.setblocking(False)
        code = sock.connect_ex(address)
        if code not in _BEGUN:
            self.hang_up()
            self._dial_next(os.strerror(code))
            return
        self._loop.watch(sock, WRITE, lambda _: self._connected(sock, address), self.failed)
        self._loop.call_later(_CONNECT_TIMEOUT_S, partial(self._timed_out, sock), self.failed)

    def _connected(self, sock: socket.socket, address: Any) -> None:
        code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        # A free port of the ephemeral range can be connected to itself; there is no server.
        if not code and sock.getsockname()[:2] == address[:2]:
            code = errno.ECONNREFUSED
        if code:
            self.hang_up()
            self._dial_next(os.strerror(code))
            return
        self._loop.unwatch(sock)
        self._sock = None
        if not self._secure:
            self._link_up(sock, address_text(address), self)
            return
        secured = self._secure(sock)
        done = partial(self._handshake_done, secured, address_text(address))
        self._handshake = Handshake(secured, self._loop, done, self._handshake_failed, self.failed)
        self._handshake.begin(_CONNECT_TIMEOUT_S)

    def _handshake_done(self, sock: Layer, place: str) -> None:
        self._handshake = None
        self._link_up(sock, place, self)

    def _handshake_failed(self, reason: str, detail: str) -> None:
        self.hang_up()
        self._dial_next(f"{reason} ({detail})" if detail else reason)

    def _timed_out(self, sock: socket.socket) -> None:
        if self._sock is sock:
            self.hang_up()
            self._dial_next(os.strerror(errno.ETIMEDOUT))

    def _give_up(self, cause: str) -> None:
        if self._gave_up:
            self._gave_up(self, cause)
            return
        if self._note_once.first(cause):
            text = f"cannot connect to {self.target}: {cause}; still trying"
            data = {"peer": self.target, "reason": cause}
            self._reporter.note(0, Note(Level.WARN, "connect_failed", text, data=data))
        self._retry()

    def _retry(self) -> None:
        self._loop.call_later(self._delay_s, self.dial, self.failed)
        self._delay_s = min(2 * self._delay_s, _RETRY_LAST_S)

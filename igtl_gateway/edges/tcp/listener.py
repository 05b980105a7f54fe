"""Accepting peers at one address."""

from __future__ import annotations

import socket
from collections.abc import Callable

from igtl_gateway.edges.tcp.link_parts import Refusals
from igtl_gateway.edges.tcp.loop import READ, Loop
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S, Reporter
from igtl_gateway.edges.tcp.sockets import AllowList, address_text
from igtl_gateway.gateway.log.note import Level, Note


class Listener:
    """Accepts peers and passes them to ``up`` (socket, address); of the I/O thread alone.

    ``crowded`` returns why no further peer may connect, or ``""``.
    """

    def __init__(
        self,
        sock: socket.socket,
        allow: AllowList,
        crowded: Callable[[], str],
        up: Callable[[socket.socket, str], None],
        loop: Loop,
        reporter: Reporter,
        refusals: Refusals,
    ) -> None:
        self._sock = sock
        self._allow = allow
        self._over_limit = crowded
        self._link_up = up
        self._loop = loop
        self._reporter = reporter
        self._refusals = refusals

    def open(self) -> None:
        if not self._loop.stopping:
            self._loop.watch(self._sock, READ, self._accept, self.failed)

    def close(self) -> None:
        self._loop.unwatch(self._sock)
        self._sock.close()

    def failed(self, exc: Exception) -> None:
        """An unexpected error of our own code: it is noted, and the listener pauses for a second."""
        self._reporter.note_error(exc)
        self._pause()

    def _accept(self, mask: int) -> None:
        try:
            sock, address = self._sock.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as exc:
            # out of descriptors, mostly: the listener would stay ready and the loop spin
            text = f"cannot accept connections at {address_text(self._sock.getsockname())}: {exc.strerror}"
            self._reporter.note(0, Note(Level.ERROR, "accept_failed", text))
            self._pause()
            return
        peer = address_text(address)
        if address[0] not in self._allow:
            self._refusals.refuse(sock, peer, "not in the allow-list")
        elif reason := self._over_limit():
            self._refusals.refuse(sock, peer, reason)
        else:
            self._link_up(sock, peer)

    def _pause(self) -> None:
        self._loop.unwatch(self._sock)
        self._loop.call_later(NOTE_EVERY_S, self.open, self.failed)

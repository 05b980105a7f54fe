"""Accepting peers at one address: at once, to a lobby, from which one after the other becomes a link."""

from __future__ import annotations

import socket
from collections.abc import Callable

from igtl_gateway.edges.tcp.link_parts import Refusals
from igtl_gateway.edges.tcp.lobby import Lobby, Waiting
from igtl_gateway.edges.tcp.loop import READ, Loop
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S, Reporter
from igtl_gateway.edges.tcp.sockets import AllowList, address_text
from igtl_gateway.edges.tcp.turns import Turn
from igtl_gateway.gateway.log.note import Level, Note

#: Connections that are accepted in one turn.
_AT_ONCE = 64


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
        self._lobby = Lobby()
        self._accepting = Turn(self._accept, self.failed)
        self._admitting = Turn(self._admit, self.failed)

    def open(self) -> None:
        if not self._loop.stopping:
            self._loop.watch_in_turn(self._sock, READ, self._accepting)

    def close(self) -> None:
        self._loop.unwatch(self._sock)
        self._admitting.give_up()
        self._sock.close()
        self._lobby.close()

    def failed(self, exc: Exception) -> None:
        """An unexpected error of our own code: it is noted, and the listener pauses for a second."""
        self._reporter.note_error(exc)
        self._pause()

    def _accept(self, mask: int) -> None:
        """Take what has connected, while there is room."""
        for _ in range(_AT_ONCE):
            for gone in self._lobby.make_room():
                self._refusals.refuse(gone.sock, gone.peer, "it left before its turn")
            if self._lobby.is_full:
                self._loop.unwatch(self._sock)
                return
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
            if address[0] in self._allow:
                self._lobby.add(Waiting(sock, address[0], peer))
                self._loop.ask(self._admitting)
            else:
                self._refusals.refuse(sock, peer, "not in the allow-list")

    def _admit(self, mask: int) -> None:
        """Make a link of one that waits."""
        if self._lobby.is_full:
            self.open()
        waiting = self._lobby.take()
        if self._lobby:
            self._loop.ask(self._admitting)
        self._admitting.has_more = waiting.has_left
        if reason := self._over_limit():
            self._refusals.refuse(waiting.sock, waiting.peer, reason)
        else:
            self._link_up(waiting.sock, waiting.peer)

    def _pause(self) -> None:
        self._loop.unwatch(self._sock)
        self._loop.call_later(NOTE_EVERY_S, self.open, self.failed)

"""Accepting peers at one address: at once, to a lobby, from which one after the other becomes a link."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from contextlib import suppress

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.link_parts import Refusals
from igtl_gateway.edges.tcp.lobby import Lobby, Waiting
from igtl_gateway.edges.tcp.loop import READ, Loop
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S, Reporter
from igtl_gateway.edges.tcp.sockets import AllowList, address_text
from igtl_gateway.edges.tcp.turns import Turn
from igtl_gateway.gateway.log.note import Level, Note

#: Connections that are accepted in one turn: each takes 20 µs.
_AT_ONCE = 16
#: How long (s) a crowd gathers until it is accepted: to look for each one would cost as much again.
_GATHERING_S = 0.002
#: SO_LINGER: a reset when the socket is closed.
_RESET = struct.pack("ii", 1, 0)


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
        self._is_timed = False  # a timer runs for the first one that is due
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
        self._pause(NOTE_EVERY_S)
        self._ask_to_admit()  # those that had come in before it

    def _accept(self, mask: int) -> None:
        """Take what has connected, while there is room."""
        now_ns = self._loop.now()
        for _ in range(_AT_ONCE):
            if self._lobby.is_full:
                self._refuse(self._lobby.make_room())
            if self._lobby.is_full:
                self._loop.unwatch(self._sock)
                break
            try:
                sock, address = self._sock.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                if self._lobby.is_crowd(now_ns):
                    self._pause(_GATHERING_S)
                break
            except OSError as exc:
                # out of descriptors, mostly: the listener would stay ready and the loop spin
                text = f"cannot accept connections at {address_text(self._sock.getsockname())}: {exc.strerror}"
                self._reporter.note(0, Note(Level.ERROR, "accept_failed", text))
                self._pause(NOTE_EVERY_S)
                break
            self._lobby.arrived(now_ns)
            if address[0] in self._allow:
                self._lobby.add(Waiting(sock, address), now_ns)
            else:
                self._refusals.refuse(sock, address_text(address), "not in the allow-list")
        self._ask_to_admit()

    def _admit(self, mask: int) -> None:
        """Make a link of one that waits and is due."""
        was_full = self._lobby.is_full
        waiting, gone = self._lobby.take(self._loop.now())
        self._refuse(gone)
        if was_full and not self._lobby.is_full:
            self.open()
        self._ask_to_admit()
        if waiting is None:
            return
        self._admitting.has_more = waiting.has_left
        if reason := self._over_limit():
            self._refusals.refuse(waiting.sock, waiting.peer, reason)
        else:
            self._link_up(waiting.sock, waiting.peer)

    def _ask_to_admit(self) -> None:
        """Have a turn for the first one that waits: now, or when it is due."""
        due_ns = self._lobby.due_ns
        if due_ns is None or self._is_timed:
            return
        if (wait_ns := due_ns - self._loop.now()) <= 0:
            self._loop.ask(self._admitting)
        else:
            self._is_timed = True
            self._loop.call_later(wait_ns / NS_PER_S, self._time_has_come, self.failed)

    def _time_has_come(self) -> None:
        self._is_timed = False
        self._ask_to_admit()

    def _refuse(self, gone: set[Waiting]) -> None:
        """Close connections whose peers have left: without a farewell, which would cost as much as to accept them."""
        for one in gone:
            with suppress(OSError):
                one.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        if gone:
            peer = next(iter(gone)).peer
            self._refusals.refuse_all([one.sock for one in gone], peer, "it left before its turn")

    def _pause(self, pause_s: float) -> None:
        self._loop.unwatch(self._sock)
        self._loop.call_later(pause_s, self.open, self.failed)

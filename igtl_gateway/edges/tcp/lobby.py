"""Connections that were accepted and are no links yet: which of them is next.

Strategy: a new peer must not wait for those that come and leave in great numbers.  The system's own queue is first in,
first out, and a connection that finds it full tries again a second later; so connections are taken from there at once,
and a link, which costs a hundred times as much, is made of one at a time.  Hosts take turns.  Connections of one host
keep their order, because a program may send each message in a connection of its own; but where many have left again,
those that are still there come first, and where there is no room, those that have left give way.
"""

from __future__ import annotations

import select
import socket
import sys
from collections import Counter
from dataclasses import dataclass

#: Connections that wait here at most; the system has a queue of its own.
ROOM = 256
#: Connections of a host that have left, and keep their place in the order.
KEPT = 16


@dataclass(slots=True, eq=False)
class Waiting:
    """An accepted connection.  ``has_left``: its peer sends no more; ``is_empty``: and there is nothing to read."""

    sock: socket.socket
    host: str
    peer: str
    has_left: bool = False
    is_empty: bool = False


class Lobby:
    """Connections in the order of their arrival; of one thread."""

    def __init__(self) -> None:
        self._waiting: list[Waiting] = []
        self._taken: Counter[str] = Counter()  # of hosts that have a connection here

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def is_full(self) -> bool:
        return len(self._waiting) >= ROOM

    def add(self, waiting: Waiting) -> None:
        """Take a connection, while there is room."""
        if waiting.host not in self._taken:  # it has saved nothing up
            self._taken[waiting.host] = min(self._taken.values(), default=0)
        self._waiting.append(waiting)

    def make_room(self) -> set[Waiting]:
        """Return those that give way if there is no room: those without anything to read, or half of who has left."""
        if not self.is_full:
            return set()
        self._look()
        left = [one for one in self._waiting if one.has_left]
        gone = {one for one in left if one.is_empty} or set(left[: len(left) // 2 + 1])
        self._waiting = [one for one in self._waiting if one not in gone]
        return gone

    def take(self) -> Waiting:
        """Return the next one."""
        self._look()
        left = Counter(one.host for one in self._waiting if one.has_left)
        found = min(self._waiting, key=lambda one: (self._is_last(one, left), self._taken[one.host]))
        self._waiting.remove(found)
        self._taken[found.host] += 1
        for host in self._taken.keys() - {one.host for one in self._waiting}:
            del self._taken[host]
        return found

    def close(self) -> None:
        """Close all."""
        while self._waiting:
            self._waiting.pop().sock.close()

    def _is_last(self, one: Waiting, left: Counter[str]) -> bool:
        return one.is_empty or (one.has_left and left[one.host] > KEPT)

    def _look(self) -> None:
        """See who has left; where the system does not show it, those are as the others."""
        if sys.platform != "linux":
            return
        poll, here = select.poll(), {one.sock.fileno(): one for one in self._waiting if not one.has_left}
        for number in here:
            poll.register(number, select.POLLRDHUP)
        for number, _ in poll.poll(0):
            here[number].has_left, here[number].is_empty = True, _is_empty(here[number].sock)


def _is_empty(sock: socket.socket) -> bool:
    try:
        return not sock.recv(1, socket.MSG_PEEK)
    except OSError:
        return True

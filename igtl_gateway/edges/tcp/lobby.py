"""Connections that were accepted and are no links yet: which of them is next.

Strategy: a new peer must not wait for those that come and leave in great numbers.  The system's own queue is first in,
first out, and a connection that finds it full tries again a second later; so connections are taken from there at once,
and a link, which costs a hundred times as much, is made of one at a time.  Hosts take turns.  Connections of one host
keep their order, because a program may send each message in a connection of its own; but where many have left again,
those that are still there come first, and where there is no room, those that have left give way.

A crowd is more than programs with a connection for each message bring.  In a crowd each connection waits for some ms,
and one that has left by then without a whole header becomes no link: twenty thousand a second would otherwise take a
core that the poses of ROS need.
"""

from __future__ import annotations

import select
import socket
import sys
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.edges.tcp.sockets import address_text
from igtl_gateway.wire.header import HEADER_SIZE

#: Connections that wait here at most; the system has a queue of its own.
ROOM = 256
#: Connections of a host that have left, and keep their place in the order.
KEPT = 16
#: A crowd: this number of connections within this time (ns).
CROWD, WITHIN_NS = 32, 100 * NS_PER_MS
#: How long (ns) each connection of a crowd waits.
WAIT_NS = 10 * NS_PER_MS
#: Connections that leave a crowd in one turn: to close one takes 10 µs.
_GO_AT_ONCE = 16


@dataclass(slots=True, eq=False)
class Waiting:
    """An accepted connection.

    Attributes:
        due_ns: when it may become a link (monotonic ns).
        in_crowd: it came in a crowd.
        has_left: its peer sends no more.
        is_empty: and there is no whole header to read.
    """

    sock: socket.socket
    address: tuple[Any, ...]
    due_ns: int = 0
    in_crowd: bool = False
    has_left: bool = False
    is_empty: bool = False

    @property
    def host(self) -> str:
        return str(self.address[0])

    @property
    def peer(self) -> str:
        return address_text(self.address)


class Lobby:
    """Connections in the order of their arrival; of one thread.  Times are monotonic nanoseconds."""

    def __init__(self) -> None:
        self._waiting: list[Waiting] = []
        self._taken: Counter[str] = Counter()  # of hosts that have a connection here
        self._arrivals: deque[int] = deque(maxlen=CROWD)
        self._due_ns = 0  # when the last one is due

    @property
    def is_full(self) -> bool:
        return len(self._waiting) >= ROOM

    @property
    def due_ns(self) -> int | None:
        """When the first one is due; None: none waits."""
        return self._waiting[0].due_ns if self._waiting else None

    def is_crowd(self, now_ns: int) -> bool:
        """Whether many have arrived within a short time, up to now."""
        return len(self._arrivals) == CROWD and now_ns - self._arrivals[0] < WITHIN_NS

    def arrived(self, now_ns: int) -> None:
        """Count a connection; whether it may come in or not."""
        self._arrivals.append(now_ns)

    def add(self, waiting: Waiting, now_ns: int) -> None:
        """Take a connection, while there is room."""
        if waiting.host not in self._taken:  # it has saved nothing up
            self._taken[waiting.host] = min(self._taken.values(), default=0)
        waiting.in_crowd = self.is_crowd(now_ns)
        # those that come after a crowd wait for it: the order stays
        waiting.due_ns = self._due_ns = max(self._due_ns, now_ns + WAIT_NS * waiting.in_crowd)
        self._waiting.append(waiting)

    def make_room(self) -> set[Waiting]:
        """Return those that give way if there is no room: those without a whole header, or half of who has left."""
        if not self.is_full:
            return set()
        _look(self._waiting)
        left = [one for one in self._waiting if one.has_left]
        return self._without({one for one in left if one.is_empty} or set(left[: len(left) // 2 + 1]))

    def take(self, now_ns: int) -> tuple[Waiting | None, set[Waiting]]:
        """Return the next one that is due, if any, and some of a crowd that have left without a whole header."""
        due = [one for one in self._waiting if one.due_ns <= now_ns]
        _look(due)
        gone = self._without(set([one for one in due if one.in_crowd and one.is_empty][:_GO_AT_ONCE]))
        due = [one for one in due if not (one.in_crowd and one.is_empty)]
        if not due:
            return None, gone
        left = Counter(one.host for one in due if one.has_left)
        found = min(due, key=lambda one: (_is_last(one, left), self._taken[one.host]))
        self._taken[found.host] += 1
        self._without({found})
        return found, gone

    def close(self) -> None:
        """Close all."""
        while self._waiting:
            self._waiting.pop().sock.close()

    def _without(self, gone: set[Waiting]) -> set[Waiting]:
        """Forget these, and the hosts that have no connection here any more; return these."""
        self._waiting = [one for one in self._waiting if one not in gone]
        for host in self._taken.keys() - {one.host for one in self._waiting}:
            del self._taken[host]
        return gone


def _is_last(one: Waiting, left: Counter[str]) -> bool:
    return one.is_empty or (one.has_left and left[one.host] > KEPT)


def _look(waiting: Sequence[Waiting]) -> None:
    """See who has left; where the system does not show it, those are as the others."""
    if sys.platform != "linux":
        return
    poll, here = select.poll(), {one.sock.fileno(): one for one in waiting if not one.has_left}
    for number in here:
        poll.register(number, select.POLLRDHUP)
    for number, events in poll.poll(0):
        here[number].has_left = True
        # a reset ends what is to be read as well (RFC 9293, 3.10.7.4), where the system still has it
        here[number].is_empty = bool(events & select.POLLERR) or _is_empty(here[number].sock)


def _is_empty(sock: socket.socket) -> bool:
    try:
        return len(sock.recv(HEADER_SIZE, socket.MSG_PEEK)) < HEADER_SIZE
    except OSError:
        return True

"""Whose turn it is in a thread: fair shares of its time, however much each one has to do.

Strategy: start-time fair queueing.  Each taker (a link, a listener, a handshake) has a place in a time that advances
with the turns.  A turn moves its taker's place on by the CPU time that it used, and the next turn is that of the taker
whose place is the first.  One that had nothing to do begins at the present: it saves nothing up, and it comes before
all that are busy.  So a peer that asks for little waits for one turn at most, however many others flood the gateway,
and those that flood share what is left.

Its taker limits a turn, see ``QUANTUM_NS``; what is left waits for the next one, behind it in the socket
of the peer.  Who leaves nothing pays an eighth: beside twenty that flood, a peer that waits for each answer would
otherwise use more than one of them, and wait for all of them each time.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

from igtl_gateway.base.stamp import NS_PER_S

#: A turn ends after the message with which it has lasted this long.
QUANTUM_NS = 100_000

#: The part of its time that a turn costs which leaves nothing to be done.
_PART = 8

#: Large messages without valid content rest for this multiple of their time, beyond what may come at once.
_REST, _BURST_NS = 9, 200_000_000
#: What is too large to be one of many small ones, and what a byte of it costs.
LARGE_BYTES, _NS_PER_BYTE = 64 << 10, 1


class InvalidTime:
    """The time that large messages without valid content may take, of all links together: a tenth.

    Twenty peers that send pictures with a wrong CRC would otherwise fill both cores, and the poses of ROS wait.
    """

    def __init__(self) -> None:
        self._until_ns = 0

    def rest_s(self, size: int, now_ns: int) -> float:
        """Count such a message of this size; return how long (s) its link is not to be read."""
        if size < LARGE_BYTES:
            return 0.0
        self._until_ns = max(self._until_ns, now_ns - _BURST_NS) + _REST * _NS_PER_BYTE * size
        return max(0, self._until_ns - now_ns) / NS_PER_S


class Turn:
    """One taker, and what it does when its turn comes.

    Attributes:
        action: called with the events of the socket since the last turn; 0: it asked itself.
        rescue: called with an exception of the action.
        mask: those events.
        waits: it has asked for a turn.
        has_more: set by the action: something is left that the turn had no time for.
    """

    __slots__ = ("_at_ns", "_serial", "action", "has_more", "mask", "rescue", "waits")

    def __init__(self, action: Callable[[int], None], rescue: Callable[[Exception], None]) -> None:
        self.action = action
        self.rescue = rescue
        self.mask = 0
        self.waits = False
        self.has_more = False
        self._at_ns = 0
        self._serial = 0

    def charge(self, time_ns: int) -> None:
        """Pay for CPU time that was used for this taker elsewhere."""
        self._at_ns += time_ns

    def give_up(self) -> None:
        """Ask for a turn no longer."""
        self.waits = False
        self.mask = 0


class Turns:
    """The takers that wait for their turn; of one thread."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, int, Turn]] = []
        self._now_ns = 0
        self._serial = 0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def ask(self, turn: Turn) -> None:
        """Have a turn; nothing changes if it waits for one."""
        if not turn.waits:
            turn.waits = True
            turn._at_ns = max(turn._at_ns, self._now_ns)
            self._serial = turn._serial = self._serial + 1
            heapq.heappush(self._waiting, (turn._at_ns, turn._serial, turn))

    def next(self) -> Turn | None:
        """Return whose turn it is; None: no taker waits.  ``used`` must follow."""
        while self._waiting:
            at_ns, serial, turn = heapq.heappop(self._waiting)
            if turn.waits and turn._serial == serial:
                turn.waits = False
                self._now_ns = at_ns
                return turn
        return None

    def used(self, turn: Turn, time_ns: int) -> None:
        """A turn has ended: it used this CPU time.  It may have asked for another one already."""
        turn._at_ns += max(0, time_ns if turn.has_more else time_ns // _PART)
        if turn.waits:
            turn.waits = False
            self.ask(turn)

"""The priority of the worker: behind all others, as long as that does not cost entries."""

from __future__ import annotations

from collections.abc import Callable

#: The worker has raised priority from when the first part of the queue's bound waits until the second part does.
_HURRY_PART, _CALM_PART = 8, 64
#: Also where that took longer which should take less than two looks: others leave it too little time.  Then it stays
#: raised for some time: a machine that is busy stays busy.
_LATE_NS, _RAISED_NS = 150_000_000, 30_000_000_000
#: It lowers its priority again at this interval, ns: the bridge may have raised it.
_LOWER_NS = 60_000_000_000


class Priority:
    """The priority of this thread.

    Args:
        rank: sets it, raised or not; returns whether that worked.  It is called at each change, and again where it
            failed.
        queue_bytes: bound of the queue.
        now_ns: the present time, monotonic, as of all methods.

    Attributes:
        is_raised: whether it is; it is at first.
    """

    def __init__(self, rank: Callable[[bool], bool], queue_bytes: int, now_ns: int) -> None:
        self.is_raised = True
        self._rank = rank
        self._queue_bytes = queue_bytes
        self._late_ns: int | None = None  # when it was late last
        self._set_ns = now_ns

    def look(self, late_ns: int, waiting_bytes: int, now_ns: int) -> None:
        """Choose it by how late the worker was, and by what waits in the queue."""
        part = _CALM_PART if self.is_raised else _HURRY_PART
        if late_ns > _LATE_NS:
            self._late_ns = now_ns
        is_late = self._late_ns is not None and now_ns - self._late_ns < _RAISED_NS
        self.set(is_late or waiting_bytes > self._queue_bytes // part, now_ns)

    def set(self, is_raised: bool, now_ns: int) -> None:
        """Raise or lower it; lower it once in a while again: the bridge raises it where the worker does not look."""
        again = not is_raised and now_ns - self._set_ns > _LOWER_NS
        if (is_raised != self.is_raised or again) and self._rank(is_raised):
            self.is_raised, self._set_ns = is_raised, now_ns

"""Memory that a program holds and does not use: given back to the system after a burst of large messages.

The bridge has malloc keep large blocks, because fresh pages are slow, and glibc then returns none of them: a burst of
large messages from many peers would keep what all of them took together.  What a burst leaves in use, such as queues
for a peer that stalls, is free later, when the process does not grow: so that which malloc has free counts, too.
"""

from __future__ import annotations

import gc
import mmap
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.base.systems.malloc import FREE_BYTES, GIVE_BACK

_STATM = Path("/proc/self/statm")
#: Growth from which on memory is given back.
_MUCH_BYTES = 32 << 20
#: Looks at which it has grown no more.
_CALM_LOOKS = 3
#: What malloc has free is asked at one of this number of looks, and at each of some after memory was given back, when
#: the last of a burst becomes free: it takes a microsecond for each of its gaps.
_RARELY, _AFTERWARDS = 10, 30


def own_bytes() -> int:
    """Return the resident memory of this process that no file or other process shares; 0 where it is not known."""
    try:
        _, resident, shared, *_ = _STATM.read_text("ascii").split()
        return (int(resident) - int(shared)) * mmap.PAGESIZE
    except (OSError, ValueError):
        return 0


class IdleMemory:
    """Gives freed memory back to the system some time after a burst.

    Args:
        own: returns the memory of the process.
        free: returns what malloc has free of it, or of what was given back.
        give_back: gives freed memory back; None: the system has no such call.
    """

    def __init__(
        self,
        own: Callable[[], int] = own_bytes,
        free: Callable[[], int] = FREE_BYTES,
        give_back: Callable[[], None] | None = GIVE_BACK,
    ) -> None:
        self._own, self._free, self._give_back = own, free, give_back
        self._floor = self._least = self._most = own()
        self._least_free = free()
        self._has_free = False
        self._calm, self._looks = 0, _AFTERWARDS  # since memory was given back

    def look(self) -> None:
        """Give memory back if there is much, and no more than at the last looks; to be called once a second."""
        bytes_ = self._own()
        self._ask_free(bytes_)
        if self._give_back is None or not (self._has_free or bytes_ - self._least >= _MUCH_BYTES):
            self._least = min(self._least, bytes_) or bytes_
            self._most, self._calm = bytes_, 0
            return
        self._calm = 0 if bytes_ > self._most else self._calm + 1
        self._most = max(self._most, bytes_)
        if self._calm >= _CALM_LOOKS:
            gc.collect()  # closed links and their buffers refer to each other
            self._give_back()
            self._least = self._most = self._own()
            self._least_free, self._has_free = self._free(), False
            self._calm = self._looks = 0

    def _ask_free(self, bytes_: int) -> None:
        """Ask what is free, now and then, if the process has more than it once had."""
        self._looks += 1
        self._floor = min(self._floor, bytes_)
        is_due = self._looks <= _AFTERWARDS or self._looks % _RARELY == 0
        if is_due and bytes_ - self._floor >= _MUCH_BYTES:
            free = self._free()
            self._has_free = free - self._least_free >= _MUCH_BYTES
            self._least_free = min(self._least_free, free)

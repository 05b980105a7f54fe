"""Memory that a program holds and does not use: given back to the system after a burst of large messages.

The bridge has malloc keep large blocks, because fresh pages are slow, and glibc then returns none of them: a burst of
large messages from many peers would keep what all of them took together.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import sys
from collections.abc import Callable
from pathlib import Path

_STATM = Path("/proc/self/statm")
#: Growth from which on memory is given back.
_MUCH_BYTES = 32 << 20
#: Looks at which it has grown no more.
_CALM_LOOKS = 3


def own_bytes() -> int:
    """Return the resident memory of this process that no file or other process shares; 0 where it is not known."""
    try:
        _, resident, shared, *_ = _STATM.read_text("ascii").split()
        return (int(resident) - int(shared)) * mmap.PAGESIZE
    except (OSError, ValueError):
        return 0


def _trimmer() -> Callable[[int], object] | None:
    """glibc's ``malloc_trim``; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)


#: Gives freed memory back to the system, down to some bytes; None where the C library has no such call.
MALLOC_TRIM = _trimmer()


class IdleMemory:
    """Gives freed memory back to the system some time after a burst.

    Args:
        own: returns the memory of the process.
        trim: gives freed memory back; None: the system has no such call.
    """

    def __init__(self, own: Callable[[], int] = own_bytes, trim: Callable[[int], object] | None = MALLOC_TRIM) -> None:
        self._own, self._trim = own, trim
        self._least = self._most = own()
        self._calm = 0

    def look(self) -> None:
        """Give memory back if there is much, and no more than at the last looks; to be called once a second."""
        bytes_ = self._own()
        if self._trim is None or bytes_ < self._least + _MUCH_BYTES:
            self._least = min(self._least, bytes_) or bytes_
            self._most, self._calm = bytes_, 0
            return
        self._calm = 0 if bytes_ > self._most else self._calm + 1
        self._most = max(self._most, bytes_)
        if self._calm >= _CALM_LOOKS:
            gc.collect()  # closed links and their buffers refer to each other
            self._trim(0)
            self._least = self._most = self._own()
            self._calm = 0

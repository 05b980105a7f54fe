"""The clock of Windows: Python before 3.13 reads one there that advances in steps of 15.6 ms."""

from __future__ import annotations

import sys

if sys.platform == "win32":
    import ctypes

    _PRECISE = ctypes.WinDLL("kernel32").GetSystemTimePreciseAsFileTime
    #: 1970 on its scale, which counts 100 ns since 1601.
    _EPOCH = 116_444_736_000_000_000

    def precise_utc_ns() -> int:
        """Return UTC nanoseconds since 1970, in steps of 100 ns."""
        found = ctypes.c_uint64()
        _PRECISE(ctypes.byref(found))
        return (found.value - _EPOCH) * 100

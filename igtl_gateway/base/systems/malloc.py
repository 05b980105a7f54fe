"""How glibc's malloc keeps the blocks of large messages, and gives them back after a burst.

It keeps big blocks instead of giving them back to the kernel after every message: the page faults of fresh blocks were
half of the cost of a picture.  The price is that a burst stays, so ``give_back`` is called when it is over.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Mapping

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -2, -3, -8
_ARENAS = 2

# mallopt takes an int.  Before 2.35 glibc refuses a mmap threshold above 32 MiB, still five Full HD images.
_SETTINGS: tuple[tuple[str, int, tuple[int, ...]], ...] = (
    ("M_MMAP_THRESHOLD", _M_MMAP_THRESHOLD, (1 << 30, 32 << 20)),
    ("M_TRIM_THRESHOLD", _M_TRIM_THRESHOLD, ((1 << 31) - 1,)),
    ("M_TOP_PAD", _M_TOP_PAD, (64 << 20,)),
    # each thread's memory is that of its arena: the more there are, the more of them keep what a burst took
    ("M_ARENA_MAX", _M_ARENA_MAX, (_ARENAS,)),
)
_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "MALLOC_TOP_PAD_")

#: Of the settings that were applied, those that keep the end of an arena.
_keeping: dict[int, int] = {}
#: While memory is given back: the end of an arena that may stay, and a block whose end frees the rest.
_STAYS_BYTES, _BLOCK_BYTES = 1 << 17, 1 << 18


class _Info(ctypes.Structure):
    """``struct mallinfo2``."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]


def tune_malloc() -> str:
    """Have malloc keep the blocks of pictures, unless the user has set its options; return one line of text.

    It also halves the cost of the recorder, so it is useful without ROS.
    """
    kept = _why_keep(os.environ)
    if kept:
        return f"malloc: {kept}"
    mallopt = ctypes.CDLL(None).mallopt
    done = []
    for name, option, values in _SETTINGS:
        if os.environ.get(name.replace("M_", "MALLOC_", 1)):  # the number of arenas, which has no bearing on the rest
            continue
        value = next((value for value in values if mallopt(option, value) == 1), None)
        done.append(f"{name}={value}" if value is not None else f"{name} refused")
        if value is not None and option in (_M_TRIM_THRESHOLD, _M_TOP_PAD):
            _keeping[option] = value
    return f"memory: freed blocks of large messages are kept (malloc: {', '.join(done)})"


def _why_keep(environ: Mapping[str, str]) -> str:
    """Return why the allocator must not be changed; ``""`` if it may be."""
    for name in _VARIABLES:
        if environ.get(name):
            return f"kept the user's ({name}={environ[name]})"
    if "glibc.malloc." in environ.get("GLIBC_TUNABLES", ""):
        return f"kept the user's (GLIBC_TUNABLES={environ['GLIBC_TUNABLES']})"
    if not _is_glibc():
        return "not set, this is not glibc on Linux"
    return ""


def _is_glibc() -> bool:
    if not sys.platform.startswith("linux"):
        return False
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except ValueError:  # musl does not know the name
        return False


def _give_back() -> None:
    """Give what is free back to the system.

    ``malloc_trim`` leaves the end of each arena but the first.  That goes back when a block of the arena is freed, if
    the settings allow it: they do for a moment, and threads that begin get the arenas in turns.
    """
    library = ctypes.CDLL(None)
    library.malloc_trim(0)
    for option in _keeping:
        library.mallopt(option, _STAYS_BYTES)
    try:
        for _ in range(2 * _ARENAS if _keeping else 0):
            thread = threading.Thread(target=_free_a_block, args=(library,), name="igtl-trim")
            thread.start()
            thread.join()
    finally:
        for option, value in _keeping.items():
            library.mallopt(option, value)


def _free_a_block(library: ctypes.CDLL) -> None:
    malloc, free = library.malloc, library.free
    malloc.restype, malloc.argtypes, free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
    free(malloc(_BLOCK_BYTES))


def _free_bytes() -> int:
    """What malloc has free, whether the system has its pages back or not; 0 where that is not known (before 2.33)."""
    info = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if info is None:
        return 0
    info.restype = _Info
    return int(info().fordblks)


#: Gives freed memory back to the system; None where the C library has no such call.
GIVE_BACK: Callable[[], None] | None = _give_back if _is_glibc() else None
#: Returns the bytes that malloc has free.
FREE_BYTES: Callable[[], int] = _free_bytes if _is_glibc() else int

"""The order of the inputs: the lock, and the numbers that it guards; in Python here, in C as the native passage."""

from __future__ import annotations

import threading
from typing import Protocol, Self


class Sequence(Protocol):
    """The sequence lock as a context, and what it guards.

    Attributes:
        seq: number of the last entry.
        stamp_ns: gateway time of the last entry (UTC ns).
        last_ns: gateway time of the last input (UTC ns).
        ahead_ns: gateway time less the time of the host's clock (ns).
    """

    seq: int
    stamp_ns: int
    last_ns: int
    ahead_ns: int

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...


class PythonSequence:
    """The sequence where there is no native passage."""

    def __init__(self) -> None:
        self.seq = self.stamp_ns = self.last_ns = self.ahead_ns = 0
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self._lock.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

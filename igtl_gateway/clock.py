"""The only reader of system time.  Everything else is given its time as an argument."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """What the edges, the playback and the command line need of time."""

    def utc_ns(self) -> int:
        """UTC nanoseconds since 1970; may step when the host's clock is set."""
        ...

    def monotonic_ns(self) -> int:
        """Nanoseconds since an arbitrary moment; never steps back."""
        ...


class SystemClock:
    """The host's clock."""

    def utc_ns(self) -> int:
        return time.time_ns()

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()


class ManualClock:
    """A clock that moves only when told to; for tests and for synthetic sessions."""

    def __init__(self, utc_ns: int = 0) -> None:
        self._start_ns = utc_ns
        self._now_ns = utc_ns

    def utc_ns(self) -> int:
        return self._now_ns

    def monotonic_ns(self) -> int:
        return self._now_ns - self._start_ns

    def advance(self, ns: int) -> None:
        """Move on by ``ns`` nanoseconds (not negative)."""
        if ns < 0:
            raise ValueError(f"a clock does not run backwards: {ns} ns")
        self._now_ns += ns

    def set(self, utc_ns: int) -> None:
        """Move on to ``utc_ns``."""
        self.advance(utc_ns - self._now_ns)

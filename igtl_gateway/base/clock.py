"""Clocks.  Only this module reads the system time; all others receive the time as an argument."""

from __future__ import annotations

import sys
import time
from typing import Protocol

if sys.platform == "win32":
    from igtl_gateway.base.systems.clocks import precise_utc_ns


class Clock(Protocol):
    """A source of time for the edges, the playback and the command line."""

    def utc_ns(self) -> int:
        """Return UTC nanoseconds since 1970; steps when the host's clock is set."""
        ...

    def monotonic_ns(self) -> int:
        """Return nanoseconds since an arbitrary time; never decreases."""
        ...


class SystemClock:
    """The clock of the host."""

    if sys.platform == "win32":

        def utc_ns(self) -> int:
            return precise_utc_ns()

        def monotonic_ns(self) -> int:
            return time.perf_counter_ns()  # monotonic_ns has steps of 15.6 ms there before Python 3.13

    else:

        def utc_ns(self) -> int:
            return time.time_ns()

        def monotonic_ns(self) -> int:
            return time.monotonic_ns()


def thread_ns() -> int:
    """Return the CPU time of the calling thread: what it has really used, however many others the machine has."""
    return time.thread_time_ns()


def process_ns() -> int:
    """Return the CPU time of the process, all threads together."""
    return time.process_time_ns()


class ManualClock:
    """A clock that advances only by calls, for tests and synthetic sessions."""

    def __init__(self, utc_ns: int = 0) -> None:
        self._start_ns = utc_ns
        self._now_ns = utc_ns

    def utc_ns(self) -> int:
        return self._now_ns

    def monotonic_ns(self) -> int:
        return self._now_ns - self._start_ns

    def advance(self, ns: int) -> None:
        """Advance by ``ns`` nanoseconds.  Raises ValueError for a negative number."""
        if ns < 0:
            raise ValueError(f"found a step of {ns} ns, expected 0 or more")
        self._now_ns += ns

    def set(self, utc_ns: int) -> None:
        """Advance to ``utc_ns``."""
        self.advance(utc_ns - self._now_ns)

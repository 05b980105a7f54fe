"""A short measurement of a machine: how late a thread wakes up, and how long two threads take to hand over.

Both use locks of Python, as the threads of the bridge do: timed waits and wake-ups by futex, plus the interpreter lock.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

SLEEPS, SLEEP_NS = 1_000, NS_PER_MS
HANDOVERS = 2_000


@dataclass(frozen=True, slots=True)
class Delays:
    """Percentiles (nearest rank) of durations, in nanoseconds."""

    p50_ns: int
    p99_ns: int
    max_ns: int

    @classmethod
    def of(cls, durations: list[int]) -> Delays:
        """Return the percentiles of at least one duration."""
        ordered = sorted(durations)
        return cls(ordered[(len(ordered) - 1) // 2], ordered[-(-len(ordered) * 99 // 100) - 1], ordered[-1])


@dataclass(frozen=True, slots=True)
class HostMeasurement:
    """The results.

    Attributes:
        lateness: of wake-ups after a sleep of 1 ms.
        handover: from one thread to another, half of a round trip.
        steal: share of the time that other virtual machines used during the measurement; None: unknown.
    """

    lateness: Delays
    handover: Delays
    steal: float | None = None


def measure(clock: Clock, sleeps: int = SLEEPS, handovers: int = HANDOVERS) -> HostMeasurement:
    """Measure for a little longer than a second."""
    return HostMeasurement(Delays.of(_lateness(clock, sleeps)), Delays.of(_handovers(clock, handovers)))


def _lateness(clock: Clock, count: int) -> list[int]:
    """Return by how much each sleep is too long, in nanoseconds."""
    closed = threading.Lock()
    closed.acquire()
    late = []
    for _ in range(count):
        begin_ns = clock.monotonic_ns()
        closed.acquire(timeout=SLEEP_NS / NS_PER_S)
        late.append(max(0, clock.monotonic_ns() - begin_ns - SLEEP_NS))
    return late


def _handovers(clock: Clock, count: int) -> list[int]:
    there, back = threading.Lock(), threading.Lock()
    there.acquire()
    back.acquire()

    def answer() -> None:
        for _ in range(count):
            there.acquire()
            back.release()

    thread = threading.Thread(target=answer, name="igtl-probe")
    thread.start()
    taken = []
    for _ in range(count):
        begin_ns = clock.monotonic_ns()
        there.release()
        back.acquire()
        taken.append((clock.monotonic_ns() - begin_ns) // 2)
    thread.join()
    return taken

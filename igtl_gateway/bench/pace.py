"""When to send: several streams at their rates, each on absolute deadlines, so that a late message makes none later."""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from igtl_gateway.clock import Clock
from igtl_gateway.stamp import NS_PER_S


@dataclass(frozen=True, slots=True)
class Schedule:
    """One stream's.

    Attributes:
        send: called with the sequence number, from 1; returns when the message was handed over (monotonic ns).
        rate_hz: how often; 0: again at once.
        count: how many messages; 0: until ``until_ns`` of ``run``.
    """

    send: Callable[[int], int]
    rate_hz: float
    count: int


class Pace:
    """Sends by schedules until all are through; ``stop`` from another thread ends it before."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stopped = False
        # A lock that nobody lets go of waits by the monotonic clock and costs half of what an event costs.
        self._rest = threading.Lock()
        self._rest.acquire()

    def stop(self) -> None:
        self._stopped = True

    def run(self, schedules: Sequence[Schedule], begin_ns: int, until_ns: int) -> list[list[int]]:
        """Send everything.

        Args:
            schedules: of the streams; streams of one rate are spread over its period.
            begin_ns: when the first is due, monotonic.
            until_ns: schedules without a count end then.

        Returns:
            For each schedule, when its messages were sent.
        """
        sent: list[list[int]] = [[] for _ in schedules]
        due: list[tuple[int, int]] = []
        for index, schedule in enumerate(schedules):
            period_ns = NS_PER_S / schedule.rate_hz if schedule.rate_hz else 0.0
            due.append((begin_ns + round(period_ns * index / len(schedules)), index))
        heapq.heapify(due)
        starts = {index: at_ns for at_ns, index in due}
        while due and not self._stopped:
            due_ns, index = due[0]
            now_ns = self._clock.monotonic_ns()
            if now_ns < due_ns:
                self._rest.acquire(timeout=(due_ns - now_ns) / NS_PER_S)
                continue
            schedule, times = schedules[index], sent[index]
            times.append(schedule.send(len(times) + 1))
            if len(times) == schedule.count or (not schedule.count and now_ns >= until_ns):
                heapq.heappop(due)
            elif schedule.rate_hz:
                next_ns = starts[index] + round(len(times) * NS_PER_S / schedule.rate_hz)
                heapq.heapreplace(due, (next_ns, index))
        return sent

"""When to send: several streams at their rates, each on absolute deadlines, so that a late message makes none later."""

from __future__ import annotations

import ctypes
import heapq
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway_lab.bench.window import SendWindow

#: The kernel wakes a sleeper so much late; the rest of a wait is spent looking at the clock.
_SPIN_NS = 20_000
#: Between two looks whether a full window has room again.
_LOOK_NS = 50_000
_PR_SET_TIMERSLACK = 29

#: Sends a number of messages from a sequence number on; returns for each when it was handed over (monotonic ns).
Send = Callable[[int, int], Sequence[int]]


@dataclass(frozen=True, slots=True)
class Schedule:
    """One stream's.

    Attributes:
        send: see ``Send``; sequence numbers count from 1.
        rate_hz: how often; 0: again at once.
        count: how many messages; 0: until ``until_ns`` of ``run``.
        window: without a rate, how many may be on their way; None: any number.
    """

    send: Send
    rate_hz: float
    count: int
    window: SendWindow | None = None


class SendPacer:
    """Sends by schedules until all are through; ``stop`` from another thread ends it before."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._stopped = False
        # A lock that is never released waits by the monotonic clock and costs half of what an event costs.
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
        wake_in_time()
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
            schedule, times = schedules[index], sent[index]
            if now_ns < due_ns:
                self._wait(due_ns - now_ns, _SPIN_NS if schedule.rate_hz else 0)
                continue
            room = self._room(schedule, len(times))
            if room:
                times += schedule.send(len(times) + 1, room)
            if (schedule.count and len(times) >= schedule.count) or (not schedule.count and now_ns >= until_ns):
                heapq.heappop(due)
            elif schedule.rate_hz:
                next_ns = starts[index] + round(len(times) * NS_PER_S / schedule.rate_hz)
                heapq.heapreplace(due, (next_ns, index))
            else:
                heapq.heapreplace(due, (now_ns if room else now_ns + _LOOK_NS, index))
        return sent

    def _wait(self, left_ns: int, spin_ns: int) -> None:
        if left_ns > spin_ns:
            self._rest.acquire(timeout=(left_ns - spin_ns) / NS_PER_S)

    @staticmethod
    def _room(schedule: Schedule, sent: int) -> int:
        """How many messages may be sent now."""
        if schedule.window is None:
            return 1
        room = schedule.window.room(sent)
        return min(room, schedule.count - sent) if schedule.count else room


def wake_in_time() -> None:
    """Have the kernel wake this thread when it asks for, not up to 50 µs later; on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)

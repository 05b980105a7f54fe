"""The thread that acts on time: it waits until the gateway is due, and looks around once a second.

It also wakes when the host's clock is set, where the system reports that (Linux), so that the step is noted at once.

It is late itself when the bridge does not run: the process was stopped, or gets no processor.  Whatever comes
meanwhile, from peers and from ROS, is read afterwards, so its receipt is late by up to that time.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable
from contextlib import suppress

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

#: Between two looks.  Where the system does not report that the clock is set, each tick has to see it.
_LOOK_NS, _BLIND_LOOK_NS = NS_PER_S, 50 * NS_PER_MS

#: A thread that is so late shows that the bridge did not run; a busy machine delays a thread by less.
HALT_NS = 500 * NS_PER_MS

_NEVER = 1 << 63
_CLOCK_REALTIME = 0
_TFD_TIMER_ABSTIME, _TFD_TIMER_CANCEL_ON_SET, _TFD_CLOEXEC = 1, 2, 0o2000000
_FAR_S = (1 << 31) - 1  # the timer itself never ends


class Timer:
    """Calls ``tick`` at each deadline of the gateway.

    Args:
        tick: acts on what is due; returns the next deadline (gateway time, UTC ns), None if there is none.
        due_ns: the next deadline, as ``tick`` returns it; called by `deadline_set`.
        now_ns: gateway time.
        each_second: called once a second, after a tick.
        least_ns: from a tick at which a deadline stays overdue to the next one.
        clock: the monotonic clock paces the looks.
        halted: called with the times, ns, for which the bridge did not run, at least and at most.
    """

    def __init__(
        self,
        tick: Callable[[], int | None],
        due_ns: Callable[[], int | None],
        now_ns: Callable[[], int],
        each_second: Callable[[], None],
        least_ns: int,
        clock: Clock,
        halted: Callable[[int, int], None] = lambda _late_ns, _most_ns: None,
    ) -> None:
        self._halted = halted
        self._tick = tick
        self._due_ns = due_ns
        self._now_ns = now_ns
        self._each_second = each_second
        self._least_ns = least_ns
        self._clock = clock
        self._planned_ns = _NEVER  # the deadline that the thread waits for
        self._stopping = False
        self._wake = threading.Event()
        self._alarm = ClockAlarm(self._wake.set)
        self._thread = threading.Thread(target=self._run, name="igtl-timer", daemon=True)

    def start(self) -> None:
        self._alarm.start()
        self._thread.start()

    def stop(self) -> None:
        """End the thread, if it was started; nothing is called after this."""
        self._stopping = True
        self._wake.set()
        if self._thread.ident:
            self._thread.join()
        self._alarm.stop()

    def deadline_set(self) -> None:
        """Wake the thread if there is an earlier deadline than that it waits for.

        To be called while nothing else changes the deadlines.
        """
        if threading.get_ident() == self._thread.ident:  # its own tick: a deadline that stays must not wake it again
            return
        due_ns = self._due_ns()
        if due_ns is not None and due_ns < self._planned_ns:
            self._planned_ns = due_ns
            self._wake.set()

    def _run(self) -> None:
        every_ns = _LOOK_NS if self._alarm.works else _BLIND_LOOK_NS
        second_ns = expected_ns = waited_ns = self._clock.monotonic_ns()
        while True:
            self._wake.clear()
            if self._stopping:
                return
            self._planned_ns = _NEVER  # what is set from here on wakes, even if this tick sees it
            due_ns = self._tick()
            begun_ns = self._clock.monotonic_ns()
            if (late_ns := begun_ns - expected_ns) >= HALT_NS:
                self._halted(late_ns, begun_ns - waited_ns)
            if begun_ns >= second_ns:
                second_ns = begun_ns + NS_PER_S
                self._each_second()
            left_ns = min(every_ns, second_ns - self._clock.monotonic_ns())
            if due_ns is not None:
                self._planned_ns = min(self._planned_ns, due_ns)
                due_in_ns = due_ns - self._now_ns()
                left_ns = min(left_ns, due_in_ns if due_in_ns > 0 else self._least_ns)
            waited_ns = self._clock.monotonic_ns()
            expected_ns = waited_ns + max(0, left_ns)
            self._wake.wait(max(0, left_ns) / NS_PER_S)


class ClockAlarm:
    """A thread that calls ``on_set`` whenever the host's clock is set; it sleeps otherwise.

    Attributes:
        works: whether it was started, and the system reports that (Linux).
    """

    def __init__(self, on_set: Callable[[], None]) -> None:
        self._on_set = on_set
        self.works = False
        self._descriptor = -1
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-clock", daemon=True)

    def start(self) -> None:
        self._descriptor = _clock_timer()
        self.works = self._descriptor >= 0
        if self.works:
            self._thread.start()

    def stop(self) -> None:
        """End the thread, if it was started."""
        self._stopping = True
        if self.works:
            self.works = False
            _set_timer(self._descriptor, _TimerSpec(0, 0, 1, 0), _TFD_TIMER_ABSTIME)  # ended in 1970
            self._thread.join()
            os.close(self._descriptor)

    def _run(self) -> None:
        while True:
            with suppress(OSError):  # ECANCELED: the clock was set
                os.read(self._descriptor, 8)
            if self._stopping:
                return
            self._on_set()


class _TimerSpec(ctypes.Structure):
    """struct itimerspec: interval and end, each in seconds and ns."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("interval_s", "interval_ns", "end_s", "end_ns"))


def _clock_timer() -> int:
    """Return the descriptor of a timer that only a step of the host's clock ends; -1 if the system has none."""
    try:
        descriptor = int(ctypes.CDLL(None).timerfd_create(_CLOCK_REALTIME, _TFD_CLOEXEC))
    except (OSError, AttributeError, TypeError):  # macOS has no such function, Windows no such library
        return -1
    never, flags = _TimerSpec(0, 0, _FAR_S, 0), _TFD_TIMER_ABSTIME | _TFD_TIMER_CANCEL_ON_SET
    if descriptor >= 0 and not _set_timer(descriptor, never, flags):
        os.close(descriptor)
        return -1
    return descriptor


def _set_timer(descriptor: int, spec: _TimerSpec, flags: int) -> bool:
    return int(ctypes.CDLL(None).timerfd_settime(descriptor, flags, ctypes.byref(spec), None)) == 0

"""The timer's thread: it acts in time, and sleeps otherwise."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from igtl_gateway.app.timer import ClockAlarm, Timer
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

CLOCK = SystemClock()
TIMEOUT_S = 10.0


class Core:
    """A gateway with a deadline, whose time is the host's; counts its ticks."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.due_ns: int | None = None
        self.ticks: list[int] = []
        self.seconds = 0
        self.stays = False

    def tick(self) -> int | None:
        with self.changed:
            now_ns = CLOCK.utc_ns()
            self.ticks.append(now_ns)
            if not self.stays and self.due_ns is not None and self.due_ns <= now_ns:
                self.due_ns = None
            self.changed.notify_all()
            return self.due_ns

    def each_second(self) -> None:
        self.seconds += 1

    def wait(self, condition: Callable[[], bool]) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, TIMEOUT_S)


@contextmanager
def running(core: Core) -> Iterator[Timer]:
    timer = Timer(core.tick, lambda: core.due_ns, CLOCK.utc_ns, core.each_second, 20 * NS_PER_MS, CLOCK)
    timer.start()
    try:
        core.wait(lambda: bool(core.ticks))
        yield timer
    finally:
        timer.stop()


@pytest.mark.skipif(not hasattr(time, "clock_settime"), reason="the system does not report that its clock is set")
def test_without_a_deadline_it_wakes_once_a_second() -> None:
    core = Core()
    with running(core):
        time.sleep(1.5)
        assert 2 <= len(core.ticks) <= 3
        assert core.seconds == 2


def test_a_deadline_that_is_set_meanwhile_is_met() -> None:
    core = Core()
    with running(core) as timer:
        time.sleep(0.1)
        before = len(core.ticks)
        due_ns = core.due_ns = CLOCK.utc_ns() + 100 * NS_PER_MS
        timer.deadline_set()
        core.wait(lambda: core.due_ns is None)
        assert due_ns <= core.ticks[-1] < due_ns + 50 * NS_PER_MS
        assert len(core.ticks) <= before + 3, "one to see it, one to meet it"


def test_a_later_deadline_wakes_nobody() -> None:
    core = Core()
    core.due_ns = CLOCK.utc_ns() + 600 * NS_PER_MS
    with running(core) as timer:
        time.sleep(0.05)
        before = len(core.ticks)
        for _ in range(100):
            core.due_ns += NS_PER_MS
            timer.deadline_set()
        time.sleep(0.05)
        assert len(core.ticks) == before


def test_a_deadline_that_stays_does_not_keep_it_awake() -> None:
    core = Core()
    core.due_ns, core.stays = CLOCK.utc_ns() - NS_PER_S, True
    with running(core):
        time.sleep(0.5)
    assert 5 <= len(core.ticks) <= 26


def test_it_ends_at_once_and_may_be_stopped_before_its_start() -> None:
    core = Core()
    Timer(core.tick, lambda: None, CLOCK.utc_ns, core.each_second, 1, CLOCK).stop()
    with running(core):
        begun = time.monotonic()
    assert time.monotonic() - begun < 0.5


def test_the_alarm_of_the_clock_is_silent_until_it_is_set() -> None:
    rings: list[int] = []
    alarm = ClockAlarm(lambda: rings.append(1))
    alarm.start()
    time.sleep(0.05)
    alarm.stop()
    assert rings == []

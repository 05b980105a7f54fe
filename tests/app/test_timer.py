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
from tests.timing import WAIT_S, at_once

CLOCK = SystemClock()


class Core:
    """A gateway with a deadline, whose time is the host's; counts its ticks."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.due_ns: int | None = None
        self.ticks: list[int] = []
        self.looks: list[int] = []  # which ticks, from 1
        self.met = self.settled = 0  # the last tick that met a deadline; the last one whose look is known
        self.stays = False

    def tick(self) -> int | None:
        with self.changed:
            now_ns = CLOCK.utc_ns()
            self.settled = len(self.ticks)
            self.ticks.append(now_ns)
            if not self.stays and self.due_ns is not None and self.due_ns <= now_ns:
                self.due_ns, self.met = None, len(self.ticks)
            self.changed.notify_all()
            return self.due_ns

    def each_second(self) -> None:
        self.looks.append(len(self.ticks))

    def wait(self, condition: Callable[[], bool]) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, WAIT_S)


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
        core.wait(lambda: len(core.ticks) >= 3)
    assert core.looks == [1, 2, 3]
    assert core.ticks[2] - core.ticks[0] > 1.9 * NS_PER_S


def test_a_deadline_that_is_set_meanwhile_is_met() -> None:
    """By a tick of its own, and not by the next look: where both fall together, as on a busy machine, once more."""
    core = Core()
    with running(core) as timer:
        for _ in range(10):
            before = len(core.ticks)
            due_ns = core.due_ns = CLOCK.utc_ns() + 100 * NS_PER_MS
            timer.deadline_set()
            core.wait(lambda: core.due_ns is None)
            assert due_ns <= core.ticks[core.met - 1]
            core.wait(lambda: core.settled >= core.met)
            looks = sum(look > before for look in core.looks)
            assert core.met <= before + 2 + looks, "one to see it, one to meet it"
            if core.met not in core.looks:
                return
    pytest.fail("each deadline waited for a look")


def test_a_later_deadline_wakes_nobody() -> None:
    core = Core()
    core.due_ns = CLOCK.utc_ns() + 3600 * NS_PER_S
    with running(core) as timer:
        for _ in range(100):
            core.due_ns += NS_PER_MS
            timer.deadline_set()
            time.sleep(0.001)
    assert core.looks == list(range(1, len(core.ticks) + 1))


def test_a_deadline_that_stays_does_not_keep_it_awake() -> None:
    core = Core()
    core.due_ns, core.stays = CLOCK.utc_ns() - NS_PER_S, True
    with running(core):
        core.wait(lambda: len(core.ticks) >= 20)
    waits = len(core.ticks) - 1 - len(core.looks)
    assert core.ticks[-1] - core.ticks[0] >= waits * 19 * NS_PER_MS


def test_it_ends_at_once_and_may_be_stopped_before_its_start() -> None:
    core = Core()
    Timer(core.tick, lambda: None, CLOCK.utc_ns, core.each_second, 1, CLOCK).stop()
    with at_once():
        for _ in range(int(WAIT_S)):  # a second each, if the end waited for a look
            with running(core):
                pass


def test_the_alarm_of_the_clock_is_silent_until_it_is_set() -> None:
    rings: list[int] = []
    alarm = ClockAlarm(lambda: rings.append(1))
    alarm.start()
    time.sleep(0.05)
    alarm.stop()
    assert rings == []


def test_that_the_bridge_did_not_run_is_found_when_it_goes_on() -> None:
    """A clock that jumps, as that of a process which was stopped for 3 s does for it."""
    stopped_ns, late = [0], list[tuple[int, int]]()

    class Stopped(SystemClock):
        def monotonic_ns(self) -> int:
            return super().monotonic_ns() + stopped_ns[0]

    core = Core()
    each_second, clock = core.each_second, Stopped()
    timer = Timer(
        core.tick, lambda: core.due_ns, CLOCK.utc_ns, each_second, 20 * NS_PER_MS, clock, lambda *ns: late.append(ns)
    )
    timer.start()
    try:
        core.wait(lambda: len(core.ticks) > 0)
        core.wait(lambda: core.due_ns is None)
        stopped_ns[0] += 3 * NS_PER_S
        core.due_ns = CLOCK.utc_ns()
        timer.deadline_set()
        core.wait(lambda: len(core.ticks) > 2)
    finally:
        timer.stop()
    assert len(late) == 1
    least_ns, most_ns = late[0]
    assert 2 * NS_PER_S <= least_ns <= 3 * NS_PER_S <= most_ns

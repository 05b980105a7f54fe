"""When the worker looks and flushes: times are arguments."""

from __future__ import annotations

from igtl_gateway.record.flush_times import LOOK_NS, FlushTimes
from tests.tables import table

MS = 1_000_000


@table(
    "taken, waits, now_ms, pause_ms",
    [
        (0, False, 0, 400),  # until the flush, which is early
        (0, True, 0, 50),
        (32, False, 0, 400),
        (33, False, 0, 50),
        (33, False, 370, 30),  # the flush is due before
        (33, False, 400, 50),  # overdue: it is made at this poll
        (0, False, 380, 50),
    ],
)
def test_the_pause_ends_with_the_flush_or_with_the_look(taken: int, waits: bool, now_ms: int, pause_ms: int) -> None:
    times = FlushTimes(0.5, 0)
    assert times.pause_ns(taken, now_ms * MS, waits=waits) == pause_ms * MS


@table("flush_s, early_ms", [(0.5, 100), (0.4, 100), (0.2, 50)])
def test_a_flush_is_early_by_a_part_of_the_interval(flush_s: float, early_ms: int) -> None:
    times = FlushTimes(flush_s, 7)
    due_ns = 7 + round(flush_s * 1000 - early_ms) * MS
    assert not times.is_flush_due(due_ns - 1) and times.is_flush_due(due_ns)
    times.flushed(due_ns)
    assert not times.is_flush_due(due_ns)


@table("late_ms, flush_ms", [(0, 400), (99, 400), (101, 399), (300, 200), (375, 125), (9_000, 125)])
def test_who_was_late_flushes_earlier_but_not_always(late_ms: int, flush_ms: int) -> None:
    times = FlushTimes(0.5, 0)
    times.expect_late(late_ms * MS)
    assert not times.is_flush_due(flush_ms * MS - 1) and times.is_flush_due(flush_ms * MS)


def test_lateness_is_forgotten_slowly() -> None:
    times = FlushTimes(0.5, 0)
    times.expect_late(375 * MS)
    looks = 0
    while times.is_flush_due(250 * MS):
        times.expect_late(0)
        looks += 1
    assert 200 < looks < 215, "a third of it"


def test_what_was_planned_is_no_lateness() -> None:
    times = FlushTimes(0.5, 0)
    times.emptied(10 * MS)
    times.rested(400 * MS, 430 * MS)  # 30 longer than planned
    assert times.late_ns(440 * MS) == (30 + 50) * MS, "the rest, and a look"
    times.emptied(440 * MS)
    assert times.late_ns(441 * MS) == 80 * MS, "as late as it was"
    times.emptied(442 * MS)
    assert times.late_ns(450 * MS) == 8 * MS


def test_a_short_pause_counts_as_it_was() -> None:
    times = FlushTimes(0.5, 0)
    times.rested(20 * MS, 30 * MS)
    assert times.late_ns(30 * MS) == 30 * MS


def test_what_is_due_next() -> None:
    times = FlushTimes(0.5, 0)
    assert not times.is_look_due(LOOK_NS - 1) and times.is_look_due(LOOK_NS)
    times.looked(LOOK_NS)
    times.plan()
    assert times.due_ns == 2 * LOOK_NS
    times.looked(390 * MS)
    times.plan()
    assert times.due_ns == 400 * MS, "the flush"

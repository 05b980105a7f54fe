"""The effect of a step of the host's clock, and its report."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep, without_jump
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from tests.tables import table

HOUR_NS = 3600 * NS_PER_S


@table(
    ("step", "words"),
    [
        (ClockStep.after(-HOUR_NS, 0), "back by 1 h: gateway time goes on, 1 h ahead of it"),
        (ClockStep.after(HOUR_NS, 0), "forward (or the machine slept) by 1 h: gateway time jumps by 1 h"),
        (ClockStep.after(-NS_PER_S, 0), "back by 1 s: gateway time stands until the clock has caught up"),
        (ClockStep.after(HOUR_NS, HOUR_NS), "forward (or the machine slept) by 1 h: gateway time is ahead of"),
        (ClockStep.after(HOUR_NS, HOUR_NS - 5_000), "gateway time is ahead of it no more"),
        (ClockStep.after(HOUR_NS, HOUR_NS + 5_000), "gateway time is ahead of it no more"),
        (ClockStep.after(HOUR_NS, 2 * HOUR_NS), "gateway time goes on, 1 h ahead of it"),
        (ClockStep.after(2 * HOUR_NS, HOUR_NS), "gateway time jumps by 1 h"),
    ],
)
def test_it_is_told_in_words_and_in_fields(step: ClockStep, words: str) -> None:
    note = step.note()
    assert (note.level, note.code) == (Level.WARN, CLOCK_STEP)
    assert words in note.text
    assert ClockStep.of(Entry(7, 123, Kind.EDGE_NOTE, payload=(note.pack(),))) == replace(step, at_ns=123)


def test_other_entries_tell_of_none() -> None:
    for other in (
        Note(Level.INFO, "tick", "not a clock_step"),
        Note(Level.WARN, CLOCK_STEP, "without numbers"),
        Note(Level.WARN, CLOCK_STEP, "of a foreign hand", data={"step_ns": 1, "jump_ns": "2", "ahead_ns": None}),
    ):
        assert ClockStep.of(Entry(1, 1, Kind.EDGE_NOTE, payload=(other.pack(),))) is None
    assert ClockStep.of(Entry(1, 1, Kind.NOTE, payload=(ClockStep.after(HOUR_NS, 0).note().pack(),))) is None


@dataclass
class Times:
    first_ns: int
    last_ns: int
    longest_pause_ns: int


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (Times(10, 20, 3), Times(1010, 1020, 3)),  # silent since: the next message is not later for it
        (Times(10, 31, 3), Times(1010, 1031, 3)),  # the last one at the moment before the jump
        (Times(10, 1030, 1005), Times(1010, 1030, 5)),
        (Times(1028, 1030, 2), Times(1028, 1030, 2)),  # begun behind it
        (Times(0, 0, 0), Times(0, 0, 0)),  # not begun
    ],
)
def test_a_jump_is_no_pause(stream: Times, expected: Times) -> None:
    without_jump(stream, ClockStep(1000, 1000, 0, at_ns=1031))
    assert stream == expected

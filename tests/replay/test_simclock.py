"""Ticks of /clock between the entries."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.simclock import CLOCK_TOPIC, clock_entry, is_tick, period_ns, with_ticks
from igtl_gateway.replay.timeline import SessionTimeline


def entries(*stamps: int, channel: str = "/a") -> list[Entry]:
    return [Entry(seq, stamp, Kind.ROS_OUT, channel) for seq, stamp in enumerate(stamps, start=1)]


def stamps(found: list[Entry]) -> list[str]:
    return [f"{'tick' if is_tick(entry) else 'entry'} {entry.stamp_ns}" for entry in found]


def test_ticks_stand_at_fixed_steps_before_what_is_not_earlier() -> None:
    found = list(with_ticks(entries(100, 105, 110, 131), None, 10))
    assert stamps(found) == [
        *("tick 100", "entry 100", "entry 105", "tick 110", "entry 110", "tick 120", "tick 130", "entry 131"),
    ]


def test_after_a_jump_the_clock_comes_before_the_state() -> None:
    found = list(with_ticks(entries(3, 7, 101, 112), 100, 10))
    assert stamps(found) == ["tick 100", "entry 3", "entry 7", "entry 101", "tick 110", "entry 112"]


def test_in_a_jump_of_the_session_there_are_no_ticks() -> None:
    pace = SessionTimeline([ClockStep(1000, 1000, 0, at_ns=1112)])
    found = list(with_ticks(entries(100, 105, 1110, 1131), None, 10, pace))
    assert stamps(found) == ["tick 100", "entry 100", "entry 105", "tick 110", "entry 1110", "tick 1120", "tick 1130",
                             "entry 1131"]  # fmt: skip


def test_a_recorded_clock_gives_way() -> None:
    recorded = Entry(1, 100, Kind.ROS_IN, CLOCK_TOPIC)
    assert not is_tick(recorded)
    assert stamps(list(with_ticks([recorded, *entries(100)], None, 10))) == ["tick 100", "entry 100"]


def test_a_tick_is_a_clock_message() -> None:
    assert clock_entry(5_000_000_007).data() == bytes.fromhex("00010000 05000000 07000000")


def test_rates() -> None:
    assert period_ns(40) == 25_000_000
    for hz in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match="--clock"):
            period_ns(hz)

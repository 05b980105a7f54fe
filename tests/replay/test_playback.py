"""Recorded time against the time of now, on manual time."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.replay.playback import PlaybackClock

S = 1_000_000_000


@pytest.mark.parametrize(("rate", "waits_s"), [(1.0, 5.0), (2.0, 2.5), (0.1, 50.0), (50.0, 0.1)])
def test_an_entry_is_due_after_its_own_time_at_the_rate(rate: float, waits_s: float) -> None:
    clock = PlaybackClock(rate)
    assert clock.wait_ns(10 * S, now_ns=7) == 0
    assert clock.wait_ns(15 * S, now_ns=7) == waits_s * S
    assert clock.wait_ns(15 * S, now_ns=7 + int(waits_s * S)) == 0


def test_as_fast_as_possible_never_waits_and_the_entries_are_the_time() -> None:
    clock = PlaybackClock(None)
    assert clock.position_ns(0) is None
    for stamp in (10 * S, 9000 * S):
        assert clock.wait_ns(stamp, 0) == 0
        clock.reached(stamp, 0)
        assert clock.position_ns(S) == stamp


def test_a_late_entry_is_due_at_once_and_shifts_nothing() -> None:
    clock = PlaybackClock(1.0)
    assert clock.wait_ns(10 * S, 0) == 0
    assert clock.wait_ns(12 * S, 3 * S) == 0
    clock.reached(12 * S, 3 * S)
    assert clock.wait_ns(15 * S, 3 * S) == 2 * S


def test_it_stands_while_paused_and_goes_on_from_there() -> None:
    clock = PlaybackClock(2.0)
    clock.wait_ns(10 * S, 0)
    clock.pause(S)
    assert clock.position_ns(99 * S) == 12 * S
    assert clock.wait_ns(13 * S, 99 * S) is None
    assert clock.wait_ns(11 * S, 99 * S) is None, "what is late waits as well"
    clock.resume(100 * S)
    assert clock.position_ns(100 * S) == 12 * S
    assert clock.wait_ns(14 * S, 100 * S) == S


def test_started_paused_it_waits_before_the_first_entry() -> None:
    clock = PlaybackClock(1.0, paused=True)
    assert clock.wait_ns(10 * S, 0) is None and clock.position_ns(0) is None
    clock.resume(50 * S)
    assert clock.wait_ns(10 * S, 51 * S) == 0
    assert clock.wait_ns(11 * S, 51 * S) == S


def test_what_is_played_while_paused_moves_it() -> None:
    clock = PlaybackClock(1.0, paused=True)
    clock.reached(10 * S, 0)
    clock.reached(12 * S, 5 * S)
    assert clock.position_ns(6 * S) == 12 * S
    clock.resume(7 * S)
    assert clock.wait_ns(13 * S, 7 * S) == S


def test_a_new_rate_counts_from_now_on() -> None:
    clock = PlaybackClock(1.0)
    clock.wait_ns(10 * S, 0)
    clock.set_rate(4.0, 2 * S)
    assert clock.rate == 4.0
    assert clock.wait_ns(16 * S, 2 * S) == S
    clock.set_rate(None, 2 * S)
    assert clock.wait_ns(1000 * S, 2 * S) == 0


@pytest.mark.parametrize("paused", [False, True])
def test_after_a_jump_its_target_is_now_and_the_state_before_it_is_due(paused: bool) -> None:
    clock = PlaybackClock(1.0, paused)
    clock.jump(20 * S, 5 * S)
    assert clock.is_state(20 * S - 1) and not clock.is_state(20 * S)
    assert clock.position_ns(5 * S) == 20 * S
    assert clock.wait_ns(21 * S, 5 * S) == (None if paused else S)


def test_a_jump_to_nowhere_begins_with_whatever_comes() -> None:
    clock = PlaybackClock(1.0)
    clock.wait_ns(10 * S, 0)
    clock.jump(None, 50 * S)
    assert clock.wait_ns(3 * S, 60 * S) == 0 and not clock.is_state(3 * S)
    assert clock.wait_ns(4 * S, 60 * S) == S


@pytest.mark.parametrize("rate", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_rates_are_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match="above 0"):
        PlaybackClock(rate)
    clock = PlaybackClock(1.0)
    with pytest.raises(ConfigError, match="above 0"):
        clock.set_rate(rate, 0)
    assert clock.rate == 1.0

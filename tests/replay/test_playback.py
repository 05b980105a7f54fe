"""Pacing on manual time."""

from __future__ import annotations

import pytest

from igtl_gateway.clock import ManualClock
from igtl_gateway.errors import ConfigError
from igtl_gateway.replay.playback import PlaybackClock, paced
from igtl_gateway.session.entry import Entry, Kind

SECOND = 1_000_000_000
STAMPS = (10 * SECOND, 10 * SECOND + 1, 12 * SECOND, 15 * SECOND)
ENTRIES = [Entry(seq, stamp, Kind.ROS_IN) for seq, stamp in enumerate(STAMPS, start=1)]


def play(rate: float | None, stop_after: int = 100) -> tuple[list[int], list[float], ManualClock]:
    """Entry numbers, pauses in seconds, and the clock after a playback on manual time."""
    clock, pauses = ManualClock(SECOND), list[float]()

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        clock.advance(round(seconds * SECOND))
        return len(pauses) >= stop_after

    played = [entry.seq for entry in paced(ENTRIES, PlaybackClock(rate, clock.monotonic_ns), wait)]
    return played, pauses, clock


@pytest.mark.parametrize(("rate", "took_s"), [(1.0, 5.0), (2.0, 2.5), (0.1, 50.0), (50.0, 0.1)])
def test_every_rate_gives_the_same_entries_in_its_own_time(rate: float, took_s: float) -> None:
    played, _, clock = play(rate)
    assert played == [1, 2, 3, 4]
    assert clock.monotonic_ns() / SECOND == pytest.approx(took_s, abs=1e-6)


def test_as_fast_as_possible_never_waits() -> None:
    assert play(None)[:2] == ([1, 2, 3, 4], [])


def test_a_stop_ends_the_playback_before_the_next_entry() -> None:
    assert play(1.0, stop_after=2)[0] == [1, 2]


def test_a_late_entry_is_due_at_once_and_shifts_nothing() -> None:
    clock = ManualClock()
    playback = PlaybackClock(1.0, clock.monotonic_ns)
    assert playback.wait_ns(10 * SECOND) == 0
    clock.advance(3 * SECOND)
    assert playback.wait_ns(12 * SECOND) == 0
    assert playback.wait_ns(15 * SECOND) == 2 * SECOND


@pytest.mark.parametrize("rate", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_rates_are_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match="above 0"):
        PlaybackClock(rate, lambda: 0)

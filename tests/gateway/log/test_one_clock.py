"""The clock of streams that are joined, where the truth is known: each message has the time of its measurement."""

from __future__ import annotations

import random

import numpy as np
import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.one_clock import OneClock, StreamTimes, one_clock

MS, S = 10**6, 10**9
START = 1_700_000_000 * S


def stream(
    name: str,
    *,
    ahead_ms: float = 0,
    late_ms: float = 1,
    jitter_ms: float = 0,
    unset: int = 0,
    sender: str = "",
    count: int = 300,
    drift: float = 0,
    step_ms: float = 0,
) -> tuple[StreamTimes, np.ndarray]:
    """A stream of 50 Hz, and the true times of its messages; the clock is set by ``step_ms`` in the middle."""
    turn = random.Random(name)
    true = START + np.arange(count, dtype=np.int64) * 20 * MS
    stamps = true + int(ahead_ms * MS) + ((true - START) * drift).astype(np.int64)
    stamps[count // 2 :] += int(step_ms * MS)
    stamps[:unset] = 0
    times = true + np.array([int((late_ms + turn.uniform(0, jitter_ms)) * MS) for _ in range(count)], np.int64)
    return StreamTimes(name, np.sort(times), stamps, sender), true


def away_ms(clock: OneClock, streams: list[tuple[StreamTimes, np.ndarray]]) -> float:
    """How far the streams are from each other, at most, by the truth."""
    offs = [clock.times(each, number) - true for number, (each, true) in enumerate(streams)]
    return max(float(np.abs(one - two).max()) for one in offs for two in offs) / MS


def test_late_pictures_of_a_right_clock_stay_where_they_are() -> None:
    both = [stream("pose"), stream("picture", late_ms=100)]
    clock = one_clock([each for each, _ in both])
    assert (clock.name, clock.shifts, len(clock.notes)) == ("source", (0, 0), 1)
    assert away_ms(clock, both) == 0
    assert "one clock is assumed" in clock.notes[0] and "99 ms older" in clock.notes[0]


@pytest.mark.parametrize("ahead_ms", [3000, -3000, 200, 86_400_000])
@pytest.mark.parametrize("jitter_ms", [0, 40])
def test_two_clocks_are_one_except_for_the_latency(ahead_ms: float, jitter_ms: float) -> None:
    both = [stream("pose", ahead_ms=ahead_ms, jitter_ms=jitter_ms), stream("picture", late_ms=5, jitter_ms=jitter_ms)]
    clock = one_clock([each for each, _ in both])
    assert clock.name == "source"
    assert away_ms(clock, both) <= 2
    assert "the stamps of pose" in clock.notes[0] and "corrected by" in clock.notes[0]


def test_streams_of_one_wrong_clock_have_one_clock() -> None:
    both = [stream("pose", ahead_ms=3000), stream("picture", ahead_ms=3000, late_ms=100)]
    clock = one_clock([each for each, _ in both])
    assert (clock.name, clock.shifts) == ("source", (0, 0))
    third = [*both, stream("other")]
    clock = one_clock([each for each, _ in third])
    assert away_ms(clock, third[:2]) == 0 and away_ms(clock, third) <= 2
    assert "pose, picture" in clock.notes[0]


def test_the_streams_of_one_link_have_one_clock() -> None:
    """Its stamps are 200 ms ahead; a picture that is 250 ms late is not of the gateway's clock for that."""
    both = [stream("pose", ahead_ms=200, sender="1"), stream("picture", ahead_ms=200, late_ms=250, sender="1")]
    other = stream("other", sender="2")
    clock = one_clock([each for each, _ in (*both, other)])
    assert away_ms(clock, both) == 0
    assert away_ms(clock, [*both, other]) <= 2


def test_a_stream_without_stamps_gives_all_the_times_of_receipt() -> None:
    both = [stream("pose", ahead_ms=3000), stream("picture", unset=7)]
    streams = [each for each, _ in both]
    clock = one_clock(streams)
    assert clock.name == "gateway"
    assert away_ms(clock, both) == 0
    assert "7 of 300 messages of picture without a stamp" in clock.notes[0]
    with pytest.raises(ConfigError, match="7 of 300 messages of picture"):
        one_clock(streams, "source")
    assert one_clock([stream("pose", unset=300)[0]]).notes == ()  # nothing is mixed


@pytest.mark.parametrize(("drift", "step_ms"), [(0.2, 0), (0, 3000), (0, -3000)])
def test_a_clock_that_was_set_gives_all_the_times_of_receipt(drift: float, step_ms: float) -> None:
    both = [stream("pose", drift=drift, step_ms=step_ms, count=400), stream("picture", count=400)]
    streams = [each for each, _ in both]
    clock = one_clock(streams)
    assert clock.name == "gateway"
    assert away_ms(clock, both) == 0
    assert "the ages of pose go from" in clock.notes[0]
    assert one_clock(streams, "source").name == "source"  # the user has chosen it


def test_a_latched_message_is_on_the_clock_that_fits() -> None:
    """Its age is the time since it was sent, not an offset."""
    plan = StreamTimes("plan", np.array([START + 60 * S]), np.array([START]))
    streams = [stream("pose")[0], plan, StreamTimes("empty", np.zeros(0, np.int64), np.zeros(0, np.int64))]
    clock = one_clock(streams)
    assert clock.shifts == (0, 0, 0)
    assert "plan" in clock.notes[0]  # it may be an offset
    assert one_clock(streams, "gateway").notes == ()


def test_all_streams_that_are_late_or_behind_are_named() -> None:
    """A clock that is behind by 0.4 s looks like a latency."""
    now = np.arange(10, dtype=np.int64) * 100 * MS + START
    at_once = StreamTimes("image", now + 2 * MS, now)
    for late_ms in (25, 60, 400):
        late = [StreamTimes(name, now + 2 * MS, now - late_ms * MS) for name in ("probe", "needle")]
        clock = one_clock([at_once, *late])
        assert (clock.name, clock.shifts) == ("source", (0, 0, 0))
        (note,) = clock.notes
        assert f"the stamps of probe, needle are up to {late_ms} ms older on receipt than those of image" in note


@pytest.mark.parametrize("ahead_ms", [1617, -4390, 30])
def test_what_a_correction_leaves_is_compared_with_the_ages_of_the_others(ahead_ms: float) -> None:
    both = [stream("pose", ahead_ms=ahead_ms, late_ms=2), stream("picture", ahead_ms=-682, late_ms=2)]
    clock = one_clock([each for each, _ in both])
    assert away_ms(clock, both) > 600  # an offset that looks like a latency
    assert any("one clock is assumed" in note and "picture" in note and "684 ms" in note for note in clock.notes)


@pytest.mark.parametrize(("ticks", "is_named"), [(0, True), (1, True), (100, True), (50_000, False)])
def test_stamps_that_are_times_of_receipt_are_named(ticks: int, is_named: bool) -> None:
    """A topic that the gateway makes of messages without a stamp has the time of receipt as stamp."""
    pose = stream("pose")[0]
    times = pose.stamps + 120 * MS
    picture = StreamTimes("picture", times, times - ticks)
    for wanted in ("auto", "source"):
        clock = one_clock([pose, picture], wanted)
        assert clock.name == "source"
        assert any("the stamps of picture are times of receipt" in note for note in clock.notes) == is_named
    alone = one_clock([picture, StreamTimes("other", times, times - ticks)])
    assert (alone.name, alone.notes) == ("source", ())  # nothing is mixed
    assert bool(one_clock([picture], "source").notes) == is_named
    assert one_clock([pose, StreamTimes("now", times, times, is_clock=True)]).notes == ()


def test_a_clock_that_agrees_by_chance_is_not_that_of_receipt() -> None:
    turn = random.Random(1)
    times = START + np.arange(5000, dtype=np.int64) * MS
    picture = StreamTimes("picture", times, times - np.array([turn.randint(-10_000, 10_000) for _ in times]))
    assert one_clock([stream("pose")[0], picture]).notes == ()

"""The estimate of a lag against planted ones, and what is refused."""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import numpy as np
import pytest

from igtl_gateway.addons.sync.lag import MOST_SKEW_PPM, Verdict, measure_lag, measure_together
from igtl_gateway.addons.sync.signal import Floats, Signal
from igtl_gateway.addons.sync.statistics import chi_squared, student
from igtl_gateway.base.stamp import NS_PER_S
from tests.addons.sync.trajectories import staircase, strokes, trajectory
from tests.addons.sync.worlds import irregular, stamps, world
from tests.tables import table

#: Random cases; the table in docs/evidence/sync.md is of 300.
CASES = int(os.environ.get("SYNC_CASES", "6"))
#: Trajectories of an instrument; with ``SYNC_TRAJECTORIES=68`` all of them, and with ``SYNC_SEED`` other ones.
TRAJECTORIES = int(os.environ.get("SYNC_TRAJECTORIES", "3"))
SEED = int(os.environ.get("SYNC_SEED", "1"))

LAG_S = 0.12


def pair(movement: Callable[[Floats], Floats], noise: float = 0.01, seconds: float = 30) -> tuple[Signal, Signal]:
    """A movement at 30 Hz, and at 100 Hz with the lag and twice the size."""
    random = np.random.default_rng(1)
    first, second = np.arange(0, seconds, 1 / 30), np.arange(0, seconds, 1 / 100)
    seen, late = movement(first), 2 * movement(second - LAG_S)
    size = noise * max(float(np.std(seen)), 1e-3)
    return (
        Signal.of(stamps(first), seen + random.normal(0, size, seen.shape)),
        Signal.of(stamps(second), late + random.normal(0, 2 * size, late.shape)),
    )


def test_planted_lags_are_within_their_intervals() -> None:
    """Errors, and coverage of the 95 % intervals: 94 to 98 % for 300 cases."""
    inside, refused, errors = 0, 0, []
    for number in range(CASES):
        case = world(number)
        lag = measure_lag(case.fixed, case.moving)
        if not lag.verdict.has_lag:
            refused += 1
            continue
        error = lag.lag_s - case.lag_at(lag.middle_ns)
        inside += lag.low_s <= lag.lag_s - error <= lag.high_s
        errors.append(abs(error))
        assert abs(error) < (0.005 if case.noise < 0.1 else 0.05), number
        assert lag.skew_low_ppm <= lag.skew_ppm <= lag.skew_high_ppm
    assert refused <= 0.03 * CASES
    assert inside >= 0.88 * len(errors) - 1
    assert float(np.median(errors)) < 0.002


def test_a_skew_is_measured() -> None:
    seconds = 120.0
    first, second = np.arange(0, seconds, 1 / 30), np.arange(0, seconds, 1 / 50)

    def movement(at: Floats) -> Floats:
        return np.asarray(np.sin(at) + np.sin(1.7 * at + 1) + np.sin(0.31 * at * at / 20))

    late = second + 0.2 + 200e-6 * (second - seconds / 2)
    lag = measure_lag(Signal.of(stamps(first), movement(first)), Signal.of(stamps(late), movement(second)))
    assert lag.verdict is Verdict.MEASURED
    assert lag.lag_s == pytest.approx(0.2, abs=1e-4)
    assert lag.skew_ppm == pytest.approx(200, abs=5)
    assert 0 < lag.skew_low_ppm < 200 < lag.skew_high_ppm


def test_exchanged_streams_have_the_opposite_lag() -> None:
    fixed, moving = pair(lambda at: np.sin(at) + np.sin(1.7 * at + 1) + np.sin(at * at / 60))
    one, other = measure_lag(fixed, moving), measure_lag(moving, fixed)
    assert one.lag_s == pytest.approx(LAG_S, abs=1e-3)
    assert (other.lag_s, other.low_s, other.high_s) == pytest.approx((-one.lag_s, -one.high_s, -one.low_s))
    assert one.low_s < one.lag_s < one.high_s < one.low_s + 0.02


REFUSED = [
    ("still", lambda at: 0 * at, Verdict.STILL),
    ("still, far away", lambda at: 0 * at + 5_000.0, Verdict.STILL),
    ("steady", lambda at: at, Verdict.ONE_WAY),
    ("from one place to another", lambda at: np.tanh((at - 15) / 3), Verdict.ONE_WAY),
    *(
        (f"sine of {period} s", lambda at, period=period: np.sin(2 * np.pi * at / period), Verdict.PERIODIC)
        for period in (0.4, 1.0, 2.0, 4.0, 8.0, 14.0)
    ),
    ("triangle", lambda at: np.abs((at / 2) % 1 - 0.5), Verdict.PERIODIC),
    ("sine that drifts", lambda at: np.sin(np.pi * at) + 0.05 * at, Verdict.PERIODIC),
]


@table("noise", [0.001, 0.01, 0.1])
@table(("movement", "verdict"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_what_the_data_cannot_tell_is_refused(
    movement: Callable[[Floats], Floats], verdict: Verdict, noise: float
) -> None:
    lag = measure_lag(*pair(movement, noise))
    assert lag.verdict is verdict
    assert not lag.verdict.has_lag
    assert math.isnan(lag.low_s) and math.isnan(lag.high_s)


def test_the_period_is_named() -> None:
    assert measure_lag(*pair(lambda at: np.sin(2 * np.pi * at / 2))).period_s == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize(("period", "range_s"), [(2.0, 0.4), (4.0, 0.9), (8.0, 0.5)])
def test_a_range_below_a_quarter_of_the_period_is_a_statement(period: float, range_s: float) -> None:
    """Then there is one lag; the range by default states nothing."""
    fixed, moving = pair(lambda at: np.sin(2 * np.pi * at / period), seconds=60)
    lag = measure_lag(fixed, moving, max_lag_s=range_s)
    assert lag.verdict is Verdict.MEASURED
    assert lag.lag_s == pytest.approx(LAG_S, abs=0.005)
    assert lag.period_s == pytest.approx(period, rel=0.05)
    assert measure_lag(fixed, moving).verdict is Verdict.PERIODIC
    assert measure_lag(fixed, moving, max_lag_s=0.3 * period).verdict is Verdict.PERIODIC


def test_a_movement_in_a_circle_fits_at_any_lag() -> None:
    """Its two components explain a sine of any phase."""
    fixed, moving = pair(lambda at: np.sin(2 * np.pi * at / 4), seconds=60)
    seconds = (moving.times_ns - stamps(np.zeros(1))) / NS_PER_S
    circle = np.stack([np.sin(np.pi * seconds / 2), np.cos(np.pi * seconds / 2)], axis=1)
    assert not measure_lag(fixed, Signal(moving.times_ns, circle), max_lag_s=0.5).verdict.has_lag


@pytest.mark.parametrize("number", [12, 24, 44, 47, 54, 59])
def test_slow_signals_are_alike_by_chance(number: int) -> None:
    """Unrelated movements of 8 to 20 s with R² from 0.59 to 0.99, "measured" with skews of up to -21 %."""
    random = np.random.default_rng(number)
    seconds, band_hz = float(random.choice([8, 10, 15, 20, 30])), float(random.choice([0.3, 0.6, 1.2]))
    fixed = irregular(random, seconds, 30, int(random.choice([1, 3])), band_hz)
    moving = irregular(random, seconds, 40, int(random.choice([1, 3, 6])), band_hz)
    assert not measure_lag(fixed, moving, max_lag_s=float(random.choice([1.0, 1.0, 3.0]))).verdict.has_lag


@pytest.mark.parametrize("number", [4, 60, 125])
def test_two_strokes_are_alike_by_chance(number: int) -> None:
    """R² from 0.93 to 0.99: in what moves now and then, few values are independent."""
    random = np.random.default_rng([88, number])
    robot, video = np.arange(0, 40, 1 / 50), np.arange(0, 40, 1 / 30)
    fixed, moving = (Signal.of(stamps(at), strokes(random, at)) for at in (robot, video))
    assert measure_lag(fixed, moving, max_lag_s=5).verdict is Verdict.BY_CHANCE


@pytest.mark.parametrize("number", range(6))
def test_a_skew_is_one_of_clocks(number: int) -> None:
    """A delay that grows by up to 20 ms per s is not the skew of a clock, so it is not reported as one."""
    random = np.random.default_rng([7, number])
    fixed = irregular(random, 30, 30, 1, 1.0)
    grown = stamps((fixed.times_ns - stamps(np.zeros(1))) / NS_PER_S * (1 + random.uniform(-0.02, 0.02)))
    lag = measure_lag(fixed, Signal(grown, fixed.values + random.normal(0, 0.3, fixed.values.shape)))
    assert not lag.has_skew or abs(lag.skew_ppm) <= MOST_SKEW_PPM


@pytest.mark.parametrize("number", range(6))
def test_noise_has_no_skew_beyond_that_of_clocks(number: int) -> None:
    """Short and noisy movements gave up to 9,073 ppm, with an interval as wide."""
    random = np.random.default_rng([8, number])
    fixed = irregular(random, 8, 30, 1, 1.0)
    lag = measure_lag(fixed, Signal(fixed.times_ns, fixed.values + random.normal(0, 1.2, fixed.values.shape)))
    assert not abs(lag.skew_ppm) > MOST_SKEW_PPM


def test_two_windows_that_contradict_each_other() -> None:
    """Without a third one, the data do not show which of them is right."""
    fixed, moving = pair(lambda at: np.sin(2 * at) + np.sin(5.1 * at + 1) + np.sin(at * at / 3), seconds=6)
    half = len(moving.times_ns) // 2
    stepped = moving.times_ns + np.where(np.arange(len(moving.times_ns)) < half, 0, NS_PER_S * 136 // 1000)
    lag = measure_lag(fixed, Signal(stepped, moving.values))
    assert not lag.verdict.has_lag
    assert math.isnan(lag.low_s)


@pytest.mark.slow
def test_trajectories_of_an_instrument() -> None:
    """A periodic jaw, and an insertion that is not, up to 2.4 s late: 64 of 68 within one frame, none wrong."""
    found = []
    for number in range(TRAJECTORIES):
        case = trajectory(number, SEED)
        lag = measure_together([case.jaw, case.insertion], max_lag_s=5.0)
        if lag.verdict.has_lag:
            assert abs(lag.lag_s - case.lag_s) < case.frame_s, number
            found.append(lag.low_s <= case.lag_s <= lag.high_s)
    assert len(found) >= 64 / 68 * TRAJECTORIES
    assert sum(found) >= 0.9 * len(found) - 1


@pytest.mark.parametrize(("number", "seed"), [(1, 3), (25, 3)])
def test_a_jaw_that_repeats_itself_does_not_choose(number: int, seed: int) -> None:
    """Of lags a period apart, those with fewer samples in common were better; and beside a jaw, few lags need proof."""
    case = trajectory(number, seed)
    lag = measure_together([case.jaw, case.insertion], max_lag_s=5.0)
    assert lag.verdict.has_lag
    assert abs(lag.lag_s - case.lag_s) < case.frame_s


@pytest.mark.parametrize("number", [3, 47])
def test_noise_of_other_frequencies_does_not_hide_a_lag(number: int) -> None:
    """With noise of one size at all frequencies, two lags were almost equally good."""
    case = trajectory(number, 1)
    lag = measure_together([case.jaw, case.insertion], max_lag_s=5.0)
    assert lag.verdict.has_lag
    assert abs(lag.lag_s - case.lag_s) < case.frame_s


@pytest.mark.parametrize("number", [0, 8, 37])
def test_an_insertion_from_place_to_place_chooses(number: int) -> None:
    """Also one that never reverses (0, 8), and between lags that are nearer than the steps of the search (37)."""
    pairs, lag_s, frame_s = staircase(number)
    lag = measure_together(pairs, max_lag_s=5.0)
    assert lag.verdict.has_lag
    assert abs(lag.lag_s - lag_s) < frame_s


@pytest.mark.parametrize("number", [0, 2])
def test_an_insertion_that_is_not_related_does_not_choose(number: int) -> None:
    """What is alike by chance is no reason for one of the lags that a jaw offers."""
    pairs, *_ = staircase(number, is_related=False)
    assert measure_together(pairs, max_lag_s=5.0).verdict is Verdict.BY_CHANCE


@pytest.mark.slow
def test_what_each_of_several_pairs_contributes() -> None:
    """Neither the jaw alone has a lag, nor both if the insertion does not move; a bed does not matter."""
    random = np.random.default_rng(2)
    robot, video = np.arange(0, 30, 1 / 30), np.arange(0, 30, 1 / 25)
    jaw, insertion = (lambda at: np.sin(2 * np.pi * at / 1.5)), (lambda at: np.sin(at) + np.sin(0.37 * at * at / 3))

    def seen(movement: Callable[[Floats], Floats]) -> tuple[Signal, Signal]:
        one, other = (movement(at) + random.normal(0, 0.05, len(at)) for at in (robot, video))
        return Signal.of(stamps(robot), one, "robot"), Signal.of(stamps(video + 2.1), -3 * other, "video")

    jaws, insertions, bed = seen(jaw), seen(insertion), seen(lambda at: 0 * at)
    assert measure_lag(*jaws, max_lag_s=5).verdict is Verdict.PERIODIC
    assert measure_together([jaws, bed], max_lag_s=5).verdict is Verdict.PERIODIC
    for pairs in ([jaws, insertions, bed], [bed, insertions, jaws]):
        lag = measure_together(pairs, max_lag_s=5)
        assert lag.verdict is Verdict.MEASURED
        assert lag.lag_s == pytest.approx(2.1, abs=0.005)
        assert lag.low_s < 2.1 < lag.high_s
        roles = {pair.verdict: pair for pair in lag.pairs}
        assert roles[Verdict.PERIODIC].period_s == pytest.approx(1.5, abs=0.02)
        assert Verdict.UNRELATED in roles and math.isnan(roles[Verdict.UNRELATED].r2)
    turned = [(two, one) for one, two in (jaws, insertions)]
    assert measure_together(turned, max_lag_s=5).lag_s == pytest.approx(-2.1, abs=0.005)
    assert not measure_together([jaws, insertions], max_lag_s=1).verdict.has_lag


def test_streams_of_different_movements() -> None:
    random = np.random.default_rng(3)
    times = np.arange(0, 30, 1 / 50)
    for _ in range(5):
        first, second = (np.convolve(random.normal(size=len(times)), np.ones(40), "same") for _ in range(2))
        lag = measure_lag(Signal.of(stamps(times), first), Signal.of(stamps(times), second))
        assert lag.verdict is Verdict.UNRELATED


def test_a_lag_beyond_the_search_range() -> None:
    fixed, moving = pair(lambda at: np.sin(at) + np.sin(1.7 * at + 1) + np.sin(at * at / 60))
    later = Signal(moving.times_ns + NS_PER_S // 4, moving.values)
    assert measure_lag(fixed, later, max_lag_s=0.3).verdict is Verdict.AT_EDGE
    assert measure_lag(fixed, later).lag_s == pytest.approx(LAG_S + 0.25, abs=2e-3)


def test_a_lag_that_jumps() -> None:
    """A delay that changes in the middle of the session is not one lag."""
    fixed, moving = pair(lambda at: np.sin(at) + np.sin(1.7 * at + 1) + np.sin(at * at / 60), seconds=60)
    half = len(moving.times_ns) // 2
    stepped = moving.times_ns + np.where(np.arange(len(moving.times_ns)) < half, 0, NS_PER_S // 20)
    lag = measure_lag(fixed, Signal(stepped, moving.values))
    assert lag.verdict is Verdict.VARIES
    assert lag.low_s < LAG_S + 0.025 < lag.high_s
    early = [window.lag_s for window in lag.windows if window.end_s < 28]
    late = [window.lag_s for window in lag.windows if window.start_s > 32]
    assert np.median(late) - np.median(early) == pytest.approx(0.05, abs=0.005)


@table(("step_ms", "verdict"), [(2, Verdict.MEASURED), (4, Verdict.VARIES)])
def test_a_lag_that_varies_by_two_milliseconds(step_ms: int, verdict: Verdict) -> None:
    """Later in the middle half, so without a trend; the noise alone spreads the windows by 1.3 ms."""
    fixed, moving = pair(lambda at: np.sin(at) + np.sin(1.7 * at + 1) + np.sin(at * at / 60), seconds=60)
    since = np.abs(np.arange(len(moving.times_ns)) / len(moving.times_ns) - 0.5)
    stepped = moving.times_ns + np.where(since < 0.25, step_ms * NS_PER_S // 1000, 0)
    lag = measure_lag(fixed, Signal(stepped, moving.values))
    assert lag.verdict is verdict
    assert len(lag.windows) > 3


def test_a_window_at_the_end_of_a_stream_is_no_other_lag() -> None:
    """There the filter has samples on one side only; a constant lag of 3.3 s was reported as 3.17 to 3.32 s."""
    random = np.random.default_rng(4)
    first, second = np.arange(0, 35, 1 / 50), np.arange(0, 35, 1 / 30)

    def movement(at: Floats) -> Floats:
        return np.asarray(np.sin(1.3 * at) + np.sin(0.7 * at + 2) + np.sin(0.05 * at * at))

    fixed = Signal.of(stamps(first), movement(first) + random.normal(0, 0.01, len(first)))
    moving = Signal.of(stamps(second), -0.4 * movement(second - 3.3) + random.normal(0, 0.02, len(second)))
    lag = measure_lag(fixed, moving, max_lag_s=4.9)
    assert lag.verdict is Verdict.MEASURED
    assert all(abs(window.lag_s - 3.3) < 0.05 for window in lag.windows)


def test_too_little() -> None:
    fixed, moving = pair(np.sin, seconds=1.9)
    assert measure_lag(fixed, moving).verdict is Verdict.TOO_SHORT
    assert measure_lag(Signal.of([], []), moving).verdict is Verdict.TOO_SHORT
    later = Signal(moving.times_ns + 10**12, moving.values)
    assert measure_lag(fixed, later).verdict is Verdict.TOO_SHORT


def test_values_that_are_not_finite_and_equal_stamps_are_left_out() -> None:
    signal = Signal.of([3, 1, 1, 2], [3.0, 1.0, 7.0, math.nan])
    assert signal.times_ns.tolist() == [1, 3]
    assert signal.values.tolist() == [[1.0], [3.0]]


def test_quantiles() -> None:
    assert student(3) == pytest.approx(3.182, rel=0.01)
    assert student(9) == pytest.approx(2.262, rel=0.001)
    assert chi_squared(5) == pytest.approx(20.515, rel=0.02)
    assert chi_squared(11) == pytest.approx(31.264, rel=0.01)

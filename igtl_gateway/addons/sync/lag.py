"""The lag between two streams of the same movement, or of several pairs of streams of two clocks, with its interval.

A lag o means: what the fixed stream shows at time t, the moving one shows at t + o.  A positive lag means that the
moving stream's stamps are late, and ``moving stamp - o`` corrects them.  PLUS has the same sign
(``vtkPlusTemporalCalibrationAlgo``).

Method: both signals are low-pass filtered without phase.  For each lag in the search range, the fixed signal is
regressed on the components of the moving one, because gain, axis and sign are not known, and on slow cosines, because
two streams that drift always look alike.  R², the part of the remaining variance that the moving signal explains, is
the measure.  Gauss-Newton steps on f(t) = a·m(t + τ + s·(t - t̄)) + d(t) give the lag τ and the skew s, with Huber's
weights against outliers.  The residuals of real signals are correlated, so the naive standard error is several
times too small.  The interval is that of a block bootstrap (Künsch, 1989), widened by Student's t for the number of
blocks, or that of the lags in windows if that is wider.

Several pairs have one lag.  A periodic movement offers lags a period apart, those that are not periodic choose one of
them, and all of them together refine it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.sync.defaults import CUT_OFF_HZ, MAX_LAG_S
from igtl_gateway.addons.sync.fit import LEAST_INFORMATION, LEAST_R2, Fit, Solution, Window
from igtl_gateway.addons.sync.probe import LEAST_SAMPLES, Probe
from igtl_gateway.addons.sync.search import Curve, chosen_peak, rival
from igtl_gateway.addons.sync.signal import Filtered, Floats, Signal, bandwidth, main_component, period, reversals
from igtl_gateway.addons.sync.statistics import NORMAL_975, chi_squared, student

#: Skew of two clocks, at most: crystals differ by up to 200 ppm, NTP corrects by up to 500 ppm, and a camera of
#: 29.97 Hz whose frames are stamped as 30 Hz has 1,000 ppm.
MOST_SKEW_PPM = 1_100.0

_LEAST_CUT_OFF_HZ = 0.5
_WINDOW_ERROR = 2.0  # the errors of short windows are too small by about this factor
_VARIES_S = 0.002  # spread of the windows' lags below which a lag counts as constant
_LEAST_WINDOWS = 3
_CONFIRMED = 0.5  # part of the windows with movement that have to show a lag
_LEAST_SHARED = 0.1  # R² of a pair below which it shows nothing of the lag of several
_PART_OF_PERIOD = 4  # a sine whose sign is not known is unambiguous within a quarter of its period to both sides


class Verdict(Enum):
    """What the data show of a lag.  Only the first two have one."""

    MEASURED = "measured"
    VARIES = "the lag is not constant"
    TOO_SHORT = "too little common time"
    STILL = "no movement"
    ONE_WAY = "the movement never reverses"
    PERIODIC = "the movement is periodic: lags a period apart look the same"
    AMBIGUOUS = "two lags explain the data almost equally well"
    AT_EDGE = "the best lag is at the end of the search range"
    UNRELATED = "the streams do not show the same movement"
    BY_CHANCE = "too little movement: streams that are not related are as alike by chance"
    CONTRADICTORY = "parts of the time show different lags"

    @property
    def has_lag(self) -> bool:
        """Whether there is a lag to use."""
        return self in (Verdict.MEASURED, Verdict.VARIES)


@dataclass(frozen=True, slots=True)
class Pair:
    """One of several pairs of streams with one lag.

    Attributes:
        fixed, moving: names of the streams.
        verdict: why the pair is not used; PERIODIC if it refines the lag and does not choose it; otherwise MEASURED.
        r2: explained part of its variance at the lag, NaN if it is not used.
        period_s: period of a movement that repeats itself, NaN otherwise.
    """

    fixed: str
    moving: str
    verdict: Verdict
    r2: float = math.nan
    period_s: float = math.nan


@dataclass(frozen=True, slots=True)
class Lag:
    """The result.  Without a lag (see ``Verdict.has_lag``) the numbers are those that led to the verdict, or NaN.

    Attributes:
        verdict: what the data show.
        lag_s: the lag in the middle of the common time, s.
        low_s, high_s: 95 % confidence interval.
        r2: explained part of the variance of the fixed signal.
        skew_ppm: how much faster the moving stream's clock runs, parts per million; ``skew_low_ppm`` and
            ``skew_high_ppm`` are its 95 % confidence interval.
        common_s: duration of the common time.
        middle_ns: the middle of the common time, UTC ns of the fixed stream.
        samples: number of samples that were compared.
        windows: the lag in windows.
        period_s: period of a movement that repeats itself, NaN otherwise.
        other_s: the second best lag if it is almost as good, NaN otherwise.
        search: lags (s) and R² of the search, for plots.
        pairs: of several pairs of streams, what each contributes.
    """

    verdict: Verdict
    lag_s: float = math.nan
    low_s: float = math.nan
    high_s: float = math.nan
    r2: float = math.nan
    skew_ppm: float = math.nan
    skew_low_ppm: float = math.nan
    skew_high_ppm: float = math.nan
    common_s: float = 0.0
    middle_ns: int = 0
    samples: int = 0
    windows: tuple[Window, ...] = ()
    period_s: float = math.nan
    other_s: float = math.nan
    search: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    pairs: tuple[Pair, ...] = ()

    def __repr__(self) -> str:
        if not self.verdict.has_lag:
            return f"<Lag: none, {self.verdict.value}>"
        low, high = self.low_s * 1e3, self.high_s * 1e3
        return f"<Lag: {self.lag_s * 1e3:+.1f} ms, 95 % {low:+.1f} to {high:+.1f}, {self.verdict.value}>"

    @property
    def has_skew(self) -> bool:
        """Whether the interval of the skew excludes 0: then it is part of the fit."""
        return self.skew_low_ppm > 0 or self.skew_high_ppm < 0


def measure_lag(
    fixed: Signal, moving: Signal, *, max_lag_s: float | None = None, cut_off_hz: float = CUT_OFF_HZ
) -> Lag:
    """Return the lag of ``moving`` behind ``fixed``.

    Args:
        fixed, moving: the signals.  That with fewer components, or else with fewer samples, is compared at its own
            samples, and the other one is interpolated.
        max_lag_s: search range to both sides; None: 1 s.  A given range states that the lag is in it.  So the lag of a
            periodic movement is measured if the range is shorter than a quarter of the period.
        cut_off_hz: cut-off of the low-pass for both; lower for noisy signals.
    """
    return replace(measure_together([(fixed, moving)], max_lag_s=max_lag_s, cut_off_hz=cut_off_hz), pairs=())


def measure_together(
    pairs: Sequence[tuple[Signal, Signal]], *, max_lag_s: float | None = None, cut_off_hz: float = CUT_OFF_HZ
) -> Lag:
    """Return the one lag of several pairs of signals: all fixed ones have one clock, all moving ones another one.

    A pair in which nothing moves is left out; a movement that never reverses counts beside one that does.
    ``Lag.pairs`` has what each contributes.

    Args:
        pairs: (fixed, moving) of each movement.
        max_lag_s, cut_off_hz: as of ``measure_lag``.
    """
    range_s = MAX_LAG_S if max_lag_s is None else max_lag_s
    origin_ns = min(_common_ns(*pair)[0] for pair in pairs)
    prepared = [_prepared(*pair, origin_ns, range_s, cut_off_hz) for pair in pairs]
    first = next((each for each in prepared if each.verdict is Verdict.MEASURED), prepared[0])
    found = Lag(
        first.verdict,
        common_s=first.common_s,
        middle_ns=first.middle_ns,
        samples=first.samples,
        pairs=tuple(each.pair for each in prepared),
    )
    if first.verdict is not Verdict.MEASURED:
        return found
    used = [each for each in prepared if each.probe]
    cut_off_hz = max(each.cut_off_hz for each in used)
    curve = Curve.of([each.probe for each in used if each.probe], range_s, cut_off_hz)
    related = curve.largest() >= _LEAST_SHARED
    if related.any():
        curve = replace(curve, each=curve.each[related])
        used = [each for each, is_related in zip(used, related.tolist(), strict=True) if is_related]
    probes = [each.probe for each in used if each.probe]
    curve = curve.sharpened(probes)
    fit = Fit(probes)
    found = replace(
        found,
        common_s=fit.end_s - fit.start_s if len(pairs) > 1 else first.common_s,
        middle_ns=origin_ns + round(fit.middle_s * NS_PER_S),
        samples=sum(each.samples for each in used),
    )
    result, periods = _searched(found, fit, curve, is_known=max_lag_s is not None)
    facts = {id(each): period_s for each, period_s in zip(used, periods, strict=True)}
    return replace(result, pairs=tuple(_contribution(each, result, facts.get(id(each))) for each in prepared))


def _contribution(prepared: _Prepared, lag: Lag, period_s: float | None) -> Pair:
    """What a pair contributes; the period is None if it is not used."""
    if prepared.probe is None or period_s is None:
        verdict = Verdict.UNRELATED if prepared.probe else prepared.verdict
        return replace(prepared.pair, verdict=verdict)
    r2 = prepared.probe.r2(lag.lag_s) if math.isfinite(lag.lag_s) else math.nan
    verdict = Verdict.MEASURED if math.isnan(period_s) else Verdict.PERIODIC
    return replace(prepared.pair, verdict=verdict, r2=r2, period_s=period_s)


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A pair of signals, filtered; the verdict is the reason if there is no probe, or if it does not suffice alone."""

    pair: Pair
    common_s: float
    middle_ns: int
    samples: int
    cut_off_hz: float = math.nan
    probe: Probe | None = None

    @property
    def verdict(self) -> Verdict:
        return self.pair.verdict


def _common_ns(fixed: Signal, moving: Signal) -> tuple[int, int]:
    """Begin and end of the common time, UTC ns; equal without one."""
    if not len(fixed.times_ns) or not len(moving.times_ns):
        return 0, 0
    begin_ns = int(max(fixed.times_ns[0], moving.times_ns[0]))
    return begin_ns, max(begin_ns, int(min(fixed.times_ns[-1], moving.times_ns[-1])))


def _prepared(fixed: Signal, moving: Signal, origin_ns: int, max_lag_s: float, cut_off_hz: float) -> _Prepared:
    """Filter both signals, and choose the one whose samples are compared."""
    begin_ns, end_ns = _common_ns(fixed, moving)
    common_s = (end_ns - begin_ns) / NS_PER_S
    samples = min(len(fixed.times_ns), len(moving.times_ns))

    def refused(verdict: Verdict, samples: int = samples) -> _Prepared:
        return _Prepared(Pair(fixed.name, moving.name, verdict), common_s, (begin_ns + end_ns) // 2, samples)

    if samples < LEAST_SAMPLES or common_s <= 2 * max_lag_s:
        return refused(Verdict.TOO_SHORT)
    components = (fixed.values.shape[1], moving.values.shape[1])
    is_exchanged = components[0] > components[1] or (
        components[0] == components[1] and fixed.period_s < moving.period_s
    )
    slower, faster = (moving, fixed) if is_exchanged else (fixed, moving)
    cut_off_hz = min(cut_off_hz, *(max(bandwidth(each), _LEAST_CUT_OFF_HZ) for each in (slower, faster)))
    known, other = (Filtered.of(each, origin_ns, cut_off_hz) for each in (slower, faster))
    inside = (slower.times_ns >= begin_ns) & (slower.times_ns <= end_ns)
    times = (slower.times_ns[inside] - origin_ns) / NS_PER_S
    times = times[known.covers(times)]
    if len(times) < LEAST_SAMPLES or np.count_nonzero(other.covers(times)) < LEAST_SAMPLES:
        return refused(Verdict.TOO_SHORT, len(times))
    if known.is_still(times) or other.is_still(times):
        return refused(Verdict.STILL, len(times))
    target = main_component(known.at(times))
    reverses = min(reversals(target), reversals(main_component(other.at(times[other.covers(times)])))) > 0
    probe = Probe(times, target, other, -1 if is_exchanged else 1, cut_off_hz, reverses=reverses)
    verdict = Verdict.MEASURED if reverses else Verdict.ONE_WAY
    return replace(refused(verdict, len(times)), cut_off_hz=cut_off_hz, probe=probe)


def _searched(found: Lag, fit: Fit, curve: Curve, *, is_known: bool) -> tuple[Lag, list[float]]:
    """Return the result, and the period of each probe."""
    probes, max_lag_s = fit.probes, curve.max_lag_s
    every = np.where(curve.inside, curve.of_probes([True] * len(probes)), np.nan)
    search = tuple(zip(curve.lags[curve.inside].tolist(), every[curve.inside].tolist(), strict=True))
    periods = [
        _period(probe, np.where(curve.inside, r2, np.nan), curve.lags)
        for probe, r2 in zip(probes, curve.each, strict=True)
    ]
    deciders = [math.isnan(each) for each in periods]
    longest_s = math.nan if any(deciders) else max(periods)
    found = replace(found, search=search, period_s=longest_s)
    if not np.isfinite(every).any():
        return replace(found, verdict=Verdict.TOO_SHORT), periods
    top = int(np.nanargmax(every))
    found = replace(found, lag_s=float(curve.lags[top]), r2=float(every[top]))
    if float(np.max(curve.each[:, top])) < LEAST_R2:
        return replace(found, verdict=Verdict.UNRELATED), periods
    if not any(deciders) and not (is_known and max_lag_s <= longest_s / _PART_OF_PERIOD):
        return replace(found, verdict=Verdict.PERIODIC), periods
    best = chosen_peak(curve, probes, deciders, is_known=is_known)
    if best is None:
        return replace(found, verdict=Verdict.AT_EDGE), periods
    lag_s = float(curve.lags[best])
    if _is_chance(probes, deciders, lag_s):
        return replace(found, verdict=Verdict.BY_CHANCE), periods
    if any(deciders):
        other_s = rival(curve, best, probes, deciders, beyond=not is_known)
        if not math.isnan(other_s):
            return replace(found, verdict=Verdict.AMBIGUOUS, lag_s=lag_s, other_s=other_s), periods
    return _refined(found, fit, lag_s, max_lag_s), periods


def _is_chance(probes: Sequence[Probe], deciders: Sequence[bool], lag_s: float) -> bool:
    """Whether the movements that choose a lag, or all that repeat themselves, are alike by chance."""
    repeating = [probe for probe, decides in zip(probes, deciders, strict=True) if not decides]
    is_shown = any(not probe.is_chance(lag_s) for probe in repeating)
    if not any(deciders):
        return not is_shown
    # the lags between the peaks of a movement that repeats itself are excluded
    choosing = [probe for probe, decides in zip(probes, deciders, strict=True) if decides]
    return all(probe.is_chance(lag_s, of_few=is_shown) for probe in choosing)


def _period(probe: Probe, r2: Floats, lags: Floats) -> float:
    """Period of what is alike in both signals of a probe, s; NaN if it does not repeat itself."""
    found = period(probe.times, probe.target)
    if not math.isnan(found) or not np.isfinite(r2).any():
        return found
    return period(*probe.prediction(float(lags[int(np.nanargmax(r2))])))


def _refined(found: Lag, fit: Fit, start_s: float, max_lag_s: float) -> Lag:
    """Return the result with lag, skew and their intervals."""
    flat = fit.solve(start_s, with_skew=False)
    if flat is None or abs(flat.lag_s) > max_lag_s:
        return replace(found, verdict=Verdict.AT_EDGE)
    if flat.informs < LEAST_INFORMATION:
        return replace(found, verdict=Verdict.AMBIGUOUS if math.isnan(found.period_s) else Verdict.PERIODIC)
    windows, moving = fit.windows(flat.lag_s)
    line = fit.solve(start_s, with_skew=True)
    skew_ppm, half_ppm = _skew(line, windows)
    has_skew = line is not None and half_ppm < abs(skew_ppm)
    used = line if line is not None and has_skew else flat
    half_s = used.half_width(0)
    verdict = Verdict.MEASURED
    if len(windows) > 1:
        lags = np.array([window.lag_s for window in windows])
        errors = _WINDOW_ERROR * np.array([window.error_s for window in windows])
        middles = np.array([(window.start_s + window.end_s) / 2 for window in windows]) - fit.middle_s
        trend = lags - (used.skew * middles if has_skew else 0.0)
        spread_s = float(np.std(trend, ddof=1))
        weights = 1 / errors**2
        q = float(np.sum(weights * (trend - np.sum(weights * trend) / np.sum(weights)) ** 2))
        if len(windows) >= _LEAST_WINDOWS:
            half_s = max(half_s, NORMAL_975 * spread_s / math.sqrt(len(windows)))
        if q > chi_squared(len(windows) - 1) and spread_s > _VARIES_S:
            is_between = float(np.min(trend - errors)) <= used.lag_s <= float(np.max(trend + errors))
            verdict = Verdict.VARIES if len(windows) >= _LEAST_WINDOWS and is_between else Verdict.CONTRADICTORY
    if verdict is Verdict.CONTRADICTORY or len(windows) < _CONFIRMED * moving:
        return replace(found, verdict=Verdict.CONTRADICTORY, lag_s=used.lag_s, windows=tuple(windows))
    return replace(
        found,
        verdict=verdict,
        lag_s=used.lag_s,
        low_s=used.lag_s - half_s,
        high_s=used.lag_s + half_s,
        r2=used.r2,
        skew_ppm=skew_ppm,
        skew_low_ppm=skew_ppm - half_ppm,
        skew_high_ppm=skew_ppm + half_ppm,
        windows=tuple(windows),
    )


def _skew(line: Solution | None, windows: Sequence[Window]) -> tuple[float, float]:
    """Skew and half its 95 % interval, ppm: that of the bootstrap, or that of the lags in windows if it is wider."""
    if line is None:
        return math.nan, math.nan
    half = line.half_width(1)
    if len(windows) > _LEAST_WINDOWS:
        middles = np.array([(window.start_s + window.end_s) / 2 for window in windows])
        lags = np.array([window.lag_s for window in windows])
        since = middles - middles.mean()
        rest = lags - lags.mean() - since * float(since @ lags) / float(since @ since)
        freedom = len(windows) - 2
        half = max(half, student(freedom) * math.sqrt(float(rest @ rest) / freedom / float(since @ since)))
    skew_ppm, half_ppm = line.skew * 1e6, half * 1e6
    return (skew_ppm, half_ppm) if abs(skew_ppm) <= MOST_SKEW_PPM else (math.nan, math.nan)

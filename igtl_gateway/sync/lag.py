"""The lag between two streams of the same movement, with its interval.

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
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.sync.defaults import CUT_OFF_HZ, MAX_LAG_S
from igtl_gateway.sync.fit import LEAST_R2, LEAST_SAMPLES, NORMAL_975, Fit, Window, chi_squared_999
from igtl_gateway.sync.signal import Filtered, Signal, bandwidth, main_component, period, reversals

_LEAST_CUT_OFF_HZ = 0.5
_SIMILAR_R2, _EQUAL_R2 = 0.9, 0.98  # R² of another peak, relative to the best, that may be, or is, as good
_CLOSE_T = 3.0  # Student's t of their difference below which it is
_WINDOW_ERROR = 2.0  # the errors of short windows are too small by about this factor
_VARIES_S = 0.002  # spread of the windows' lags below which a lag counts as constant
_LEAST_WINDOWS = 3


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

    @property
    def has_lag(self) -> bool:
        """Whether there is a lag to use."""
        return self in (Verdict.MEASURED, Verdict.VARIES)


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

    @property
    def has_skew(self) -> bool:
        """Whether the interval of the skew excludes 0: then it is part of the fit."""
        return self.skew_low_ppm > 0 or self.skew_high_ppm < 0


def measure_lag(fixed: Signal, moving: Signal, *, max_lag_s: float = MAX_LAG_S, cut_off_hz: float = CUT_OFF_HZ) -> Lag:
    """Return the lag of ``moving`` behind ``fixed``.

    Args:
        fixed, moving: the signals.  That with fewer components, or else with fewer samples, is compared at its own
            samples, and the other one is interpolated.
        max_lag_s: search range to both sides.
        cut_off_hz: cut-off of the low-pass for both; lower for noisy signals.
    """
    if len(fixed.times_ns) < LEAST_SAMPLES or len(moving.times_ns) < LEAST_SAMPLES:
        return Lag(Verdict.TOO_SHORT, samples=min(len(fixed.times_ns), len(moving.times_ns)))
    components = (fixed.values.shape[1], moving.values.shape[1])
    if components[0] > components[1] or (components[0] == components[1] and fixed.period_s < moving.period_s):
        return _negated(_measured(moving, fixed, max_lag_s, cut_off_hz))
    return _measured(fixed, moving, max_lag_s, cut_off_hz)


def _negated(lag: Lag) -> Lag:
    """Return the result with the streams exchanged."""
    return replace(
        lag,
        lag_s=-lag.lag_s,
        low_s=-lag.high_s,
        high_s=-lag.low_s,
        skew_ppm=-lag.skew_ppm,
        skew_low_ppm=-lag.skew_high_ppm,
        skew_high_ppm=-lag.skew_low_ppm,
        windows=tuple(replace(window, lag_s=-window.lag_s) for window in lag.windows),
        other_s=-lag.other_s,
        search=tuple((-lag_s, r2) for lag_s, r2 in reversed(lag.search)),
    )


def _measured(fixed: Signal, moving: Signal, max_lag_s: float, cut_off_hz: float) -> Lag:
    origin_ns = int(max(fixed.times_ns[0], moving.times_ns[0]))
    end_ns = int(min(fixed.times_ns[-1], moving.times_ns[-1]))
    common_s = (end_ns - origin_ns) / NS_PER_S
    found = Lag(Verdict.TOO_SHORT, common_s=max(0.0, common_s), middle_ns=(origin_ns + end_ns) // 2)
    if common_s <= 2 * max_lag_s:
        return found
    cut_off_hz = min(cut_off_hz, max(bandwidth(fixed), _LEAST_CUT_OFF_HZ), max(bandwidth(moving), _LEAST_CUT_OFF_HZ))
    known = Filtered.of(fixed, origin_ns, cut_off_hz)
    faster = Filtered.of(moving, origin_ns, cut_off_hz)
    inside = (fixed.times_ns >= origin_ns) & (fixed.times_ns <= end_ns)
    times = (fixed.times_ns[inside] - origin_ns) / NS_PER_S
    times = times[known.covers(times)]
    found = replace(found, samples=len(times))
    if len(times) < LEAST_SAMPLES:
        return found
    if known.is_still(times) or faster.is_still(times):
        return replace(found, verdict=Verdict.STILL)
    target = main_component(known.at(times))
    if min(reversals(target), reversals(main_component(faster.at(times[faster.covers(times)])))) < 1:
        return replace(found, verdict=Verdict.ONE_WAY)
    period_s = period(times, target)
    fit = Fit(times, target, faster)
    step_s = min(0.02, 0.1 / cut_off_hz)
    lags = np.arange(-math.ceil(max_lag_s / step_s), math.ceil(max_lag_s / step_s) + 1) * step_s
    r2 = np.array([fit.r2(lag) for lag in lags])
    search = tuple(zip(lags.tolist(), r2.tolist(), strict=True))
    found = replace(found, search=search, period_s=period_s)
    if not np.isfinite(r2).any():
        return found
    best = int(np.nanargmax(r2))
    peaks = [i for i in range(1, len(r2) - 1) if r2[i] >= r2[i - 1] and r2[i] > r2[i + 1]]
    found = replace(found, lag_s=float(lags[best]), r2=float(r2[best]))
    if r2[best] < LEAST_R2:
        return replace(found, verdict=Verdict.UNRELATED)
    if not math.isnan(period_s):
        return replace(found, verdict=Verdict.PERIODIC)
    if best not in peaks:
        return replace(found, verdict=Verdict.AT_EDGE)
    for other in peaks:
        ratio = float(r2[other] / r2[best])
        if other == best or ratio < _SIMILAR_R2:
            continue
        if ratio > _EQUAL_R2 or fit.difference_t(float(lags[best]), float(lags[other])) < _CLOSE_T:
            return replace(found, verdict=Verdict.AMBIGUOUS, other_s=float(lags[other]))
    return _refined(found, fit, float(lags[best]), max_lag_s)


def _refined(found: Lag, fit: Fit, start_s: float, max_lag_s: float) -> Lag:
    """Return the result with lag, skew and their intervals."""
    line = fit.solve(start_s, with_skew=True)
    flat = fit.solve(start_s, with_skew=False)
    if flat is None or line is None or abs(flat.lag_s) > max_lag_s:
        return replace(found, verdict=Verdict.AT_EDGE)
    skew_low, skew_high = line.interval(1)
    windows = tuple(fit.windows(flat.lag_s))
    constant = skew_low <= 0 <= skew_high
    used = flat if constant else line
    low, high = used.interval(0)
    varies = False
    if len(windows) >= _LEAST_WINDOWS:
        lags = np.array([window.lag_s for window in windows])
        errors = np.array([window.error_s for window in windows])
        middles = np.array([(window.start_s + window.end_s) / 2 for window in windows]) - fit.middle_s
        trend = lags - (0.0 if constant else line.skew * middles)
        spread = float(np.std(trend, ddof=1))
        half = NORMAL_975 * spread / math.sqrt(len(windows))
        low, high = min(low, used.lag_s - half), max(high, used.lag_s + half)
        weights = 1 / (_WINDOW_ERROR * errors) ** 2
        q = float(np.sum(weights * (trend - np.sum(weights * trend) / np.sum(weights)) ** 2))
        varies = q > chi_squared_999(len(windows) - 1) and spread > _VARIES_S
    return replace(
        found,
        verdict=Verdict.VARIES if varies else Verdict.MEASURED,
        lag_s=used.lag_s,
        low_s=low,
        high_s=high,
        r2=used.r2,
        skew_ppm=line.skew * 1e6,
        skew_low_ppm=skew_low * 1e6,
        skew_high_ppm=skew_high * 1e6,
        windows=windows,
    )

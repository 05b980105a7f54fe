"""PLUS's temporal calibration, to compare results with it: ``vtkPlusTemporalCalibrationAlgo`` and its two signals.

The video signal is the height of the bright line in ultrasound pictures of a water tank; the tracker signal is the
translation of the probe on its main axis.  Both are normalised, and the lag is that of the least squared difference
on a grid.  ``lag`` estimates lags better; this module has the result of PLUS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.sync.signal import Floats, Signal

#: Scan lines on which the brightest peak is looked for.
_SCAN_LINES = 40
_LEAST_POINTS = 5
#: Distance from the line up to which a peak belongs to it, pixels.
_INLIER_PX = 0.5
_STEEPEST = 10.0  # slope of a line that is nearly vertical
_FINE_S = 0.001
_FINE_PERIODS = 3


@dataclass(frozen=True, slots=True)
class PlusLag:
    """PLUS's result.

    Attributes:
        lag_s: TrackerLagSec; the sign is that of ``lag.Lag``.
        error: CalibrationError, the root of the sum of the squared differences of the normalised signals times the
            standard deviation of the moving one: in the unit of the moving one.
        metric: minus the sum of the squared differences of the normalised signals.
    """

    lag_s: float
    error: float
    metric: float


def line_height(image: npt.NDArray[np.generic]) -> float:
    """Return where the bright line of a picture (rows, columns) crosses its middle, in rows; NaN if there is none."""
    columns = image.shape[1]
    at = (np.arange(_SCAN_LINES) + 0.5) * columns / _SCAN_LINES
    peaks = [_peak(np.asarray(image[:, int(x)], np.float64)) for x in at]
    found = [(float(int(x)), y) for x, y in zip(at, peaks, strict=True) if not math.isnan(y)]
    if len(found) < _LEAST_POINTS:
        return math.nan
    x, y = np.array(found).T
    # all pairs instead of random ones
    first, second = np.triu_indices(len(x), 1)
    slope = (y[second] - y[first]) / (x[second] - x[first])
    offset = y[first] - slope * x[first]
    distance = np.abs(slope[:, np.newaxis] * x + offset[:, np.newaxis] - y) / np.hypot(slope, 1)[:, np.newaxis]
    inliers = distance[np.argmax(np.count_nonzero(distance <= _INLIER_PX, axis=1))] <= _INLIER_PX
    if np.count_nonzero(inliers) < _LEAST_POINTS:
        return math.nan
    slope_, offset_ = np.polyfit(x[inliers], y[inliers], 1)
    return math.nan if abs(slope_) > _STEEPEST else float(slope_ * columns / 2 + offset_)


def _peak(line: Floats) -> float:
    """Return the centre of gravity of the brightest run of pixels above half of the maximum; NaN on a black line."""
    top = float(line.max())
    if top <= 0:
        return math.nan
    bright = np.concatenate([[False], line > top / 2, [False]])
    begins = np.flatnonzero(bright[1:] & ~bright[:-1])
    ends = np.flatnonzero(~bright[1:] & bright[:-1])
    begin, end = max(zip(begins, ends, strict=True), key=lambda run: float(line[run[0] : run[1]].sum()))
    part = line[begin:end]
    return float(begin + np.sum(np.arange(len(part)) * part) / part.sum())


def plus_lag(fixed: Signal, moving: Signal, *, max_lag_s: float = 0.5) -> PlusLag | None:
    """Return PLUS's lag of two signals with one component; None if their common time is too short."""
    origin_ns = int(max(fixed.times_ns[0], moving.times_ns[0]))
    end_ns = int(min(fixed.times_ns[-1], moving.times_ns[-1]))
    edge_ns = round(max_lag_s * NS_PER_S)
    inside = (fixed.times_ns >= origin_ns) & (fixed.times_ns <= end_ns)
    kept = (moving.times_ns >= origin_ns + edge_ns) & (moving.times_ns <= end_ns - edge_ns)
    if np.count_nonzero(inside) < _LEAST_POINTS or np.count_nonzero(kept) < _LEAST_POINTS:
        return None
    times = (fixed.times_ns[inside] - origin_ns) / NS_PER_S
    at, values = (moving.times_ns[kept] - origin_ns) / NS_PER_S, moving.values[kept, 0]
    target = _normalised(fixed.values[inside, 0])
    period = float(np.mean(np.diff(times)))

    def best(lags: Floats, sign: int) -> tuple[float, float]:
        """The lag with the highest metric, and that."""
        metrics = [
            -float(np.sum((target - sign * _normalised(np.interp(times + lag_s, at, values))) ** 2)) for lag_s in lags
        ]
        place = int(np.argmax(metrics))
        return float(lags[place]), metrics[place]

    results = []
    for sign in (1, -1):
        coarse_s, _ = best(np.arange(-max_lag_s, max_lag_s + period / 2, period), sign)
        reach_s = _FINE_PERIODS * period
        results.append(best(np.arange(coarse_s - reach_s, coarse_s + reach_s, _FINE_S), sign))
    # PLUS takes the smaller lag, not the better metric
    lag_s, best_metric = min(results, key=lambda result: abs(result[0]))
    scale = float(np.std(np.interp(times + lag_s, at, values), ddof=1))
    return PlusLag(lag_s, math.sqrt(-best_metric) * scale, best_metric)


def _normalised(values: Floats) -> Floats:
    return np.asarray((values - values.mean()) / np.std(values, ddof=1))

"""One movement that two streams show: the samples of one, to be compared with the other one at any lag."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.sync.bands import likelihood_ratio
from igtl_gateway.addons.sync.signal import Filtered, Floats
from igtl_gateway.addons.sync.statistics import chi_squared, half_waves, occupancy

#: Samples below which nothing is estimated.
LEAST_SAMPLES = 30

_PART_COVERED = 0.6  # of the samples that a lag has to cover
_SPREAD = 0.05  # part of the main component's spread below which a component is left out
_DRIFT_S = 20.0  # shortest period of what counts as drift
_MOST_DRIFT = 60  # cosines: those of 10 minutes
_SEARCH_HZ = 4.0  # samples for the search, relative to the cut-off: more of them contain nothing further
_RIDGE = 1e-9  # of columns of size 1, for those that depend on each other
_CHANCE = 4.5  # quantile of the normal distribution, of what chance explains at the best of some lags ...
_CHANCE_OF_FEW = 2.0  # ... and of the few that another movement leaves

Mask = npt.NDArray[np.bool_]


class Probe:
    """The regression of a target on the components of the faster signal at a lag.

    Attributes:
        times: (N,) s after the origin; target: (N,) low-pass filtered.
        some: (S,) as many of the times as contain all of the filtered movement, for the search; none near the ends.
        faster: the other signal.
        direction: 1 if the target is of the fixed stream; -1 if it is of the moving one, which lags behind.
        drift: (N, D) slow cosines, which are part of the regression; also a line, if the movement never reverses: a
            ramp fits at any lag.
    """

    def __init__(
        self,
        times: Floats,
        target: Floats,
        faster: Filtered,
        direction: int,
        cut_off_hz: float,
        *,
        reverses: bool = True,
    ) -> None:
        self.times, self.target, self.faster, self.direction = times, target, faster, direction
        self._cut_off_hz = cut_off_hz
        seconds = max(float(times[-1] - times[0]), 1e-9)
        slow = min(int(2 * seconds / _DRIFT_S), _MOST_DRIFT)
        part = ((times - times[0]) / seconds)[:, np.newaxis]
        self.drift = np.cos(np.pi * np.arange(slow + 1) * part)
        if not reverses:
            self.drift = np.column_stack([self.drift, part])
        values = faster.at(times[faster.covers(times)])
        _, sizes, axes = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
        kept = sizes > _SPREAD * sizes[0]
        self.axes = (axes[kept] / sizes[kept, np.newaxis]).T * math.sqrt(len(values))
        rate_hz = (len(times) - 1) / seconds
        every = max(1, min(int(rate_hz / (_SEARCH_HZ * cut_off_hz)), len(times) // (2 * LEAST_SAMPLES)))
        edge_s = min(faster.edge_s, seconds / 8)
        chosen = np.flatnonzero((times >= times[0] + edge_s) & (times <= times[-1] - edge_s))[::every]
        self.some, self._target, self._drift = times[chosen], target[chosen], self.drift[chosen]
        self._least = max(LEAST_SAMPLES / every, _PART_COVERED * len(chosen))

    def r2(self, lag_s: float) -> float:
        """Return the explained part of the variance at a lag; NaN if it covers too few samples."""
        at = self.some + self.direction * lag_s
        inside = self.faster.covers_well(at)
        if np.count_nonzero(inside) < self._least:
            return math.nan
        target, drift = self._target[inside], self._drift[inside]
        # of the normal equations, because this is done for each lag of the search
        columns = np.column_stack([drift, self.faster.at(at[inside]) @ self.axes])
        normal, score = columns.T @ columns, columns.T @ target
        size, count = float(target @ target), drift.shape[1]
        normal.flat[:: len(normal) + 1] += _RIDGE * len(columns)
        total = size - float(score[:count] @ np.linalg.solve(normal[:count, :count], score[:count]))
        left = size - float(score @ np.linalg.solve(normal, score))
        return 1 - max(left, 0.0) / total if total > 1e-12 * size else math.nan

    def covered(self, lag_s: float) -> Mask:
        """Return of which of some samples (S) the faster signal is known at a lag."""
        return self.faster.covers_well(self.some + self.direction * lag_s)

    def _beside_drift(self, lag_s: float, inside: Mask) -> tuple[Floats, Floats]:
        """The target at these of some samples (M), and what the other signal explains of it (M), without drift."""
        drift = self._drift[inside]
        values = without(drift, self.faster.at(self.some[inside] + self.direction * lag_s) @ self.axes)
        target = without(drift, self._target[inside])
        return target, values @ gains_of(values, target)

    def residual(self, lag_s: float, inside: Mask) -> Floats:
        """Return the residuals at a lag of the samples that are inside (M)."""
        target, predicted = self._beside_drift(lag_s, inside)
        return target - predicted

    def advantage_by_bands(self, lag_s: float, other_s: float, inside: Mask) -> float:
        """Return twice the logarithm of the ratio of the likelihoods of two lags, by bands of frequency."""
        first, second = self.residual(lag_s, inside), self.residual(other_s, inside)
        return likelihood_ratio(self.some[inside], first, second, self._cut_off_hz, self.drift.shape[1])

    def prediction(self, lag_s: float) -> tuple[Floats, Floats]:
        """Return times (M) and what the faster signal shows of the target at a lag (M), without the drift."""
        inside = self.covered(lag_s)
        return self.some[inside], self._beside_drift(lag_s, inside)[1]

    def freedom(self, lag_s: float, inside: Mask) -> float:
        """Return the number of independent values of the movement that both signals show in the samples inside."""
        return min(half_waves(self.some[inside], each) for each in self._beside_drift(lag_s, inside))

    def is_chance(self, lag_s: float, *, of_few: bool = False) -> bool:
        """Return whether signals that are not related are as alike at some lag, in what they show and in its speed.

        Slow signals have few independent values, and any two of them are alike at some lag.  Where something moves from
        place to place and seldom back, its speed has many.

        Args:
            lag_s: the lag.
            of_few: whether another movement leaves few lags to choose from.
        """
        quantile = _CHANCE_OF_FEW if of_few else _CHANCE
        inside = self.covered(lag_s)
        target, predicted = self._beside_drift(lag_s, inside)
        times, components = self.some[inside], self.axes.shape[1]
        if not _is_chance(times, target, predicted, components, self.drift.shape[1], quantile):
            return False
        speed = np.gradient(target, times)
        speeds = self.faster.slope_at(times + self.direction * lag_s) @ self.axes
        return _is_chance(times, speed, speeds @ gains_of(speeds, speed), components, 1, quantile)


def _is_chance(times: Floats, target: Floats, predicted: Floats, components: int, drift: int, quantile: float) -> bool:
    """Whether a target (N) could be explained so well by chance."""
    lost = drift + (components + 1) / 2
    freedom = min((half_waves(times, each) - lost) * occupancy(each) for each in (target, predicted))
    left = float(np.sum((target - predicted) ** 2)) / max(float(np.sum(target**2)), 1e-300)
    return bool(freedom <= 0 or -freedom * math.log(max(left, 1e-9)) < chi_squared(components, quantile))


def without(drift: Floats, values: Floats) -> Floats:
    """Return the values (N) or (N, K) without what the drift (N, D) explains."""
    slow, _ = np.linalg.qr(drift)
    return np.asarray(values - slow @ (slow.T @ values))


def gains_of(values: Floats, target: Floats) -> Floats:
    """Return the gains (K) of the target (N) regressed on the values (N, K)."""
    # of the normal equations: a few components, of about the same size
    gains, *_ = np.linalg.lstsq(values.T @ values, values.T @ target, rcond=None)
    return np.asarray(gains)

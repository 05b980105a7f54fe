"""The regression of one movement on another at a lag, and how certain its lag is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.sync.signal import Filtered, Floats

#: Samples below which nothing is estimated.
LEAST_SAMPLES = 30
#: R² below which two streams do not show the same movement.
LEAST_R2 = 0.5

_PART_COVERED = 0.6  # of the samples that a lag has to cover
_SPREAD = 0.05  # part of the main component's spread below which a component is left out
_DRAWS = 2_000
_BLOCKS = (8, 20)
_WINDOW_S = 2.5
_WINDOWS = 12
_WINDOW_SAMPLES = 20
_STEPS = 12
_HUBER = 2.5
_DRIFT_S = 20.0  # shortest period of what counts as drift
_COMPARED = 12  # blocks of time in which two lags are compared


@dataclass(frozen=True, slots=True)
class Window:
    """The lag in a part of the common time: begin and end (s after the first common time), lag, standard error."""

    start_s: float
    end_s: float
    lag_s: float
    error_s: float


@dataclass(frozen=True, slots=True)
class Solution:
    """A fit, with what its intervals need.

    Attributes:
        lag_s: in the middle of the common time.
        skew: seconds per second.
        r2: explained part of the variance.
        normal, score: of each block JᵀWJ (B, P, P) and JᵀWr (B, P), lag first, then skew if it was fitted.
        error_s: standard error of the lag by autocorrelation of the residuals.
        informs: part of the derivative by the lag that gain and offset cannot explain.
    """

    lag_s: float
    skew: float
    r2: float
    normal: Floats
    score: Floats
    error_s: float
    informs: float

    def interval(self, parameter: int) -> tuple[float, float]:
        """Return the 95 % interval of the lag (0) or the skew (1), by bootstrap of the blocks."""
        blocks = len(self.normal)
        value = self.lag_s if parameter == 0 else self.skew
        if blocks < _BLOCKS[0]:
            return -math.inf, math.inf
        generator = np.random.Generator(np.random.PCG64(1))  # fixed: equal inputs, equal interval
        drawn = generator.multinomial(blocks, np.full(blocks, 1 / blocks), _DRAWS).astype(np.float64)
        normal = np.einsum("db,bpq->dpq", drawn, self.normal)
        score = np.einsum("db,bp->dp", drawn, self.score)
        scale = np.sqrt(np.maximum(np.einsum("dpp->dp", normal), 1e-300))
        normal = normal / scale[:, :, np.newaxis] / scale[:, np.newaxis, :]
        ridge = 1e-12 * np.eye(normal.shape[1])
        moved = np.linalg.solve(normal + ridge, (score / scale)[:, :, np.newaxis])[:, :, 0] / scale
        half = student(blocks - 1) * float(np.std(moved[:, parameter])) * math.sqrt(blocks / (blocks - 1))
        return value - half, value + half


class Fit:
    """The regression of the target on the faster signal at a lag."""

    def __init__(self, times: Floats, target: Floats, faster: Filtered) -> None:
        self.times = times
        self.target = target
        self.faster = faster
        self.middle_s = float(times[0] + times[-1]) / 2
        since = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
        slow = int(2 * float(times[-1] - times[0]) / _DRIFT_S)
        self._drift = np.cos(np.pi * np.arange(slow + 1) * since[:, np.newaxis])
        self._slow, _ = np.linalg.qr(self._drift)
        values = faster.at(times[faster.covers(times)])
        spread = np.std(values, axis=0)
        _, _, axes = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
        scores = np.std((values - values.mean(axis=0)) @ axes.T, axis=0)
        self._axes = axes[scores > _SPREAD * scores[0]].T if spread.size > 1 else np.eye(1)

    def _moved(self, lag_s: float) -> tuple[npt.NDArray[np.bool_], Floats]:
        at = self.times + lag_s
        inside = self.faster.covers(at)
        return inside, self.faster.at(at[inside]) @ self._axes

    def r2(self, lag_s: float) -> float:
        """Return the explained part of the variance at a lag; NaN if it covers too few samples."""
        inside, values = self._moved(lag_s)
        if np.count_nonzero(inside) < max(LEAST_SAMPLES, _PART_COVERED * len(self.times)):
            return math.nan
        target, values = self._without_drift(inside, self.target[inside], values)
        residual, _ = regressed(values, target)
        total = float(np.sum(target**2))
        return 1 - float(np.sum(residual**2)) / total if total > 0 else math.nan

    def _without_drift(self, inside: npt.NDArray[np.bool_], target: Floats, values: Floats) -> tuple[Floats, Floats]:
        """Return target and values without what slow cosines explain."""
        slow = self._slow if inside.all() else np.linalg.qr(self._drift[inside])[0]
        return target - slow @ (slow.T @ target), values - slow @ (slow.T @ values)

    def difference_t(self, lag_s: float, other_s: float) -> float:
        """Return Student's t of how much better one lag is than another, over blocks of time."""
        first, second = self._moved(lag_s), self._moved(other_s)
        both = first[0] & second[0]
        gains = np.zeros(len(self.times))
        for (inside, values), sign in ((first, -1.0), (second, 1.0)):
            residual, _ = regressed(*reversed(self._without_drift(inside, self.target[inside], values)))
            gains[inside] += sign * residual**2
        sums = np.array([float(part.sum()) for part in np.array_split(gains[both], _COMPARED)])
        spread = float(np.std(sums, ddof=1))
        return math.inf if spread == 0 else float(sums.mean()) / spread * math.sqrt(len(sums))

    def solve(
        self, start_s: float, *, with_skew: bool, first_s: float = -math.inf, last_s: float = math.inf
    ) -> Solution | None:
        """Return the fit near a lag, for the samples in a part of the time; None if it does not converge."""
        chosen = (self.times >= first_s) & (self.times <= last_s)
        times, target = self.times[chosen], self.target[chosen]
        whole = math.isinf(first_s)
        middle_s = self.middle_s if whole else float(times[0] + times[-1]) / 2
        lag_s, skew = start_s, 0.0
        for _ in range(_STEPS):
            at = times + lag_s + skew * (times - middle_s)
            inside = self.faster.covers(at)
            if np.count_nonzero(inside) < 16:
                return None
            values = self.faster.at(at[inside]) @ self._axes
            slopes = self.faster.slope_at(at[inside]) @ self._axes
            drift = (self._drift[chosen] if whole else np.column_stack([np.ones(len(times)), times - middle_s]))[inside]
            slow, _ = np.linalg.qr(drift)
            rest = target[inside] - slow @ (slow.T @ target[inside])
            residual, gains = regressed(values - slow @ (slow.T @ values), rest)
            total = float(np.sum(rest**2))
            derivative = slopes @ gains
            since = times[inside] - middle_s
            columns = [derivative, derivative * since] if with_skew else [derivative]
            base = np.column_stack([values, drift])
            scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-300
            weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residual), 1e-300))
            root = np.sqrt(weights)
            orthonormal, _ = np.linalg.qr(base * root[:, np.newaxis])
            jacobian = np.column_stack(columns) * root[:, np.newaxis]
            free = jacobian - orthonormal @ (orthonormal.T @ jacobian)
            rest = residual * root
            rest = rest - orthonormal @ (orthonormal.T @ rest)
            step, *_ = np.linalg.lstsq(free, rest, rcond=None)
            step[0] = float(np.clip(step[0], -0.1, 0.1))
            lag_s += float(step[0])
            skew += float(step[1]) if with_skew else 0.0
            if abs(step[0]) < 1e-7:
                break
        informs = float(np.linalg.norm(free[:, 0]) / max(float(np.linalg.norm(jacobian[:, 0])), 1e-300))
        correlated = correlation_time(rest)
        least = max(8.0, 4 * correlated)
        count = int(np.clip(len(rest) / least, _BLOCKS[0], _BLOCKS[1]))
        parts = np.array_split(np.arange(len(rest)), count)
        normal = np.stack([free[part].T @ free[part] for part in parts])
        score = np.stack([free[part].T @ rest[part] for part in parts])
        variance = float(np.mean(rest**2)) * max(1.0, correlated)
        error_s = math.sqrt(variance / max(float(np.sum(free[:, 0] ** 2)), 1e-300))
        r2 = 1 - float(np.sum(residual**2)) / total if total > 0 else math.nan
        return Solution(lag_s, skew, r2, normal, score, error_s, informs)

    def windows(self, lag_s: float) -> list[Window]:
        """Return the lag in windows that have enough samples and movement."""
        duration = float(self.times[-1] - self.times[0])
        count = int(min(_WINDOWS, duration // _WINDOW_S, len(self.times) // _WINDOW_SAMPLES))
        found = []
        overall = float(np.std(self.target))
        for index in range(count):
            begin = float(self.times[0]) + duration * index / count
            end = begin + duration / count
            chosen = (self.times >= begin) & (self.times <= end)
            if np.count_nonzero(chosen) < _WINDOW_SAMPLES or float(np.std(self.target[chosen])) < 0.2 * overall:
                continue
            solution = self.solve(lag_s, with_skew=False, first_s=begin, last_s=end)
            if solution and abs(solution.lag_s - lag_s) < 0.5 and solution.r2 > LEAST_R2 and solution.informs > 0.1:
                found.append(Window(begin, end, solution.lag_s, solution.error_s))
        return found


def regressed(values: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Return residual (N) and gains (K) of the target regressed on the values (N, K)."""
    # of the normal equations: a few components, of about the same size
    gains, *_ = np.linalg.lstsq(values.T @ values, values.T @ target, rcond=None)
    return np.asarray(target - values @ gains), np.asarray(gains)


def correlation_time(residual: Floats) -> float:
    """Return the integrated autocorrelation time of residuals, in samples: how many of them count as one."""
    centred = residual - residual.mean()
    total = float(np.sum(centred**2))
    if total == 0:
        return 1.0
    time = 1.0
    for shift in range(1, len(centred) // 4):
        correlation = float(np.sum(centred[shift:] * centred[:-shift])) / total
        if correlation < 0.05:
            break
        time += 2 * correlation
    return time


NORMAL_975, _NORMAL_999 = 1.959964, 3.090232


def student(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t (Abramowitz and Stegun 26.7.5), within 1 % from 3 degrees on."""
    z, v = NORMAL_975, float(freedom)
    g1 = (z**3 + z) / 4
    g2 = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    g3 = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + g1 / v + g2 / v**2 + g3 / v**3


def chi_squared_999(freedom: int) -> float:
    """Return the 99.9 % quantile of chi-squared (Wilson and Hilferty, 1931)."""
    part = 2 / (9 * freedom)
    return freedom * float((1 - part + _NORMAL_999 * math.sqrt(part)) ** 3)

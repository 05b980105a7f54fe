"""The regression of movements on each other at one lag, and how certain the lag is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from igtl_gateway.addons.sync.probe import Mask, Probe, gains_of, without
from igtl_gateway.addons.sync.signal import Floats
from igtl_gateway.addons.sync.statistics import correlation_time, student

#: R² below which two streams do not show the same movement.
LEAST_R2 = 0.5
#: Part of the derivative by the lag below which gain and offset explain it: at any lag, the fit is as good.
LEAST_INFORMATION = 0.1

_DRAWS = 2_000
_BLOCKS = (8, 20)
_WINDOW_S = 2.5
_WINDOWS = 12
_WINDOW_SAMPLES = 20
_WINDOW_SPREAD = 0.2  # of the movement in a window, relative to that of the whole time
_WINDOW_REACH_S = 0.5
_STEPS = 12
_LARGEST_STEP_S = 0.1
_HUBER = 2.5
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
        r2: explained part of the variance, of several probes the geometric mean of what is left, from 1.
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

    def half_width(self, parameter: int) -> float:
        """Return half the 95 % interval of the lag (0) or the skew (1), by bootstrap of the blocks."""
        blocks = len(self.normal)
        if blocks < _BLOCKS[0]:
            return math.inf
        generator = np.random.Generator(np.random.PCG64(1))  # fixed: equal inputs, equal interval
        drawn = generator.multinomial(blocks, np.full(blocks, 1 / blocks), _DRAWS).astype(np.float64)
        normal = np.einsum("db,bpq->dpq", drawn, self.normal)
        score = np.einsum("db,bp->dp", drawn, self.score)
        scale = np.sqrt(np.maximum(np.einsum("dpp->dp", normal), 1e-300))
        normal = normal / scale[:, :, np.newaxis] / scale[:, np.newaxis, :]
        ridge = 1e-12 * np.eye(normal.shape[1])
        moved = np.linalg.solve(normal + ridge, (score / scale)[:, :, np.newaxis])[:, :, 0] / scale
        return student(blocks - 1) * float(np.std(moved[:, parameter])) * math.sqrt(blocks / (blocks - 1))


@dataclass(frozen=True, slots=True)
class _Part:
    """One probe at a lag: weighted residuals (N) and derivatives (N, P) without gain and offset, in units of noise."""

    residual: Floats
    free: Floats
    left: float
    slope: float


class Fit:
    """The regression of the targets of probes on their faster signals, at one lag.

    Attributes:
        probes: the probes, one or several, of two clocks.
        start_s, end_s, middle_s: of the time that they cover.
    """

    def __init__(self, probes: Sequence[Probe]) -> None:
        self.probes = probes
        self.start_s = min(float(probe.times[0]) for probe in probes)
        self.end_s = max(float(probe.times[-1]) for probe in probes)
        self.middle_s = (self.start_s + self.end_s) / 2

    def advantage(self, lag_s: float, other_s: float) -> tuple[float, float]:
        """Return how much better one lag explains the data than another one, at the samples that both cover.

        Returns:
            Student's t over blocks of time, and twice the logarithm of the ratio of the likelihoods.
        """
        ends = np.linspace(self.start_s, self.end_s, _COMPARED + 1)[1:-1]
        sums, likelihood = np.zeros(_COMPARED), 0.0
        for probe in self.probes:
            both = probe.covered(lag_s) & probe.covered(other_s)
            if not both.any():
                continue
            # gains and drift of the same samples: those of fewer samples fit them better
            first, second = probe.residual(lag_s, both) ** 2, probe.residual(other_s, both) ** 2
            noise, other_noise = float(np.mean(first)), float(np.mean(second))
            if noise > 0 and other_noise > 0:
                gains = (second - first) / noise / len(first)
                sums += np.bincount(np.searchsorted(ends, probe.some[both]), gains, _COMPARED)
                likelihood += probe.freedom(lag_s, both) * math.log(other_noise / noise)
        spread = float(np.std(sums, ddof=1))
        return float(sums.mean()) / spread * math.sqrt(len(sums)) if spread > 0 else math.inf, likelihood

    def advantage_by_bands(self, lag_s: float, other_s: float) -> float:
        """Return the second one of ``advantage``, with noise of another size in each band of frequency."""
        both = [probe.covered(lag_s) & probe.covered(other_s) for probe in self.probes]
        return sum(
            probe.advantage_by_bands(lag_s, other_s, inside)
            for probe, inside in zip(self.probes, both, strict=True)
            if np.count_nonzero(inside) >= _WINDOW_SAMPLES
        )

    def solve(
        self, start_s: float, *, with_skew: bool, first_s: float = -math.inf, last_s: float = math.inf
    ) -> Solution | None:
        """Return the fit near a lag, for the samples in a part of the time; None if it does not converge."""
        chosen = [(probe.times >= first_s) & (probe.times <= last_s) for probe in self.probes]
        middle_s = self.middle_s if math.isinf(first_s) else (first_s + last_s) / 2
        lag_s, skew = start_s, 0.0
        for _ in range(_STEPS):
            parts = [
                part
                for probe, some in zip(self.probes, chosen, strict=True)
                if (part := _part(probe, some, lag_s, skew, middle_s, with_skew, whole=math.isinf(first_s)))
            ]
            if not parts:
                return None
            free = np.concatenate([part.free for part in parts])
            step, *_ = np.linalg.lstsq(free, np.concatenate([part.residual for part in parts]), rcond=None)
            step[0] = float(np.clip(step[0], -_LARGEST_STEP_S, _LARGEST_STEP_S))
            lag_s += float(step[0])
            skew += float(step[1]) if with_skew else 0.0
            if abs(step[0]) < 1e-7:
                break
        slope = math.sqrt(sum(part.slope for part in parts))
        informs = float(np.linalg.norm(free[:, 0])) / max(slope, 1e-300)
        correlated = [correlation_time(part.residual) for part in parts]
        blocks = [block for part, time in zip(parts, correlated, strict=True) for block in _blocks(part, time)]
        normal, score = (np.stack([block[index] for block in blocks]) for index in range(2))
        noise = sum(
            float(np.mean(part.residual**2)) * max(1.0, time) * float(np.sum(part.free[:, 0] ** 2))
            for part, time in zip(parts, correlated, strict=True)
        )
        error_s = math.sqrt(noise) / max(float(np.sum(free[:, 0] ** 2)), 1e-300)
        r2 = 1 - float(np.prod([part.left for part in parts])) ** (1 / len(parts))
        return Solution(lag_s, skew, r2, normal, score, error_s, informs)

    def windows(self, lag_s: float) -> tuple[list[Window], int]:
        """Return the lag in windows that have enough samples and movement, and the number of windows that have."""
        duration = self.end_s - self.start_s
        samples = max(len(probe.times) for probe in self.probes)
        count = int(min(_WINDOWS, duration // _WINDOW_S, samples // _WINDOW_SAMPLES))
        found, moving = [], 0
        for index in range(count):
            begin = self.start_s + duration * index / count
            end = begin + duration / count
            if not any(_moves(probe, begin, end) for probe in self.probes):
                continue
            moving += 1
            solution = self.solve(lag_s, with_skew=False, first_s=begin, last_s=end)
            if (
                solution
                and abs(solution.lag_s - lag_s) < _WINDOW_REACH_S
                and solution.r2 > LEAST_R2
                and solution.informs > LEAST_INFORMATION
            ):
                found.append(Window(begin, end, solution.lag_s, solution.error_s))
        return found, moving


def _moves(probe: Probe, begin_s: float, end_s: float) -> bool:
    chosen = (probe.times >= begin_s) & (probe.times <= end_s)
    enough = np.count_nonzero(chosen) >= _WINDOW_SAMPLES
    return bool(enough and np.std(probe.target[chosen]) >= _WINDOW_SPREAD * np.std(probe.target))


def _part(
    probe: Probe, chosen: Mask, lag_s: float, skew: float, middle_s: float, with_skew: bool, *, whole: bool
) -> _Part | None:
    """Linearise one probe at a lag; None with too few samples."""
    times, target = probe.times[chosen], probe.target[chosen]
    at = times + probe.direction * (lag_s + skew * (times - middle_s))
    inside = probe.faster.covers(at) if whole else probe.faster.covers_well(at)
    if np.count_nonzero(inside) < 16:
        return None
    values = probe.faster.at(at[inside]) @ probe.axes
    slopes = probe.direction * (probe.faster.slope_at(at[inside]) @ probe.axes)
    drift = probe.drift[chosen] if whole else np.column_stack([np.ones(len(times)), times - middle_s])
    drift = drift[inside]
    rest, moved = without(drift, target[inside]), without(drift, values)
    gains = gains_of(moved, rest)
    residual = rest - moved @ gains
    derivative = slopes @ gains
    since = times[inside] - middle_s
    total = float(np.sum(rest**2))
    scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-9 * math.sqrt(total / len(rest)), 1e-150)
    weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residual), 1e-300))
    root = np.sqrt(weights)[:, np.newaxis]
    base = np.column_stack([values, drift]) * root
    columns = np.column_stack([derivative, derivative * since] if with_skew else [derivative]) * root
    weighted = residual * root[:, 0]
    left = float(np.sum(residual**2)) / total if total > 0 else math.nan
    slope = float(np.sum((columns[:, 0] / scale) ** 2))
    return _Part(without(base, weighted) / scale, without(base, columns) / scale, left, slope)


def _blocks(part: _Part, correlated: float) -> list[tuple[Floats, Floats]]:
    """JᵀWJ and JᵀWr of blocks of time, longer than the residuals are correlated."""
    count = int(np.clip(len(part.residual) / max(8.0, 4 * correlated), *_BLOCKS))
    return [
        (part.free[block].T @ part.free[block], part.free[block].T @ part.residual[block])
        for block in np.array_split(np.arange(len(part.residual)), count)
    ]

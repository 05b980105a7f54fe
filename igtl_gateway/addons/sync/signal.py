"""The movement that a stream shows, as numbers; and what one can see of it before it is compared with another."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S

Floats = npt.NDArray[np.float64]

#: Values from here on are no movement; their fourth powers would not be finite.
LARGEST = 1e60

_MOST_GRID = 1 << 20  # samples of a grid: stamps may lie, and be centuries apart
_POWER = 0.98  # part of the power of a movement that its bandwidth has to have
_MARGIN = 1.5
GAP = 3.0  # periods without a sample from which on a signal is unknown
_EDGE = 2.0  # standard deviations of the filter: nearer to an end, its result is off by more than 5 % of them
_REFERENCE_HZ = 1.5  # cut-off above which nothing counts as the movement of a reference: noise does not move
_HYSTERESIS = 0.2  # part of the range of a movement that a reversal has to exceed
_ALIKE = 0.97  # autocorrelation from which on a movement repeats itself


@dataclass(frozen=True, slots=True)
class Signal:
    """What moves in a stream.

    Attributes:
        times_ns: int64 (N,), UTC ns, increasing.
        values: float64 (N, K), K components in one unit.
        name: of the stream.
        unit: of the values.
        is_stamped: whether the times are stamps of the sender; otherwise they are gateway times.
    """

    times_ns: npt.NDArray[np.int64]
    values: Floats
    name: str = ""
    unit: str = ""
    is_stamped: bool = True

    @classmethod
    def of(
        cls, times_ns: npt.ArrayLike, values: npt.ArrayLike, name: str = "", unit: str = "", *, is_stamped: bool = True
    ) -> Signal:
        """Return the signal of samples in any order: sorted, with one for each time.

        Samples with a value that is not finite, or not below 1e60, are left out."""
        times = np.asarray(times_ns, np.int64)
        array = np.asarray(values, np.float64)
        array = array[:, np.newaxis] if array.ndim == 1 else array
        good = (np.abs(array) < LARGEST).all(axis=1)
        order = np.argsort(times[good], kind="stable")
        times, array = times[good][order], array[good][order]
        first = np.ones(len(times), bool)
        first[1:] = times[1:] > times[:-1]
        return cls(times[first], array[first], name, unit, is_stamped)

    @property
    def period_s(self) -> float:
        """The median time between samples."""
        return float(np.median(np.diff(self.times_ns))) / NS_PER_S if len(self.times_ns) > 1 else math.inf


@dataclass(frozen=True, slots=True)
class Filtered:
    """A signal, low-pass filtered without phase, on a uniform grid.

    Attributes:
        times: of the samples, s after the origin.
        noise: standard deviation of what the filter removed.
        step_s: of the grid, which begins at the first sample.
        grid: (G, K).
        slope: derivative of the grid, per second.
        gap_s: from here on, the time between samples is a gap.
        edge_s: so near to its ends the signal is less exact: the filter has samples on one side only.
    """

    times: Floats
    noise: float
    step_s: float
    grid: Floats
    slope: Floats
    gap_s: float
    edge_s: float

    @classmethod
    def of(cls, signal: Signal, origin_ns: int, cut_off_hz: float) -> Filtered:
        times = (signal.times_ns - origin_ns) / NS_PER_S
        period = signal.period_s
        sigma_s = 1 / (2 * math.pi * cut_off_hz)
        step_s = _step(min(period, sigma_s) / 2, float(times[-1] - times[0]))
        count = int((times[-1] - times[0]) / step_s) + 1
        at = times[0] + step_s * np.arange(count)
        raw = np.stack([np.interp(at, times, column) for column in signal.values.T], axis=1)
        grid = _smoothed(raw, sigma_s / step_s)
        smooth = np.stack([np.interp(times, at, column) for column in grid.T], axis=1)
        noise = float(np.sqrt(np.mean((signal.values - smooth) ** 2)))
        return cls(times, noise, step_s, grid, np.gradient(grid, step_s, axis=0), GAP * period, _EDGE * sigma_s)

    def covers(self, at: Floats) -> npt.NDArray[np.bool_]:
        """Return at which times (s) the signal is known: between samples that are not far apart."""
        after = np.searchsorted(self.times, at, side="left")
        inside = (after > 0) & (after < len(self.times))
        right = np.clip(after, 1, len(self.times) - 1)
        on_sample = (after < len(self.times)) & (self.times[np.clip(after, 0, len(self.times) - 1)] == at)
        return np.asarray(on_sample | (inside & (self.times[right] - self.times[right - 1] <= self.gap_s)))

    def covers_well(self, at: Floats) -> npt.NDArray[np.bool_]:
        """Return at which times (s) the signal is known as exactly as anywhere: not near its ends."""
        return np.asarray(self.covers(at) & (at >= self.times[0] + self.edge_s) & (at <= self.times[-1] - self.edge_s))

    def at(self, at: Floats) -> Floats:
        """Return the values (N, K) at these times."""
        return self._interpolated(self.grid, at)

    def slope_at(self, at: Floats) -> Floats:
        """Return the derivatives (N, K) at these times, per second."""
        return self._interpolated(self.slope, at)

    def _interpolated(self, grid: Floats, at: Floats) -> Floats:
        place = np.clip((at - self.times[0]) / self.step_s, 0, len(grid) - 1)
        left = np.minimum(place.astype(np.intp), len(grid) - 2)
        part = (place - left)[:, np.newaxis]
        return np.asarray((1 - part) * grid[left] + part * grid[left + 1])

    def is_still(self, at: Floats) -> bool:
        """Return whether nothing moves at these times: less than what the filter removes as noise."""
        values = self.at(at)
        spread = float(np.sqrt(np.sum(np.var(values, axis=0))))
        size = float(np.max(np.abs(values))) if values.size else 0.0
        return spread <= max(0.5 * self.noise, 1e-9 * size)


def _smoothed(values: Floats, sigma: float) -> Floats:
    """Return values (N, K) convolved with a Gaussian of this standard deviation in samples; shorter at the ends."""
    count = len(values)
    reach = min(math.ceil(3 * sigma), count - 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    size = 1 << (count + 2 * reach).bit_length()
    spectrum, padded = np.fft.rfft(kernel, size), np.zeros(size)

    def sums(column: Floats) -> Floats:
        padded[:count] = column
        found = np.fft.rfft(padded)
        found *= spectrum
        return np.asarray(np.fft.irfft(found, size)[reach : reach + count])

    # column by column: a column of a table has its numbers far apart, which takes twice as long
    weights, means = sums(np.ones(count)), values.mean(axis=0)
    smooth = np.empty_like(values)
    for column, mean in enumerate(means):
        smooth[:, column] = sums(values[:, column] - mean) / weights + mean
    return smooth


def bandwidth(signal: Signal) -> float:
    """Return the frequency that the movement stays below, Hz: that with nearly all of the power above the noise."""
    times = (signal.times_ns - signal.times_ns[0]) / NS_PER_S
    period = _step(signal.period_s, float(times[-1]))
    at = np.arange(0.0, times[-1], period)
    values = np.stack([np.interp(at, times, column) for column in signal.values.T], axis=1)
    values = (values - values.mean(axis=0)) * np.hanning(len(at))[:, np.newaxis]
    power = np.sum(np.abs(np.fft.rfft(values, axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(at), period)
    floor = float(np.median(power[len(power) // 2 :])) / math.log(2)  # median of an exponential distribution
    above = np.cumsum(np.maximum(power - floor, 0.0)[: len(power) // 2])
    place = int(np.searchsorted(above, _POWER * above[-1]))
    return _MARGIN * float(frequencies[place])


def _step(wanted_s: float, span_s: float) -> float:
    """The step of a grid: the wanted one, or a longer one for a grid that would be too large."""
    return max(wanted_s, span_s / _MOST_GRID, 1e-9)


def moves(signal: Signal) -> bool:
    """Return whether a signal moves by more than its noise, and turns round."""
    if len(signal.times_ns) < 2:
        return False
    filtered = Filtered.of(signal, int(signal.times_ns[0]), _REFERENCE_HZ)
    values = filtered.at(filtered.times)
    return not filtered.is_still(filtered.times) and reversals(main_component(values)) > 0


def main_component(values: Floats) -> Floats:
    """Return the values (N, K) on the axis of their largest variance (N)."""
    centred = values - values.mean(axis=0)
    if centred.shape[1] == 1:
        return np.asarray(centred[:, 0])
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(centred @ axes[0])


def reversals(values: Floats) -> int:
    """Return how often a movement (N) turns round, by more than a part of its range."""
    least = _HYSTERESIS * float(np.ptp(values))
    count, direction, extreme = 0, 0, float(values[0])
    for value in values.tolist():
        if (direction >= 0 and value > extreme) or (direction <= 0 and value < extreme):
            if direction == 0 and abs(value - float(values[0])) < least:
                continue
            direction = direction or (1 if value > extreme else -1)
            extreme = value
        elif direction and abs(value - extreme) > least:
            direction, extreme, count = -direction, value, count + 1
    return count


def period(times: Floats, values: Floats) -> float:
    """Return the period of a movement that repeats itself throughout, s; NaN if it does not."""
    step = _step(float(np.median(np.diff(times))), float(times[-1] - times[0]))
    grid = np.interp(np.arange(times[0], times[-1], step), times, values)
    grid = grid - grid.mean()
    count = len(grid)
    size = 1 << (2 * count - 1).bit_length()
    spectrum = np.fft.rfft(grid, size)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size)[: count // 2]
    squares = np.concatenate([[0.0], np.cumsum(grid**2)])
    shift = np.arange(len(products))
    energy = np.sqrt((squares[count] - squares[shift]) * squares[count - shift])
    likeness = products / np.maximum(energy, 1e-300)
    below = np.flatnonzero(likeness < 0.5)
    if not len(below):
        return math.nan
    later = likeness[below[0] :]
    if not len(later) or float(later.max()) < _ALIKE:
        return math.nan
    # the first of the peaks: at multiples of the period they are as high
    first = int(np.argmax(later >= _ALIKE * float(later.max())))
    while first + 1 < len(later) and later[first + 1] > later[first]:
        first += 1
    place = int(below[0]) + first
    left, top, right = (float(likeness[min(place + by, len(likeness) - 1)]) for by in (-1, 0, 1))
    bend = left - 2 * top + right  # of the parabola through the three: its top is between the samples
    return (place + ((left - right) / (2 * bend) if bend < 0 else 0.0)) * step

"""Steps of quantised depth: the distance between the values of a sensor, and its effect on the errors.

A 16-bit depth image has integer millimetres.  Stereo cameras and structured light have steps of disparity, which grow
with the square of the distance: Δz = z² Δd / (f b).  In both cases many readings share few values, so the step around
each depth is estimated from the values.

A step q adds a variance of q² / 12 to a reading.  This part does not change from cloud to cloud if the other noise is
small, and it does not average out over pixels at the same depth.  With Gaussian noise σ before the rounding, the mean
of many readings at depth z has the bias

    B(z) = Σ_k (−1)^k q / (π k) · exp(−2 π² k² σ² / q²) · sin(2 π k z / q)

(Widrow and Kollár, *Quantization Noise*, Cambridge University Press 2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

_MAX_READINGS = 400_000  # readings that the steps are estimated from
_SAME = 4e-7  # relative difference of one value after rounding to single precision
_SHARED = 4.0  # minimum number of readings for each value of quantised depth
_BETWEEN = 0.1  # maximum share of readings between the steps
_AROUND = 8  # gaps to each side that are averaged
_HOLE = 2.5  # median gaps; a larger gap contains values that no reading happens to have
_KNOWN_STEPS_M = (1e-3, 1e-4)  # steps that are assumed if all readings are equal: those of common sensors
_HARMONICS = 40
_ACCURACY = 0.98  # relative accuracy of a measured variance

UNIFORM_VARIANCE = 1 / 12  # of a number that is uniform between −½ and ½


@dataclass(frozen=True, slots=True)
class Steps:
    """The step of depth at each depth.

    Attributes:
        depths: (n,) ascending, metres; empty if depth is continuous.
        sizes: (n,) the step at these depths, metres.
    """

    depths: Array
    sizes: Array

    def at(self, depths: Array) -> Array:
        """Return the steps at these depths, metres; 0 if depth is continuous, and for NaN."""
        if not len(self.depths):
            return np.zeros(np.shape(depths))
        sizes: Array = np.interp(np.nan_to_num(depths), self.depths, self.sizes)
        return np.where(np.isfinite(depths), sizes, 0.0)

    @property
    def grow(self) -> float:
        """Exponent with which the step grows with depth: 0 for steps of depth, 2 for steps of disparity."""
        known = self.sizes > 0
        if np.count_nonzero(known) < 3:
            return 0.0
        x, y = np.log(self.depths[known]), np.log(self.sizes[known])
        x, y = x - x.mean(), y - y.mean()
        return float((x * y).sum() / max((x * x).sum(), 1e-12))


CONTINUOUS = Steps(np.zeros(0), np.zeros(0))


def steps_of(depths: Array) -> Steps:
    """Return the steps of readings (metres, any shape); ``CONTINUOUS`` if they are not quantised."""
    values = depths[np.isfinite(depths)]
    values = np.sort(values[:: max(-(-len(values) // _MAX_READINGS), 1)].astype(np.float64))
    if not len(values):
        return CONTINUOUS
    first = np.flatnonzero(np.diff(values, prepend=-np.inf) > _SAME * values)
    last = np.append(first[1:], len(values)) - 1
    number = last - first + 1
    narrow = values[last] - values[first] <= 2 * _SAME * values[last]
    if number[narrow].sum() < (1 - _BETWEEN) * len(values):
        return CONTINUOUS
    levels = (values[first] + values[last])[narrow] / 2
    number = number[narrow]
    median = np.sort(np.repeat(number, number))[number.sum() // 2]  # over the readings: how many share its value
    if median < _SHARED:
        return CONTINUOUS
    levels = levels[number >= max(median / 50, 2)]  # next to rarer values are values that no reading happens to have
    if len(levels) < 2:
        return _of_one(levels)
    gaps = np.diff(levels)
    sizes = _smoothed(gaps)
    return Steps((levels[1:] + levels[:-1]) / 2, sizes)


def _of_one(levels: Array) -> Steps:
    """Return the step if all readings are equal: a common one, if the value is a multiple of it."""
    for size in _KNOWN_STEPS_M:
        if len(levels) and abs(levels[0] / size - round(levels[0] / size)) < 1e-3:
            return Steps(levels, np.array([size]))
    return CONTINUOUS


def _smoothed(gaps: Array) -> Array:
    """Return the (n,) means of the gaps around each gap, without holes."""
    padded = np.pad(gaps, _AROUND, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    medians = np.nanmedian(windows, axis=1)[:, None]
    kept = windows <= _HOLE * medians  # False for NaN
    sizes: Array = np.where(kept, windows, 0.0).sum(axis=1) / kept.sum(axis=1)
    return sizes


def _rounded_variance() -> tuple[Array, Array]:
    """Return a table from the variance before rounding to that of rounded readings about their mean, both in steps².

    The second is averaged over all positions in a step.
    """
    sigma = np.linspace(0, 1.0, 401)
    order = np.arange(1, _HARMONICS + 1)[:, None]
    constant = 0.5 * (np.exp(-4 * np.pi**2 * order**2 * sigma**2) / (np.pi * order) ** 2).sum(axis=0)
    constant[0] = UNIFORM_VARIANCE
    return sigma**2, np.maximum.accumulate(sigma**2 + UNIFORM_VARIANCE - constant)


_VARIANCE, _OBSERVED = _rounded_variance()


def before_rounding(variance: Array, step: Array) -> Array:
    """Return the variance of the noise before rounding, from the variance between readings (m²) and the step (m)."""
    square = np.where(step > 0, step, 1.0) ** 2
    share = variance / square
    inside = np.where(share < _OBSERVED[-1], np.interp(share, _OBSERVED, _VARIANCE), share - UNIFORM_VARIANCE)
    return np.where(step > 0, square * inside, variance)


def share_before_rounding(observed: Array, phase: Array) -> float:
    """Return σ before rounding, in steps, of a complete image; the smallest possible value if it is ambiguous.

    Over all positions in a step the observed variance determines σ.  If all readings are at one position it might not:
    for readings that alternate between two values, the ratio of the two is the same for any small σ.

    Args:
        observed: (n,) variance between readings, in steps², mean over some pixels.
        phase: (n,) mean reading of these pixels, in steps.
    """
    known = np.isfinite(observed) & np.isfinite(phase)
    if not known.any():
        return 0.0
    variance = float(observed[known].mean())
    ordered = np.sort(phase[known])
    low, high = ordered[len(ordered) // 20], ordered[-1 - len(ordered) // 20]
    if high - low >= 1.0:
        return float(np.sqrt(before_rounding(np.array(variance), np.array(1.0))))
    middle = float(phase[known].mean())
    off = abs(middle - round(middle))
    if off * (1 - off) >= _ACCURACY * variance:  # two values
        return 0.0
    for sigma in np.arange(0.0, 1.0, 0.02):
        mean, spread = _at_one_place(float(sigma))
        if np.interp(off, mean, spread) >= _ACCURACY * variance:
            return float(sigma)
    return float(np.sqrt(variance))


def _at_one_place(sigma: float) -> tuple[Array, Array]:
    """Return mean and variance of rounded readings, in steps, for positions from the centre of a step to its edge."""
    places = np.linspace(0.0, 0.5, 26)
    edges = np.arange(-4, 5) + 0.5  # σ below 1
    below = np.array(
        [[0.5 + 0.5 * erf((edge - place) / (sigma * sqrt(2) + 1e-9)) for place in places] for edge in edges]
    )
    share = np.diff(below, axis=0)
    values = np.arange(-3, 5)[:, None]
    mean = (share * values).sum(axis=0)
    return mean, (share * values**2).sum(axis=0) - mean**2


def bias(step: Array, sigma: Array, phase: Array, weights: Array, shifts: Array) -> Array:
    """Return the bias of a weighted sum of many readings by rounding, for several shifts of the steps.

    Args:
        step, sigma: (n,) step and noise before rounding of each reading, metres.
        phase: (n,) depth of each reading, in steps.
        weights: (n,) of the sum.
        shifts: (m,) shifts of the steps, in steps.

    Returns:
        (m,) biases, metres.
    """
    found = np.zeros(len(shifts))
    ratio = (sigma / step) ** 2
    for k in range(1, 7):
        size = weights * step / (np.pi * k) * np.exp(-2 * np.pi**2 * k**2 * ratio)
        angle = 2 * np.pi * k * phase
        real, imaginary = (size * np.cos(angle)).sum(), (size * np.sin(angle)).sum()
        turn = 2 * np.pi * k * shifts
        found += (-1) ** k * (imaginary * np.cos(turn) + real * np.sin(turn))
    return found

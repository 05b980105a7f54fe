"""Steps of quantised depth: how far apart the values are that a sensor can give, and what that does to its errors.

A 16-bit depth image has whole millimetres; a stereo camera, and structured light, have steps of disparity, which grow
with the square of the distance: Δz = z² Δd / (f b).  Both show as few distinct values that are shared by many
readings, so the step is read off the values themselves, around each depth.

A step of q adds q / √12 to the standard deviation of a reading.  That part does not change from cloud to cloud
where the rest of the noise is small, and it does not average out over pixels that look at the same depth.  With
Gaussian noise σ before the rounding, the mean of many readings at depth z is still off by the Fourier series

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

_MOST_READINGS = 400_000  # that steps are looked for in
_SAME = 4e-7  # relative: values so close are one value that went through single precision
_SHARED = 4.0  # readings for each value, from which on values are steps
_SMEARED = 0.1  # share of readings that may lie between the steps
_AROUND = 8  # steps to each side that a step is the mean of
_HOLE = 2.5  # usual steps; what is further apart has values in between that nothing happened to have
_WHOLE_M = (1e-3, 1e-4)  # where all readings are equal: the steps that sensors have
_HARMONICS = 40
_TOLD = 0.98  # of a variance: no figure is better than this

UNIFORM_VARIANCE = 1 / 12  # of a number between −½ and ½


@dataclass(frozen=True, slots=True)
class Steps:
    """The step of depth at each depth.

    Attributes:
        depths: (n,) ascending, metres; none where depth is continuous.
        sizes: (n,) the step there, metres.
    """

    depths: Array
    sizes: Array

    def at(self, depths: Array) -> Array:
        """The step at some depths, metres; 0 where depth is continuous, and of NaN."""
        if not len(self.depths):
            return np.zeros(np.shape(depths))
        sizes: Array = np.interp(np.nan_to_num(depths), self.depths, self.sizes)
        return np.where(np.isfinite(depths), sizes, 0.0)

    @property
    def grow(self) -> float:
        """Exponent with which the step grows with depth: 0 for a grid of depths, 2 for one of disparities."""
        known = self.sizes > 0
        if np.count_nonzero(known) < 3:
            return 0.0
        x, y = np.log(self.depths[known]), np.log(self.sizes[known])
        x, y = x - x.mean(), y - y.mean()
        return float((x * y).sum() / max((x * x).sum(), 1e-12))


CONTINUOUS = Steps(np.zeros(0), np.zeros(0))


def steps_of(depths: Array) -> Steps:
    """The steps of readings of any shape, metres; ``CONTINUOUS`` where there are none."""
    values = depths[np.isfinite(depths)]
    values = np.sort(values[:: max(-(-len(values) // _MOST_READINGS), 1)].astype(np.float64))
    if not len(values):
        return CONTINUOUS
    first = np.flatnonzero(np.diff(values, prepend=-np.inf) > _SAME * values)
    last = np.append(first[1:], len(values)) - 1
    number = last - first + 1
    narrow = values[last] - values[first] <= 2 * _SAME * values[last]
    if number[narrow].sum() < (1 - _SMEARED) * len(values):
        return CONTINUOUS
    levels = (values[first] + values[last])[narrow] / 2
    number = number[narrow]
    usual = np.sort(np.repeat(number, number))[number.sum() // 2]  # readings that share the value of a usual reading
    if usual < _SHARED:
        return CONTINUOUS
    levels = levels[number >= max(usual / 50, 2)]  # what is rarer has neighbours that nothing happened to have
    if len(levels) < 2:
        return _of_one(levels)
    gaps = np.diff(levels)
    sizes = _smoothed(gaps)
    return Steps((levels[1:] + levels[:-1]) / 2, sizes)


def _of_one(levels: Array) -> Steps:
    """All readings are equal: a step that sensors have, and of which the value is a multiple."""
    for size in _WHOLE_M:
        if len(levels) and abs(levels[0] / size - round(levels[0] / size)) < 1e-3:
            return Steps(levels, np.array([size]))
    return CONTINUOUS


def _smoothed(gaps: Array) -> Array:
    """(n,) mean of the gaps around each, without holes."""
    padded = np.pad(gaps, _AROUND, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    usual = np.nanmedian(windows, axis=1)[:, None]
    kept = windows <= _HOLE * usual  # NaN is not
    sizes: Array = np.where(kept, windows, 0.0).sum(axis=1) / kept.sum(axis=1)
    return sizes


def _changing() -> tuple[Array, Array]:
    """For σ in steps: the variance of the rounded value around its own mean, averaged over all places in a step."""
    sigma = np.linspace(0, 1.0, 401)
    order = np.arange(1, _HARMONICS + 1)[:, None]
    constant = 0.5 * (np.exp(-4 * np.pi**2 * order**2 * sigma**2) / (np.pi * order) ** 2).sum(axis=0)
    constant[0] = UNIFORM_VARIANCE
    return sigma**2, np.maximum.accumulate(sigma**2 + UNIFORM_VARIANCE - constant)


_VARIANCE, _SEEN = _changing()


def before_rounding(variance: Array, step: Array) -> Array:
    """Variance of the noise before the rounding, of the variance that is seen from reading to reading."""
    square = np.where(step > 0, step, 1.0) ** 2
    share = variance / square
    inside = np.where(share < _SEEN[-1], np.interp(share, _SEEN, _VARIANCE), share - UNIFORM_VARIANCE)
    return np.where(step > 0, square * inside, variance)


def share_before_rounding(seen: Array, phase: Array) -> float:
    """σ before the rounding, in steps, of a whole picture; the least that fits where the picture does not tell.

    Over all places in a step the variance that is seen tells σ.  Where everything lies at one place it may not: of
    what flips between two values the share of flips is the same for any small σ.

    Args:
        seen: (n,) variance from reading to reading, in steps², mean over some pixels.
        phase: (n,) their mean reading, in steps.
    """
    known = np.isfinite(seen) & np.isfinite(phase)
    if not known.any():
        return 0.0
    variance = float(seen[known].mean())
    ordered = np.sort(phase[known])
    low, high = ordered[len(ordered) // 20], ordered[-1 - len(ordered) // 20]
    if high - low >= 1.0:
        return float(np.sqrt(before_rounding(np.array(variance), np.array(1.0))))
    middle = float(phase[known].mean())
    off = abs(middle - round(middle))
    if off * (1 - off) >= _TOLD * variance:  # two values
        return 0.0
    for sigma in np.arange(0.0, 1.0, 0.02):
        mean, spread = _at_one_place(float(sigma))
        if np.interp(off, mean, spread) >= _TOLD * variance:
            return float(sigma)
    return float(np.sqrt(variance))


def _at_one_place(sigma: float) -> tuple[Array, Array]:
    """Mean and variance of rounded readings, in steps, for places from the middle of a step to its edge."""
    places = np.linspace(0.0, 0.5, 26)
    edges = np.arange(-4, 5) + 0.5  # σ below 1
    below = np.array(
        [[0.5 + 0.5 * erf((edge - place) / (sigma * sqrt(2) + 1e-9)) for place in places] for edge in edges]
    )
    share = np.diff(below, axis=0)
    values = np.arange(-3, 5)[:, None]
    mean = (share * values).sum(axis=0)
    return mean, (share * values**2).sum(axis=0) - mean**2


def bias(step: Array, sigma: Array, phase: Array, weights: Array, turns: Array) -> Array:
    """What rounding does to a weighted sum of many readings, for several places of the grid.

    Args:
        step, sigma: (n,) of each reading, metres; ``sigma`` before the rounding.
        phase: (n,) depth of each reading in steps.
        weights: (n,).
        turns: (m,) shifts of the grid, in steps.

    Returns:
        (m,) metres.
    """
    found = np.zeros(len(turns))
    ratio = (sigma / step) ** 2
    for k in range(1, 7):
        size = weights * step / (np.pi * k) * np.exp(-2 * np.pi**2 * k**2 * ratio)
        angle = 2 * np.pi * k * phase
        real, imaginary = (size * np.cos(angle)).sum(), (size * np.sin(angle)).sum()
        turn = 2 * np.pi * k * turns
        found += (-1) ** k * (imaginary * np.cos(turn) + real * np.sin(turn))
    return found

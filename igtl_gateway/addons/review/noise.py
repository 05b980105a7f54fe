"""Depth noise of each pixel, from the changes of its depth from cloud to cloud, or from pixel to pixel.

Both are differences between readings of one position, so the shape of the tissue cancels out.  Both are pooled over
the pixels around, because a dozen clouds determine the noise of a single pixel only to ±20 %.  Differences far larger
than the noise around them (a passing tool, a gross error) are left out.

If depth is quantised, most differences are 0 and the others are at least one step, so their median has no
information.  In this case all differences below two steps count, and the part that rounding hides is added
(``steps``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review.steps import UNIFORM_VARIANCE, before_rounding

Array = npt.NDArray[Any]

#: Ratio of the standard deviation of a normal number to the median of its absolute value.
MAD = 1.4826
_BLOCK = 10  # pixels: side of the squares for the first estimate
_POOL = 2  # pixels to each side: 5 × 5 are pooled
_POOL_OF_STEPS = 5  # for quantised depth: its changes depend on the position between two steps
_CUT = 3.5  # standard deviations beyond which a difference is not noise
_CUT_SHRINKS = 0.9969  # standard deviation of a normal number without the tails beyond the cut
_ROUNDS = 3
_ENOUGH = 12  # minimum number of differences for a result
_COARSE = 0.1  # share of equal readings from which depth counts as quantised: steps of about three deviations
_REPEATED = 0.4  # share of equal readings that continuous depth does not reach by chance: clouds were sent twice
_LEAST_STEPS = 0.55  # minimum of the standard deviation, in steps: keeps differences of nearly two steps


def between_clouds(depths: Array, step: Array | float = 0.0) -> Array:
    """Return the (height, width) standard deviation of depth from the differences of successive clouds, metres.

    The median change of all pixels is subtracted: breathing is not noise.  The constant part of the rounding error is
    not included: ``total_noise`` adds it.

    Args:
        depths: (clouds, height, width) metres, NaN without a depth; two clouds or more.
        step: (height, width) step of quantised depth, metres; 0 if depth is continuous.
    """
    changes = np.diff(depths.astype(np.float64), axis=0) / np.sqrt(2.0)
    for number, change in enumerate(changes):
        known = change[np.isfinite(change)]
        if known.size:
            changes[number] -= np.median(known)
    return _pooled(changes, step)


def within_clouds(depths: Array, step: Array | float = 0.0) -> Array:
    """Return the (height, width) standard deviation of depth from second differences within each cloud, metres.

    The differences along rows and columns contain only what differs between neighbours: the result is a lower bound if
    the noise is correlated over more than a pixel.

    Args:
        depths: (clouds, height, width) metres, NaN without a depth.
        step: (height, width) step of quantised depth, metres; 0 if depth is continuous.
    """
    depths = depths.astype(np.float64)
    bends = np.full((2, *depths.shape), np.nan)
    bends[0, :, 1:-1] = (depths[:, :-2] - 2 * depths[:, 1:-1] + depths[:, 2:]) / np.sqrt(6.0)
    bends[1, :, :, 1:-1] = (depths[:, :, :-2] - 2 * depths[:, :, 1:-1] + depths[:, :, 2:]) / np.sqrt(6.0)
    return _pooled(bends.reshape(-1, *depths.shape[1:]), step)


def total_noise(changing: Array, step: Array) -> Array:
    """Return the standard deviation of readings from the true depth, from that of the changes between readings, metres.

    With the step q and the noise σ before the rounding it is √(σ² + q² / 12): noise and rounding error are
    uncorrelated over all positions in a step.
    """
    deviation: Array = np.sqrt(before_rounding(changing**2, step) + UNIFORM_VARIANCE * step**2)
    return deviation


def deviation(values: Array) -> float:
    """Return the standard deviation about 0 without gross errors; NaN without finite values."""
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return float("nan")
    guess = MAD * float(np.median(size))
    kept = size[size <= _CUT * guess]
    return float(np.sqrt((kept**2).mean())) / _CUT_SHRINKS


def _pooled(differences: Array, step: Array | float) -> Array:
    """Return the root mean square of (n, height, width) differences over the pixels around, without gross errors."""
    size = np.abs(differences)
    unchanged = size <= 1e-3 * np.asarray(step)
    equal = int(np.count_nonzero(unchanged)) / max(int(np.count_nonzero(np.isfinite(size))), 1)
    coarse = bool(np.any(step)) and equal > _COARSE
    least = _LEAST_STEPS * np.asarray(step) * coarse
    reach = _POOL_OF_STEPS if coarse else _POOL
    if not coarse and equal > _REPEATED:
        size = np.where(unchanged, np.nan, size)
    sigma = _first_estimate(size)
    for _ in range(_ROUNDS):
        kept = size <= _CUT * np.maximum(sigma, least)  # False for NaN
        squares = _box(np.where(kept, size, 0.0) ** 2, reach)
        number = _box(kept.astype(np.float64), reach)
        enough = number > _ENOUGH - 0.5
        found = np.sqrt(np.where(enough, np.maximum(squares, 0.0) / np.where(enough, number, 1.0), np.nan))
        sigma = np.where(enough, found / _CUT_SHRINKS, np.nan)
    return sigma


def _first_estimate(size: Array) -> Array:
    """Return the (height, width) standard deviation from the medians of blocks of pixels."""
    count, height, width = size.shape
    rows, columns = -(-height // _BLOCK), -(-width // _BLOCK)
    padded = np.full((count, rows * _BLOCK, columns * _BLOCK), np.inf)
    padded[:, :height, :width] = np.where(np.isfinite(size), size, np.inf)
    blocks = padded.reshape(count, rows, _BLOCK, columns, _BLOCK).transpose(1, 3, 0, 2, 4).reshape(rows * columns, -1)
    blocks = np.sort(blocks, axis=1)
    number = np.isfinite(blocks).sum(axis=1)
    medians = MAD * blocks[np.arange(len(blocks)), np.maximum(number - 1, 0) // 2]
    medians = np.where(number > 0, medians, np.nan).reshape(rows, columns)
    return np.repeat(np.repeat(medians, _BLOCK, axis=0), _BLOCK, axis=1)[:height, :width]


def _box(values: Array, reach: int) -> Array:
    """Return the (height, width) sums over all (n, height, width) values in the square around each pixel."""
    total: Array = values.sum(axis=0)
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (reach + 1, reach)
        running = np.cumsum(np.pad(total, padding), axis=axis)
        length, side = total.shape[axis], 2 * reach + 1
        total = np.take(running, range(side, side + length), axis) - np.take(running, range(length), axis)
    return total

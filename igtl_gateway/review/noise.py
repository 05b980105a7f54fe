"""Depth noise of every pixel, from how its depth changes from cloud to cloud, or from pixel to pixel.

Both are differences of readings of one place, so what is being looked at falls out, and both are pooled over the
pixels around: a dozen clouds alone would tell a pixel's noise to ±20 % only.  What changes by far more than the
noise around it (the tool that comes by, a gross error) is left out.

Where depth comes in steps most differences are 0 and the others at least a step, so a median of them tells nothing:
there whatever is below two steps counts, and what the rounding hides is added (``steps``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.review.steps import UNIFORM_VARIANCE, before_rounding

Array = npt.NDArray[Any]

#: Median of the size of a normal number → its deviation.
MAD = 1.4826
_BLOCK = 10  # pixels: squares for a first guess
_POOL = 2  # pixels to each side: 5 by 5 are pooled
_POOL_OF_STEPS = 5  # the same where depth has steps: how often it changes depends on the place between two steps
_CUT = 3.5  # deviations; what is beyond is no noise
_CUT_SHRINKS = 0.9969  # deviation of a normal number whose tails are cut off there
_ROUNDS = 3
_ENOUGH = 12  # differences that make a figure
_COARSE = 0.1  # share of equal readings from which on steps count: about three deviations
_HALF = 0.4  # share of equal readings that no continuous depth has by chance
_LEAST_STEPS = 0.55  # of a deviation, in steps: with this two steps are below the cut


def between_clouds(depths: Array, step: Array | float = 0.0) -> Array:
    """(height, width) standard deviation of depth from the differences of successive clouds.

    A shift that all pixels share is taken off: the patient breathes, and that is no noise.  What rounding adds
    without ever changing is not in it: ``total_noise`` adds it.

    Args:
        depths: (clouds, height, width), NaN where there is none; two clouds or more.
        step: (height, width) of the sensor's grid, metres; 0 where depth is continuous.
    """
    changes = np.diff(depths.astype(np.float64), axis=0) / np.sqrt(2.0)
    for number, change in enumerate(changes):
        known = change[np.isfinite(change)]
        if known.size:
            changes[number] -= np.median(known)
    return _pooled(changes, step)


def within_clouds(depths: Array, step: Array | float = 0.0) -> Array:
    """(height, width) standard deviation of depth from second differences along the rows and the columns of each cloud.

    Sees what differs between neighbours only: a lower bound where the grain is larger than a pixel.

    Args:
        depths: (clouds, height, width), NaN where there is none.
        step: (height, width) of the sensor's grid, metres; 0 where depth is continuous.
    """
    depths = depths.astype(np.float64)
    bends = np.full((2, *depths.shape), np.nan)
    bends[0, :, 1:-1] = (depths[:, :-2] - 2 * depths[:, 1:-1] + depths[:, 2:]) / np.sqrt(6.0)
    bends[1, :, :, 1:-1] = (depths[:, :, :-2] - 2 * depths[:, :, 1:-1] + depths[:, :, 2:]) / np.sqrt(6.0)
    return _pooled(bends.reshape(-1, *depths.shape[1:]), step)


def total_noise(changing: Array, step: Array) -> Array:
    """Standard deviation of a reading from the truth, of that which changes from reading to reading: with a step of
    q and σ before the rounding √(σ² + q² / 12).  (Noise and rounding error are uncorrelated over all places in a
    step.)"""
    deviation: Array = np.sqrt(before_rounding(changing**2, step) + UNIFORM_VARIANCE * step**2)
    return deviation


def deviation(values: Array) -> float:
    """Standard deviation of what scatters about 0, gross errors left out; NaN of nothing."""
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return float("nan")
    guess = MAD * float(np.median(size))
    kept = size[size <= _CUT * guess]
    return float(np.sqrt((kept**2).mean())) / _CUT_SHRINKS


def _pooled(differences: Array, step: Array | float) -> Array:
    """Root mean square of (n, height, width) differences about 0 over the pixels around, gross errors left out."""
    size = np.abs(differences)
    still = size <= 1e-3 * np.asarray(step)
    equal = int(np.count_nonzero(still)) / max(int(np.count_nonzero(np.isfinite(size))), 1)
    coarse = bool(np.any(step)) and equal > _COARSE
    least = _LEAST_STEPS * np.asarray(step) * coarse
    reach = _POOL_OF_STEPS if coarse else _POOL
    if not coarse and equal > _HALF:
        size = np.where(still, np.nan, size)  # clouds that were sent twice
    sigma = _guess(size)
    for _ in range(_ROUNDS):
        kept = size <= _CUT * np.maximum(sigma, least)  # NaN is not
        squares = _box(np.where(kept, size, 0.0) ** 2, reach)
        number = _box(kept.astype(np.float64), reach)
        enough = number > _ENOUGH - 0.5
        found = np.sqrt(np.where(enough, np.maximum(squares, 0.0) / np.where(enough, number, 1.0), np.nan))
        sigma = np.where(enough, found / _CUT_SHRINKS, np.nan)
    return sigma


def _guess(size: Array) -> Array:
    """(height, width) deviation by the medians of blocks."""
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
    """(height, width) sums over all (n, height, width) in the square around each pixel."""
    total: Array = values.sum(axis=0)
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (reach + 1, reach)
        running = np.cumsum(np.pad(total, padding), axis=axis)
        length, side = total.shape[axis], 2 * reach + 1
        total = np.take(running, range(side, side + length), axis) - np.take(running, range(length), axis)
    return total

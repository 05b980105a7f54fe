"""Numbers of the STAR scene that are the same everywhere, bit by bit.

Random numbers are sums of raw generator words (no library function whose last bit or stream may change), dot
products are written out (no BLAS), and what leaves the scene is rounded to a sensor's step, which swallows the
last bits of exp and arctan2 that differ between processors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rgb = NDArray[np.uint8]

SEED = 2017


class Noise:
    """Random numbers that depend on the seed and a key only, bit by bit, with any numpy."""

    def __init__(self, *key: int) -> None:
        self._bits = np.random.PCG64(np.random.SeedSequence(key))

    def uniform(self, *shape: int) -> Array:
        """Numbers in [0, 1)."""
        words = np.asarray(self._bits.random_raw(int(np.prod(shape))), dtype=np.uint64)
        return (words >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53

    def normal(self, *shape: int) -> Array:
        """Nearly normal numbers of mean 0 and deviation 1: each the sum of eight 16-bit ones, so within ±4.9."""
        words = np.asarray(self._bits.random_raw(2 * int(np.prod(shape))), dtype="<u8")
        total = words.view("<u2").reshape(-1, 8).sum(axis=1, dtype=np.int64)
        return np.asarray((total - 4 * 65535) / (65536 * np.sqrt(8 / 12))).reshape(shape)

    def smooth(self, height: int, width: int, cell: int) -> Array:
        """As ``normal``, but neighbours within ``cell`` pixels are alike."""
        grid = self.normal(height // cell + 2, width // cell + 2)
        row, down = np.divmod(np.arange(height) / cell, 1)
        column, right = np.divmod(np.arange(width) / cell, 1)
        i, j = row.astype(int)[:, None], column.astype(int)[None, :]
        v, u = down[:, None], right[None, :]
        mixed = (1 - v) * ((1 - u) * grid[i, j] + u * grid[i, j + 1])
        mixed += v * ((1 - u) * grid[i + 1, j] + u * grid[i + 1, j + 1])
        return np.asarray(mixed / np.sqrt(((1 - v) ** 2 + v**2) * ((1 - u) ** 2 + u**2)))


def dot(a: Array, b: Array) -> Array:
    """Scalar products of vectors along the last axis."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def unit_vectors(a: Array) -> Array:
    """The vectors, of length 1."""
    return a / np.sqrt(dot(a, a))[..., None]


def rounded(a: Array, step: float) -> Array:
    """The nearest multiples of ``step``."""
    return np.rint(a / step) * step

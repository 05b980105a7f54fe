"""What the tests of the STAR scene measure with."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from igtl_gateway_lab.simulate.star_numbers import Array

SECONDS = 12
#: When the arm sets off in a session, about.
BEGIN_S = 1.8


def length(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def matrix(rotation: Iterable[float]) -> Array:
    """Rotation matrix of x, y, z, w by the textbook formula, independent of the code under test."""
    x, y, z, w = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

"""Where an image lies: matrix of the wire ⇄ directions, spacing and origin.

Plain arithmetic on Python floats (float64): IEEE 754 fixes every bit of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Triple = tuple[float, float, float]

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def split(nine: Sequence[float]) -> tuple[tuple[float, ...], Triple]:
    """(direction, spacing) of three finite vectors T, S, N in a row: unit columns in a row, and their lengths.

    A vector of no length gets the unit vector of its axis; ``join`` gives it back (its zeros positive).
    """
    direction: list[float] = []
    spacing: list[float] = []
    for axis, start in zip(_AXES, (0, 3, 6), strict=True):
        x, y, z = nine[start : start + 3]
        length = math.sqrt(x * x + y * y + z * z)
        spacing.append(length)
        direction += (x / length, y / length, z / length) if length else axis
    return tuple(direction), (spacing[0], spacing[1], spacing[2])


def join(direction: Sequence[float], spacing: Sequence[float]) -> tuple[float, ...]:
    """The inverse of ``split``: exact once the numbers are float32 again."""
    return tuple(value * spacing[index // 3] for index, value in enumerate(direction))


def flipped(vectors: Sequence[float]) -> tuple[float, ...]:
    """Vectors in a row from LPS to RAS or back: x and y change their sign."""
    return tuple(value if index % 3 == 2 else -value for index, value in enumerate(vectors))

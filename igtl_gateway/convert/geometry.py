"""Where an image lies: matrix of the wire ⇄ directions, spacing and centre or origin in ROS.

On the wire a matrix is T, S, N (directions × spacing) and P, the centre, in millimetres, RAS or LPS.  In ROS
numbers are of the header's frame, as RAS is.

Plain arithmetic on Python floats (float64): IEEE 754 fixes every bit of it.  Of a finite matrix everything comes
back to the same float32, but for the signs of zeros in a vector without length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.image import LPS

Triple = tuple[float, float, float]

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
#: From here on numbers round to the infinity of float32.
_FLOAT32_END = 2.0**128 - 2.0**103


def split_axes(nine: Sequence[float]) -> tuple[tuple[float, ...], Triple]:
    """(direction, spacing) of three finite vectors T, S, N in a row: unit columns in a row, and their lengths.

    A vector of no length gets the unit vector of its axis; ``join_axes`` gives it back (its zeros positive).
    """
    direction: list[float] = []
    spacing: list[float] = []
    for axis, start in zip(_AXES, (0, 3, 6), strict=True):
        x, y, z = nine[start : start + 3]
        length = math.sqrt(x * x + y * y + z * z)
        spacing.append(length)
        direction += (x / length, y / length, z / length) if length else axis
    return tuple(direction), (spacing[0], spacing[1], spacing[2])


def join_axes(direction: Sequence[float], spacing: Sequence[float]) -> tuple[float, ...]:
    """The inverse of ``split_axes``: exact once the numbers are float32 again."""
    return tuple(value * spacing[index // 3] for index, value in enumerate(direction))


def flip_lps_ras(vectors: Sequence[float]) -> tuple[float, ...]:
    """Vectors in a row from LPS to RAS or back: x and y change their sign."""
    return tuple(value if index % 3 == 2 else -value for index, value in enumerate(vectors))


@dataclass(frozen=True, slots=True)
class Placement:
    """Where an image lies, as ROS says it.

    Attributes:
        direction: unit columns i, j, k in a row.
        spacing: distance of voxels along them, in the length unit of ROS.
        center: of the whole image, in the same unit.
    """

    direction: tuple[float, ...]
    spacing: Triple
    center: Triple

    @classmethod
    def of_wire(cls, matrix: Sequence[float], coordinate: int, lengths: LengthUnits) -> Self:
        """Of the 12 numbers of the wire; where they are not finite, neither are these."""
        axes = flip_lps_ras(matrix) if coordinate == LPS else tuple(matrix)
        direction, (i, j, k) = split_axes(axes[:9])
        x, y, z = axes[9:]
        to_ros = lengths.to_ros
        return cls(direction, (to_ros(i), to_ros(j), to_ros(k)), (to_ros(x), to_ros(y), to_ros(z)))

    def to_wire(self, coordinate: int, lengths: LengthUnits, place: str) -> tuple[float, ...]:
        """The 12 numbers of the wire.  Raises ConversionError where float32 cannot hold them."""
        (i, j, k), (x, y, z) = self.spacing, self.center
        to_igtl = lengths.to_igtl
        axes = join_axes(self.direction, (to_igtl(i), to_igtl(j), to_igtl(k)))
        matrix = (*axes, to_igtl(x), to_igtl(y), to_igtl(z))
        if not all(-_FLOAT32_END < value < _FLOAT32_END for value in matrix):
            raise ConversionError(f"{place}: found {self}, expected finite numbers (float32 in {lengths.igtl})")
        return flip_lps_ras(matrix) if coordinate == LPS else matrix

    def origin(self, size: Sequence[int]) -> Triple:
        """Centre of the first voxel of an image of ``size`` voxels."""
        x, y, z = (center - half for center, half in zip(self.center, self._half(size), strict=True))
        return x, y, z

    @classmethod
    def from_origin(cls, direction: tuple[float, ...], spacing: Triple, origin: Triple, size: Sequence[int]) -> Self:
        """The inverse of ``origin``.

        A centre of 0 comes back as 0, any other to within 2^-52 of the larger of origin and extent: that is the
        same float32, unless the centre is 2^27 times nearer to the frame's origin than the image is large.
        """
        half = cls(direction, spacing, origin)._half(size)
        x, y, z = (first + step for first, step in zip(origin, half, strict=True))
        return cls(direction, spacing, (x, y, z))

    def _half(self, size: Sequence[int]) -> Triple:
        """From the first voxel to the centre: (n - 1) / 2 steps along each axis."""
        steps = [(count - 1) / 2 * spacing for count, spacing in zip(size, self.spacing, strict=True)]
        d = self.direction
        x, y, z = (d[row] * steps[0] + d[row + 3] * steps[1] + d[row + 6] * steps[2] for row in range(3))
        return x, y, z

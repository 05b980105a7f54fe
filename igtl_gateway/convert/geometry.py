"""The placement of an image: matrix of the wire ⇄ directions, spacing and centre or origin in ROS.

On the wire a matrix consists of T, S, N (directions × spacing) and P, the centre, in millimetres, RAS or LPS.  In ROS
the numbers are in the frame of the header, which corresponds to RAS.

The arithmetic is on Python floats (float64): IEEE 754 defines every bit.  The conversion of a finite matrix and back
gives the same float32 values, except for the signs of zeros in a vector of zero length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.versions import Self
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.image import LPS

#: A direction without rotation, column by column.
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

Xyz = tuple[float, float, float]

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
#: Numbers from this one on round to the infinity of float32.
_FLOAT32_END = 2.0**128 - 2.0**103


def split_axes(nine: Sequence[float]) -> tuple[tuple[float, ...], Xyz]:
    """Return direction (three unit vectors, nine numbers) and spacing (their lengths) of three finite vectors T, S, N.

    A vector of zero length gets the unit vector of its axis; ``join_axes`` returns zeros for it, all positive.
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
    """Return the vectors of ``split_axes``; they are equal after rounding to float32."""
    return tuple(value * spacing[index // 3] for index, value in enumerate(direction))


def flip_lps_ras(vectors: Sequence[float]) -> tuple[float, ...]:
    """Convert consecutive vectors from LPS to RAS or back: x and y change their sign."""
    return tuple(value if index % 3 == 2 else -value for index, value in enumerate(vectors))


@dataclass(frozen=True, slots=True)
class Placement:
    """Direction, spacing and centre of an image in ROS.

    Attributes:
        direction: unit vectors of the axes i, j, k: nine numbers.
        spacing: distance of neighbouring voxels along the axes, in the length unit of ROS.
        center: centre of the whole image, in the length unit of ROS.
    """

    direction: tuple[float, ...]
    spacing: Xyz
    center: Xyz

    @classmethod
    def of_wire(cls, matrix: Sequence[float], coordinate: int, lengths: LengthUnits) -> Self:
        """Return the placement of the 12 numbers of the wire; NaN and infinity remain NaN or infinity."""
        axes = flip_lps_ras(matrix) if coordinate == LPS else tuple(matrix)
        direction, (i, j, k) = split_axes(axes[:9])
        x, y, z = axes[9:]
        to_ros = lengths.to_ros
        return cls(direction, (to_ros(i), to_ros(j), to_ros(k)), (to_ros(x), to_ros(y), to_ros(z)))

    def to_wire(self, coordinate: int, lengths: LengthUnits, place: str) -> tuple[float, ...]:
        """Return the 12 numbers of the wire.  Raises ConversionError if float32 cannot hold them."""
        (i, j, k), (x, y, z) = self.spacing, self.center
        to_igtl = lengths.to_igtl
        axes = join_axes(self.direction, (to_igtl(i), to_igtl(j), to_igtl(k)))
        matrix = (*axes, to_igtl(x), to_igtl(y), to_igtl(z))
        if not all(-_FLOAT32_END < value < _FLOAT32_END for value in matrix):
            raise ConversionError(f"{place}: found {self}, expected finite numbers (float32 in {lengths.igtl})")
        return flip_lps_ras(matrix) if coordinate == LPS else matrix

    def origin(self, size: Sequence[int]) -> Xyz:
        """Return the centre of the first voxel of an image of ``size`` voxels, in the length unit of ROS."""
        x, y, z = (center - half for center, half in zip(self.center, self._half(size), strict=True))
        return x, y, z

    @classmethod
    def from_origin(cls, direction: tuple[float, ...], spacing: Xyz, origin: Xyz, size: Sequence[int]) -> Self:
        """Return the placement for an origin: the inverse of ``origin``.

        A centre of 0 is exact.  The error of any other centre is at most 2^-52 of the larger of origin and extent.  As
        float32 it is equal, unless its distance from the frame's origin is less than the size of the image / 2^27.
        """
        half = cls(direction, spacing, origin)._half(size)
        x, y, z = (first + step for first, step in zip(origin, half, strict=True))
        return cls(direction, spacing, (x, y, z))

    def _half(self, size: Sequence[int]) -> Xyz:
        """Return the vector from the first voxel to the centre: (n - 1) / 2 steps along each axis."""
        steps = [(count - 1) / 2 * spacing for count, spacing in zip(size, self.spacing, strict=True)]
        d = self.direction
        x, y, z = (d[row] * steps[0] + d[row + 3] * steps[1] + d[row + 6] * steps[2] for row in range(3))
        return x, y, z

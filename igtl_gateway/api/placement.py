"""Position and orientation of an image in the patient: axes and first voxel of a file ⇄ the matrix of an IMAGE.

Files contain the vector from voxel to voxel along each axis and the centre of the first voxel, in a space that the
format names.  IMAGE contains the vectors T, S, N and the centre of the volume, in millimetres, here always RAS.  The
convention of ITK applies to MetaImage and NRRD: a space without a name is LPS.

The arithmetic is float64.  A position is exact to the resolution of float32: 0.02 µm at 300 mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.image import RAS, Image

Vector = tuple[float, float, float]

_FLOAT32_MAX = 3.4028234e38
#: Triple product of unit vectors below which three axes are coplanar: float32 rounds a right angle to 1e-7.
_FLAT = 1e-5

#: Orientation of a space → sign of each coordinate for the conversion to RAS.
SIGNS: dict[str, Vector] = {
    "RAS": (1.0, 1.0, 1.0),
    "LAS": (-1.0, 1.0, 1.0),
    "LPS": (-1.0, -1.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class ImagePlacement:
    """Axes and origin of an image in RAS, millimetres.

    Attributes:
        axes: vectors from voxel to voxel along columns, rows and slices.
        origin: centre of the first voxel.
    """

    axes: tuple[Vector, Vector, Vector]
    origin: Vector

    @classmethod
    def of_file(cls, axes: Sequence[Sequence[float]], origin: Sequence[float], space: str, where: str) -> Self:
        """Build it from 2 or 3 axes with 2 or 3 coordinates each, in ``space`` (a key of SIGNS).

        A slice gets the unit normal as its third axis.  Raises DamagedRecording if numbers are not finite, or if axes
        have zero length or are coplanar.
        """
        signs = SIGNS[space]
        turned = [_change_space(axis, signs) for axis in axes]
        first = _change_space(origin, signs)
        numbers = [value for vector in (*turned, first) for value in vector]
        if not all(math.isfinite(value) and abs(value) < _FLOAT32_MAX for value in numbers):
            raise DamagedRecording(f"{where}: found axes {turned} and origin {first}, expected finite millimetres")
        if len(turned) == 2:
            turned.append(normal(turned[0], turned[1]) or (0.0, 0.0, 0.0))
        if is_degenerate(turned):
            raise DamagedRecording(f"{where}: found axes {turned[: len(axes)]}, expected ones that span the image")
        i, j, k = turned
        return cls((i, j, k), first)

    @classmethod
    def of_image(cls, image: Image) -> Self | None:
        """Build it from an IMAGE, complete or partial; None if its matrix is invalid.

        A single slice whose third axis has zero length, or lies in the slice, gets the unit normal.
        """
        matrix = image.wire_matrix
        if not all(map(math.isfinite, matrix)):
            return None
        signs = SIGNS["LPS" if image.is_lps else "RAS"]
        i, j, k, centre = (_change_space(matrix[start : start + 3], signs) for start in (0, 3, 6, 9))
        if image.dimensions[2] == 1 and is_degenerate((i, j, k)):
            k = normal(i, j) or k
        if is_degenerate((i, j, k)):
            return None
        return cls((i, j, k), _moved(centre, (i, j, k), image.dimensions, -1.0))

    def wire_matrix(self, size: Sequence[int], where: str) -> tuple[float, ...]:
        """Return the 12 numbers of an IMAGE in RAS.  Raises DamagedRecording if they exceed the range of float32."""
        matrix = (*self.axes[0], *self.axes[1], *self.axes[2], *_moved(self.origin, self.axes, size, 1.0))
        if not all(abs(value) < _FLOAT32_MAX for value in matrix):
            raise DamagedRecording(f"{where}: found the matrix {matrix}, expected numbers in the range of float32")
        return matrix

    def in_space(self, space: str) -> tuple[tuple[Vector, Vector, Vector], Vector]:
        """Return axes and origin in ``space``: the inverse of ``of_file``."""
        signs = SIGNS[space]
        i, j, k = (_change_space(axis, signs) for axis in self.axes)
        return (i, j, k), _change_space(self.origin, signs)


def has_own_normal(image: Image) -> bool:
    """Return whether the matrix of an IMAGE is valid with its own third axis, without the normal of the slice."""
    place = ImagePlacement.of_image(image)
    signs = SIGNS["LPS" if image.is_lps else "RAS"]
    return place is not None and place.axes[2] == _change_space(image.wire_matrix[6:9], signs)


def normal(i: Vector, j: Vector) -> Vector | None:
    """Return the unit vector that completes a right-handed system; None if ``i`` and ``j`` are parallel or zero."""
    cross = (i[1] * j[2] - i[2] * j[1], i[2] * j[0] - i[0] * j[2], i[0] * j[1] - i[1] * j[0])
    length, scale = math.hypot(*cross), math.hypot(*i) * math.hypot(*j)
    if not scale or length / scale < _FLAT:
        return None
    return cross[0] / length, cross[1] / length, cross[2] / length


def is_degenerate(axes: Sequence[Vector]) -> bool:
    """Return whether three axes are coplanar, or one has zero length: ITK rejects such an image."""
    lengths = [math.hypot(*axis) for axis in axes]
    if not all(lengths):
        return True
    i, j, k = (tuple(value / length for value in axis) for axis, length in zip(axes, lengths, strict=True))
    x, y, z = (i[1] * j[2] - i[2] * j[1], i[2] * j[0] - i[0] * j[2], i[0] * j[1] - i[1] * j[0])
    return abs(x * k[0] + y * k[1] + z * k[2]) < _FLAT


def _change_space(vector: Sequence[float], signs: Vector) -> Vector:
    """Return coordinates in another space; a missing third one is 0.  Adding 0.0 removes negative zeros."""
    x, y, z = (*vector, 0.0)[:3]
    return x * signs[0] + 0.0, y * signs[1] + 0.0, z * signs[2] + 0.0


def _moved(start: Vector, axes: Sequence[Vector], size: Sequence[int], sign: float) -> Vector:
    """Move a point from the first voxel to the centre of the volume (sign 1), or back (-1)."""
    x, y, z = (
        start[row] + sign * sum((count - 1) / 2 * axis[row] for count, axis in zip(size, axes, strict=True))
        for row in range(3)
    )
    return x, y, z


#: Coordinate system of an IMAGE from an imported file.
COORDINATE = RAS

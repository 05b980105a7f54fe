"""The surface of a volume as triangles: surface nets, in numpy alone; and a brain without an MR scanner.

*Surface nets* (Gibson 1998, in the form where a vertex is the mean of its cell's crossings): a cell of eight
voxels that the surface passes through gets one vertex, the mean of the points where its edges cross the level;
an edge that crosses gets one quad, of the vertices of the four cells around it.  The result is closed, has no
thin triangles and needs no table of cases.

All arithmetic is +, −, ×, ÷ and √ of IEEE 754 on whole arrays, so that a volume gives the same surface, bit for
bit, on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igtl_gateway.base.versions import Self
from igtl_gateway_lab.simulate.star_numbers import Array, Noise

Indices = NDArray[np.int64]

#: Corners of the four cells around an edge of an axis, in the order of a quad that faces along the axis.
_AROUND = ((-1, -1), (0, -1), (0, 0), (-1, 0))


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles that face outwards.

    Attributes:
        points: (n, 3) in the unit of its creator.
        faces: (m, 3) indices into the points, anticlockwise seen from outside.
    """

    points: Array
    faces: Indices

    def placed(self, columns: Array, origin: Array) -> Self:
        """Moved from voxels to space: (3, 3) steps of the voxel axes as columns, and the place of voxel 0."""
        i, j, k = self.points.T
        points = i[:, None] * columns[:, 0] + j[:, None] * columns[:, 1] + k[:, None] * columns[:, 2] + origin
        mirrored = _determinant(columns) < 0
        return type(self)(points, self.faces[:, ::-1].copy() if mirrored else self.faces)

    def unwelded(self) -> Self:
        """Every face with three points of its own, as an STL file has them."""
        return type(self)(self.points[self.faces].reshape(-1, 3), np.arange(self.faces.size).reshape(-1, 3))


def _determinant(m: Array) -> float:
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def extract_surface(field: NDArray[Any], level: float) -> TriangleMesh:
    """The surface between voxels below ``level`` and those from it on, in voxels; outside the field is below.

    Args:
        field: (i, j, k) numbers that are finite.
        level: in their unit.
    """
    below = min(float(field.min()), level - 1)
    padded = np.pad(field, 1, constant_values=np.asarray(below, field.dtype))
    inside = padded >= level
    strides = np.array([padded.shape[1] * padded.shape[2], padded.shape[2], 1])
    flat = padded.reshape(-1)
    cells, crossings, quads = [], [], []
    for axis in range(3):
        before, after = _neighbours(inside, axis)
        edges = np.stack(np.nonzero(before != after), axis=1)
        first = edges @ strides
        low, high = flat[first].astype(np.float64), flat[first + strides[axis]].astype(np.float64)
        crossing = edges.astype(np.float64)
        crossing[:, axis] += (level - low) / (high - low)
        # a cell is named after its first corner; of the edge's two other axes in turn, so that the quad faces +axis
        side, rise = (axis + 1) % 3, (axis + 2) % 3
        around = np.stack([first + a * strides[side] + b * strides[rise] for a, b in _AROUND], axis=1)
        around = np.where((high < low)[:, None], around, around[:, ::-1])
        cells.append(around.reshape(-1))
        crossings.append(np.repeat(crossing, 4, axis=0))
        quads.append(len(edges))
    names, corner = np.unique(np.concatenate(cells), return_inverse=True)
    sums = np.concatenate(crossings)
    count = np.bincount(corner)
    points = np.stack([np.bincount(corner, sums[:, axis]) / count for axis in range(3)], axis=1) if len(names) else sums
    quad = corner.reshape(sum(quads), 4)
    faces = np.stack([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    return TriangleMesh(points - 1, faces.astype(np.int64))


def resampled(field: NDArray[Any], step: float) -> Array:
    """The field at every ``step``-th voxel along each axis, straight lines between voxels."""
    values = field.astype(np.float64)
    for axis in range(values.ndim):
        at = step * np.arange(int((values.shape[axis] - 1) / step) + 1)
        low = np.minimum(at.astype(np.int64), values.shape[axis] - 2)
        part = (at - low).reshape([-1 if axis == other else 1 for other in range(values.ndim)])
        values = values.take(low, axis) * (1 - part) + values.take(low + 1, axis) * part
    return values


def _neighbours(values: NDArray[Any], axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Each value and the next one along ``axis``, as views."""
    length = values.shape[axis]
    return values.take(range(length - 1), axis), values.take(range(1, length), axis)


def smoothed(voxels: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """64 times the volume, each axis weighted 1 : 2 : 1; at the border its own value counts for the missing one."""
    sums = voxels.astype(np.uint16)
    for axis in range(3):
        wide = np.pad(sums, [(int(axis == other),) * 2 for other in range(3)], mode="edge")
        low, high = _neighbours(wide, axis)
        pairs = low + high
        low, high = _neighbours(pairs, axis)
        sums = low + high
    return sums


# -- A brain without a scanner ----------------------------------------------------------------------------------------

#: Half the box around it, and semi-axes of its hemispheres; right, anterior, superior (mm).
_BOX_MM = (72, 90, 72)
_HEMISPHERES = (66.0, 84.0, 58.0)
_CELL_MM = 13.0  #: size of the folds


def procedural_brain(step_mm: float) -> TriangleMesh:
    """A synthetic brain in millimetres, RAS: folded hemispheres, the fissure between them, cerebellum and stem.

    ``step_mm`` is the distance of the voxels that it is made of; it has about 360,000 faces divided by its square.
    """
    count = [int(2 * half / step_mm) + 1 for half in _BOX_MM]
    axes = [np.asarray(step_mm * np.arange(n) - half, float) for half, n in zip(_BOX_MM, count, strict=True)]
    grid = Noise(2017, 31).normal(*(2 * int(half / _CELL_MM) + 4 for half in _BOX_MM))
    # slab by slab: the intermediate arrays of the whole would take a gigabyte
    field = np.stack([_depth(np.array(x), axes[1][:, None], axes[2][None, :], grid) for x in axes[0]])
    return extract_surface(field, 0.0).placed(step_mm * np.eye(3), -np.array(_BOX_MM, float))


def _depth(x: Array, y: Array, z: Array, grid: Array) -> Array:
    """Roughly how deep inside points are, in millimetres; negative outside."""
    a, b, c = _HEMISPHERES
    reach = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2) + 1e-9
    # the pattern is that of the outside, carried inwards, so that folds are walls that stand on the surface
    pattern = _sampled(grid, x / reach, y / reach, z / reach)
    cortex = 60 * (1 - reach) - _groove(15.0, 7.0 * pattern)
    fissure = _groove(34.0, (x - 0.8 * pattern) / 1.2) * np.clip((z + 12) / 20, 0, 1)
    flat_base = (z + 36) * 0.9
    temporal = 20 * (1 - np.sqrt(((np.abs(x) - 40) / 23) ** 2 + ((y - 14) / 42) ** 2 + ((z + 28) / 19) ** 2))
    hemispheres = np.maximum(np.minimum(cortex, flat_base) - fissure, temporal - _groove(6.0, 7.0 * pattern))
    fold = np.abs((z + 0.06 * y**2 / 10) / 5.0 % 1.0 - 0.5) * 5.0
    cerebellum = 26 * (1 - np.sqrt((x / 48) ** 2 + ((y + 52) / 31) ** 2 + ((z + 42) / 23) ** 2)) - _groove(3.0, fold)
    stem = np.minimum(12 - np.sqrt(x**2 + (y + 22 - 0.25 * (z + 45)) ** 2), 0.0 - np.abs(z + 40) + 29)
    return np.asarray(np.maximum(np.maximum(hemispheres, cerebellum), stem))


def _groove(deep: float, off: Array) -> Array:
    """How much a groove takes away, ``off`` millimetres beside its middle: ``deep`` there, a tenth 5 mm away."""
    return np.asarray(deep / (1 + (off / 1.7) ** 2))


def _sampled(grid: Array, *place: Array) -> Array:
    """Smooth noise at places (mm): values of ``grid``, blended between its points."""
    shape = np.broadcast_shapes(*(axis.shape for axis in place))
    low, part = [], []
    for axis, (values, half) in enumerate(zip(place, _BOX_MM, strict=True)):
        at = np.clip((np.broadcast_to(values, shape) + half) / _CELL_MM, 0, grid.shape[axis] - 2)
        index = at.astype(np.int64)
        rest = at - index
        low.append(index)
        part.append(rest * rest * (3 - 2 * rest))
    total = np.zeros(shape)
    for corner in range(8):
        bits = [corner >> axis & 1 for axis in range(3)]
        weight = np.ones(shape)
        for bit, rest in zip(bits, part, strict=True):
            weight = weight * (rest if bit else 1 - rest)
        total += weight * grid[tuple(index + bit for index, bit in zip(low, bits, strict=True))]
    return total

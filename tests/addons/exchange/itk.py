"""The referee of image geometry: SimpleITK's corners of an image against those of an IMAGE."""

from __future__ import annotations

import itertools
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import LPS, Image

Array = npt.NDArray[np.float64]

#: One micrometre, in millimetres.
MICROMETRE = 1e-3
#: Turns by 25°, -40° and 70° about three axes, after one another.
OBLIQUE = np.array(
    [
        [0.26200263, -0.94949951, 0.17274313],
        [0.71984631, 0.07302254, -0.69028206],
        [0.64280761, 0.30520494, 0.70261788],
    ]
)


def orientations() -> list[Array]:
    """The 48 ways in which axes lie along those of the patient: all orders, all signs."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            for column, (row, sign) in enumerate(zip(order, signs, strict=True)):
                matrix[row, column] = sign
            found.append(matrix)
    return found


def orthonormal(matrix: Array) -> Array:
    """The nearest rotation: numbers written above have eight digits."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def images_of(path: Path, epoch_ns: int | None = None) -> list[Image]:
    """The IMAGEs that a file is imported as."""
    with closing(open_source(path, epoch_ns)) as source:
        contents = [decode(item.payload).content for item in source.items() if item.kind is Kind.IGTL_IN]
    return [content for content in contents if isinstance(content, Image)]


def corners(image: Image) -> Array:
    """The centres of the eight outer voxels of an IMAGE in LPS, millimetres, by the document of IMAGE."""
    t, s, n, p = np.array(image.wire_matrix, np.float64).reshape(4, 3)
    size = np.array(image.dimensions)
    points = [
        p + sum(axis * (index - (count - 1) / 2) for axis, index, count in zip((t, s, n), corner, size, strict=True))
        for corner in itertools.product(*((0, count - 1) for count in size))
    ]
    return np.array(points) * (1 if image.coordinate == LPS else np.array([-1, -1, 1]))


def itk_corners(image: Any, size: tuple[int, int, int]) -> Array:
    """The same of a SimpleITK image with 2, 3 or 4 axes (the first of those over time)."""
    dims = image.GetDimension()
    points = []
    for corner in itertools.product(*((0.0, count - 1.0) for count in size)):
        point = image.TransformContinuousIndexToPhysicalPoint([*corner, 0.0][:dims])
        points.append([*point, 0.0][:3])
    return np.array(points)


def sitk() -> Any:
    """SimpleITK, or skip."""
    return pytest.importorskip("SimpleITK", reason="SimpleITK is the referee")


def read(path: Path) -> Any:
    """A file as SimpleITK reads it."""
    return sitk().ReadImage(str(path))

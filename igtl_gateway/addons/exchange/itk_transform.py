"""Reads linear transforms of ITK and 3D Slicer: text (``.tfm .txt``), MATLAB level 4 (``.mat``) and HDF5 (``.h5``).

ITK's transform takes a point of the fixed picture to the moving one, in LPS millimetres: for 3D Slicer, from the parent
to the child.  Its kinds are those with a matrix: *x* goes to *M (x - c) + c + t*, with *c* among the fixed parameters.
A composite applies its last transform first.  Displacement grids and B-splines have no matrix and are refused by name.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits
from igtl_gateway.addons.exchange.itk_hdf5 import HDF5, read_hdf5

Array = npt.NDArray[np.float64]

TEXT = b"#Insight Transform File V"
_HEAD = "#Insight Transform File V1.0"
_NAME = re.compile(r"([A-Za-z0-9]+)_(?:double|float)_([0-9]{1,3})_([0-9]{1,3})")
#: Header of a matrix of MATLAB level 4: number type, rows, columns, imaginary part, bytes of the name.
_MAT = struct.Struct("<5i")
_MAT_TYPES = {0: "<f8", 10: "<f4", 1000: ">f8", 1010: ">f4"}
_COMPOSITE = "CompositeTransform"
#: Kinds without a matrix → what they are, for people.
_NOT_LINEAR = {
    "DisplacementFieldTransform": "a displacement grid",
    "BSplineTransform": "a B-spline",
    "BSplineDeformableTransform": "a B-spline",
    "ThinPlateSplineKernelTransform": "a thin-plate spline",
}


class ItkTransform(NamedTuple):
    """One transform of a file."""

    name: str
    parameters: list[float]
    fixed: list[float]


def looks_like_transform(start: bytes) -> bool:
    """Return whether a file that begins with these bytes has transforms of ITK."""
    return start.startswith((TEXT, HDF5)) or _is_mat(start)


def _is_mat(start: bytes) -> bool:
    return len(start) > _MAT.size and b"Transform_" in start[_MAT.size : _MAT.size + 80]


def read_transform(path: Path) -> tuple[str, Array]:
    """Return the kind of a file's transform and its matrix, 4 by 4: from the parent in LPS to the child, millimetres.

    Raises DamagedRecording, UnsupportedRecording (a kind without a matrix) or LimitExceeded.
    """
    with files.open_file(path) as stream:
        start = stream.read(_MAT.size + 80)
    if start.startswith(HDF5):
        found = [ItkTransform(*each) for each in read_hdf5(path)]
    elif start.startswith(TEXT):
        found = list(_of_text(files.read_bytes(path).decode("utf-8", "replace"), str(path)))
    else:
        found = list(_of_mat(files.read_bytes(path), str(path)))
    if not found:
        raise DamagedRecording(f"{path}: found no transform, expected one")
    first, *others = found
    kind = _kind(first, str(path))
    if kind != _COMPOSITE:
        if others:
            raise UnsupportedRecording(
                f"{path}: found {counted(len(found), 'transform')}, expected one, or one {_COMPOSITE}"
            )
        return kind, _matrix(first, kind, str(path))
    placed = np.eye(4)
    for number, each in enumerate(others, 1):
        where = f"{path}: transform {number}"
        placed = _product(placed, _matrix(each, _kind(each, where), where))
    return kind, placed


def to_parent(from_parent: Array, where: str) -> list[list[float]]:
    """Return the matrix of a node of 3D Slicer, from the child to its parent in RAS; raises DamagedRecording."""
    a, b, c = from_parent[:3, :3].tolist()
    across = [_cross(b, c), _cross(c, a), _cross(a, b)]
    volume = sum(one * other for one, other in zip(a, across[0], strict=True))
    size = max(map(abs, [*a, *b, *c]))
    if not math.isfinite(volume) or abs(volume) <= 1e-12 * size**3:
        raise DamagedRecording(f"{where}: found a matrix without an inverse, expected one with")
    rows = [[across[column][row] / volume for column in range(3)] for row in range(3)]
    moved = [-sum(value * float(shift) for value, shift in zip(row, from_parent[:3, 3], strict=True)) for row in rows]
    signs = (-1.0, -1.0, 1.0, 1.0)
    full = [[*row, shift] for row, shift in zip(rows, moved, strict=True)]
    return [[value * signs[row] * signs[column] + 0.0 for column, value in enumerate(full[row])] for row in range(3)]


def _cross(a: list[float], b: list[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _product(a: Array, b: Array) -> Array:
    """Return the product without the library that numpy calls for it, whose sums differ between machines."""
    return np.array([[sum(float(a[i, k]) * float(b[k, j]) for k in range(4)) for j in range(4)] for i in range(4)])


def _kind(transform: ItkTransform, where: str) -> str:
    name = _NAME.fullmatch(transform.name)
    if not name:
        raise DamagedRecording(f"{where}: found the transform {transform.name[:60]!r}, expected a name of ITK")
    if what := _NOT_LINEAR.get(name[1]):
        raise UnsupportedRecording(f"{where}: found {what} ({name[1]}), expected a linear transform")
    if name[1] != _COMPOSITE and name[1] not in _KINDS:
        raise UnsupportedRecording(f"{where}: found {name[1][:60]}, expected one of {', '.join(_KINDS)}")
    if (name[2], name[3]) != ("3", "3"):
        raise UnsupportedRecording(f"{where}: found a transform of {name[2]} dimensions, expected 3")
    return name[1]


def _matrix(transform: ItkTransform, kind: str, where: str) -> Array:
    if kind == _COMPOSITE:
        raise UnsupportedRecording(f"{where}: found a composite in a composite, expected a transform with a matrix")
    count, build = _KINDS[kind]
    parameters, fixed = transform.parameters, transform.fixed
    if len(parameters) != count:
        raise DamagedRecording(f"{where}: {kind}: found {counted(len(parameters), 'parameter')}, expected {count}")
    if fixed and len(fixed) < 3:
        raise DamagedRecording(f"{where}: {kind}: found {counted(len(fixed), 'fixed parameter')}, expected 3")
    if not all(map(math.isfinite, [*parameters, *fixed])):
        raise DamagedRecording(f"{where}: {kind}: found a number that is not finite, expected finite ones")
    rows, shift = build(parameters, fixed)
    centre = fixed[:3] or [0.0] * 3
    placed = np.eye(4)
    for row in range(3):
        placed[row, :3] = rows[row]
        turned = sum(value * middle for value, middle in zip(rows[row], centre, strict=True))
        placed[row, 3] = shift[row] + centre[row] - turned
    return placed


Rows = list[list[float]]
Built = tuple[Rows, list[float]]


def _affine(p: list[float], _fixed: list[float]) -> Built:
    return [p[0:3], p[3:6], p[6:9]], p[9:12]


def _translation(p: list[float], _fixed: list[float]) -> Built:
    return _diagonal([1.0, 1.0, 1.0]), p


def _scale(p: list[float], _fixed: list[float]) -> Built:
    return _diagonal(p), [0.0] * 3


def _identity(_p: list[float], _fixed: list[float]) -> Built:
    return _diagonal([1.0, 1.0, 1.0]), [0.0] * 3


def _euler(p: list[float], fixed: list[float]) -> Built:
    (sx, cx), (sy, cy), (sz, cz) = ((math.sin(angle), math.cos(angle)) for angle in p[:3])
    x = [[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]]
    y = [[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]]
    z = [[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]]
    # the fourth fixed parameter, of newer files, is the order of the angles
    order = (z, y, x) if len(fixed) > 3 and fixed[3] else (z, x, y)
    return _times(_times(order[0], order[1]), order[2]), p[3:6]


def _versor_rigid(p: list[float], _fixed: list[float]) -> Built:
    return _turn(p[:3]), p[3:6]


def _similarity(p: list[float], _fixed: list[float]) -> Built:
    return [[value * p[6] for value in row] for row in _turn(p[:3])], p[3:6]


def _versor(p: list[float], _fixed: list[float]) -> Built:
    return _turn(p[:3]), [0.0] * 3


def _quaternion(p: list[float], _fixed: list[float]) -> Built:
    length = math.hypot(*p[:4]) or 1.0
    return _rotation([value / length for value in p[:4]]), p[4:7]


def _scale_versor(p: list[float], _fixed: list[float]) -> Built:
    """ITK adds the scales, less 1, to the diagonal of the rotation."""
    rows = _turn(p[:3])
    for axis in range(3):
        rows[axis][axis] += p[6 + axis] - 1.0
    return rows, p[3:6]


def _scale_skew_versor(p: list[float], fixed: list[float]) -> Built:
    rows, shift = _scale_versor(p, fixed)
    for (row, column), skew in zip(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)), p[9:15], strict=True):
        rows[row][column] += skew
    return rows, shift


#: Kind → number of its parameters, and its matrix and translation by them.
_KINDS: dict[str, tuple[int, Callable[[list[float], list[float]], Built]]] = {
    "AffineTransform": (12, _affine),
    "MatrixOffsetTransformBase": (12, _affine),
    "Rigid3DTransform": (12, _affine),
    "Euler3DTransform": (6, _euler),
    "VersorTransform": (3, _versor),
    "VersorRigid3DTransform": (6, _versor_rigid),
    "QuaternionRigidTransform": (7, _quaternion),
    "Similarity3DTransform": (7, _similarity),
    "ScaleVersor3DTransform": (9, _scale_versor),
    "ScaleSkewVersor3DTransform": (15, _scale_skew_versor),
    "ScaleTransform": (3, _scale),
    "TranslationTransform": (3, _translation),
    "IdentityTransform": (0, _identity),
}


def _diagonal(values: list[float]) -> Rows:
    return [[values[row] if row == column else 0.0 for column in range(3)] for row in range(3)]


def _times(a: Rows, b: Rows) -> Rows:
    return [[sum(a[row][k] * b[k][column] for k in range(3)) for column in range(3)] for row in range(3)]


def _turn(versor: list[float]) -> Rows:
    """Return the rotation of the vector part of a versor."""
    square = sum(value * value for value in versor)
    if square > 1.0:
        return _rotation([value / math.sqrt(square) for value in versor] + [0.0])
    return _rotation([*versor, math.sqrt(1.0 - square)])


def _rotation(quaternion: list[float]) -> Rows:
    x, y, z, w = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _of_text(text: str, where: str) -> Iterator[ItkTransform]:
    """Yield the transforms of the lines ``Transform:``, ``Parameters:`` and ``FixedParameters:``."""
    if (head := text.partition("\n")[0].strip()) != _HEAD:
        raise UnsupportedRecording(f"{where}: line 1: found {head[:40]!r}, expected {_HEAD!r}")
    name, numbers, found = "", dict[str, list[float]](), 0
    for at, line in enumerate(text.splitlines(), 1):
        key, colon, value = line.partition(":")
        if line.startswith("#") or not line.strip():
            continue
        if not colon or key not in {"Transform", "Parameters", "FixedParameters"}:
            raise DamagedRecording(
                f"{where}: line {at}: found {line[:40]!r}, expected Transform, Parameters or FixedParameters"
            )
        if key != "Transform":
            numbers[key] = _numbers(value, f"{where}: line {at}: {key}")
            continue
        if name:
            yield ItkTransform(name, numbers.get("Parameters", []), numbers.get("FixedParameters", []))
        found += 1
        limits.check_limit("fields", found, f"{where}: transforms")
        name, numbers = value.strip(), {}
    if name:
        yield ItkTransform(name, numbers.get("Parameters", []), numbers.get("FixedParameters", []))


def _numbers(text: str, where: str) -> list[float]:
    limits.check_limit("document", len(text), f"{where}: characters")
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        raise DamagedRecording(f"{where}: found {text.strip()[:60]!r}, expected numbers") from None


def _of_mat(data: bytes, where: str) -> Iterator[ItkTransform]:
    """Yield the transforms of pairs of matrices: the first one has the name of the kind, the second its ``fixed``."""
    matrices = []
    at = 0
    while at < len(data):
        if at + _MAT.size > len(data):
            raise DamagedRecording(
                f"{where}: byte {at}: found {counted(len(data) - at, 'byte')}, expected a header of {_MAT.size}"
            )
        kind, rows, columns, imaginary, width = _MAT.unpack_from(data, at)
        if kind not in _MAT_TYPES or imaginary or not (0 <= rows and 0 <= columns and 0 < width < 256):
            raise DamagedRecording(f"{where}: byte {at}: found no header of a real matrix, expected one of MATLAB 4")
        dtype = np.dtype(_MAT_TYPES[kind])
        size = rows * columns * dtype.itemsize
        start = at + _MAT.size + width
        if start + size > len(data):
            raise DamagedRecording(
                f"{where}: byte {at}: found {counted(len(data) - start, 'byte')}, expected {rows} by "
                f"{counted(columns, 'number')}"
            )
        name = data[at + _MAT.size : start].rstrip(b"\0").decode("ascii", "replace")
        matrices.append((name, np.frombuffer(data, dtype, rows * columns, start).astype(float).tolist()))
        limits.check_limit("fields", len(matrices), f"{where}: matrices")
        at = start + size
    if len(matrices) % 2 or any(name != "fixed" for name, _ in matrices[1::2]):
        raise DamagedRecording(
            f"{where}: found {counted(len(matrices), 'matrix', 'matrices')}, expected pairs of a transform and 'fixed'"
        )
    for (name, parameters), (_, fixed) in zip(matrices[::2], matrices[1::2], strict=True):
        yield ItkTransform(name, parameters, fixed)

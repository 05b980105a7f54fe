"""Plain values (arrays, strings, mappings) → contents of OpenIGTLink messages, for ``Peer.send``.

One row per message type.  A type without a row takes a content object of `igtl_gateway.wire` or the bytes of its body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.poses import determinant, distance_from_rotation, rotation_quaternion
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, SCALARS, Image
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.query import QUERIES
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.sensor import Sensor, parse_unit
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import (
    QTRACKING_DTYPE,
    TOOL_6D,
    TRACKING_DTYPE,
    QuaternionTrackingData,
    TrackingData,
)
from igtl_gateway.wire.transform import Position, Transform

Array = npt.NDArray[Any]

_SCALAR_OF = {np.dtype(name): scalar for scalar, name in SCALARS.items()}
_ND_SCALAR_OF = {np.dtype(name).newbyteorder("="): scalar for scalar, name in NDARRAY_SCALARS.items()}
_TEXT_DIMENSIONS = "(j, i), (k, j, i) or (k, j, i, components)"
#: Largest deviation of RᵀR from the identity in a pose that is sent as a quaternion: ten times that of float32 inputs.
_ORTHONORMAL = 1e-5
_BOTTOM_ROW = (0.0, 0.0, 0.0, 1.0)


def content_of(type_name: str, value: object, matrix: object = None, unit: str = "") -> Body:
    """Return the content of a message for a value.

    Args:
        type_name: message type on the wire.
        value: a content of `igtl_gateway.wire`, which is returned as it is, or what the row of the type takes; None: no
            content.
        matrix: of an IMAGE: (4, 4), voxel index (i, j, k) → RAS, millimetres; None: 1 mm voxels centred at the origin.
        unit: of a SENSOR, such as ``"mm/s"``.

    Raises ConversionError for a value that the type cannot hold.
    """
    if matrix is not None and type_name != "IMAGE":
        raise ConversionError(f"{type_name}: found matrix=…, expected it with IMAGE only; a pose is the value")
    if unit and type_name != "SENSOR":
        raise ConversionError(f"{type_name}: found unit={unit!r}, expected it with SENSOR only")
    if hasattr(value, "pack") and hasattr(value, "describe"):
        return cast(Body, value)
    if isinstance(value, bytes | bytearray | memoryview) and type_name not in _TEXTS:
        return BODIES.get(type_name, Raw).unpack(memoryview(bytes(value))) if len(value) else Raw(b"")
    if value is None:
        return _without_content(type_name)
    if type_name == "IMAGE":
        return _image(value, matrix)
    if type_name == "SENSOR":
        return _sensor(value, unit)
    make = _ROWS.get(type_name)
    if make is None:
        expected = f"a content of igtl_gateway.wire, or bytes; values are for {', '.join(sorted(VALUE_TYPES))}"
        raise ConversionError(f"{type_name}: found {_shown(value)}, expected {expected}")
    return make(value)


def _without_content(type_name: str) -> Body:
    """A query without content, or an empty body."""
    kind = QUERIES.get(type_name)
    return kind.unpack(memoryview(b"")) if getattr(kind, "MAY_BE_EMPTY", False) and kind else Raw(b"")


def _shown(value: object) -> str:
    text = f"an array of shape {value.shape}, {value.dtype}" if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def numbers(place: str, value: object, shapes: Sequence[tuple[int | None, ...]], dtype: Any = np.float64) -> Array:
    """Return an array with one of the shapes (None: any length).  Raises ConversionError with ``place``."""
    try:
        array = np.asarray(value, dtype)
    except (TypeError, ValueError):
        array = np.empty(0)
        found = _shown(value)
    else:
        found = f"shape {array.shape}"
        for shape in shapes:
            if len(shape) == array.ndim and all(
                want in (None, size) for want, size in zip(shape, array.shape, strict=True)
            ):
                return array
    shown = " or ".join("(" + ", ".join("n" if size is None else str(size) for size in shape) + ")" for shape in shapes)
    raise ConversionError(f"{place}: found {found}, expected numbers of shape {shown}")


def _pose(place: str, value: object) -> Array:
    """A pose as the upper three rows of its matrix."""
    matrix = numbers(place, value, ((4, 4), (3, 4)))
    if len(matrix) == 4 and tuple(matrix[3]) != _BOTTOM_ROW:
        raise ConversionError(f"{place}: found a last row {matrix[3].tolist()}, expected 0, 0, 0, 1")
    return matrix[:3]


def _transform(value: object) -> Transform:
    matrix = _pose("TRANSFORM", value)
    return Transform(tuple(matrix.T.reshape(-1).tolist()))


def _quaternion(place: str, matrix: Array) -> tuple[float, ...]:
    """The quaternion (x, y, z, w) of a rotation, normalised."""
    rotation = matrix[:, :3].tolist()
    if distance_from_rotation(rotation) > _ORTHONORMAL or determinant(rotation) < 0:
        raise ConversionError(f"{place}: found a matrix with scale, shear or reflection, expected an orthonormal one")
    return rotation_quaternion(rotation)


def _position(value: object) -> Position:
    if isinstance(value, tuple) and len(value) == 2:
        place, turn = numbers("POSITION", value[0], ((3,),)), numbers("POSITION", value[1], ((4,),))
        return Position(tuple(place.tolist()), tuple(turn.tolist()))
    array = numbers("POSITION", value, ((3,), (4, 4), (3, 4)))
    if array.ndim == 1:
        return Position(tuple(array.tolist()))
    matrix = _pose("POSITION", array)
    return Position(tuple(matrix[:, 3].tolist()), _quaternion("POSITION", matrix))


def _text(place: str, value: object) -> str:
    if not isinstance(value, str):
        raise ConversionError(f"{place}: found {_shown(value)}, expected a string")
    return value


def _status(value: object) -> Status:
    if isinstance(value, str):
        return Status(1, 0, "", value)
    if isinstance(value, int):
        return Status(value)
    raise ConversionError(f"STATUS: found {_shown(value)}, expected a code, or the text of an OK")


def _pixel_array(value: object) -> Array:
    pixels = np.asarray(value)
    if pixels.dtype == bool:
        pixels = pixels.astype(np.uint8)
    if pixels.ndim == 2:
        pixels = pixels[np.newaxis]
    if pixels.ndim == 3:
        pixels = pixels[..., np.newaxis]
    if pixels.ndim != 4 or pixels.dtype.newbyteorder("=") not in _SCALAR_OF:
        expected = f"shape {_TEXT_DIMENSIONS}, one of {', '.join(str(kind) for kind in _SCALAR_OF)}"
        raise ConversionError(f"IMAGE: found shape {pixels.shape}, {pixels.dtype}, expected {expected}")
    return pixels


def _image(value: object, matrix: object) -> Image:
    pixels = _pixel_array(value)
    slices, rows, columns, components = pixels.shape
    size = (columns, rows, slices)
    placed = np.eye(4)[:3]
    if matrix is None:
        placed = placed.copy()
    else:
        placed = _pose("IMAGE matrix", matrix).copy()
        # the wire has the centre of the volume, the matrix the centre of the first voxel
        placed[:, 3] += placed[:, :3] @ ((np.array(size) - 1) / 2)
    big = pixels.dtype.byteorder == ">"
    return Image(
        size,
        _SCALAR_OF[pixels.dtype.newbyteorder("=")],
        np.ascontiguousarray(pixels).reshape(-1).view(np.uint8).data if pixels.size else b"",
        components,
        BIG_ENDIAN if big else LITTLE_ENDIAN,
        wire_matrix=tuple(placed.T.reshape(-1).tolist()),
    )


def _points(value: object) -> Points:
    return Points.of(numbers("POINT", value, ((None, 3),)))


def _surface(value: object) -> PolyData:
    """Points, or (points, triangles)."""
    if isinstance(value, tuple) and len(value) == 2:
        points = numbers("POLYDATA points", value[0], ((None, 3),))
        triangles = numbers("POLYDATA triangles", value[1], ((None, 3),), np.int64)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
            found = f"point index {triangles.max() if triangles.min() >= 0 else triangles.min()}"
            raise ConversionError(f"POLYDATA triangles: found {found}, expected 0 to {len(points) - 1}")
        return PolyData(points.astype(">f4"), polygons=Cells.of(triangles))
    points = numbers("POLYDATA", value, ((None, 3),))
    return PolyData(points.astype(">f4"), vertices=Cells.of_all(len(points)))


def _sensor(value: object, unit: str) -> Sensor:
    try:
        word = parse_unit(unit)
    except ValueError as error:
        raise ConversionError(f"SENSOR: {error}") from None
    return Sensor(np.atleast_1d(numbers("SENSOR", value, ((None,), ()))), word)


def _ndarray(value: object) -> NdArray:
    array = np.asarray(value)
    if array.dtype == np.int64:  # what a list of integers becomes; the protocol ends at 32 bits
        small = array.astype(np.int32)
        array = small if (small == array).all() else array
    scalar = _ND_SCALAR_OF.get(array.dtype.newbyteorder("="))
    if scalar is None or not array.ndim:
        kinds = ", ".join(str(kind) for kind in _ND_SCALAR_OF)
        raise ConversionError(f"NDARRAY: found shape {array.shape}, {array.dtype}, expected 1 or more of {kinds}")
    return NdArray(scalar, array.shape, np.ascontiguousarray(array, NDARRAY_SCALARS[scalar]).tobytes())


def _tools(place: str, value: object) -> list[tuple[bytes, Array]]:
    if not isinstance(value, Mapping):
        raise ConversionError(f"{place}: found {_shown(value)}, expected poses by name: {{'Probe': matrix}}")
    return [(str(name).encode(), _pose(f"{place} {name!r}", pose)) for name, pose in value.items()]


def _tracking(value: object) -> TrackingData:
    tools = _tools("TDATA", value)
    elements = np.zeros(len(tools), TRACKING_DTYPE)
    for element, (name, pose) in zip(elements, tools, strict=True):
        element["name"], element["type"], element["matrix"] = name, TOOL_6D, pose.T.reshape(-1)
    return TrackingData(elements)


def _quaternion_tracking(value: object) -> QuaternionTrackingData:
    tools = _tools("QTDATA", value)
    elements = np.zeros(len(tools), QTRACKING_DTYPE)
    for element, (name, pose) in zip(elements, tools, strict=True):
        element["name"], element["type"], element["position"] = name, TOOL_6D, pose[:, 3]
        element["quaternion"] = _quaternion("QTDATA", pose)
    return QuaternionTrackingData(elements)


def _capability(value: object) -> Capability:
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(name, str) for name in value):
        raise ConversionError(f"CAPABILITY: found {_shown(value)}, expected type names such as ['IMAGE', 'STRING']")
    return Capability(tuple(value))


_TEXTS = frozenset({"STRING", "CLIENTINFO"})
#: Message type → content for a value.
_ROWS: Mapping[str, Callable[[object], Body]] = {
    "TRANSFORM": _transform,
    "POSITION": _position,
    "STRING": lambda value: String.of(_text("STRING", value)),
    "CLIENTINFO": lambda value: ClientInfo.of(_text("CLIENTINFO", value)),
    "STATUS": _status,
    "POINT": _points,
    "POLYDATA": _surface,
    "NDARRAY": _ndarray,
    "TDATA": _tracking,
    "QTDATA": _quaternion_tracking,
    "CAPABILITY": _capability,
}
#: Types that take plain values.
VALUE_TYPES = frozenset(_ROWS) | {"IMAGE", "SENSOR"}

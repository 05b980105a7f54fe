"""POINT and POLYDATA clouds ⇄ sensor_msgs/PointCloud2 and geometry_msgs/PointStamped.

All arithmetic works on columns of numpy views, without loops over points.

Points with NaN or infinite coordinates (the holes of an organised cloud) have no counterpart in OpenIGTLink and are
left out.  Colours are sent as a point scalar of 3 or 4 components from 0 to 1: the reference library reads beyond the
end of the RGBA attribute of POLYDATA, but not of scalars.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.free_names import FreeNames
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import POINT_FIELD_DTYPES, Header, PointCloud2, PointField, PointStamped
from igtl_gateway.convert.scaling import all_finite, into_igtl, into_ros
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.point import POINT_DTYPE, Points
from igtl_gateway.wire.polydata import (
    CELL,
    MAX_ATTRIBUTES,
    MAX_COMPONENTS,
    NO_CELLS,
    NORMAL,
    RGBA,
    SCALAR,
    Attribute,
    Cells,
    PolyData,
)

Array = npt.NDArray[Any]

_FLOAT32, _UINT32 = 7, 6
_XYZ = ("x", "y", "z")
_NORMALS = ("normal_x", "normal_y", "normal_z")
_COLOURS = ("rgb", "rgba")
_DIAMETER = "diameter"

#: Attribute names that hold colours, with their number of components.
RGB_NAME, RGBA_NAME = "RGB", "RGBA"
_COLOUR_COMPONENTS = {3: "rgb", 4: "rgba"}


@ieee_754
def points_to_cloud(content: Points, to: ToRosContext) -> PointCloud2:
    """Convert to a cloud with x, y, z, rgba and diameter; names, groups and owners have no field in a cloud."""
    elements = content.elements
    # copy to contiguous memory first: arithmetic on strided numbers takes ten times as long
    numbers = elements.view(_NUMBERS)["lengths"].copy().view(">f4").astype("<f4")
    into_ros(to.lengths, numbers, numbers)
    words = elements.view(_NUMBERS)["rgba"].astype("<u4")
    alpha = words << 24
    words >>= 8
    words |= alpha
    points, lengths = np.empty(len(elements), _POINT), numbers.view(_LENGTHS)
    points["position"], points["rgba"], points["diameter"] = lengths["position"], words, lengths["diameter"]
    finite = all_finite(numbers) or all_finite(numbers.reshape(-1, 4)[:, :3])
    return _cloud(_POINT_FIELDS, points, finite, to)


def is_single(content: Points) -> bool:
    """Return whether the message has exactly one point."""
    return len(content.elements) == 1


@ieee_754
def point_to_ros(content: Points, to: ToRosContext) -> PointStamped:
    """Convert the first point; the table selects messages with exactly one."""
    x, y, z = content.elements["position"][0].tolist()
    lengths = to.lengths
    return PointStamped(Header(to.stamp_ns, to.frame_id), (lengths.to_ros(x), lengths.to_ros(y), lengths.to_ros(z)))


@ieee_754
def point_to_igtl(message: PointStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POINT with one unnamed element.  Raises ConversionError for NaN and infinity."""
    positions = to.lengths.to_igtl(np.array([message.point])).astype(">f4")
    if not np.isfinite(positions).all():
        raise ConversionError(f"PointStamped: found {message.point}, expected finite numbers")
    return ConvertedMessage(Points.of(positions), message.header.stamp_ns, message.header.frame_id)


@ieee_754
def cloud_to_points(message: PointCloud2, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POINT (136 bytes per point), with colour and diameter if the cloud has these fields."""
    columns = CloudColumns.of(message)
    positions, kept = _finite_positions(columns, to)
    colours = _colours(columns)
    diameters: Array | float = 0.0
    if columns.is_single(_DIAMETER):
        column = columns[_DIAMETER][kept]
        diameters = into_igtl(to.lengths, column, np.empty(len(column), ">f4"))
    content = Points.of(positions, None if colours is None else colours[kept], diameters)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id)


@ieee_754
def cloud_to_polydata(message: PointCloud2, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POLYDATA: 12 bytes per point, 4 for its vertex, and one attribute for each other field.

    One vertex cell lists all points: without cells, viewers that use VTK draw nothing; with one cell per point, the
    C++ bridge crashed at 200,000 points.
    """
    columns = CloudColumns.of(message)
    positions, kept = _finite_positions(columns, to)
    count = len(positions)
    attributes = []
    known = set(_XYZ)
    colours = _colours(columns)
    if colours is not None:
        name, components = (RGBA_NAME, 4) if columns.is_packed("rgba") else (RGB_NAME, 3)
        attributes.append(Attribute.of(SCALAR, name, _unit_range(colours[kept][:, :components])))
        known |= {name for name in _COLOURS if columns.is_packed(name)}
    if all(columns.is_single(name) for name in _NORMALS):
        normals = np.stack([columns[name][kept] for name in _NORMALS], axis=1)
        attributes.append(Attribute.of(NORMAL, "Normals", normals))
        known |= set(_NORMALS)
    for name in columns.fields:
        if name in known:
            continue
        if len(attributes) == MAX_ATTRIBUTES:
            text = f"fields from {name!r} on are left out: a message has at most {MAX_ATTRIBUTES} attributes"
            to.warnings.append(("field_left_out", text))
            break
        values = columns[name]
        width = values.shape[1] if values.ndim > 1 else 1
        if width > MAX_COMPONENTS:
            text = f"field {name!r} is left out: {counted(width, 'value')} per point, maximum {MAX_COMPONENTS}"
            to.warnings.append(("field_left_out", text))
            continue
        if values.dtype.itemsize > np.dtype(np.float32).itemsize or (
            values.dtype.kind in "iu" and values.dtype.itemsize > 2
        ):
            to.warnings.append(("float32_attribute", f"field {name!r} ({values.dtype}) is sent as float32"))
        attributes.append(Attribute.of(SCALAR, name, values[kept].reshape(count, width)))
    vertices = Cells.of_all(count) if count else NO_CELLS
    content = PolyData(positions, vertices, attributes=tuple(attributes))
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id)


@ieee_754
def polydata_to_cloud(content: PolyData, to: ToRosContext) -> PointCloud2:
    """Convert to a cloud with the point attributes as fields; cells and their attributes are left out.

    No attribute replaces another one: underscores are appended to a name that is in use or has another meaning in
    clouds, and a number where many have it.
    """
    count = len(content.points)
    columns: dict[str, Array] = {}  # besides the positions
    names = FreeNames((*_XYZ, *_COLOURS))
    for attribute in content.attributes:
        if attribute.type & CELL or attribute.tuples != count or not attribute.components:
            continue
        values = attribute.values
        field = colour_field(attribute)
        if field and field not in columns:
            columns[field] = _packed(colour_bytes(values))
            if field == "rgb":
                columns[field] = columns[field].view("<f4")  # as PCL packs it
        elif attribute.type == NORMAL and values.shape[1] == len(_NORMALS) and columns.keys().isdisjoint(_NORMALS):
            columns |= {names.take(name): values[:, axis] for axis, name in enumerate(_NORMALS)}
        else:
            columns[names.take(visible(attribute.name) or f"attribute{len(_XYZ) + len(columns)}")] = values
    fields, words = list(_XYZ_FIELDS), len(_XYZ)
    widths = [values.shape[1] if values.ndim > 1 else 1 for values in columns.values()]
    for (name, values), width in zip(columns.items(), widths, strict=True):
        fields.append(PointField(name, 4 * words, _UINT32 if values.dtype.kind == "u" else _FLOAT32, width))
        words += width
    points = np.empty((count, words), "<f4")
    positions = into_ros(to.lengths, content.points, points[:, :3])
    end = len(_XYZ)
    for values, width in zip(columns.values(), widths, strict=True):
        target = points.view("<u4") if values.dtype.kind == "u" else points
        target[:, end : end + width] = values.reshape(count, width)
        end += width
    return _cloud(tuple(fields), points, all_finite(positions), to)


def colour_field(attribute: Attribute) -> str | None:
    """Return ``"rgb"`` or ``"rgba"`` if the attribute holds 3 or 4 colour components, by type or name; else None."""
    components = attribute.values.shape[1]
    if attribute.type & ~CELL == RGBA or (
        attribute.type & ~CELL == SCALAR and attribute.name.upper() in (RGB_NAME, RGBA_NAME, "COLORS")
    ):
        return _COLOUR_COMPONENTS.get(components)
    return None


@dataclass(frozen=True, slots=True)
class _Field:
    """The position of a field in each point; offset in bytes."""

    dtype: np.dtype[Any]
    offset: int
    count: int


@lru_cache(maxsize=64)
def _layout(items: tuple[PointField, ...], is_bigendian: bool, point_step: int) -> dict[str, _Field]:
    """Return the fields by name.  Raises ConversionError if they do not fit the points, or x, y or z is missing."""
    fields: dict[str, _Field] = {}
    for item in items:
        kind = POINT_FIELD_DTYPES.get(item.datatype)
        if kind is None:
            raise ConversionError(
                f"sensor_msgs/PointCloud2, field {item.name!r}: found datatype {item.datatype}, expected 1 … 8"
            )
        if not item.name or item.name in fields:
            continue  # padding, or a second field with the same name
        dtype = np.dtype((">" if is_bigendian else "<") + kind)
        if item.offset + dtype.itemsize * max(item.count, 1) > point_step:
            raise ConversionError(
                f"sensor_msgs/PointCloud2, field {item.name!r}: found offset {item.offset}, "
                f"expected to end within point_step {point_step}"
            )
        fields[item.name] = _Field(dtype, item.offset, max(item.count, 1))
    if missing := [name for name in _XYZ if name not in fields or fields[name].count > 1]:
        raise ConversionError(
            f"sensor_msgs/PointCloud2: found fields {list(fields)}, expected {', '.join(missing)} too, one value each"
        )
    return fields


@dataclass(frozen=True, slots=True)
class CloudColumns:
    """The fields of a cloud as views on its data, each an array (n,) or (n, count)."""

    fields: dict[str, _Field]
    data: Buffer | Array
    points: int
    step: int

    @classmethod
    def of(cls, message: PointCloud2) -> CloudColumns:
        """Return the columns of a cloud.  Raises ConversionError if the data do not match their description."""
        size = memoryview(message.data).nbytes
        step = message.point_step
        row = message.width * step
        if (message.height > 1 and message.row_step < row) or size < message.row_step * (message.height - 1) + row:
            raise ConversionError(
                f"sensor_msgs/PointCloud2: found {counted(size, 'byte')} (row_step {message.row_step}), "
                f"expected {counted(message.height, 'row')} of {row} bytes"
            )
        fields = _layout(message.fields, message.is_bigendian, step)
        count = message.width * message.height
        if not count:  # an empty cloud might have an arbitrary layout
            return cls(dict.fromkeys(fields, _NOTHING), b"", 0, 0)
        if message.height == 1 or message.row_step == row:
            return cls(fields, message.data, count, step)
        padded = np.ndarray((message.height, row), np.uint8, message.data, 0, (message.row_step, 1))
        return cls(fields, np.ascontiguousarray(padded), count, step)

    def __getitem__(self, name: str) -> Array:
        field = self.fields[name]
        return self._view(field, field.count)

    def _view(self, field: _Field, count: int) -> Array:
        """Return ``count`` consecutive values of every point, beginning with a field."""
        if count == 1:
            return np.ndarray((self.points,), field.dtype, self.data, field.offset, (self.step,))
        return np.ndarray((self.points, count), field.dtype, self.data, field.offset, (self.step, field.dtype.itemsize))

    def is_single(self, name: str) -> bool:
        """Return whether the cloud has this field, with one value per point."""
        return name in self.fields and self.fields[name].count == 1

    def is_packed(self, name: str) -> bool:
        """Return whether the cloud has this field, with one 4-byte word per point."""
        return self.is_single(name) and self.fields[name].dtype.itemsize == np.dtype(np.uint32).itemsize

    @property
    def positions(self) -> tuple[Array, ...]:
        """x, y and z, as one array (n, 3) if the cloud has no other data."""
        x, y, z = (self.fields[name] for name in _XYZ)
        size = x.dtype.itemsize
        places = x.offset, y.offset, z.offset, self.step
        if x.dtype == y.dtype == z.dtype and places == (0, size, 2 * size, 3 * size):
            return (self._view(x, len(_XYZ)),)
        return tuple(self[name] for name in _XYZ)


_NOTHING = _Field(np.dtype("<f4"), 0, 1)


def _finite_positions(columns: CloudColumns, to: ToIgtlContext) -> tuple[Array, Any]:
    """Return the (m, 3) wire positions of the points with finite coordinates, and the index that selects them."""
    positions = np.empty((columns.points, 3), ">f4")
    sources = columns.positions
    for source, target in zip(sources, (positions,) if len(sources) == 1 else positions.T, strict=True):
        into_igtl(to.lengths, source, target)
    if all_finite(positions):
        return positions, slice(None)
    kept = np.isfinite(positions).all(axis=1)
    return positions[kept], kept


def _colours(columns: CloudColumns) -> Array | None:
    """Return (n, 4) uint8 RGBA of a packed ``rgb`` or ``rgba`` field, or None."""
    for name in reversed(_COLOURS):
        if columns.is_packed(name):
            packed = columns[name]
            words = packed.view(packed.dtype.str[0] + "u4").astype(np.uint32)
            colours = words << 8  # of 0xAARRGGBB
            colours |= 255 if name == "rgb" else words >> 24
            return colours.astype(">u4").view(np.uint8).reshape(-1, 4)
    return None


def _unit_range(colours: Array) -> Array:
    """Return uint8 0 … 255 as float32 0 … 1; ``colour_bytes`` is the exact inverse."""
    return np.divide(colours, 255.0, out=np.empty(colours.shape, ">f4"), dtype=np.float64, casting="same_kind")


def colour_bytes(colours: Array) -> Array:
    """Return colours 0 … 1 as uint8."""
    numbers = unit_colours(colours).astype(np.float64)
    np.fmin(np.fmax(numbers, 0.0, out=numbers), 1.0, out=numbers)  # NaN becomes 0
    numbers *= 255.0
    return np.rint(numbers, out=numbers).astype(np.uint8)


def unit_colours(colours: Array) -> Array:
    """Return colours in the range 0 … 1.  If any value is above 1, the range of all is 0 … 255."""
    return colours / 255.0 if np.fmax.reduce(colours, axis=None, initial=0.0) > 1.0 else colours


def _packed(colours: Array) -> Array:
    """Return (n, 3 or 4) uint8 RGB(A) as words 0xAARRGGBB; alpha is 255 by default."""
    words = np.full((len(colours), 4), 255, np.uint8)
    for place, channel in zip((2, 1, 0, 3), colours.T, strict=False):
        words[:, place] = channel
    return words.reshape(-1).view("<u4")


_XYZ_FIELDS = tuple(PointField(name, 4 * axis, _FLOAT32) for axis, name in enumerate(_XYZ))

#: View of an element of POINT: colour as a word; position and diameter, which are four consecutive numbers.
_NUMBERS = np.dtype(
    {
        "names": ["rgba", "lengths"],
        "formats": [">u4", "V16"],
        "offsets": [POINT_DTYPE.fields[name][1] for name in ("rgba", "position")] if POINT_DTYPE.fields else [],
        "itemsize": POINT_DTYPE.itemsize,
    }
)
_LENGTHS = np.dtype([("position", "V12"), ("diameter", "<f4")])
#: A point of the cloud that POINT is converted to.
_POINT = np.dtype([("position", "V12"), ("rgba", "<u4"), ("diameter", "<f4")])
_POINT_FIELDS = (*_XYZ_FIELDS, PointField("rgba", 12, _UINT32), PointField(_DIAMETER, 16, _FLOAT32))


def _cloud(fields: tuple[PointField, ...], points: Array, is_dense: bool, to: ToRosContext) -> PointCloud2:
    """Return an unorganised cloud; each point is a row of 4-byte words."""
    count = len(points)
    data = points.view(np.uint8).reshape(-1).data if count else b""
    step = points.nbytes // count if count else fields[-1].offset + 4 * fields[-1].count
    return PointCloud2(Header(to.stamp_ns, to.frame_id), 1, count, fields, False, step, step * count, data, is_dense)

"""POINT and POLYDATA clouds ⇄ sensor_msgs/PointCloud2 and geometry_msgs/PointStamped.

Everything is column arithmetic on numpy views: no loop over points.

Points with a coordinate that is not finite (the holes of an organised cloud) have no counterpart in
OpenIGTLink and are left out.  Colours travel as a point scalar of 3 or 4 components between 0 and 1: the
RGBA attribute of POLYDATA is over-read by the reference library, scalars are not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.context import Outgoing, ToIgtl, ToRos
from igtl_gateway.convert.rosmsg import POINT_FIELD_DTYPES, Header, PointCloud2, PointField, PointStamped
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import (
    CELL,
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
def points_to_ros(content: Points, to: ToRos) -> PointCloud2:
    """x, y, z, rgba and diameter of every point; names, groups and owners have no place in a cloud."""
    elements = content.elements
    columns = _position_columns(to.lengths.to_ros(elements["position"]))
    columns["rgba"] = _packed(elements["rgba"])
    columns[_DIAMETER] = to.lengths.to_ros(elements["diameter"]).astype("<f4")
    return _cloud(columns, len(elements), to)


def is_single(content: Points) -> bool:
    """Whether there is one point only."""
    return len(content.elements) == 1


@ieee_754
def point_to_ros(content: Points, to: ToRos) -> PointStamped:
    """The first (in the table: the only) point."""
    x, y, z = content.elements["position"][0].tolist()
    lengths = to.lengths
    return PointStamped(Header(to.stamp_ns, to.frame_id), (lengths.to_ros(x), lengths.to_ros(y), lengths.to_ros(z)))


@ieee_754
def point_to_igtl(message: PointStamped, to: ToIgtl) -> Outgoing:
    """As POINT with one nameless element.  Raises ConversionError for numbers that are not finite."""
    positions = to.lengths.to_igtl(np.array([message.point])).astype(">f4")
    if not np.isfinite(positions).all():
        raise ConversionError(f"PointStamped: found {message.point}, expected finite numbers")
    return Outgoing(Points.of(positions), message.header.stamp_ns, message.header.frame_id)


@ieee_754
def cloud_to_points(message: PointCloud2, to: ToIgtl) -> Outgoing:
    """As POINT (136 bytes a point), with colour and diameter where the cloud has them."""
    columns = _columns(message)
    positions, kept = _finite_positions(columns, to)
    colours = _colours(columns)
    diameters: Array | float = 0.0
    if _DIAMETER in columns and columns[_DIAMETER].ndim == 1:
        diameters = to.lengths.to_igtl(columns[_DIAMETER][kept]).astype(">f4")
    content = Points.of(positions, None if colours is None else colours[kept], diameters)
    return Outgoing(content, message.header.stamp_ns, message.header.frame_id)


@ieee_754
def cloud_to_polydata(message: PointCloud2, to: ToIgtl) -> Outgoing:
    """As POLYDATA: 12 bytes a point, 4 for its vertex, and an attribute for every further field.

    One vertex cell lists all points: without cells VTK based viewers draw nothing, with one cell for each point
    the C++ bridge crashed at 200,000.
    """
    columns = _columns(message)
    positions, kept = _finite_positions(columns, to)
    count = len(positions)
    attributes = []
    told = set(_XYZ)
    colours = _colours(columns)
    if colours is not None:
        name, components = (RGBA_NAME, 4) if _is_packed(columns, "rgba") else (RGB_NAME, 3)
        attributes.append(Attribute.of(SCALAR, name, _unit_range(colours[kept][:, :components])))
        told |= {name for name in _COLOURS if _is_packed(columns, name)}
    if all(name in columns and columns[name].ndim == 1 for name in _NORMALS):
        normals = np.stack([columns[name][kept] for name in _NORMALS], axis=1)
        attributes.append(Attribute.of(NORMAL, "Normals", normals))
        told |= set(_NORMALS)
    for name, values in columns.items():
        if name in told:
            continue
        width = values.shape[1] if values.ndim > 1 else 1
        if width > MAX_COMPONENTS:
            to.warnings.append(("field_left_out", f"field {name!r} has {width} values a point, above {MAX_COMPONENTS}"))
            continue
        if values.dtype.itemsize > np.dtype(np.float32).itemsize or (
            values.dtype.kind in "iu" and values.dtype.itemsize > 2
        ):
            to.warnings.append(("float32_attribute", f"field {name!r} ({values.dtype}) is sent as float32"))
        attributes.append(Attribute.of(SCALAR, name, values[kept].reshape(count, width)))
    vertices = Cells.of(np.arange(count).reshape(1, -1)) if count else NO_CELLS
    content = PolyData(positions, vertices, attributes=tuple(attributes))
    return Outgoing(content, message.header.stamp_ns, message.header.frame_id)


@ieee_754
def polydata_to_cloud(content: PolyData, to: ToRos) -> PointCloud2:
    """Points with their point attributes as fields; cells and attributes of cells have no place in a cloud.

    No attribute ever takes the place of another: a name that is taken, or that means something else to readers
    of clouds, gets underscores added.
    """
    count = len(content.points)
    columns = _position_columns(to.lengths.to_ros(content.points))
    for attribute in content.attributes:
        if attribute.type & CELL or attribute.tuples != count or not attribute.components:
            continue
        values = attribute.values
        field = colour_field(attribute)
        if field and field not in columns:
            columns[field] = _packed(_bytes_of(values))
            if field == "rgb":
                columns[field] = columns[field].view("<f4")  # as PCL packs it
        elif attribute.type == NORMAL and values.shape[1] == len(_NORMALS) and columns.keys().isdisjoint(_NORMALS):
            columns |= {name: values[:, axis].astype("<f4") for axis, name in enumerate(_NORMALS)}
        else:
            name = visible(attribute.name) or f"attribute{len(columns)}"
            while name in columns or name in _COLOURS:
                name += "_"
            columns[name] = values.astype("<f4")
    return _cloud(columns, count, to)


def colour_field(attribute: Attribute) -> str | None:
    """``"rgb"`` or ``"rgba"`` if the attribute holds colours: by its type, or by its name and components."""
    components = attribute.values.shape[1]
    if attribute.type & ~CELL == RGBA or (
        attribute.type & ~CELL == SCALAR and attribute.name.upper() in (RGB_NAME, RGBA_NAME, "COLORS")
    ):
        return _COLOUR_COMPONENTS.get(components)
    return None


def _columns(message: PointCloud2) -> dict[str, Array]:
    """Every field as an array (n,) or (n, count): views on the data.  Raises ConversionError."""
    count = message.width * message.height
    size = memoryview(message.data).nbytes
    row = message.width * message.point_step
    if (message.height > 1 and message.row_step < row) or size < message.row_step * (message.height - 1) + row:
        raise ConversionError(
            f"sensor_msgs/PointCloud2: found {size} bytes (row_step {message.row_step}), "
            f"expected {message.height} rows of {row} bytes"
        )
    names, formats, offsets = [], [], []
    for item in message.fields:
        kind = POINT_FIELD_DTYPES.get(item.datatype)
        if kind is None:
            raise ConversionError(
                f"sensor_msgs/PointCloud2, field {item.name!r}: found datatype {item.datatype}, expected 1 … 8"
            )
        if not item.name or item.name in names:
            continue  # padding, or a second field of one name: there is no telling which is meant
        dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
        if item.offset + dtype.itemsize * max(item.count, 1) > message.point_step:
            raise ConversionError(
                f"sensor_msgs/PointCloud2, field {item.name!r}: found offset {item.offset}, "
                f"expected to end within point_step {message.point_step}"
            )
        names.append(item.name)
        formats.append((dtype, item.count) if item.count > 1 else dtype)
        offsets.append(item.offset)
    single = {name for name, kind in zip(names, formats, strict=True) if isinstance(kind, np.dtype)}
    if missing := [name for name in _XYZ if name not in single]:
        raise ConversionError(
            f"sensor_msgs/PointCloud2: found fields {names}, expected {', '.join(missing)} too, one value each"
        )
    if not count:  # whatever it says of its layout, there is nothing to lay out
        return {name: np.empty(0, np.float32) for name in names}
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})
    shape, strides = (message.height, message.width), (message.row_step, message.point_step)
    if message.height == 1 or message.row_step == row:
        points = np.frombuffer(message.data, layout, count)
    else:
        points = np.ndarray(shape, layout, message.data, 0, strides).reshape(-1)
    return {name: points[name] for name in names}


def _finite_positions(columns: dict[str, Array], to: ToIgtl) -> tuple[Array, Any]:
    """(m, 3) positions for the wire of the points that have finite ones, and what selects these points."""
    positions = np.empty((len(columns["x"]), 3), ">f4")
    for axis, name in enumerate(_XYZ):
        positions[:, axis] = to.lengths.to_igtl(columns[name]).astype(">f4")
    finite = np.isfinite(positions)
    if finite.all():
        return positions, slice(None)
    kept = finite.all(axis=1)
    return positions[kept], kept


def _colours(columns: dict[str, Array]) -> Array | None:
    """(n, 4) uint8 RGBA of a packed ``rgb`` or ``rgba`` field, else None."""
    for name in reversed(_COLOURS):
        if _is_packed(columns, name):
            packed = np.ascontiguousarray(columns[name])
            word = packed.view(packed.dtype.str[0] + "u4").astype("<u4")
            colours = word.view(np.uint8).reshape(-1, 4)[:, [2, 1, 0, 3]]
            if name == "rgb":
                colours[:, 3] = 255
            return colours
    return None


def _is_packed(columns: dict[str, Array], name: str) -> bool:
    """Whether a field holds one 4-byte word a point."""
    return name in columns and columns[name].ndim == 1 and columns[name].dtype.itemsize == np.dtype(np.uint32).itemsize


def _unit_range(colours: Array) -> Array:
    """uint8 0 … 255 as 0 … 1 in a way that ``_bytes_of`` undoes exactly."""
    return (colours / 255.0).astype(">f4")


def _bytes_of(colours: Array) -> Array:
    """Colours 0 … 1 as uint8."""
    return np.rint(np.clip(np.nan_to_num(unit_colours(colours).astype(np.float64)), 0.0, 1.0) * 255.0).astype(np.uint8)


def unit_colours(colours: Array) -> Array:
    """Colours 0 … 1; where any value is above 1, all are taken as 0 … 255."""
    return colours / 255.0 if (colours > 1.0).any() else colours


def _packed(colours: Array) -> Array:
    """(n, 3 or 4) uint8 RGB(A) as 0xAARRGGBB words (alpha 255 where there is none)."""
    word = np.full((len(colours), 4), 255, np.uint8)
    word[:, 2], word[:, 1], word[:, 0] = colours[:, 0], colours[:, 1], colours[:, 2]
    if colours.shape[1] > 3:
        word[:, 3] = colours[:, 3]
    return word.reshape(-1).view("<u4")


def _position_columns(xyz: Array) -> dict[str, Array]:
    """x, y, z as float32, the type that every reader of clouds knows."""
    return {name: xyz[:, axis].astype("<f4") for axis, name in enumerate(_XYZ)}


def _cloud(columns: dict[str, Array], count: int, to: ToRos) -> PointCloud2:
    """An unorganised cloud of 4-byte fields."""
    fields, offset, formats = [], 0, []
    for name, values in columns.items():
        width = values.shape[1] if values.ndim > 1 else 1
        fields.append(PointField(name, offset, _UINT32 if values.dtype.kind == "u" else _FLOAT32, width))
        formats.append((values.dtype, width) if width > 1 else values.dtype)
        offset += 4 * width
    points = np.empty(count, np.dtype({"names": list(columns), "formats": formats}))
    for name, values in columns.items():
        points[name] = values if points[name].ndim == values.ndim else values.reshape(points[name].shape)
    finite = all(bool(np.isfinite(columns[name]).all()) for name in _XYZ)
    return PointCloud2(
        Header(to.stamp_ns, to.frame_id),
        1,
        count,
        tuple(fields),
        False,
        offset,
        offset * count,
        points.view(np.uint8).data if count else b"",
        finite,
    )

"""POLYDATA surfaces and lines ⇄ shape_msgs/Mesh and visualization_msgs/Marker."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.convert.clouds import RGBA_NAME, colour_field, unit_colours
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.poses import rotation_matrix, unit_quaternion
from igtl_gateway.convert.rosmsg import Header, Marker, Mesh
from igtl_gateway.convert.scaling import all_finite, into_igtl, into_ros
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.polydata import CELL, NO_CELLS, SCALAR, Attribute, Cells, PolyData

Array = npt.NDArray[Any]

#: Default colour, RGBA.
GREY = (0.8, 0.8, 0.8, 1.0)
#: Drawn width of lines and points in ROS viewers, in metres.
DRAWN_WIDTH = 0.001
_MIN_LINE, _MIN_FACE = 2, 3
#: Maximum number of triangles or line segments of one message: 4 bytes per point of a strip become 72 in a marker.
#: The largest surfaces in use have some hundred thousand; more separate triangles do not fit the longest message.
MAX_PIECES = 4_000_000


def has_faces(content: PolyData) -> bool:
    """Return whether the content has polygons or triangle strips."""
    return bool(content.polygons.count or content.triangle_strips.count)


def has_lines(content: PolyData) -> bool:
    return bool(content.lines.count)


def is_point_cloud(content: PolyData) -> bool:
    """Return whether the content has only points, with or without vertex cells."""
    return not has_faces(content) and not has_lines(content)


@ieee_754
def polydata_to_mesh(content: PolyData, to: ToRosContext) -> Mesh:
    """Convert to Mesh: all points, and the triangles of all polygons (as fans) and strips, in their order."""
    vertices = into_ros(to.lengths, content.points, np.empty(content.points.shape))
    return Mesh(_triangles(content).astype("<u4"), vertices)


def polydata_to_marker(content: PolyData, to: ToRosContext) -> Marker:
    """Convert the surface to a TRIANGLE_LIST."""
    return _marker(content, Marker.TRIANGLE_LIST, _triangles(content).reshape(-1), 1.0, to)


def polydata_to_lines(content: PolyData, to: ToRosContext) -> Marker:
    """Convert the lines to a LINE_LIST: a polyline of n points becomes n − 1 segments."""
    return _marker(content, Marker.LINE_LIST, _segments(content.lines).reshape(-1), DRAWN_WIDTH, to)


@ieee_754
def _marker(content: PolyData, kind: int, indices: Array, scale: float, to: ToRosContext) -> Marker:
    points = content.points.take(indices, axis=0)
    colors = np.empty((0, 4), np.float32)
    for attribute in content.attributes:
        if not attribute.type & CELL and attribute.tuples == len(content.points) and colour_field(attribute):
            colors = np.ones((len(indices), 4), np.float32)
            colors[:, : attribute.values.shape[1]] = unit_colours(attribute.values)[indices]
            break
    return Marker(
        Header(to.stamp_ns, to.frame_id),
        to.device_name,
        0,
        kind,
        scale=(scale, scale, scale),
        color=GREY,
        points=into_ros(to.lengths, points, np.empty(points.shape)),
        colors=colors,
    )


@ieee_754
def mesh_to_igtl(message: Mesh, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POLYDATA with one polygon for each triangle.

    Raises ConversionError for a vertex index out of range, NaN and infinity.
    """
    highest = int(message.triangles.max()) if message.triangles.size else -1
    if highest >= len(message.vertices):
        raise ConversionError(
            f"shape_msgs/Mesh: found vertex index {highest}, expected less than {len(message.vertices)}"
        )
    points = _finite(message.vertices, to, "shape_msgs/Mesh")
    return ConvertedMessage(PolyData(points, polygons=Cells.of(message.triangles)))


@ieee_754
def marker_to_igtl(message: Marker, to: ToIgtlContext) -> ConvertedMessage:
    """Convert lists of triangles, lines and points to POLYDATA, moved by the marker's pose.

    A deletion becomes an empty POLYDATA.  Raises ConversionError for shapes without points, NaN and infinity.
    """
    if message.action in DELETIONS:
        return ConvertedMessage(PolyData(np.empty((0, 3), ">f4")), message.header.stamp_ns, message.header.frame_id)
    count = len(message.points)
    shape = _SHAPES.get(message.type)
    if shape is None:
        raise ConversionError(
            f"visualization_msgs/Marker: found type {message.type}, expected one that lists points: {sorted(_SHAPES)}"
        )
    section, group = shape
    group = group or count
    if not group or count % group:
        raise ConversionError(
            f"visualization_msgs/Marker, type {message.type}: found {counted(count, 'point')}, expected groups of "
            f"{group or 1}"
        )
    indices = np.arange(count).reshape(-1, group)
    points = message.points
    if message.type == Marker.TRIANGLE_LIST:  # viewers apply the scale to the points of this list only
        points = points * np.array(message.scale)
    points = _finite(_apply_marker_pose(points, message), to, "visualization_msgs/Marker")
    attributes: tuple[Attribute, ...] = ()
    if len(message.colors) == count:
        attributes = (Attribute.of(SCALAR, RGBA_NAME, message.colors),)
    elif len(message.colors):
        text = f"colours are left out: {len(message.colors)} for {counted(count, 'point')}"
        to.warnings.append(("colours_left_out", text))
    cells: dict[str, Any] = {"vertices": NO_CELLS, "lines": NO_CELLS, "polygons": NO_CELLS} | {
        section: Cells.of(indices)
    }
    return ConvertedMessage(
        PolyData(points, **cells, attributes=attributes), message.header.stamp_ns, message.header.frame_id
    )


#: Actions that delete markers.
DELETIONS = (2, 3)
_CUBE_LIST = 6
#: Marker type → section of POLYDATA, points per cell (0: all points in one cell).
_SHAPES = {
    Marker.LINE_STRIP: ("lines", 0),
    Marker.LINE_LIST: ("lines", 2),
    _CUBE_LIST: ("vertices", 0),
    Marker.SPHERE_LIST: ("vertices", 0),
    Marker.POINTS: ("vertices", 0),
    Marker.TRIANGLE_LIST: ("polygons", 3),
}


def _finite(points: Array, to: ToIgtlContext, place: str) -> Array:
    """Return wire coordinates.  Raises ConversionError for NaN and infinity: cells refer to all points by index."""
    wire = into_igtl(to.lengths, points, np.empty(points.shape, ">f4"))
    if not all_finite(wire):
        raise ConversionError(f"{place}: found a coordinate that is not finite (as float32), expected finite numbers")
    return wire


def is_unrotated(message: Marker) -> bool:
    """Return whether the marker's pose has no rotation; all zero is unset, as in viewers."""
    return message.orientation in ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0))


def _apply_marker_pose(points: Array, message: Marker) -> Array:
    """Return (n, 3) points moved by the marker's pose, without a matrix product: its bits depend on the machine."""
    if is_unrotated(message):
        rotated = points
    else:
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        rotated = np.stack(
            [a * x + b * y + c * z for a, b, c in rotation_matrix(unit_quaternion(message.orientation))], axis=1
        )
    moved: Array = rotated + np.array(message.position)
    return moved


def _triangles(content: PolyData) -> Array:
    """Return (n, 3) indices of all polygons as fans, then of all strips with alternating winding."""
    polygons = _pieces(content.polygons, _MIN_FACE, _fan)
    if not content.triangle_strips.count:
        return polygons
    return np.concatenate([polygons, _pieces(content.triangle_strips, _MIN_FACE, _strip)])


def _segments(lines: Cells) -> Array:
    """Return (n, 2) indices of all polylines."""
    return _pieces(lines, _MIN_LINE, _line_segments)


def _fan(cells: Array) -> Array:
    """Return (n, k, 3) points of the triangles of (n, points) polygons: 0 1 2, 0 2 3, …"""
    cut = np.empty((len(cells), cells.shape[1] - 2, 3), cells.dtype)
    cut[:, :, 0] = cells[:, :1]
    cut[:, :, 1] = cells[:, 1:-1]
    cut[:, :, 2] = cells[:, 2:]
    return cut


def _strip(cells: Array) -> Array:
    """Return (n, k, 3) points of the triangles of (n, points) strips: 0 1 2, 2 1 3, 2 3 4, …"""
    cut = np.empty((len(cells), cells.shape[1] - 2, 3), cells.dtype)
    cut[:, ::2, 0] = cells[:, :-2:2]
    cut[:, ::2, 1] = cells[:, 1:-1:2]
    cut[:, 1::2, 0] = cells[:, 2:-1:2]
    cut[:, 1::2, 1] = cells[:, 1:-2:2]
    cut[:, :, 2] = cells[:, 2:]
    return cut


def _line_segments(cells: Array) -> Array:
    """Return (n, k, 2) points of the segments of (n, points) polylines: 0 1, 1 2, …"""
    cut = np.empty((len(cells), cells.shape[1] - 1, 2), cells.dtype)
    cut[:, :, 0] = cells[:, :-1]
    cut[:, :, 1] = cells[:, 1:]
    return cut


def _count(cells: Cells, size: int) -> int:
    """Return the number of rows that ``_pieces`` returns."""
    if (table := cells.table) is not None:
        return cells.count * max(int(table.shape[1]) - size + 1, 0)
    lengths = cells.data[cells.starts()].astype(np.int64)
    return int(np.maximum(lengths - size + 1, 0).sum())


def _pieces(cells: Cells, size: int, cut: Callable[[Array], Array]) -> Array:
    """Return (n, size) point indices: each cell as ``cut`` splits the cells of equal length, in their order.

    Cells of equal length are split together; cells that are too short are left out.  Raises ConversionError for more
    than MAX_PIECES pieces.
    """
    if not cells.count:
        return np.empty((0, size), np.int64)
    # a cell of n points has at most n pieces: most messages need no exact count
    if len(cells.data) > MAX_PIECES and (found := _count(cells, size)) > MAX_PIECES:
        raise ConversionError(f"POLYDATA: found cells of {count_text(found, 'piece')}, expected at most {MAX_PIECES:,}")
    if (table := cells.table) is not None:  # cells of equal length
        width = table.shape[1]
        if width == size:
            return table
        return cut(table).reshape(-1, size) if width > size else np.empty((0, size), table.dtype)
    starts = cells.starts()
    lengths = cells.data[starts].astype(np.int64)
    by_length = np.argsort(lengths, kind="stable")
    order, pieces = [], []
    for which in np.split(by_length, np.flatnonzero(np.diff(lengths[by_length])) + 1):
        length = int(lengths[which[0]])
        if length < size:
            continue
        pieces.append(cut(cells.data[starts[which][:, None] + np.arange(1, length + 1)]).reshape(-1, size))
        order.append(np.repeat(which, length - size + 1))
    if not pieces:
        return np.empty((0, size), np.int64)
    if len(pieces) == 1:
        return pieces[0].astype(np.int64)
    return np.concatenate(pieces)[np.argsort(np.concatenate(order), kind="stable")].astype(np.int64)

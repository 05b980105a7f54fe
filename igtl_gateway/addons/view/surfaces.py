"""Surfaces, lines and markers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.messages import (
    LengthUnits,
    ToIgtlContext,
    ToRosContext,
    has_faces,
    has_lines,
    polydata_to_igtl,
    polydata_to_lines,
    polydata_to_mesh,
    rotation_matrix,
)
from igtl_gateway.addon.ros import Marker, Mesh, PolyData, TrajectoryList
from igtl_gateway.addons.view import colours
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.clouds import POINT_M
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.markers import MarkerArray
from igtl_gateway.addons.view.other_msgs import Path

Array = npt.NDArray[Any]

#: Half the width of lines without a width, in metres.
LINE_M = 0.0004
_SAME = LengthUnits("m", "m")
_POINT_RGBA, _POINT_SCALAR = 4, 0
_COLOUR_COMPONENTS = (3, 4)

_ARROW, _CUBE, _SPHERE, _CYLINDER, _CUBE_LIST, _TEXT, _MESH_RESOURCE = 0, 1, 2, 3, 6, 9, 10
_DELETE, _DELETE_ALL = 2, 3
_WHAT = {
    Marker.LINE_STRIP: EntityKind.LINES,
    Marker.LINE_LIST: EntityKind.LINES,
    Marker.SPHERE_LIST: EntityKind.POINTS,
    Marker.POINTS: EntityKind.POINTS,
    Marker.TRIANGLE_LIST: EntityKind.MESH,
}


def draw_mesh(message: Mesh, canvas: Canvas) -> None:
    """shape_msgs/Mesh, which has no frame id."""
    frame = canvas.frame("")
    canvas.box(message.vertices)
    canvas.log(shaded_mesh(message.vertices, message.triangles, colours.BONE), frame=frame)


def shaded_mesh(vertices: Array, triangles: Array, colour: int, vertex_colours: Array | None = None) -> rr.Mesh3D:
    """Build a shaded surface.  Raises ConversionError if a triangle has a vertex that does not exist."""
    positions = np.asarray(vertices, np.float32)
    indices = np.asarray(triangles, np.uint32)
    if indices.size and int(indices.max()) >= len(positions):
        raise ConversionError(f"found a triangle with vertex {indices.max()}, expected below {len(positions)}")
    return rr.Mesh3D(
        vertex_positions=positions,
        triangle_indices=indices,
        vertex_normals=normals(positions, indices),
        vertex_colors=vertex_colours,
        albedo_factor=colour if vertex_colours is None else None,
    )


def normals(positions: Array, triangles: Array) -> Array:
    """Return unit normals of the vertices: the area-weighted mean of their triangles."""
    corners = positions[triangles].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = triangles.reshape(-1)
    weights = np.repeat(across, 3, axis=0)
    sums = [np.bincount(flat, weights[:, axis], len(positions)) for axis in range(3)]
    total = np.stack(sums, axis=1).astype(np.float64)  # numpy returns integers for empty input
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.divide(total, length, out=np.zeros_like(total), where=length > 0)
    finite: Array = np.nan_to_num(unit).astype(np.float32)
    return finite


def draw_polydata(message: PolyData, canvas: Canvas) -> None:
    """igtl_msgs/PolyData: faces, lines below ``lines``, and points if there are neither."""
    frame = canvas.frame(message.header.frame_id)
    content = polydata_to_igtl(message, ToIgtlContext(_SAME)).content
    to = ToRosContext("", 0, frame, "", _SAME)
    words = _attribute_colours(message)
    canvas.box(message.points)
    faces, lines = has_faces(content), has_lines(content)  # type: ignore[arg-type]
    segments = polydata_to_lines(content, to).points if lines else np.empty((0, 3))  # type: ignore[arg-type]
    strips = rr.LineStrips3D(segments.reshape(-1, 2, 3), colors=[canvas.colour], radii=[LINE_M])
    if faces:
        canvas.set_kind(EntityKind.MESH)
        mesh = polydata_to_mesh(content, to)  # type: ignore[arg-type]
        canvas.log(shaded_mesh(mesh.vertices, mesh.triangles, colours.BONE, words), frame=frame)
        if lines:
            canvas.log(strips, child="lines", frame=frame)
    elif lines:
        canvas.set_kind(EntityKind.LINES)
        canvas.log(strips, frame=frame)
    else:
        canvas.set_kind(EntityKind.CLOUD)
        colour: Any = [canvas.colour] if words is None else words
        canvas.log(rr.Points3D(message.points, colors=colour, radii=[rr.Radius.ui_points(2.0)]), frame=frame)


def _attribute_colours(message: PolyData) -> Array | None:
    """Return the colour of each point: from a colour attribute, else from the first scalar attribute."""
    count = len(message.points)
    for attribute in message.attributes:
        if attribute.type == _POINT_RGBA and attribute.components in _COLOUR_COMPONENTS:
            values = attribute.values.reshape(-1, attribute.components)
            if len(values) == count:
                return colours.rgba(values)
    for attribute in message.attributes:
        if attribute.type == _POINT_SCALAR and attribute.components == 1 and len(attribute.values) == count and count:
            return colours.scale_colours(attribute.values, *colours.span(attribute.values))
    return None


def draw_trajectories(message: TrajectoryList, canvas: Canvas) -> None:
    """igtl_msgs/TrajectoryList: a line from each entry point to its target, with its name."""
    frame = canvas.frame(message.header.frame_id)
    listed = message.trajectories
    strips = np.array([(each.entry, each.target) for each in listed], np.float32).reshape(-1, 2, 3)
    canvas.box(strips.reshape(-1, 3))
    lines = rr.LineStrips3D(
        strips,
        colors=np.array([colours.octet_colour(each.rgba, canvas.colour) for each in listed], np.uint32),
        radii=[each.diameter / 2 or LINE_M for each in listed],
        labels=[canvas.pen.displayable(each.name) for each in listed],
    )
    canvas.log(lines, frame=frame)


def draw_path(message: Path, canvas: Canvas) -> None:
    """nav_msgs/Path."""
    frame = canvas.frame(message.header.frame_id)
    strip = np.array([pose.pose[:3] for pose in message.poses], np.float32).reshape(-1, 3)
    canvas.box(strip)
    canvas.log(rr.LineStrips3D([strip], colors=[canvas.colour], radii=[LINE_M]), frame=frame)


def draw_marker(message: Marker, canvas: Canvas) -> None:
    """visualization_msgs/Marker: the first marker of the topic at its path, others below it."""
    canvas.set_kind(_WHAT.get(message.type, EntityKind.MARKERS))
    key = (message.ns, message.id)
    first = canvas.memory.setdefault("first", key)
    _draw(message, canvas, "" if key == first else f"{canvas.part(message.ns)}/{message.id}")


def draw_marker_array(message: MarkerArray, canvas: Canvas) -> None:
    """visualization_msgs/MarkerArray: each at ``<namespace>/<id>`` below the topic."""
    for marker in message.markers:
        _draw(marker, canvas, f"{canvas.part(marker.ns)}/{marker.id}")


def _draw(marker: Marker, canvas: Canvas, child: str) -> None:
    frame = canvas.frame(marker.header.frame_id)
    if marker.action == _DELETE_ALL:
        canvas.log(rr.Clear(recursive=True), child=child.partition("/")[0] if child else "")
    elif marker.action == _DELETE:
        canvas.log(rr.Clear(recursive=False), child=child)
    elif make := _SHAPES.get(marker.type):
        canvas.log(make(marker, canvas), child=child, frame=frame)
    else:
        canvas.text_once(f"markers of type {marker.type} are not drawn")


def posed(points: Array, marker: Marker) -> Array:
    """Return the (n, 3) points of a marker in its frame, in metres."""
    moved: Array = _rotated(points, marker) + np.array(marker.position)
    return moved


def _rotated(points: Array, marker: Marker) -> Array:
    turned: Array = np.asarray(points, np.float64) @ np.array(rotation_matrix(_unit(marker.orientation))).T
    return turned


def _unit(quaternion: Sequence[float]) -> tuple[float, float, float, float]:
    length = float(np.linalg.norm(quaternion))
    if not length or not np.isfinite(length):
        return (0.0, 0.0, 0.0, 1.0)
    x, y, z, w = (part / length for part in quaternion)
    return (x, y, z, w)


def _colours(marker: Marker, step: int = 1) -> Any:
    """Return one colour, or one for each element of ``step`` points."""
    if len(marker.colors) == len(marker.points) and len(marker.points):
        return colours.rgba(marker.colors[::step])
    return [colours.marker_colour(marker.color)]


def _lines(marker: Marker, canvas: Canvas) -> rr.LineStrips3D:
    points = posed(marker.points, marker)
    canvas.box(points)
    radii = [marker.scale[0] / 2 if marker.scale[0] > 0 else LINE_M]
    if marker.type == Marker.LINE_LIST:
        pairs = points[: len(points) // 2 * 2].reshape(-1, 2, 3)
        return rr.LineStrips3D(pairs, colors=_colours(marker, 2), radii=radii)
    if len(marker.colors) == len(points) > 1:
        pairs = np.stack([points[:-1], points[1:]], axis=1)
        return rr.LineStrips3D(pairs, colors=colours.rgba(marker.colors)[:-1], radii=radii)
    return rr.LineStrips3D([points], colors=_colours(marker), radii=radii)


def _points(marker: Marker, canvas: Canvas) -> rr.Points3D:
    points = posed(marker.points, marker)
    canvas.box(points)
    radius = marker.scale[0] / 2 if marker.scale[0] > 0 else POINT_M
    return rr.Points3D(points, colors=_colours(marker), radii=[radius])


def _triangles(marker: Marker, canvas: Canvas) -> rr.Mesh3D:
    points = posed(marker.points * np.array(marker.scale), marker)
    points = points[: len(points) // 3 * 3]
    canvas.box(points)
    words = colours.rgba(marker.colors)[: len(points)] if len(marker.colors) == len(marker.points) else None
    triangles = np.arange(len(points), dtype=np.uint32).reshape(-1, 3)
    return shaded_mesh(points, triangles, colours.marker_colour(marker.color), words)


def _arrow(marker: Marker, canvas: Canvas) -> rr.Arrows3D:
    if len(marker.points) > 1:
        points = posed(marker.points[:2], marker)
        origin, vector, radius = points[0], points[1] - points[0], marker.scale[0] / 2
    else:
        origin = np.array(marker.position)
        vector, radius = _rotated(np.array([[marker.scale[0], 0.0, 0.0]]), marker)[0], marker.scale[1] / 2
    canvas.box(np.stack([origin, origin + vector]))
    return rr.Arrows3D(origins=[origin], vectors=[vector], radii=[radius], colors=[colours.marker_colour(marker.color)])


def _solid(marker: Marker, canvas: Canvas) -> Any:
    centres = np.array([marker.position])
    canvas.box(centres)
    quaternions = [rr.Quaternion(xyzw=_unit(marker.orientation))]
    colour = [colours.marker_colour(marker.color)]
    half = [tuple(size / 2 for size in marker.scale)]
    if marker.type == _SPHERE:
        return rr.Ellipsoids3D(
            centers=centres, half_sizes=half, quaternions=quaternions, colors=colour, fill_mode=_FULL
        )
    if marker.type == _CYLINDER:
        lengths, radii = [marker.scale[2]], [marker.scale[0] / 2]
        return rr.Cylinders3D(
            lengths=lengths, radii=radii, centers=centres, quaternions=quaternions, colors=colour, fill_mode=_FULL
        )
    if marker.type == _CUBE_LIST:
        centres = posed(marker.points, marker)
        return rr.Boxes3D(centers=centres, half_sizes=half * len(centres), colors=_colours(marker), fill_mode=_FULL)
    return rr.Boxes3D(centers=centres, half_sizes=half, quaternions=quaternions, colors=colour, fill_mode=_FULL)


def _text(marker: Marker, canvas: Canvas) -> rr.Points3D:
    canvas.box(np.array([marker.position]))
    colour = [colours.marker_colour(marker.color)]
    return rr.Points3D(
        [marker.position], labels=[canvas.pen.displayable(marker.text)], colors=colour, radii=[POINT_M / 2]
    )


_FULL = rr.components.FillMode.Solid

_SHAPES: dict[int, Callable[[Marker, Canvas], Any]] = {
    _ARROW: _arrow,
    _CUBE: _solid,
    _SPHERE: _solid,
    _CYLINDER: _solid,
    Marker.LINE_STRIP: _lines,
    Marker.LINE_LIST: _lines,
    _CUBE_LIST: _solid,
    Marker.SPHERE_LIST: _points,
    Marker.POINTS: _points,
    _TEXT: _text,
    Marker.TRIANGLE_LIST: _triangles,
}

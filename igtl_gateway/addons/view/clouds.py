"""Points: coloured clouds and labelled points."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.ros import POINT_FIELD_DTYPES, PointCloud2, PointList, PointStamped
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.view import colours
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.legend import scale_bar, scale_text

Array = npt.NDArray[Any]

_XYZ = ("x", "y", "z")
_WORD = 4
#: A cloud with up to this number of points is drawn as single points: markers, a plan.
_FEW = 200
#: Up to this number of labels are always visible; with more points a label appears under the pointer.
_READABLE = 12
#: Fields that colour a cloud without colours, by precedence.
_SCALARS = ("intensity", "intensities", "i", "noise", "confidence", "curvature", "scalar")
#: Units of the fields that ROS defines; other fields have no known unit.
_UNITS = dict.fromkeys(_XYZ, "m")
_LEGEND = ("legend", "legend/numbers")
#: Radius of single points without a size, in metres.
POINT_M = 0.0008


def draw_cloud(message: PointCloud2, canvas: Canvas) -> None:
    """sensor_msgs/PointCloud2: the points with finite coordinates, coloured by ``Options.colour_by``."""
    frame = canvas.frame(message.header.frame_id)
    fields = columns(message)
    canvas.fields(fields)
    places = np.empty((len(fields["x"]), 3), np.float32)
    for axis, name in enumerate(_XYZ):
        places[:, axis] = fields[name]
    kept: Any = slice(None)
    if not message.is_dense or not np.isfinite(places.sum(dtype=np.float64)):
        kept = np.isfinite(places).all(axis=1)
        places = places[kept]
    words = _point_colours(fields, canvas)
    canvas.shown.coloured = words is not None
    canvas.box(places)
    if canvas.shown.scale and not canvas.memory.get("legend") and canvas.shown.low and canvas.shown.high:
        name, (low, high) = next(iter(canvas.memory["scales"].items()))
        box = canvas.shown.low, canvas.shown.high
        for child, part in zip(_LEGEND, scale_bar(name, low, high, _UNITS.get(name, ""), box), strict=True):
            canvas.log(part, child=child, frame=frame)
        canvas.memory["legend"] = True
    few = len(places) <= _FEW
    if few:
        canvas.set_kind(EntityKind.POINTS)
    radius = canvas.memory.get("radius")
    if radius is None and len(places):
        radius = canvas.memory["radius"] = point_size(places) if few else _radius(message, places)
    points = rr.Points3D(
        places,
        colors=[canvas.colour if few else colours.GREY] if words is None else words[kept],
        radii=None if radius is None else [radius],
    )
    canvas.log(points, frame=frame)


def columns(message: PointCloud2) -> dict[str, Array]:
    """Return each scalar field as an array (n,), a view on the data.  Raises ConversionError."""
    count = message.width * message.height
    row = message.width * message.point_step
    size = memoryview(message.data).nbytes
    if (message.height > 1 and message.row_step < row) or size < message.row_step * (message.height - 1) + row:
        raise ConversionError(
            f"{message.TYPE}: found {counted(size, 'byte')}, expected {counted(message.height, 'row')} of "
            f"{counted(row, 'byte')}"
        )
    order = ">" if message.is_bigendian else "<"
    found: dict[str, Array] = {}
    for item in message.fields:
        kind = POINT_FIELD_DTYPES.get(item.datatype)
        if kind is None or item.name in found or item.count > 1:
            continue
        dtype = np.dtype(order + kind)
        if item.offset + dtype.itemsize > message.point_step:
            raise ConversionError(f"{message.TYPE}: field {item.name!r} ends behind point_step {message.point_step}")
        if not count:
            found[item.name] = np.empty(0, dtype)
            continue
        shape, strides = (message.height, message.width), (message.row_step, message.point_step)
        view: Array = np.ndarray(shape, dtype, message.data, item.offset, strides)
        found[item.name] = view.reshape(-1)
    if missing := [name for name in _XYZ if name not in found]:
        raise ConversionError(f"{message.TYPE}: found fields {list(found)}, expected {', '.join(missing)} too")
    return found


def draw_point(message: PointStamped, canvas: Canvas) -> None:
    """geometry_msgs/PointStamped."""
    frame = canvas.frame(message.header.frame_id)
    canvas.box(np.array([message.point]))
    canvas.log(rr.Points3D([message.point], colors=[canvas.colour], radii=[POINT_M]), frame=frame)


def draw_point_list(message: PointList, canvas: Canvas) -> None:
    """igtl_msgs/PointList: names become labels; a point without a colour has the colour of the topic."""
    frame = canvas.frame(message.header.frame_id)
    points = message.points
    places = np.array([point.position for point in points], np.float32).reshape(-1, 3)
    canvas.box(places)
    size = point_size(places)
    shown = rr.Points3D(
        places,
        colors=np.array([colours.octet_colour(point.rgba, canvas.colour) for point in points], np.uint32),
        radii=[point.diameter / 2 or size for point in points],
        labels=[canvas.pen.displayable(point.name) for point in points],
        show_labels=len(points) <= _READABLE,
    )
    canvas.log(shown, frame=frame)


def point_size(places: Array) -> float:
    """Return the radius of single points in metres: ``POINT_M``, or less if the points are close together."""
    if not 1 < len(places) <= _FEW:
        return POINT_M
    gaps = np.linalg.norm(places[:, None].astype(np.float64) - places[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    near = float(np.median(gaps.min(axis=1)))
    return min(POINT_M, 0.2 * near) if near > 0 else POINT_M


def _point_colours(fields: dict[str, Array], canvas: Canvas) -> Array | None:
    """Return the colour of each point; None for a cloud without colours."""
    wanted = canvas.options.colour_by
    if wanted in fields and wanted not in ("rgb", "rgba"):
        return _scaled(wanted, fields[wanted], canvas)
    for name in ("rgba", "rgb"):
        if name in fields and fields[name].dtype.itemsize == _WORD:
            values = np.ascontiguousarray(fields[name])
            return colours.unpack_pcl_colours(
                values.view(values.dtype.str[0] + "u4").astype(np.uint32), alpha=name == "rgba"
            )
    if all(name in fields for name in ("r", "g", "b")):
        return colours.rgba(np.stack([fields[name] for name in ("r", "g", "b")], axis=1))
    for name in _SCALARS:
        if name in fields:
            return _scaled(name, fields[name], canvas)
    return None


def _scaled(name: str, values: Array, canvas: Canvas) -> Array:
    """Return colours by a field; the first cloud sets the scale, so that colours are comparable."""
    scales = canvas.memory.setdefault("scales", {})
    if name not in scales and len(values):
        scales[name] = low, high = colours.span(values)
        canvas.shown.scale = scale_text(name, low, high, _UNITS.get(name, ""))
        canvas.text(f"coloured by {canvas.shown.scale}")
    return colours.scale_colours(values, *scales.get(name, (0.0, 1.0)))


def _radius(message: PointCloud2, places: Array) -> float:
    """Return half the point spacing of an organised cloud, so that it looks closed; else a size in pixels."""
    if message.height > 1:
        steps = np.linalg.norm(np.diff(places.astype(np.float64), axis=0), axis=1)
        if len(steps):
            return float(np.median(steps)) * 0.6
    return float(rr.Radius.ui_points(1.5))

"""Plans: TRAJ ⇄ igtl_msgs/TrajectoryList, → visualization_msgs/Marker; POINT ⇄ igtl_msgs/PointList.

Both lists have all fields of the wire.  The conversion of float32 millimetres to float64 metres and back is exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import by_count, counted
from igtl_gateway.convert.columns import check_rows, set_text_fields, texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import LabeledPoint, PointList, Trajectory, TrajectoryList
from igtl_gateway.convert.rosmsg import Header, Marker
from igtl_gateway.convert.surfaces import DRAWN_WIDTH, GREY
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.point import POINT_DTYPE, Points
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, TRAJECTORY_DTYPE, Trajectories

Array = npt.NDArray[Any]

#: Actions of a marker.
_ADD, _DELETE = 0, 2

#: Maximum number of points of a list: digitised surfaces have thousands; 65,535 take a second.
MAX_POINTS = 20_000

_LABELS = ("name", "group", "owner")
#: Offsets of the labels of a point; if the bytes at these offsets are 0, all labels are empty.
_FIRST_BYTES = tuple(POINT_DTYPE.fields[name][1] for name in _LABELS) if POINT_DTYPE.fields else ()


def trajectories_to_ros(content: Trajectories, to: ToRosContext) -> TrajectoryList:
    """Convert to a list with one ``Trajectory`` for each element.  Raises ConversionError for more than MAX_ROWS."""
    elements = content.elements
    check_rows(elements, content.NAME)
    columns = zip(
        texts(elements, "name"),
        texts(elements, "group"),
        elements["type"].tolist(),
        map(tuple, elements["rgba"].tolist()),
        map(tuple, _to_ros(elements["entry"], to).tolist()),
        map(tuple, _to_ros(elements["target"], to).tolist()),
        _to_ros(elements["diameter"], to).tolist(),
        texts(elements, "owner"),
        strict=True,
    )
    return TrajectoryList(_header(to), tuple(Trajectory(*row) for row in columns), to.metadata)


def trajectories_to_igtl(message: TrajectoryList, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to TRAJ.  Raises ConversionError for numbers that float32 cannot hold."""
    rows = message.trajectories
    elements = np.zeros(len(rows), TRAJECTORY_DTYPE)
    elements["type"] = [row.type for row in rows]
    _set_labels(elements, rows, to)
    for field in ("entry", "target"):
        _set_lengths(elements, field, [getattr(row, field) for row in rows], to, TrajectoryList.TYPE)
    _set_lengths(elements, "diameter", [row.diameter for row in rows], to, TrajectoryList.TYPE)
    return _outgoing(Trajectories(elements), message)


@ieee_754
def trajectories_to_lines(content: Trajectories, to: ToRosContext) -> Marker:
    """Convert each trajectory with entry and target to a line; without lines the marker deletes the previous ones."""
    elements = content.elements
    points = np.stack([_to_ros(elements["entry"], to), _to_ros(elements["target"], to)], axis=1)
    _warn_of_ends(elements, to)
    drawn = (elements["type"] == ENTRY_AND_TARGET) & np.isfinite(points).all(axis=(1, 2))
    rgba = elements["rgba"][drawn]
    colors = (rgba / 255.0).astype("<f4")
    colors[~rgba.any(axis=1)] = GREY  # C++ senders leave an unset colour all zero; it does not mean an invisible line
    return Marker(
        _header(to),
        to.device_name,
        0,
        Marker.LINE_LIST,
        _ADD if drawn.any() else _DELETE,
        scale=(DRAWN_WIDTH, DRAWN_WIDTH, DRAWN_WIDTH),
        color=GREY,
        points=points[drawn].reshape(-1, 3),
        colors=np.repeat(colors, 2, axis=0),
    )


def _warn_of_ends(elements: Array, to: ToRosContext) -> None:
    """Warn of trajectories that have both ends, but are of a type without a line: no line shows them."""
    types = elements["type"]
    both = elements["entry"].any(axis=1) & elements["target"].any(axis=1)
    # NaN counts as an end: a line without numbers is not drawn either
    finite = np.isfinite(elements["entry"]).all(axis=1) & np.isfinite(elements["target"]).all(axis=1)
    left_out = np.flatnonzero((both & (types != ENTRY_AND_TARGET)) | ((types == ENTRY_AND_TARGET) & ~finite))
    if not len(left_out):
        return
    first = left_out[0]
    (name,) = texts(elements[first : first + 1], "name")
    found = int(types[first])
    if found == ENTRY_AND_TARGET:
        why = "an end that is not a number"
    else:
        meaning = {ENTRY_ONLY: "entry only", TARGET_ONLY: "target only, the default of the C++ library"}
        why = f"the type {found} ({meaning.get(found, 'undefined')}), although both ends are set; a line has the type 3"
    text = (
        f"{len(left_out)} of {counted(len(elements), 'trajectory', 'trajectories')} "
        f"{by_count(len(left_out), 'is', 'are')} not drawn: {name!r} has {why}"
    )
    to.warnings.append(("trajectory_not_drawn", text))


def is_labeled(content: Points) -> bool:
    """Return whether any point has a name, a group or an owner, or the list is empty, which clears earlier points.

    Only three bytes of each point are read: a cloud of 10,000 unnamed points takes less than 0.1 ms.
    """
    elements = content.elements
    if not len(elements):
        return True
    data = np.ascontiguousarray(elements).view(np.uint8)
    return any(np.bitwise_or.reduce(data[at :: POINT_DTYPE.itemsize]) for at in _FIRST_BYTES)


def points_to_point_list(content: Points, to: ToRosContext) -> PointList:
    """Convert to a list with one ``LabeledPoint`` per element.  Raises ConversionError for more than MAX_POINTS."""
    elements = content.elements
    check_rows(elements, content.NAME, MAX_POINTS)
    columns = zip(
        texts(elements, "name"),
        texts(elements, "group"),
        map(tuple, elements["rgba"].tolist()),
        map(tuple, _to_ros(elements["position"], to).tolist()),
        _to_ros(elements["diameter"], to).tolist(),
        texts(elements, "owner"),
        strict=True,
    )
    return PointList(_header(to), tuple(LabeledPoint(*row) for row in columns), to.metadata)


def point_list_to_igtl(message: PointList, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POINT.  Raises ConversionError for numbers that float32 cannot hold."""
    rows = message.points
    elements = np.zeros(len(rows), POINT_DTYPE)
    _set_labels(elements, rows, to)
    _set_lengths(elements, "position", [row.position for row in rows], to, PointList.TYPE)
    _set_lengths(elements, "diameter", [row.diameter for row in rows], to, PointList.TYPE)
    return _outgoing(Points(elements), message)


def _header(to: ToRosContext) -> Header:
    return Header(to.stamp_ns, to.frame_id)


def _outgoing(content: Points | Trajectories, message: PointList | TrajectoryList) -> ConvertedMessage:
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


@ieee_754
def _to_ros(lengths: Array, to: ToRosContext) -> Array:
    return to.lengths.to_ros(lengths)


def _set_labels(elements: Array, rows: tuple[Trajectory, ...] | tuple[LabeledPoint, ...], to: ToIgtlContext) -> None:
    for field in _LABELS:
        set_text_fields(elements, field, [getattr(row, field) for row in rows], to)
    elements["rgba"] = np.array([row.rgba for row in rows], np.uint8).reshape(-1, 4)


@ieee_754
def _set_lengths(elements: Array, field: str, values: list[Any], to: ToIgtlContext, place: str) -> None:
    """Fill a field with lengths as float32 in OpenIGTLink units.  Raises ConversionError for NaN and infinity."""
    column = elements[field]
    column[...] = to.lengths.to_igtl(np.array(values, np.float64).reshape(column.shape))
    finite = np.isfinite(column)
    if not finite.all():
        index = int(np.argwhere(~finite)[0][0])
        raise ConversionError(
            f"{place}, element {index}: found {field} {values[index]}, expected finite numbers within float32"
        )

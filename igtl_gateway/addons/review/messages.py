"""Conversion of ROS messages to the inputs of a review: clouds, plans and poses."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.igtl import ENTRY_AND_TARGET
from igtl_gateway.addon.messages import Pose, rotation_matrix, unit_quaternion
from igtl_gateway.addon.reading import Buffer, Entry
from igtl_gateway.addon.ros import (
    POINT_FIELD_DTYPES,
    Marker,
    PointCloud2,
    PointList,
    PolyData,
    PoseStamped,
    TFMessage,
    TrajectoryList,
    TransformStamped,
)
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.review.scene import DepthCloud

Array = npt.NDArray[Any]

#: Maximum number of points of a plan; a PointCloud2 with more points is a cloud.
MAX_PLAN_POINTS = 400
_EQUAL_M = 2e-5  # tolerance of equal points: a plan can have been rounded to float32 millimetres
_SAME_SHARE = 0.5  # minimum share of the ends that a correction leaves unchanged


@dataclass(frozen=True, slots=True)
class DrawnPlan:
    """The plan of one message.

    Attributes:
        topic, type, frame_id: of the message.
        stamp_ns: gateway time.
        source_ns: stamp in the message; 0 = unset.
        entry, exit: (stitches, 3) metres.
        labels: names of the stitches; empty if the message does not name all of them.
        lines: whether the message itself defines the pairs of points.
    """

    topic: str
    type: str
    frame_id: str
    stamp_ns: int
    source_ns: int
    entry: Array
    exit: Array
    labels: tuple[str, ...] = ()
    lines: bool = True

    def ends(self) -> Array:
        """Return (2 · stitches, 3) points: all entry points, then all exit points."""
        return np.concatenate([self.entry, self.exit])

    def equals(self, other: DrawnPlan) -> bool:
        """Return whether it is the same plan, up to rounding."""
        return self._share_equal(other) == 1.0

    def corrects(self, other: DrawnPlan) -> bool:
        """Return whether it is a version of the same plan: at least half of its points are unchanged."""
        return self._share_equal(other) >= _SAME_SHARE

    def _share_equal(self, other: DrawnPlan) -> float:
        if len(self.entry) != len(other.entry):
            return 0.0
        near = np.abs(self.ends() - other.ends()).max(axis=1) <= _EQUAL_M
        return float(near.mean())


def cloud_of(entry: Entry) -> DepthCloud | None:
    """Return the positions of a sensor_msgs/PointCloud2; None without x, y, z as floating-point fields."""
    message = PointCloud2.unpack(entry.data())
    points = _positions(message)
    if points is None:
        return None
    return DepthCloud(entry.channel, message.header.frame_id, entry.stamp_ns, message.header.stamp_ns, points)


def plan_of(entry: Entry) -> DrawnPlan | None:
    """Return the message as a plan; None if it cannot be one."""
    read = _PLANS.get(entry.type)
    drawn = read(entry) if read else None
    if drawn is None or not 0 < len(drawn.entry) <= MAX_PLAN_POINTS // 2 or not np.isfinite(drawn.ends()).all():
        return None
    return drawn


def poses_of(entry: Entry) -> Iterator[tuple[str, str, Pose, int]]:
    """Yield (parent, child, pose, stamp in UTC ns) of a message; the topic is the child of a PoseStamped."""
    data = entry.data()
    if entry.type == TransformStamped.TYPE:
        one = TransformStamped.unpack(data)
        x, y, z = one.translation
        yield one.header.frame_id, one.child_frame_id, (x, y, z, *one.rotation), one.header.stamp_ns
    elif entry.type == TFMessage.TYPE:
        for each in TFMessage.unpack(data).transforms:
            yield each.header.frame_id, each.child_frame_id, each.pose, each.header.stamp_ns
    elif entry.type == PoseStamped.TYPE:
        posed = PoseStamped.unpack(data)
        yield posed.header.frame_id, entry.channel, posed.pose, posed.header.stamp_ns


#: Types that ``poses_of`` reads.
POSES = frozenset({TransformStamped.TYPE, TFMessage.TYPE, PoseStamped.TYPE})


def is_large_cloud(data: Buffer) -> bool:
    """Return whether a PointCloud2 has more points than a plan can have."""
    message = PointCloud2.unpack(data)
    return message.width * message.height > MAX_PLAN_POINTS


def _positions(message: PointCloud2) -> Array | None:
    """Return (height, width, 3) float32 positions, NaN without a depth; None without x, y, z."""
    places: dict[str, np.dtype[Any]] = {}
    offsets = []
    for item in message.fields:
        kind = POINT_FIELD_DTYPES.get(item.datatype, "")
        if item.name in ("x", "y", "z") and item.name not in places and kind in ("f4", "f8") and item.count <= 1:
            places[item.name] = np.dtype((">" if message.is_bigendian else "<") + kind)
            offsets.append(item.offset)
    height, width, step = message.height, message.width, message.point_step
    data = memoryview(message.data)
    if sorted(places) != ["x", "y", "z"] or not height * width:
        return None
    ends = [offset + kind.itemsize for offset, kind in zip(offsets, places.values(), strict=True)]
    if max(ends) > step or message.row_step * (height - 1) + width * step > data.nbytes:
        raise ConversionError(
            f"{message.TYPE}: found {counted(data.nbytes, 'byte')}, expected {counted(height, 'row')} of "
            f"{counted(width, 'point')} of {counted(step, 'byte')}"
        )
    layout = np.dtype({"names": list(places), "formats": list(places.values()), "offsets": offsets, "itemsize": step})
    points = np.ndarray((height, width), layout, data, 0, (message.row_step, step))
    found = np.stack([points[name] for name in ("x", "y", "z")], axis=-1).astype(np.float32)
    found[~np.isfinite(found).all(axis=-1)] = np.nan
    return found


def _of_marker(entry: Entry) -> DrawnPlan | None:
    """Return the segments of a LINE_LIST."""
    message = Marker.unpack(entry.data())
    if message.type != Marker.LINE_LIST or message.action != 0 or len(message.points) % 2:
        return None
    points = np.asarray(message.points, np.float64)
    if any(message.orientation[:3]):
        rows = rotation_matrix(unit_quaternion(message.orientation))
        points = np.stack([a * points[:, 0] + b * points[:, 1] + c * points[:, 2] for a, b, c in rows], axis=1)
    points = points + np.array(message.position)
    return _drawn(entry, message, points[0::2], points[1::2])


def _of_trajectories(entry: Entry) -> DrawnPlan | None:
    message = TrajectoryList.unpack(entry.data())
    both = [row for row in message.trajectories if row.type == ENTRY_AND_TARGET]
    if not both:
        return None
    ends = np.array([(row.entry, row.target) for row in both], np.float64)
    return _drawn(entry, message, ends[:, 0], ends[:, 1], tuple(row.name for row in both))


def _of_polydata(entry: Entry) -> DrawnPlan | None:
    """Return the first and the last point of each line; without lines, the points in the order of a cloud."""
    message = PolyData.unpack(entry.data())
    points, cells = np.asarray(message.points, np.float64), message.lines
    if len(message.polygons) or len(message.triangle_strips):
        return None
    ends, at = [], 0
    while at < len(cells):
        size = int(cells[at])
        if size < 2 or at + size >= len(cells):  # a line has two ends
            return None
        ends.append((int(cells[at + 1]), int(cells[at + size])))
        at += size + 1
    if not ends:
        return _halves(entry, message, points)
    indices = np.array(ends)
    if indices.max() >= len(points):
        return None
    return _drawn(entry, message, points[indices[:, 0]], points[indices[:, 1]])


def _of_point_list(entry: Entry) -> DrawnPlan | None:
    """Return the points in pairs: entry and exit (or target) by group, or by the first word of the name.

    If not all points are marked like this, the first half are entry points and the second half exit points.
    """
    message = PointList.unpack(entry.data())
    names = [point.name.strip() for point in message.points]
    positions = np.array([point.position for point in message.points], np.float64).reshape(-1, 3)
    marked = [_END.match(point.group) or _END.match(name) for point, name in zip(message.points, names, strict=True)]
    kinds = [match.group(1).lower() if match else "" for match in marked]
    first = [number for number, kind in enumerate(kinds) if kind == "entry"]
    last = [number for number, kind in enumerate(kinds) if kind in ("exit", "target")]
    if len(first) + len(last) != len(names) or len(first) != len(last):
        if len(names) % 2:
            return None
        first, last = list(range(len(names) // 2)), list(range(len(names) // 2, len(names)))
    labels = tuple(_END.sub("", names[number]).strip() for number in first)
    return _drawn(entry, message, positions[first], positions[last], labels, lines=False)


#: Spaces are tried from their first one only: a long run of them costs its length, not the square of it.
_END = re.compile(r"(?<!\s)\s*(entry|exit|target)\b", re.IGNORECASE)


def _of_cloud(entry: Entry) -> DrawnPlan | None:
    message = PointCloud2.unpack(entry.data())
    if message.width * message.height > MAX_PLAN_POINTS:
        return None
    points = _positions(message)
    return None if points is None else _halves(entry, message, points.reshape(-1, 3).astype(np.float64))


def _halves(entry: Entry, message: PointCloud2 | PolyData, points: Array) -> DrawnPlan | None:
    """Return unmarked points in pairs: all entry points, then all exit points.  None if their number is odd."""
    half, rest = divmod(len(points), 2)
    return None if rest else _drawn(entry, message, points[:half], points[half:], lines=False)


def _drawn(
    entry: Entry,
    message: Marker | TrajectoryList | PolyData | PointList | PointCloud2,
    first: Array,
    last: Array,
    labels: tuple[str, ...] = (),
    lines: bool = True,
) -> DrawnPlan:
    header = message.header
    return DrawnPlan(
        entry.channel,
        entry.type,
        header.frame_id,
        entry.stamp_ns,
        header.stamp_ns,
        first,
        last,
        labels if all(labels) else (),
        lines,
    )


_PLANS: dict[str, Callable[[Entry], DrawnPlan | None]] = {
    Marker.TYPE: _of_marker,
    TrajectoryList.TYPE: _of_trajectories,
    PolyData.TYPE: _of_polydata,
    PointList.TYPE: _of_point_list,
    PointCloud2.TYPE: _of_cloud,
}
#: Types that ``plan_of`` reads.
PLANS = frozenset(_PLANS)

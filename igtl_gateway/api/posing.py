"""The poses in the messages of one stream."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.poses import Poses, matrices_of
from igtl_gateway.api.source import Source
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.names import frames_of
from igtl_gateway.errors import ConfigError, GatewayError
from igtl_gateway.exchange.cdr_columns import Column, NotColumns, ros_columns
from igtl_gateway.exchange.igtl_columns import POSE_TYPES, pose_rows
from igtl_gateway.session.entry import Kind
from igtl_gateway.sessionfile.bulk import MessageBlock
from igtl_gateway.sessionfile.channels import ChannelSummary
from igtl_gateway.wire import decode
from igtl_gateway.wire.fields import decode_text
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData

Array = npt.NDArray[Any]

#: Endings of the columns of a position → those of the rotation beside it.
_PAIRS = {"translation": "rotation", "position": "orientation"}

#: Times, source times, stamps, matrices; parent and child; messages without a pose.
_Part = tuple[Array, Array, Array, Array, set[tuple[str, str]], int]


def read_poses(source: Source, channel: ChannelSummary, unit: str, blocks: Iterable[MessageBlock], frame: str) -> Poses:
    """Return the poses in blocks of messages; see ``Stream.poses``.  Raises ConfigError."""
    part = _reader(source, channel, frame)
    parts = [part(block) for block in blocks]
    matrices = np.concatenate([np.zeros((0, 4, 4)), *(each[3] for each in parts)])
    times, source_times, stamps = (
        np.concatenate([np.zeros(0, np.int64), *(each[column] for each in parts)]) for column in range(3)
    )
    names = {pair for each in parts for pair in each[4]}
    parents, children = {parent for parent, _ in names}, {child for _, child in names}
    if frame and not len(times):
        raise ConfigError(f"{channel.stream}: found no pose of frame {frame!r}")
    return Poses(
        matrices,
        unit,
        times,
        source_times,
        stamps,
        parents.pop() if len(parents) == 1 else "",
        children.pop() if len(children) == 1 else "",
        sum(each[5] for each in parts),
    )


def _reader(source: Source, channel: ChannelSummary, frame: str) -> Callable[[MessageBlock], _Part]:
    kind, name, ros_type = channel.entry_type, channel.stream, channel.type
    is_igtl = channel.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)
    several = (kind in ("TDATA", "QTDATA")) if is_igtl else ros_type == TFMessage.TYPE
    if several and not frame:
        raise ConfigError(f"{name}: found messages with several poses, expected a name: poses(frame=…)")
    if frame and not several:
        raise ConfigError(f"{name}: found frame={frame!r}, expected none: {kind} has one pose")
    if is_igtl and kind in POSE_TYPES:
        device = name.partition("/")[2]
        return lambda block: _of_igtl(block, kind, frames_of(device, ""))
    if several:
        return lambda block: _of_several(block, is_igtl, frame)
    if is_igtl:
        raise ConfigError(f"{name}: found type {kind}, expected one with a pose, such as TRANSFORM")
    return lambda block: _of_ros(source, block, ros_type)


def _of_igtl(block: MessageBlock, igtl_type: str, frames: tuple[str, str]) -> _Part:
    found = pose_rows(block, igtl_type)
    rows = found.rows
    source_times = block.source_times[rows]
    return (
        block.times[rows],
        source_times,
        source_times,
        found.matrices,
        {frames} if len(rows) else set(),
        len(block) - len(rows),
    )


def _of_ros(source: Source, block: MessageBlock, ros_type: str) -> _Part:
    columns, left_out = _ros_columns(source, block, ros_type)
    if columns is None:
        return *(3 * (np.zeros(0, np.int64),)), np.zeros((0, 4, 4)), set(), left_out
    kept, by_name = columns
    found = _pose_of(by_name)
    if found is None:
        raise ConfigError(f"found type {ros_type}, expected one with a pose, such as geometry_msgs/msg/PoseStamped")
    position, rotation = found
    stamps = by_name["header.stamp_ns"].values if "header.stamp_ns" in by_name else np.zeros(len(kept), np.int64)
    names = [
        by_name[name].texts() if name in by_name else [""] * len(kept) for name in ("header.frame_id", "child_frame_id")
    ]
    pairs = set(zip(*names, strict=True))
    return kept.times, kept.source_times, stamps, matrices_of(position, rotation), pairs, left_out


def _ros_columns(
    source: Source, block: MessageBlock, ros_type: str
) -> tuple[tuple[MessageBlock, dict[str, Column]] | None, int]:
    """The columns of the messages that can be decoded, and the number of the others."""
    types = source.types(ros_type)
    try:
        return (block, {column.name: column for column in ros_columns(block, types, ros_type)}), 0
    except NotColumns:
        pass
    good = []
    for index in range(len(block)):
        try:
            ros_columns(block.where(slice(index, index + 1)), types, ros_type)
            good.append(index)
        except NotColumns:
            pass
    if not good:
        return None, len(block)
    kept = block.where(np.array(good))
    return (kept, {column.name: column for column in ros_columns(kept, types, ros_type)}), len(block) - len(good)


def _pose_of(columns: dict[str, Column]) -> tuple[Array, Array] | None:
    """Positions (N, 3) and quaternions (N, 4) in columns of a type that has one pose."""
    for place, turn in _PAIRS.items():
        for name in columns:
            head, found, _ = name.rpartition(f"{place}.x_")
            if not found or (head and not head.endswith(".")):
                continue
            unit = name.rpartition("_")[2]
            names = [f"{head}{place}.{axis}_{unit}" for axis in "xyz"] + [f"{head}{turn}.{axis}" for axis in "xyzw"]
            if all(each in columns for each in names):
                values = [columns[each].values for each in names]
                return np.stack(values[:3], axis=1), np.stack(values[3:], axis=1)
    return None


def _of_several(block: MessageBlock, is_igtl: bool, frame: str) -> _Part:
    """The poses of one frame in messages with poses of several."""
    rows, stamps, poses, names, bad = [], [], [], set(), 0
    for index in range(len(block)):
        payload = block.payload(index)
        try:
            found = list(tools_of(payload) if is_igtl else transforms_of(payload))
        except GatewayError:
            bad += 1
            continue
        for parent, child, stamp_ns, pose in found:
            if child == frame:
                rows.append(index)
                stamps.append(int(block.source_times[index]) if is_igtl else stamp_ns)
                poses.append(pose)
                names.add((parent, child))
    places = np.array(rows, np.intp)
    matrices = np.array(poses).reshape(-1, 4, 4)
    return block.times[places], block.source_times[places], np.array(stamps, np.int64), matrices, names, bad


def tools_of(payload: memoryview) -> Iterator[tuple[str, str, int, Array]]:
    """Yield parent, child, stamp (0) and matrix of each tool of TDATA or QTDATA.  Raises WireError."""
    content = decode(payload).content
    if not isinstance(content, TrackingData | QuaternionTrackingData):
        return
    for element in content.elements:
        if isinstance(content, TrackingData):
            matrix = np.eye(4)
            matrix[:3] = element["matrix"].astype(np.float64).reshape(4, 3).T
        else:
            matrix = matrices_of(
                element["position"].astype(np.float64)[None], element["quaternion"].astype(np.float64)[None]
            )[0]
        parent, child = frames_of(decode_text(bytes(element["name"])), "")
        yield parent, child, 0, matrix


def transforms_of(payload: memoryview, ros_type: str = TFMessage.TYPE) -> Iterator[tuple[str, str, int, Array]]:
    """Yield parent, child, stamp (UTC ns) and matrix of each transform of a TFMessage, or of one TransformStamped.

    Raises GatewayError.
    """
    each = TFMessage.unpack(payload).transforms if ros_type == TFMessage.TYPE else (FrameTransform.unpack(payload),)
    for one in each:
        pose = np.array(one.pose)
        matrix = matrices_of(pose[None, :3], pose[None, 3:])[0]
        yield one.header.frame_id, one.child_frame_id, one.header.stamp_ns, matrix

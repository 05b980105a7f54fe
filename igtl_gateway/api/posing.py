"""The poses in the messages of one stream."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.cdr_columns import NotColumns, ros_columns
from igtl_gateway.api.columns import name_ros_fields
from igtl_gateway.api.igtl_columns import POSE_TYPES, pose_rows
from igtl_gateway.api.poses import Poses, matrices_of
from igtl_gateway.api.source import Source
from igtl_gateway.base.errors import ConfigError, DamagedRecording, GatewayError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.names import frames_of
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import decode_text
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData

Array = npt.NDArray[Any]

#: Endings of the columns of a position → those of the rotation beside it.
_PAIRS = {"translation": "rotation", "position": "orientation"}

#: Times, source times, stamps, matrices, indices in the block; parent and child; messages without a pose.
_Part = tuple[Array, Array, Array, Array, Array, set[tuple[str, str]], int]


def read_poses(source: Source, channel: ChannelSummary, unit: str, blocks: Iterable[MessageBlock], frame: str) -> Poses:
    """Return the poses in blocks of messages; see ``Stream.poses``.  Raises ConfigError."""
    part = _reader(source, channel, frame)
    parts, rows, count = [], [np.zeros(0, np.int64)], 0
    for block in blocks:
        parts.append(part(block))
        rows.append(parts[-1][4] + count)
        count += len(block)
    matrices = np.concatenate([np.zeros((0, 4, 4)), *(each[3] for each in parts)])
    times, source_times, stamps = (
        np.concatenate([np.zeros(0, np.int64), *(each[column] for each in parts)]) for column in range(3)
    )
    names = {pair for each in parts for pair in each[5]}
    parents, children = {parent for parent, _ in names}, {child for _, child in names}
    if frame and not len(times):
        raise ConfigError(f"{channel.stream}: found no pose of frame {frame!r}")
    left_out = sum(each[6] for each in parts)
    if left_out and not len(times):
        raise ConfigError(
            f"{channel.stream}: found {channel.entry_type} without a pose in any of {count_text(left_out, 'message')}"
        )
    return Poses(
        matrices,
        unit,
        times,
        source_times,
        stamps,
        parents.pop() if len(parents) == 1 else "",
        children.pop() if len(children) == 1 else "",
        left_out,
        np.concatenate(rows),
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
        return lambda block: _of_igtl(source, block, kind, frames_of(device, ""))
    if several:
        return lambda block: _of_several(source, block, is_igtl, frame)
    if is_igtl:
        raise ConfigError(f"{name}: found type {kind}, expected one with a pose, such as TRANSFORM")
    return lambda block: _of_ros(source, block, ros_type)


def _of_igtl(source: Source, block: MessageBlock, igtl_type: str, frames: tuple[str, str]) -> _Part:
    found = pose_rows(block, igtl_type, source.acceptance)
    rows = found.rows
    source_times = block.source_times[rows]
    return (
        block.times[rows],
        source_times,
        source_times,
        found.matrices,
        rows,
        {frames} if len(rows) else set(),
        len(block) - len(rows),
    )


def _of_ros(source: Source, block: MessageBlock, ros_type: str) -> _Part:
    rows, fields = _fields_of(source, block, ros_type)
    kept = block.where(rows)
    if not len(rows):
        return kept.times, kept.times, kept.times, np.zeros((0, 4, 4)), kept.times, set(), len(block)
    names = _pose_names(fields, ros_type)
    position, rotation = (np.stack([np.asarray(fields[name]) for name in each], axis=1) for each in names)
    stamps = np.asarray(fields.get("header.stamp_ns", np.zeros(len(rows), np.int64)))
    frames = [fields.get(name, [""] * len(rows)) for name in ("header.frame_id", "child_frame_id")]
    pairs = set(zip(*frames, strict=True))
    return kept.times, kept.source_times, stamps, matrices_of(position, rotation), rows, pairs, len(block) - len(rows)


def _fields_of(source: Source, block: MessageBlock, ros_type: str) -> tuple[Array, dict[str, Any]]:
    """Indices of the messages that can be decoded, and their numbers (N,) and strings by name of column."""
    try:
        columns = ros_columns(block, source.types(ros_type), ros_type)
    except NotColumns:
        pass
    else:
        plain = [each for each in columns if each.is_text or (each.offsets is None and each.values.ndim == 1)]
        return np.arange(len(block)), {each.name: each.texts() if each.is_text else each.values for each in plain}
    rows: list[int] = []
    found: list[dict[str, Any]] = []
    for index in range(len(block)):
        try:
            message = source.decode(ros_type, bytes(block.payload(index)))
        except DamagedRecording:
            continue
        fields = dict(_scalars("", name_ros_fields(source.decoder.store(ros_type), message)))
        if not found:
            _pose_names(fields, ros_type)
        rows.append(index)
        found.append(fields)
    names = found[0] if found else {}
    return np.array(rows, np.intp), {name: [each[name] for each in found] for name in names}


def _scalars(place: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Numbers and strings with the names of columns, as ``columns`` has them."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _scalars(f"{place}.{name}" if place else name, inner)
    elif isinstance(value, int | float | str):
        yield place, value


def _pose_names(fields: Iterable[str], ros_type: str) -> tuple[list[str], list[str]]:
    """The names of position and quaternion of a type that has one pose.  Raises ConfigError."""
    names = list(fields)
    for place, turn in _PAIRS.items():
        for name in names:
            head, found, _ = name.rpartition(f"{place}.x_")
            if not found or (head and not head.endswith(".")):
                continue
            unit = name.rpartition("_")[2]
            position = [f"{head}{place}.{axis}_{unit}" for axis in "xyz"]
            rotation = [f"{head}{turn}.{axis}" for axis in "xyzw"]
            if {*position, *rotation} <= {*names}:
                return position, rotation
    raise ConfigError(f"found type {ros_type}, expected one with a pose, such as geometry_msgs/msg/PoseStamped")


def _of_several(source: Source, block: MessageBlock, is_igtl: bool, frame: str) -> _Part:
    """The poses of one frame in messages with poses of several."""
    rows, stamps, poses, names, bad = [], [], [], set(), 0
    for index in range(len(block)):
        payload = block.payload(index)
        try:
            found = list(tools_of(source.acceptance.message(payload).content) if is_igtl else transforms_of(payload))
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
    moments = block.times[places], block.source_times[places], np.array(stamps, np.int64)
    return *moments, matrices, places, names, bad


def tools_of(content: Body) -> Iterator[tuple[str, str, int, Array]]:
    """Yield parent, child, stamp (0) and matrix of each tool of TDATA or QTDATA."""
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

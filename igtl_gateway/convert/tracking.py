"""TDATA and QTDATA ⇄ igtl_msgs/TrackingData, → geometry_msgs/PoseArray; poses of all types → tf2_msgs/TFMessage.

A tool without a valid pose (trackers send zeros for a tool that is out of sight) does not affect the other tools, and
causes a warning.  It is left out of messages with tool names, and NaN in messages where the index identifies a tool.
From OpenIGTLink the tools are converted one by one, with the arithmetic of ``poses``; to OpenIGTLink the same formulas
are applied to columns, with equal bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.columns import check_rows, set_text_fields, texts
from igtl_gateway.convert.common_msgs import FrameTransform, PoseArray, TFMessage
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.convert.names import frames_of_name, topic_token
from igtl_gateway.convert.plus_signs import whole_tool_names
from igtl_gateway.convert.poses import (
    pose_of_matrix,
    pose_of_position,
    position_to_ros,
    rotation_matrix,
    transform_to_ros,
)
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire import tracking as wire
from igtl_gateway.wire.transform import Position, Transform

Array = npt.NDArray[Any]
Tracking = wire.TrackingData | wire.QuaternionTrackingData

#: Maximum number of tools: one takes up to 0.2 ms (a matrix that is not a rotation).  Trackers have a hundred at most.
MAX_TOOLS = 512

#: What `ToRosContext.made` has of the tools.
TOOLS = "tools"

#: Code of the warning about a pose that its sender marks as not valid.
NOT_VALID = "not_valid"

_POSE_COLUMNS = 7
_NO_POSE = (float("nan"),) * _POSE_COLUMNS


def tracking_to_ros(content: Tracking, to: ToRosContext) -> TrackingData:
    """Convert to TrackingData with all tools that have a valid pose."""
    types = content.elements["type"].tolist()
    tools = (
        TrackedTool(name, kind, pose)
        for (name, pose), kind in zip(_tools(content, to), types, strict=True)
        if pose is not None
    )
    return TrackingData(Header(to.stamp_ns, to.frame_id), tuple(tools), to.metadata)


def tracking_to_poses(content: Tracking, to: ToRosContext) -> PoseArray:
    """Convert to PoseArray in the order of the tools; NaN for a tool without a valid pose."""
    poses = np.array([pose or _NO_POSE for _, pose in _tools(content, to)], float).reshape(-1, _POSE_COLUMNS)
    return PoseArray(Header(to.stamp_ns, to.frame_id), poses)


def tracking_to_tf(content: Tracking, to: ToRosContext) -> TFMessage:
    """Convert each tool to a frame: ``AToB`` is child A of B, any other name is a child of the stream's frame.

    A tool without name gets the name of the device and its index.  Tools without a valid pose are left out.
    """
    frames = []
    for index, (name, pose) in enumerate(_tools(content, to)):
        if pose is None or _is_marked(name, to):
            continue
        if name:
            parent, child = to.frames(name, to.frame_id)
        else:
            parent, child = to.frame_id, topic_token(f"{to.device_name}_{index}")
        frames.append((parent, child, pose))
    return _tf(frames, to)


def transform_to_tf(content: Transform, to: ToRosContext) -> TFMessage:
    """Convert to TFMessage.  Raises ConversionError as ``transform_to_ros``."""
    return _one_tf(to.made.get(TransformStamped.TYPE) or transform_to_ros(content, to), to)


def position_to_tf(content: Position, to: ToRosContext) -> TFMessage:
    """Convert to TFMessage.  Raises ConversionError as ``position_to_ros``."""
    return _one_tf(to.made.get(TransformStamped.TYPE) or position_to_ros(content, to), to)


def _one_tf(message: TransformStamped, to: ToRosContext) -> TFMessage:
    frames = [] if _is_marked("Transform", to) else [(message.translation, message.rotation)]
    return _tf([(to.frame_id, to.child_frame_id, (*place, *turn)) for place, turn in frames], to)


def _is_marked(name: str, to: ToRosContext) -> bool:
    """Return whether the sender marks a pose as not valid, as PLUS does: /tf has no field for that."""
    if not to.reads_status or not to.metadata:
        return False
    status = next((item.value for item in to.metadata if item.key == f"{name}Status"), "")
    if status.strip().upper() in ("", "OK"):
        return False
    to.warnings.append((NOT_VALID, f"{to.device_name}: a pose with the {name}Status {status} is left out of /tf"))
    return True


def _tf(frames: Iterable[tuple[str, str, Pose]], to: ToRosContext) -> TFMessage:
    """Return the message of (parent, child, pose) rows, without frames that are their own parents: tf2 rejects them."""
    transforms = []
    for parent, child, pose in frames:
        if parent == child:
            to.warnings.append(("own_parent", f"frame {child!r} is left out of /tf: it would be its own parent"))
        else:
            transforms.append(FrameTransform(Header(to.stamp_ns, parent), child, pose))
    return TFMessage(tuple(transforms))


def _tools(content: Tracking, to: ToRosContext) -> list[tuple[str, Pose | None]]:
    """Return name and pose of each tool; None, with a warning, for an invalid pose.  The rows share them.

    Raises ConversionError for more than MAX_TOOLS tools.
    """
    if (known := to.made.get(TOOLS)) is None:
        known = to.made[TOOLS] = _read_tools(content, to)
    return list(known)


def tool_names(content: Tracking, to: ToRosContext) -> list[str]:
    """Return the names of the tools, whole where PLUS has cut them and states that."""
    names = texts(content.elements, "name")
    if to.whole_names and to.metadata:
        return whole_tool_names(names, ((item.key, item.value) for item in to.metadata))
    return names


def frame_of_tools(content: Tracking, to: ToRosContext) -> str:
    """Return the frame that is the parent of all tools by their names, ``AToB``; "" if there is none."""
    if not 0 < len(content.elements) <= MAX_TOOLS:
        return ""
    parents = {frames_of_name(name, "")[0] for name in tool_names(content, to)}
    return parents.pop() if len(parents) == 1 else ""


def _read_tools(content: Tracking, to: ToRosContext) -> list[tuple[str, Pose | None]]:
    elements = content.elements
    check_rows(elements, f"{content.NAME} {to.device_name!r}", MAX_TOOLS)
    names = tool_names(content, to)
    places = [f"{content.NAME} {to.device_name!r}, tool {name!r}" for name in names]
    readers: Iterable[Callable[[], Pose]]
    if isinstance(content, wire.QuaternionTrackingData):
        rows = zip(elements["position"].tolist(), elements["quaternion"].tolist(), places, strict=True)
        readers = (partial(pose_of_position, position, rotation, to, place) for position, rotation, place in rows)
    else:
        matrices = zip(elements["matrix"].tolist(), places, strict=True)
        readers = (partial(pose_of_matrix, matrix, to, place) for matrix, place in matrices)
    poses: list[Pose | None] = []
    for read in readers:
        try:
            poses.append(read())
        except ConversionError as error:
            to.warnings.append(("not_a_pose", f"tool without a valid pose: {error}"))
            poses.append(None)
    return list(zip(names, poses, strict=True))


def tracking_to_tdata(message: TrackingData, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to TDATA.  Raises ConversionError for NaN, infinity, and quaternions of zero length."""
    return _sent(message, wire.TrackingData(_matrices(_tool_poses(message), to, TrackingData.TYPE)), to)


def tracking_to_qtdata(message: TrackingData, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to QTDATA.  Raises ConversionError as ``tracking_to_tdata``."""
    positions, rotations = _finite(_tool_poses(message), to, TrackingData.TYPE)
    elements = np.zeros(len(positions), wire.QTRACKING_DTYPE)
    elements["position"] = positions
    elements["quaternion"] = rotations
    return _sent(message, wire.QuaternionTrackingData(elements), to)


def poses_to_tdata(message: PoseArray, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to TDATA of tools ``Tool1``, ``Tool2``, …  Raises ConversionError as ``tracking_to_tdata``."""
    elements = _matrices(message.poses, to, PoseArray.TYPE)
    elements["type"] = wire.TOOL_6D
    set_text_fields(elements, "name", (f"Tool{number}" for number in range(1, len(elements) + 1)), to)
    return ConvertedMessage(wire.TrackingData(elements), message.header.stamp_ns, message.header.frame_id)


def _sent(message: TrackingData, content: Tracking, to: ToIgtlContext) -> ConvertedMessage:
    """Return the message with the names and types of the tools."""
    set_text_fields(content.elements, "name", (tool.name for tool in message.tools), to)
    content.elements["type"] = [tool.type for tool in message.tools]
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def _tool_poses(message: TrackingData) -> Array:
    return np.array([tool.pose for tool in message.tools]).reshape(-1, _POSE_COLUMNS)


@ieee_754
def _matrices(poses: Array, to: ToIgtlContext, place: str) -> Array:
    """Return elements of TDATA with the matrices of (n, 7) poses."""
    positions, rotations = _finite(poses, to, place)
    x, y, z, w = rotations.T
    elements = np.zeros(len(poses), wire.TRACKING_DTYPE)
    matrix = elements["matrix"]
    for row, values in enumerate(rotation_matrix((x, y, z, w))):
        for column, value in enumerate(values):
            matrix[:, 3 * column + row] = value
    matrix[:, 9:] = positions
    return elements


@ieee_754
def _finite(poses: Array, to: ToIgtlContext, place: str) -> tuple[Array, Array]:
    """Return positions (n, 3), float32 in OpenIGTLink units, and unit quaternions (n, 4) of (n, 7) poses."""
    positions = to.lengths.to_igtl(poses[:, :3]).astype(">f4")
    x, y, z, w = poses[:, 3:].T
    lengths = np.sqrt(x * x + y * y + z * z + w * w)
    usable = np.isfinite(positions).all(axis=1) & np.isfinite(lengths) & (lengths > 0.0)
    if not usable.all():
        index = int(np.argmin(usable))
        raise ConversionError(
            f"{place}, pose {index}: found {poses[index].tolist()}, "
            "expected finite numbers and a quaternion of a finite length above 0"
        )
    return positions, poses[:, 3:] / lengths[:, None]

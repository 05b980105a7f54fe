"""Tracking data: composed of single poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from igtl_gateway.gateway.peers import TRACKING, Peer
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.tf_out import MOMENT_NS, moments_of
from igtl_gateway.wire.fields import cut_text, encode_text
from igtl_gateway.wire.tracking import (
    QTRACKING_DTYPE,
    TOOL_6D,
    TRACKING_DTYPE,
    QuaternionTrackingData,
    TrackingData,
)
from igtl_gateway.wire.transform import Position, Transform

NAME_BYTES = 19  # of 20: the C++ reader drops a name that fills its field

#: Device name of composed tracking data, unless the peer names one.
TRACKING_DEVICE = "Tracking"

#: (type, device or "" for any) → the latest messages, composed.
Latest = Callable[[str, str], list[OutboundMessage]]


@dataclass(frozen=True, slots=True)
class TrackedMoment:
    """Tracking data of one moment.

    Attributes:
        message: with the poses of its stamp.
        stamps: tool → stamp of its pose, UTC ns; tools that do not move are in it only if none does.
    """

    message: OutboundMessage
    stamps: dict[str, int]


def tracking_moments(igtl_type: str, device: str, latest: Latest, *, moments: bool = True) -> list[TrackedMoment]:
    """Return a TDATA or QTDATA for each moment of the single poses that are sent, the oldest first.

    A message has one stamp: poses of several moments are several messages.  What does not move is in each.

    Args:
        igtl_type: TDATA or QTDATA.
        device: of the messages; "": ``TRACKING_DEVICE``.
        latest: the latest poses.
        moments: False: one message of all poses with the newest stamp, as in old recordings.
    """
    poses = latest(TRACKING[igtl_type], "")
    if not poses:
        return []
    stamps = [pose.stamp_ns for pose in poses if not pose.is_static]
    if not moments or not stamps:
        return [_moment(igtl_type, device, poses, poses if moments else [])]
    found = []
    for end_ns in moments_of(stamps):
        near = [pose for pose in poses if pose.is_static or end_ns - MOMENT_NS < pose.stamp_ns <= end_ns]
        found.append(_moment(igtl_type, device, near, [pose for pose in near if not pose.is_static]))
    return found


def _moment(
    igtl_type: str, device: str, poses: Sequence[OutboundMessage], moving: Sequence[OutboundMessage]
) -> TrackedMoment:
    """Tracking data of poses, with the newest stamp of those that move."""
    dtype = TRACKING_DTYPE if igtl_type == "TDATA" else QTRACKING_DTYPE
    elements = np.zeros(len(poses), dtype)
    for element, pose in zip(elements, poses, strict=True):
        _fill(element, pose)
    content = (TrackingData if igtl_type == "TDATA" else QuaternionTrackingData)(elements)
    frames = {pose.frame_id for pose in poses}
    message = OutboundMessage(
        igtl_type,
        device or TRACKING_DEVICE,
        content,
        max(pose.stamp_ns for pose in moving or poses),
        ros_stamp_ns=max(pose.ros_stamp_ns for pose in moving or poses),
        frame_id=frames.pop() if len(frames) == 1 else "",
    )
    return TrackedMoment(message, {pose.full_name or pose.device: pose.stamp_ns for pose in moving})


def _fill(element: Any, pose: OutboundMessage) -> None:
    element["name"] = name_field(pose.full_name or pose.device, NAME_BYTES)
    element["type"] = TOOL_6D
    match pose.content:
        case Transform(wire_matrix):
            element["matrix"] = wire_matrix
        case Position(position, quaternion):
            element["position"] = position
            element["quaternion"] = quaternion


def trackers(peers: Iterable[Peer]) -> dict[tuple[str, str], list[Peer]]:
    """Return (type, requested device) → peers that requested this stream of tracking data."""
    wanted: dict[tuple[str, str], list[Peer]] = {}
    for peer in peers:
        for key in peer.tracked:
            wanted.setdefault(key, []).append(peer)
    return wanted


def name_field(text: str, width: int) -> bytes:
    return encode_text(cut_text(text, width), width, "name")

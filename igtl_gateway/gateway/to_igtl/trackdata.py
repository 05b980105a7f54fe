"""Tracking data: composed of single poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from igtl_gateway.gateway.peers import TRACKING, Peer
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
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


def tracking_content(igtl_type: str, device: str, now_ns: int, latest: Latest) -> OutboundMessage | None:
    """Return a TDATA or QTDATA of all single poses that are sent; None without any."""
    poses = latest(TRACKING[igtl_type], "")
    if not poses:
        return None
    dtype = TRACKING_DTYPE if igtl_type == "TDATA" else QTRACKING_DTYPE
    elements = np.zeros(len(poses), dtype)
    for element, pose in zip(elements, poses, strict=True):
        _fill(element, pose)
    content = (TrackingData if igtl_type == "TDATA" else QuaternionTrackingData)(elements)
    stamp_ns = max(pose.stamp_ns for pose in poses)
    frames = {pose.frame_id for pose in poses}
    return OutboundMessage(
        igtl_type,
        device or TRACKING_DEVICE,
        content,
        stamp_ns,
        ros_stamp_ns=max(pose.ros_stamp_ns for pose in poses),
        frame_id=frames.pop() if len(frames) == 1 else "",
    )


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

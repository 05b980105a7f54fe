"""Where the poses of tracking data are in CDR, as rows for ``express.bulk_to_ros`` and ``express.bulk_to_igtl``.

A tracker sends the same tools in every message: names and types belong to the sample, only the poses are new.  To ROS,
the places are found by comparison of messages that differ in one thing; to OpenIGTLink, they are counted, because
senders leave padding as it was in their memory.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.express import LANDMARKS, TOOLS
from igtl_gateway.convert.igtl_msgs import TrackingData
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.gateway.fastpath.common import NAMES_AT, STAMP_AT, end_of_name

#: Maximum number of tools of a compiled stream: each takes 0.2 µs, in which other messages wait.
MAX_TOOLS = 256

#: Name and type, offsets of stamp (0: none) and pose.
_TO_ROS = struct.Struct("<21s3xII")
#: Begin and end of a part that must be equal, offset of the pose after it (0: none).
_FROM_ROS = struct.Struct("<III")
_HEAD_SIZE, _STAMP_SIZE, _POSE_SIZE, _PLACE_SIZE = 21, 8, 56, 32
_U32 = struct.Struct("<I")
#: Two stamps and two numbers of which all bytes are different.
_STAMPS = tuple(byte * NS_PER_S + byte for byte in (0x11111111, 0x22222222))
_ONE, _OTHER = ((number,) * 7 for number in struct.unpack("<2d", b"\x11" * 8 + b"\x22" * 8))


def tools_form(row: ConversionToRos, content: Any, to: ToRosContext) -> tuple[Any, ...] | None:
    """Return the form of a message of all poses; None if there are too many, or one is left out."""
    elements = content.elements
    if not 0 < len(elements) <= MAX_TOOLS:
        return None
    early, late = (row.convert(content, replace(to, stamp_ns=stamp_ns)) for stamp_ns in _STAMPS)
    template = _with_poses(early, _ONE).pack()
    stamps = _differences(template, _with_poses(late, _ONE).pack(), _STAMP_SIZE)
    poses = _differences(template, _with_poses(early, _OTHER).pack(), _POSE_SIZE)
    if len(poses) != len(elements):
        return None
    each = stamps if row.message is TFMessage else [0] * len(poses)
    heads = (element.tobytes()[:_HEAD_SIZE] for element in elements)
    rows = b"".join(_TO_ROS.pack(*one) for one in zip(heads, each, poses, strict=True))
    return TOOLS, template + rows, stamps[0], elements.dtype.itemsize, len(rows)


def landmarks_form(row: ConversionToRos, content: Any, to: ToRosContext) -> tuple[Any, ...] | None:
    """Return the form of a list of labelled points; None if there are none or too many."""
    count = len(content.elements)
    if not 0 < count <= MAX_TOOLS:
        return None
    made: Any = row.convert(content, to)
    template, other = (_with_places(made, number).pack() for number in (_ONE[0], _OTHER[0]))
    places = _differences(template, other, _PLACE_SIZE)
    if len(places) != count:
        return None
    rows = b"".join(map(_U32.pack, places))
    return LANDMARKS, template + rows, STAMP_AT, 0, len(rows)


def _with_places(message: Any, number: float) -> Any:
    """Return landmarks with all places and diameters replaced."""
    points = (replace(point, position=(number,) * 3, diameter=number) for point in message.points)
    return replace(message, points=tuple(points))


def _with_poses(message: Any, pose: Pose) -> Any:
    """Return a message with all poses replaced."""
    match message:
        case TrackingData():
            return replace(message, tools=tuple(replace(tool, pose=pose) for tool in message.tools))
        case TFMessage():
            return replace(message, transforms=tuple(replace(one, pose=pose) for one in message.transforms))
        case _:
            return replace(message, poses=np.tile(pose, (len(message.poses), 1)))


def _differences(one: bytes, other: bytes, size: int) -> list[int]:
    """Return the offsets of parts of ``size`` bytes that differ in each of them."""
    found = np.flatnonzero(np.frombuffer(one, np.uint8) != np.frombuffer(other, np.uint8))
    return [int(at) for at in found[::size]]


def has_tools(forms: Sequence[tuple[Any, ...]], content: Buffer) -> bool:
    """Return whether a content has the tools of these forms; some might be out of sight, and have no pose."""
    if not forms or forms[0][0] != TOOLS:
        return False
    _, template, _, size, rest = forms[0]
    return [bytes(content[at : at + _HEAD_SIZE]) for at in range(0, len(content), size)] == [
        template[at : at + _HEAD_SIZE] for at in range(len(template) - rest, len(template), _TO_ROS.size)
    ]


def tools_places(message: object, cdr: Buffer, content: Any) -> tuple[bytes, tuple[int, ...]] | None:
    """Return the sample and the places that ``bulk_to_igtl`` needs; None for too many tools, or with metadata."""
    elements = content.elements
    named = isinstance(message, TrackingData)
    if not 0 < len(elements) <= MAX_TOOLS or (isinstance(message, TrackingData) and message.metadata):
        return None
    frame_end = end_of_name(cdr, NAMES_AT)
    begin = frame_end + -frame_end % 4
    rows, at = [(NAMES_AT, frame_end, 0)], begin + 4  # after the number of tools
    for _ in elements:
        at = end_of_name(cdr, at) + 1 if named else at  # after the type
        pose = at + (STAMP_AT - at) % 8  # alignment counts from the end of the encapsulation
        rows.append((begin, at, pose))
        begin = at = pose + _POSE_SIZE
    rows.append((begin, len(cdr), 0))
    sample = bytes(cdr) + elements.tobytes() + b"".join(_FROM_ROS.pack(*row) for row in rows)
    return sample, (len(elements), len(cdr), elements.dtype.itemsize, 0, 0, 0)

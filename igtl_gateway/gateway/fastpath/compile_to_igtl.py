"""Compiles the stream of a ROS topic from a message that took the full path without a finding.

As ``compile_to_ros``, for the connected peers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.config.settings import SOURCE
from igtl_gateway.convert import clouds, express, images, numbers, poses, robots, rosmsg, surfaces, texts, tracking
from igtl_gateway.convert.common_msgs import JointState, PoseArray, PoseStamped
from igtl_gateway.convert.express import (
    BLUE_FIRST,
    CLOUD,
    MATRIX,
    MESH,
    NUMBERS,
    PICTURE,
    POINTS,
    QUATERNION,
    TEXT,
    TOOLS,
    TRIANGLES,
    FillTemplate,
)
from igtl_gateway.convert.igtl_msgs import TrackingData
from igtl_gateway.convert.rosmsg import PointCloud2, String, TransformStamped
from igtl_gateway.gateway.fastpath.common import NAMES_AT, CompileContext, end_of_name
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.fastpath.joints import joints_places
from igtl_gateway.gateway.fastpath.tools import tools_places
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.to_igtl.origin import IgtlOrigin
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage, send
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.header import HEADER_SIZE
from igtl_gateway.wire.image import HEAD_SIZE as IMAGE_HEAD
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import EXTENDED_SIZE
from igtl_gateway.wire.polydata import Cells, PolyData

#: Conversion function of a pose → number of bytes of its content in OpenIGTLink.
_TO_IGTL: dict[Callable[..., Any], int] = {
    poses.transform_to_igtl: MATRIX,
    poses.pose_to_transform: MATRIX,
    poses.position_to_igtl: QUATERNION,
    poses.pose_to_position: QUATERNION,
}
#: Conversion function of bulk data → form of the result.
_BULK_TO_IGTL: dict[Callable[..., Any], int] = {
    texts.string_to_igtl: TEXT,
    clouds.cloud_to_points: POINTS,
    clouds.cloud_to_polydata: CLOUD,
    images.image_to_igtl: PICTURE,
    surfaces.mesh_to_igtl: MESH,
    surfaces.marker_to_igtl: TRIANGLES,
    tracking.tracking_to_tdata: TOOLS,
    tracking.tracking_to_qtdata: TOOLS,
    tracking.poses_to_tdata: TOOLS,
    numbers.joints_to_sensor: NUMBERS,
    robots.joints_to_array: NUMBERS,
}
#: ROS types whose streams can be compiled.
TYPES = frozenset(
    message.TYPE
    for message in (
        *(TransformStamped, PoseStamped, String, PointCloud2),
        *(rosmsg.Image, rosmsg.Mesh, rosmsg.Marker, TrackingData, PoseArray, JointState),
    )
)
_CLOUD_OF_ONE = PolyData(np.zeros((1, 3), ">f4"), vertices=Cells.of(np.zeros((1, 1), int)))
_SMALL = PolyData(np.zeros((1, 3), ">f4"))
_LITTLE_ENDIAN = b"\x00\x01"
_POSE_SIZE = 56
_XYZ, _FLOAT32 = ("x", "y", "z"), 7
_LEAST_PICTURE = 4  # bytes of the smallest image; the smallest point has as many
#: Stamps of 19 digits that differ in every digit: encoding both shows where in a message the stamp is.
_TWO_STAMPS = (1_111_111_111_111_111_111, 2_222_222_222_222_222_222)


def compile_to_igtl(
    entry: Entry, origin: IgtlOrigin, common: CompileContext, latest: dict[str, Entry], peers: Sequence[Peer]
) -> CompiledToIgtl | None:
    """Compile from a message that was sent without a finding; None if its stream cannot be compiled.

    ``latest`` has the latest message of each topic.
    """
    stream, out, watched = origin
    cdr, size = entry.payload[0], _TO_IGTL.get(stream.conversion.convert, 0)
    form = _BULK_TO_IGTL.get(stream.conversion.convert)
    fill: FillTemplate | None = express.pose_to_igtl if size else express.bulk_to_igtl
    if not (size or form is not None) or fill is None or bytes(cdr[:2]) != _LITTLE_ENDIAN:
        return None
    if any(_is_of_its_own(out, peer) for peer in peers):
        return None
    if form == TOOLS and any(peer.tracked for peer in peers):  # one might get them in its own form
        return None
    if form in (MESH, TRIANGLES):  # the bytes around the content are those around any content
        out = replace(out, content=_SMALL)
    content = size or sum(memoryview(part).nbytes for part in out.content.pack())
    extra, rows = 0, None
    if size:
        names: tuple[int, ...] | None = _names_of(cdr, two=entry.type == TransformStamped.TYPE)
    elif form == PICTURE:
        extra, content = IMAGE_HEAD, content - IMAGE_HEAD
        form, names = _picture_places(cdr, content)
    elif form == TRIANGLES:
        names = _marker_places(cdr)
    elif form == TOOLS:
        rows = tools_places(stream.conversion.message.unpack(cdr), cdr, out.content)
        names = rows[1] if rows else None
    elif form == NUMBERS:
        rows = joints_places(entry.channel, cdr, out.content)
        names = rows[1] if rows else None
    else:
        names = () if form in (TEXT, MESH) else _cloud_places(cdr)
    if names is None:
        return None
    copies = [replace(peer) for peer in peers]  # this sends nothing
    sign = 1 if out.ros_stamp_ns else -1  # the digits are those of the ROS stamp, or of the message's
    which = "ros_stamp_ns" if out.ros_stamp_ns else "stamp_ns"
    stamps: list[dict[str, Any]] = [{which: stamp_ns} for stamp_ns in _TWO_STAMPS]
    first, second = (send(entry, replace(out, **stamp), copies) for stamp in stamps)
    if first.findings or not first.outputs:
        return None
    outputs: list[tuple[Output, tuple[Any, ...]]] = []
    for one, other in zip(first.outputs, second.outputs, strict=True):
        version_1 = one.payload[0][1] == 1
        template = join(one.payload)
        at = HEADER_SIZE + (0 if version_1 else EXTENDED_SIZE) + extra
        head, tail = template[:at], template[at + content :]
        digits_at = 0 if version_1 else _difference(tail, join(other.payload)[at + content :])
        if digits_at > 0:
            digits_at = sign * (digits_at + (at + content if size else 0))
        if size:
            outputs.append((one, (template, at, digits_at)))
        else:
            outputs.append((replace(one, payload=()), (head, tail, digits_at)))
    own = common.config.stamp_of(stream.row) == SOURCE
    if stream.max_age_s and not own:
        return None
    sample = rows[0] if rows else bytes(cdr) if size else bytes(cdr[: names[1] if names else 4])
    place_at = len(sample) - _POSE_SIZE if size else None
    what = size or form or 0
    ratio = stream.lengths.ratio_to_igtl
    return CompiledToIgtl(
        fill,
        sample,
        names,
        what,
        outputs,
        peers,
        ratio,
        own,
        common.ledger,
        entry.channel,
        latest,
        watched,
        place_at,
    )


def _is_of_its_own(out: OutboundMessage, peer: Peer) -> bool:
    """Return whether a peer may get other messages of a stream than others, or at another pace."""
    if out.igtl_type in peer.paced_types or _is_adapted(out.content, peer):
        return True
    return peer.must_wait(out.igtl_type) or (out.in_unit is not None and bool(peer.profile.arm_unit))


def _is_adapted(content: Body, peer: Peer) -> bool:
    """Return whether a peer may get other contents of a stream.

    The attributes of a surface, and type and orientation of the pixels, are part of the sample; whether a cloud has
    points is not.
    """
    adapt = peer.profile.adapt.get(type(content))
    if isinstance(content, PolyData) and not content.polygons.count:
        content = _CLOUD_OF_ONE
    return adapt is not None and not (isinstance(content, (PolyData, Image)) and adapt(content)[0] is content)


def _difference(one: bytes, other: bytes) -> int:
    """Return the first offset after the contents at which two messages differ; −1 if there is none."""
    pairs = zip(one, other, strict=True)
    return next((index for index, (left, right) in enumerate(pairs) if left != right), -1)


def _cloud_places(cdr: Buffer) -> tuple[int, ...] | None:
    """Return the offsets that ``bulk_to_igtl`` needs of a cloud; None for fields other than float32 x, y, z."""
    cloud = PointCloud2.unpack(cdr)
    fields = {field.name: field for field in cloud.fields}
    plain = all(field.datatype == _FLOAT32 and field.count in (0, 1) for field in cloud.fields)
    if cloud.is_bigendian or not plain or len(cloud.fields) != len(_XYZ) or fields.keys() != set(_XYZ):
        return None
    same = [NAMES_AT, end_of_name(cdr, NAMES_AT)]  # between the parts is padding
    height_at = same[-1] + -same[-1] % 4
    at = height_at + 8  # offset of the number of fields
    same += (at, at + 4)
    at += 4
    for _ in cloud.fields:
        end = end_of_name(cdr, at)
        offset_at = end + -end % 4
        same += (at, end, offset_at, offset_at + 5, offset_at + 8, offset_at + 12)
        at = offset_at + 12
    same += (at, at + 1, at + 4, at + 8)  # byte order and point_step
    data_at = at + 16
    return height_at, data_at, cloud.point_step, *(fields[name].offset for name in _XYZ), *same


def _picture_places(cdr: Buffer, size: int) -> tuple[int, tuple[int, ...] | None]:
    """Return the form of an Image and the offsets that ``bulk_to_igtl`` needs; None for padded rows."""
    picture = rosmsg.Image.unpack(cdr)
    blue_first = picture.encoding.startswith("bgr")
    if picture.step * picture.height != size or size < _LEAST_PICTURE or (blue_first and picture.encoding != "bgr8"):
        return PICTURE, None
    frame_end = end_of_name(cdr, NAMES_AT)
    height_at = frame_end + -frame_end % 4
    end = end_of_name(cdr, height_at + 8) + 1  # after the encoding and the byte order
    data_at = end + -end % 4 + 8
    same = (NAMES_AT, frame_end, height_at, end, data_at - 8, data_at)
    return BLUE_FIRST if blue_first else PICTURE, (height_at, data_at, size, 0, 0, 0, *same)


def _marker_places(cdr: Buffer) -> tuple[int, ...] | None:
    """Return the offsets that ``bulk_to_igtl`` needs of a marker; None for others than unrotated triangles."""
    marker = rosmsg.Marker.unpack(cdr)
    if marker.type != rosmsg.Marker.TRIANGLE_LIST or marker.action in surfaces.DELETIONS or len(marker.colors):
        return None
    if not surfaces.is_unrotated(marker):
        return None
    frame_end = end_of_name(cdr, NAMES_AT)
    ns_at = frame_end + -frame_end % 4
    ns_end = end_of_name(cdr, ns_at)
    type_at = ns_end + -ns_end % 4 + 4  # after the id
    pose_at = type_at + 8 + (4 - type_at) % 8  # alignment counts from the end of the encapsulation
    count_at = pose_at + 80 + 16 + 8 + 4  # after pose and scale, colour, lifetime, frame_locked
    points_at = count_at + 4 + -count_at % 8
    same = (NAMES_AT, frame_end, ns_at, ns_end, type_at, type_at + 8, pose_at, pose_at + 80)
    return pose_at, points_at, 24, points_at - count_at, 0, 0, *same


def _names_of(cdr: Buffer, *, two: bool) -> tuple[int, int, int] | None:
    """Return the offsets after the first name, before and after the second; None if the pose does not follow."""
    first_end = second = end = end_of_name(cdr, 12)
    if two:
        second = first_end + -first_end % 4
        end = end_of_name(cdr, second)
    pose = end + (4 - end) % 8
    return (first_end, second, end) if len(cdr) == pose + _POSE_SIZE else None

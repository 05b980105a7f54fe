"""Compiles the stream of an OpenIGTLink device from a message that took the full path without a finding.

The constant parts of the message become a sample, with which the next message is compared, and templates, which the
functions of `igtl_gateway.convert.express` fill.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.config.settings import SOURCE
from igtl_gateway.convert import (
    clouds,
    express,
    images,
    poses,
    rosmsg,
    surfaces,
    texts,
    tracking,
    trajectories,
    volumes,
)
from igtl_gateway.convert.assembly import VolumeAssembler, form_of
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.express import (
    CLOUD,
    LANDMARKS,
    MATRIX,
    MESH,
    METADATA,
    PICTURE,
    POINT,
    POINTS,
    QUATERNION,
    TEXT,
    TOOLS,
    TRIANGLES,
    VOLUME,
    FillTemplate,
)
from igtl_gateway.convert.igtl_msgs import Metadata
from igtl_gateway.convert.plus_signs import TrackedFrames
from igtl_gateway.convert.polydata import exceeds_standard
from igtl_gateway.convert.table import ConversionToRos, Role
from igtl_gateway.convert.tracking import NOT_VALID
from igtl_gateway.convert.trajectories import is_labeled
from igtl_gateway.gateway.fastpath import metadata
from igtl_gateway.gateway.fastpath.common import NAMES_AT, STAMP_AT, CompileContext, end_of_name
from igtl_gateway.gateway.fastpath.compiled_to_ros import Assembly, CompiledToRos, Defer
from igtl_gateway.gateway.fastpath.tools import landmarks_form, tools_form
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.to_ros.beforehand import Beforehand
from igtl_gateway.gateway.to_ros.convert import METADATA_QOS
from igtl_gateway.gateway.to_ros.route import RosOrigin
from igtl_gateway.gateway.to_ros.subscribers import Waiting
from igtl_gateway.wire.header import HEADER_SIZE
from igtl_gateway.wire.image import HEAD_SIZE as IMAGE_HEAD
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import EXTENDED_SIZE
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData

#: Conversion function of a pose → offset of the stamp in its CDR, which ends with the pose.
_TO_ROS: dict[Callable[..., Any], int] = {
    poses.transform_to_ros: 4,
    poses.position_to_ros: 4,
    tracking.transform_to_tf: 8,
    tracking.position_to_tf: 8,
}
#: Types of poses → number of bytes of the content.
_POSES = {"TRANSFORM": MATRIX, "POSITION": QUATERNION, "QTRANS": QUATERNION}
#: Conversion function of bulk data → form of the result.
_BULK_TO_ROS: dict[Callable[..., Any], int] = {
    texts.string_to_ros: TEXT,
    clouds.point_to_ros: POINT,
    clouds.points_to_cloud: POINTS,
    clouds.polydata_to_cloud: CLOUD,
    surfaces.polydata_to_mesh: MESH,
    surfaces.polydata_to_marker: TRIANGLES,
    trajectories.points_to_point_list: LANDMARKS,
    images.image_to_ros: PICTURE,
    volumes.image_to_volume: VOLUME,
    tracking.tracking_to_ros: TOOLS,
    tracking.tracking_to_poses: TOOLS,
    tracking.tracking_to_tf: TOOLS,
}
#: Conditions of rows that never apply to bulk data, or (for images, clouds, surfaces) apply if they do to the sample.
_NEVER: frozenset[Callable[..., bool]] = frozenset(
    {
        is_labeled,
        surfaces.has_faces,
        surfaces.has_lines,
        surfaces.is_point_cloud,
        exceeds_standard,
        volumes.is_flat,
        volumes.exceeds_picture,
        volumes.has_slices,
    }
)
#: The smallest surface: a template needs no other.
_TRIANGLE = PolyData(np.zeros((3, 3), ">f4"), polygons=Cells.of(np.arange(3).reshape(1, 3)))
#: The smallest cloud, for the template of one: the sample may have colours, which the compiled messages have not.
_ONE_POINT = PolyData(np.zeros((1, 3), ">f4"))
#: Types whose streams can be compiled.
TYPES = frozenset({*_POSES, "STRING", "POINT", "POLYDATA", "IMAGE", "TDATA", "QTDATA"})
_U32 = struct.Struct("<I")
_ALIGNED = 4  # in CDR: what follows the pixels of a volume
#: In place of the form of a message that is not published.
_LEFT_OUT: tuple[Any, ...] = ()
#: Offset of the translation in the content.
_PLACE_AT = {MATRIX: 36, QUATERNION: 0}


def compile_to_ros(
    entry: Entry,
    origin: RosOrigin,
    common: CompileContext,
    assembler: VolumeAssembler | None,
    frames: TrackedFrames | None,
    beforehand: Beforehand,
) -> CompiledToRos | None:
    """Compile from a message that was converted without a finding; None if its stream cannot be compiled.

    ``assembler`` has the latest image of the device, ``frames`` is the search of its peer.  Raises
    ConversionError for a message that the full path has not converted, for want of subscribers.
    """
    message, stream, to, watched = origin
    to = replace(to, warnings=[], made={})
    data, size = entry.payload[0], _POSES.get(entry.type, 0)
    if not metadata.are_constant(message):
        return None
    at, tail = HEADER_SIZE, 0
    if message.header_version > 1:
        at += EXTENDED_SIZE
        tail = metadata.block_size(data)
        if tail > metadata.LARGEST_BLOCK:
            return None
    if size and (not isinstance(data, bytes) or at + size + tail != len(data)):
        return None
    volume: Assembly | None = None
    if isinstance(content := message.content, Image):
        if assembler is None or content.sub_size != content.dimensions:
            return None
        at, volume = at + IMAGE_HEAD, (assembler, form_of(content), content.array.dtype)
    forms: list[tuple[str, str, tuple[Any, ...]]] = []
    rows: dict[str, ConversionToRos] = {}
    alone = bool(to.metadata)  # no message to ROS contains them
    for row, topic in stream.outputs:
        if not isinstance(message.content, row.content):
            return None
        if not size and row.applies in _NEVER and not row.applies(message.content):
            continue
        alone = alone and row.role is not Role.FULL
        form = _pose_form(row, message.content, to) if size else _bulk_form(row, message.content, to, beforehand)
        if form is None:
            return None
        if form is not _LEFT_OUT:
            forms.append((topic, row.message.TYPE, form))
            rows[topic] = row
    if any(warning not in origin.to.warnings for warning in to.warnings):
        return None
    if alone:
        common.advertise(stream.metadata_topic, METADATA_QOS)
        made, stamp_at, id_at = metadata.metadata_form(to)
        form = (made, stamp_at, id_at) if size else (METADATA, made, stamp_at, id_at, 0)
        forms.append((stream.metadata_topic, Metadata.TYPE, form))
    own = common.config.stamp_of(stream.row) == SOURCE
    if stream.max_age_s and not own:  # the guard checks a stamp that the output does not have
        return None
    fill: FillTemplate | None = express.pose_to_ros if size else express.bulk_to_ros
    if fill is None:
        return None
    place_at = at + _PLACE_AT[size] if size else None
    labels = content.elements.tobytes() if isinstance(content, Points) and is_labeled(content) else b""
    sample = bytes(data) if size else bytes(data[:at]) + bytes(data[len(data) - tail :]) + labels
    latched = frozenset(topic for topic, _, _ in forms if (known := common.qos(topic)) and known.latched)
    return CompiledToRos(
        fill,
        sample,
        (at, size or tail),
        entry,
        forms,
        to.lengths.ratio_to_ros,
        common.config.check_crc,
        own,
        common.ledger,
        watched,
        place_at,
        (common.waiting, latched),
        volume,
        _defer(rows, to, volume and content, at) if labels or isinstance(content, PolyData | Image) else None,
        frames.passed_over if frames and volume else None,
        keeps=bool(labels),
    )


def _defer(rows: dict[str, ConversionToRos], to: ToRosContext, image: Any, at: int) -> Defer:
    """Return what keeps messages for the first subscribers of their topics, not decoded.

    ``image``: a sample of pictures, of which only the pixels from ``at`` on are new; None: of other messages.
    """
    if image is None:
        return lambda entry, topic, stamp_ns: Waiting(
            entry, rows[topic], None, replace(to, stamp_ns=stamp_ns, warnings=[], made={}), entry.size
        )
    size, sample = memoryview(image.pixels).nbytes, replace(image, pixels=b"")

    def defer(entry: Entry, topic: str, stamp_ns: int) -> Waiting:
        pixels = memoryview(entry.payload[0])[at : at + size]
        alone = replace(entry, payload=())
        context = replace(to, stamp_ns=stamp_ns, warnings=[], made={})
        return Waiting(alone, rows[topic], replace(sample, pixels=pixels), context, size)

    return defer


def may_repeat(warnings: Sequence[tuple[str, str]]) -> bool:
    """Return whether a stream can be compiled from a message with these warnings: each is reported once only."""
    return all(code == NOT_VALID for code, _ in warnings)


def _pose_form(row: ConversionToRos, content: Any, to: ToRosContext) -> tuple[Any, ...] | None:
    """Return the CDR and the offset of its stamp; ``_LEFT_OUT`` if the sender marks the pose as not valid."""
    stamp_at = _TO_ROS.get(row.convert)
    if stamp_at is None or not row.applies(content):
        return None
    made: Any = row.convert(content, to)
    if isinstance(made, TFMessage) and not made.transforms:
        return _LEFT_OUT
    return made.pack(), stamp_at


def _bulk_form(row: ConversionToRos, content: Any, to: ToRosContext, beforehand: Beforehand) -> tuple[Any, ...] | None:
    """Return the form as ``bulk_to_ros`` needs it: itself, its template, and offsets in it."""
    form = _BULK_TO_ROS.get(row.convert)
    if form == TEXT:
        return TEXT, b"", 0, 0, 0
    if form == TOOLS:
        return tools_form(row, content, to)
    if form == POINT:
        header = rosmsg.Header(to.stamp_ns, to.frame_id)
        return POINT, rosmsg.PointStamped(header, (0.0, 0.0, 0.0)).pack(), STAMP_AT, 0, 0
    if form is None or (form in (MESH, TRIANGLES) and exceeds_standard(content)):
        return None
    if form == LANDMARKS:
        return landmarks_form(row, content, to)
    if form == MESH:
        return MESH, b"", 0, 0, 0
    if form == TRIANGLES:
        return TRIANGLES, *_marker_template(row.convert(_TRIANGLE, to))
    made: Any
    if form == CLOUD:
        made = row.convert(_ONE_POINT, to)
    else:
        made = beforehand.message(content, row.convert) or row.convert(content, to)
    if form == VOLUME:
        return VOLUME, *_volume_template(made)
    # without its data, which may be a hundred megabytes; their size is the last of the template
    cdr, size = replace(made, data=b"").pack(), _U32.pack(memoryview(made.data).nbytes)
    if form == PICTURE:
        return form, cdr[: -_U32.size] + size, STAMP_AT, 0, 0
    frame_end = end_of_name(cdr, NAMES_AT)
    return form, cdr[: -1 - _U32.size] + size, STAMP_AT, frame_end + -frame_end % 4 + 4, 0


def _volume_template(made: Any) -> tuple[bytes, int, int, int]:
    """Return a volume without its pixels, the offset of its stamp, 0, and the size of what follows the pixels."""
    size = memoryview(made.data).nbytes
    rest = size % _ALIGNED  # as many bytes as decide how many follow to align the metadata
    begin = len(replace(made, data=b"", metadata=()).pack()) - _U32.size
    cdr = replace(made, data=bytes(rest)).pack()
    return cdr[: begin - _U32.size] + _U32.pack(size) + cdr[begin + rest :], STAMP_AT, 0, len(cdr) - begin - rest


def _marker_template(made: Any) -> tuple[bytes, int, int, int]:
    """Return a marker without its points, the offsets of stamp and number of points, and the size after the points."""
    points = np.full((6, 3), math.pi)
    one, other = (replace(made, points=points[:count]).pack() for count in (3, 6))
    begin, size = one.index(points[:3].tobytes()), points[:3].nbytes
    count_at = next(at for at in range(begin) if one[at] != other[at])
    return one[:begin] + one[begin + size :], STAMP_AT, count_at, len(one) - begin - size

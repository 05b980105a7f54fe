"""How the plans of ``plans`` are made: from a message that took the general way without a word.

Everything about it that does not change from message to message becomes a sample to hold the next one against, and
templates to be filled by the functions of `igtl_gateway.convert.express`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from igtl_gateway.buffers import Buffer, join
from igtl_gateway.config import Config
from igtl_gateway.convert import clouds, express, images, poses, rosmsg, surfaces, texts, tracking, volumes
from igtl_gateway.convert.assembly import VolumeAssembler, form_of
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.context import ToRos
from igtl_gateway.convert.express import (
    BLUE_FIRST,
    CLOUD,
    MATRIX,
    PICTURE,
    POINT,
    POINTS,
    QUATERNION,
    TEXT,
    Fill,
)
from igtl_gateway.convert.plans import is_labeled
from igtl_gateway.convert.polydata import exceeds_standard
from igtl_gateway.convert.rosmsg import PointCloud2, String, TransformStamped
from igtl_gateway.convert.table import RosRow
from igtl_gateway.errors import ConversionError
from igtl_gateway.gateway.guard import Watched
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.plans import ToIgtlPlan, ToRosPlan, Volume
from igtl_gateway.gateway.reply import Reply
from igtl_gateway.gateway.sender import Outbound, send
from igtl_gateway.gateway.streams import ToIgtlStream, ToRosStream
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.wire import HEADER_SIZE, Message
from igtl_gateway.wire.image import HEAD_SIZE as IMAGE_HEAD
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import EXTENDED_SIZE

#: How a row writes a pose → the offset of the stamp in its CDR, which ends with the pose.
_TO_ROS: dict[Callable[..., Any], int] = {
    poses.transform_to_ros: 4,
    poses.position_to_ros: 4,
    tracking.transform_to_tf: 8,
    tracking.position_to_tf: 8,
}
#: How a row reads one → the bytes of its numbers in OpenIGTLink.
_TO_IGTL: dict[Callable[..., Any], int] = {
    poses.transform_to_igtl: MATRIX,
    poses.pose_to_transform: MATRIX,
    poses.position_to_igtl: QUATERNION,
    poses.pose_to_position: QUATERNION,
}
#: Types whose messages are poses → the bytes of their numbers.
_POSES = {"TRANSFORM": MATRIX, "POSITION": QUATERNION, "QTRANS": QUATERNION}
#: How a row makes bulk, each way → the form that it is.
_BULK_TO_ROS: dict[Callable[..., Any], int] = {
    texts.string_to_ros: TEXT,
    clouds.point_to_ros: POINT,
    clouds.points_to_ros: POINTS,
    clouds.polydata_to_cloud: CLOUD,
    images.image_to_ros: PICTURE,
}
_BULK_TO_IGTL: dict[Callable[..., Any], int] = {
    texts.string_to_igtl: TEXT,
    clouds.cloud_to_points: POINTS,
    clouds.cloud_to_polydata: CLOUD,
    images.image_to_igtl: PICTURE,
}
#: Of rows that apply to nothing that a form of bulk is made of, or (of pictures) to nothing if not to the sample.
_NEVER: frozenset[Callable[..., bool]] = frozenset(
    {is_labeled, surfaces.has_faces, surfaces.has_lines, exceeds_standard, volumes.exceeds_picture, volumes.has_slices}
)
#: Types of which there may be plans.
PLANNED = frozenset({*_POSES, "STRING", "POINT", "POLYDATA", "IMAGE"})
PLANNED_TOPICS = frozenset({TransformStamped.TYPE, PoseStamped.TYPE, String.TYPE, PointCloud2.TYPE, rosmsg.Image.TYPE})
_LITTLE_ENDIAN = b"\x00\x01"
_POSE_SIZE = 56
_STAMP_AT, _NAMES_AT = 4, 12  # in CDR that begins with a header
_METADATA_SIZE = struct.Struct(">H")  # of the metadata's header
_XYZ, _FLOAT32 = ("x", "y", "z"), 7
_LEAST_PICTURE = 4  # bytes; the least point has as many
#: Where the translation is among the numbers in OpenIGTLink.
_PLACE_AT = {MATRIX: 36, QUATERNION: 0}


@dataclass(frozen=True, slots=True)
class Planner:
    """What all plans of a session have in common.

    Attributes:
        config, ledger: of the session.
        latest: the last message of each topic.
        unmade: what is to be made of latched topics once somebody listens.
        qos: of a topic that is published.
    """

    config: Config
    ledger: Ledger
    latest: dict[str, Entry]
    unmade: dict[str, Any]
    qos: Callable[[str], Qos | None]

    def to_ros(
        self,
        entry: Entry,
        message: Message,
        stream: ToRosStream,
        to: ToRos,
        watched: Watched | None,
        assembler: VolumeAssembler | None,
    ) -> ToRosPlan | None:
        """The plan that follows from a message that was converted without a word; None where there can be none.

        ``assembler`` keeps the last image of its device.
        """
        data, size = entry.payload[0], _POSES.get(entry.type, 0)
        at = HEADER_SIZE + (EXTENDED_SIZE if message.header_version > 1 else 0)
        if message.metadata or message.layout is not None:
            return None
        tail = _METADATA_SIZE.unpack_from(data, HEADER_SIZE + 2)[0] if message.header_version > 1 else 0
        if size and (not isinstance(data, bytes) or at + size + tail != len(data)):
            return None
        volume: Volume | None = None
        if isinstance(content := message.content, Image):
            if assembler is None or content.sub_size != content.dimensions:
                return None
            at, volume = at + IMAGE_HEAD, (assembler, form_of(content), content.array.dtype)
        forms: list[tuple[str, str, tuple[Any, ...]]] = []
        for row, topic in stream.outputs:
            if not isinstance(message.content, row.content):
                return None
            if not size and row.applies in _NEVER and not row.applies(message.content):
                continue
            form = _pose_form(row, message.content, to) if size else _bulk_form(row, message.content, to)
            if form is None:
                return None
            forms.append((topic, row.message.TYPE, form))
        if to.warnings:
            return None
        own = self.config.stamp_of(stream.row) == "source"
        if stream.row.max_age_s and not own:  # judged by a stamp that is not told
            return None
        fill: Fill | None = express.pose_to_ros if size else express.bulk_to_ros
        if fill is None:
            return None
        place_at = at + _PLACE_AT[size] if size else None
        sample = bytes(data) if size else bytes(data[:at]) + bytes(data[len(data) - tail :])
        latched = frozenset(topic for topic, _, _ in forms if (known := self.qos(topic)) and known.latched)
        return ToRosPlan(
            fill,
            sample,
            (at, size or tail),
            entry,
            forms,
            to.lengths.ratio_to_ros,
            self.config.check_crc,
            own,
            self.ledger,
            watched,
            place_at,
            (self.unmade, latched),
            volume,
        )

    def to_igtl(
        self, entry: Entry, stream: ToIgtlStream, out: Outbound, peers: Sequence[Peer], watched: Watched | None
    ) -> ToIgtlPlan | None:
        """The plan that follows from a message that was sent without a word; None where there can be none."""
        cdr, size = entry.payload[0], _TO_IGTL.get(stream.conversion.convert, 0)
        form = _BULK_TO_IGTL.get(stream.conversion.convert)
        fill: Fill | None = express.pose_to_igtl if size else express.bulk_to_igtl
        if not (size or form is not None) or fill is None or bytes(cdr[:2]) != _LITTLE_ENDIAN:
            return None
        if any(peer.wishes or type(out.content) in peer.profile.adapt for peer in peers):
            return None
        content = size or sum(memoryview(part).nbytes for part in out.content.pack())
        extra = 0
        if size:
            names: tuple[int, ...] | None = _names_of(cdr, two=entry.type == TransformStamped.TYPE)
        elif form == PICTURE:
            extra, content = IMAGE_HEAD, content - IMAGE_HEAD
            form, names = _picture_places(cdr, content)
        else:
            names = () if form == TEXT else _cloud_places(cdr)
        if names is None:
            return None
        first, second = (
            send(replace(out, ros_stamp_ns=stamp_ns if out.ros_stamp_ns else 0), peers, entry.stamp_ns)
            for stamp_ns in _TWO_STAMPS
        )
        if first.refused or first.warnings or not first.replies:
            return None
        told: list[tuple[Reply, tuple[Any, ...]]] = []
        for one, other in zip(first.replies, second.replies, strict=True):
            version_1 = one.payload[0][1] == 1
            template = join(one.payload)
            at = HEADER_SIZE + (0 if version_1 else EXTENDED_SIZE) + extra
            head, tail = template[:at], template[at + content :]
            digits_at = 0 if version_1 else _difference(tail, join(other.payload)[at + content :])
            if size:
                told.append((one, (template, at, at + content + digits_at if digits_at > 0 else digits_at)))
            else:
                told.append((replace(one, payload=()), (head, tail, digits_at)))
        own = self.config.stamp_of(stream.row) == "source"
        if stream.row.max_age_s and not own:
            return None
        sample = bytes(cdr) if size else bytes(cdr[: names[1] if names else 4])
        place_at = len(sample) - _POSE_SIZE if size else None
        what = size or form or 0
        ratio = stream.lengths.ratio_to_igtl
        return ToIgtlPlan(
            fill,
            sample,
            names,
            what,
            told,
            peers,
            ratio,
            own,
            self.ledger,
            entry.channel,
            self.latest,
            watched,
            place_at,
        )


def _pose_form(row: RosRow, content: Any, to: ToRos) -> tuple[bytes, int] | None:
    """CDR and where its stamp is."""
    stamp_at = _TO_ROS.get(row.convert)
    if stamp_at is None or not row.applies(content):
        return None
    made: Any = row.convert(content, to)
    return made.pack(), stamp_at


def _bulk_form(row: RosRow, content: Any, to: ToRos) -> tuple[int, bytes, int, int] | None:
    """What is made, its template, and where the stamp and the width of that are."""
    form = _BULK_TO_ROS.get(row.convert)
    if form == TEXT:
        return TEXT, b"", 0, 0
    if form == POINT:
        header = rosmsg.Header(to.stamp_ns, to.frame_id)
        return POINT, rosmsg.PointStamped(header, (0.0, 0.0, 0.0)).pack(), _STAMP_AT, 0
    if form is None:
        return None
    made: Any = row.convert(content, to)
    cdr = made.pack()
    end = len(cdr) - memoryview(made.data).nbytes
    if form == PICTURE:
        return form, cdr[:end], _STAMP_AT, 0
    frame_end = _behind_name(cdr, _NAMES_AT)
    return form, cdr[: end - 1], _STAMP_AT, frame_end + -frame_end % 4 + 4


#: Stamps of 19 digits, no two the same at the same place: they show where in a message the stamp is.
_TWO_STAMPS = (1_111_111_111_111_111_111, 2_222_222_222_222_222_222)


def _difference(one: bytes, other: bytes) -> int:
    """Where what is behind two contents begins to differ; −1 where it does not."""
    pairs = zip(one, other, strict=True)
    return next((index for index, (left, right) in enumerate(pairs) if left != right), -1)


def _cloud_places(cdr: Buffer) -> tuple[int, ...] | None:
    """What ``bulk_to_igtl`` is to know of a cloud; None where it has more than x, y and z, or those in another form."""
    try:
        cloud = PointCloud2.unpack(cdr)
    except ConversionError:
        return None
    fields = {field.name: field for field in cloud.fields}
    plain = all(field.datatype == _FLOAT32 and field.count in (0, 1) for field in cloud.fields)
    if cloud.is_bigendian or not plain or len(cloud.fields) != len(_XYZ) or fields.keys() != set(_XYZ):
        return None
    same = [_NAMES_AT, _behind_name(cdr, _NAMES_AT)]  # what is between the parts is padding
    height_at = same[-1] + -same[-1] % 4
    at = height_at + 8  # the number of fields
    same += (at, at + 4)
    at += 4
    for _ in cloud.fields:
        end = _behind_name(cdr, at)
        offset_at = end + -end % 4
        same += (at, end, offset_at, offset_at + 5, offset_at + 8, offset_at + 12)
        at = offset_at + 12
    same += (at, at + 1, at + 4, at + 8)  # byte order and the size of a point
    data_at = at + 16
    return height_at, data_at, cloud.point_step, *(fields[name].offset for name in _XYZ), *same


def _picture_places(cdr: Buffer, size: int) -> tuple[int, tuple[int, ...] | None]:
    """What is made of an Image of so many bytes, and what ``bulk_to_igtl`` is to know; None where rows are padded."""
    picture = rosmsg.Image.unpack(cdr)
    blue_first = picture.encoding.startswith("bgr")
    if picture.step * picture.height != size or size < _LEAST_PICTURE or (blue_first and picture.encoding != "bgr8"):
        return PICTURE, None
    frame_end = _behind_name(cdr, _NAMES_AT)
    height_at = frame_end + -frame_end % 4
    end = _behind_name(cdr, height_at + 8) + 1  # the encoding, and the byte order
    data_at = end + -end % 4 + 8
    same = (_NAMES_AT, frame_end, height_at, end, data_at - 8, data_at)
    return BLUE_FIRST if blue_first else PICTURE, (height_at, data_at, size, 0, 0, 0, *same)


def _names_of(cdr: Buffer, *, two: bool) -> tuple[int, int, int] | None:
    """Offsets behind the first name, before and behind the second one; None where no pose follows at once."""
    first_end = second = end = _behind_name(cdr, 12)
    if two:
        second = first_end + -first_end % 4
        end = _behind_name(cdr, second)
    pose = end + (4 - end) % 8
    return (first_end, second, end) if len(cdr) == pose + _POSE_SIZE else None


def _behind_name(cdr: Buffer, at: int) -> int:
    return at + 4 + int.from_bytes(cdr[at : at + 4], "little")

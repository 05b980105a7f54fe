"""Express lanes: what the gateway does with the next message of a stream when nothing but its numbers is new.

The general way of a message (`igtl_gateway.gateway.core`) asks many questions whose answers are the same for every
message of a stream: which rows, names, frames, peers.  For poses, which come a thousand times a second, and for
texts, points, clouds and pictures the answers of the last message are kept as a *plan*.  A plan gives exactly the
entries, and the ledger exactly the counts, that the general way would have given, or None: then the message takes the
general way.

What the guard looks at (`igtl_gateway.gateway.guard`), a plan lets it look at, too: where there is anything to be said
of a message it gives no entries, and the general way has the message; the plan stays.

Plans hold until something changes that their answers came from: a peer that comes, goes, shows itself or asks for
streams ends all plans to OpenIGTLink.  What leads to ROS depends on nothing that changes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.buffers import Buffer, join
from igtl_gateway.config import Config
from igtl_gateway.convert import clouds, express, images, poses, rosmsg, surfaces, texts, tracking, volumes
from igtl_gateway.convert.assembly import Form, VolumeAssembler, form_of
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
from igtl_gateway.gateway.reply import Reply
from igtl_gateway.gateway.sender import Outbound, send
from igtl_gateway.gateway.streams import ToIgtlStream, ToRosStream
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.wire import HEADER_SIZE, Message
from igtl_gateway.wire.image import HEAD_SIZE as IMAGE_HEAD
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import EXTENDED_SIZE

#: Plans of each direction; streams beyond that take the general way.
MAX_PLANS = 4_096

#: Where the names of a stream end in the header of its messages: header version, type and device name.
NAMES = slice(0, 34)

#: Plans that a stream may wear out.
MAX_BUILDS = 8

#: Link and names; topic and ROS type.
ToRosKey = tuple[int, bytes]
ToIgtlKey = tuple[str, str]

Heard = Callable[[str, str], bool]
#: What keeps the last image of a device, and what the images of a plan are.
Volume = tuple[VolumeAssembler, Form, np.dtype[Any]]

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
#: A translation in OpenIGTLink, and at the beginning of a pose in CDR.
_PLACE_IGTL, _PLACE_ROS = struct.Struct(">3f"), struct.Struct("<3d")
_POSE_SIZE = 56
_STAMP_AT, _NAMES_AT = 4, 12  # in CDR that begins with a header
_METADATA_SIZE = struct.Struct(">H")  # of the metadata's header
_XYZ, _FLOAT32 = ("x", "y", "z"), 7
_LEAST_PICTURE = 4  # bytes; the least point has as many
#: Where the translation is among the numbers in OpenIGTLink.
_PLACE_AT = {MATRIX: 36, QUATERNION: 0}


class Plans:
    """The plans of a session, by what tells the streams apart.

    A plan that did not fit is given up, and made anew from the next message that took the general way; a stream that
    has worn out ``MAX_BUILDS`` of them keeps to the general way.
    """

    def __init__(self) -> None:
        self.to_ros: dict[ToRosKey, ToRosPlan] = {}
        self.to_igtl: dict[ToIgtlKey, ToIgtlPlan] = {}
        self._builds: dict[ToRosKey | ToIgtlKey, int] = {}

    def wants(self, key: ToRosKey | ToIgtlKey) -> bool:
        """Whether a plan for a stream would be of use."""
        if key in self.to_ros or key in self.to_igtl:
            return False
        builds = self._builds.get(key)
        return builds < MAX_BUILDS if builds is not None else len(self._builds) < MAX_PLANS

    def keep_to_ros(self, key: ToRosKey, plan: ToRosPlan | None) -> None:
        """Use a plan from now on; None: that there can be none."""
        self._keep(self.to_ros, key, plan)

    def keep_to_igtl(self, key: ToIgtlKey, plan: ToIgtlPlan | None) -> None:
        """The same for the other direction."""
        self._keep(self.to_igtl, key, plan)

    def _keep(self, plans: dict[Any, Any], key: ToRosKey | ToIgtlKey, plan: ToRosPlan | ToIgtlPlan | None) -> None:
        self._builds[key] = self._builds.get(key, 0) + 1 if plan else MAX_BUILDS
        if plan:
            plans[key] = plan

    def peers_changed(self) -> None:
        """Somebody came, went, showed what it is, or asked for something."""
        self.to_ros.clear()
        self.to_igtl.clear()
        self._builds.clear()


class ToRosPlan:
    """A message of one device, from one link: fill the CDR templates of its topics.

    Args:
        fill: ``pose_to_ros`` or ``bulk_to_ros``, with the ``sample`` and ``places`` (``at``, ``size``) that it takes.
        entry: of the message that the plan is made from.
        forms: topic, ROS type and form of each output.
        place_at: where the translation is in the message, of a pose.
        unmade: what is to be made of latched topics once somebody listens; the topics of ``forms`` that are such.
        volume: of pictures, which later ones may be parts of.
    """

    def __init__(
        self,
        fill: Fill,
        sample: bytes,
        places: tuple[int, int],
        entry: Entry,
        forms: Sequence[tuple[str, str, tuple[Any, ...]]],
        ratio: tuple[float, float],
        check_crc: bool,
        own: bool,
        ledger: Ledger,
        watched: Watched | None,
        place_at: int | None,
        unmade: tuple[dict[str, Any], frozenset[str]],
        volume: Volume | None = None,
    ) -> None:
        self._fill = fill
        self._sample = sample
        self._places = places
        self._watched = watched
        self._place, self._place_at = _PLACE_IGTL if place_at else None, place_at or 0
        self._channel, self._type = entry.channel, entry.type
        self._forms = tuple(form for _, _, form in forms)
        self._told = tuple((topic, ros_type, form, ledger.counter("ros_out", topic)) for topic, ros_type, form in forms)
        self._ratio = ratio
        self._check_crc = check_crc
        self._own = own
        self._count = ledger.counter("igtl_in", entry.channel)
        self._unmade, self._latched = unmade
        self._volume = volume

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], links: tuple[int, ...], heard: Heard | None
    ) -> list[Entry] | None:
        told, forms = self._told, self._forms
        if heard is not None:
            told = tuple(one for one in told if heard(one[0], one[1]))
            forms = tuple(form for _, _, form, _ in told)
            if self._latched and not self._latched <= {topic for topic, _, _, _ in told}:
                return []  # the last message is kept for the first who listens
            if not forms and self._place is None:
                return []  # bulk is looked at as it is made: the general way knows whether it is well
        at, size = self._places
        volume = self._volume
        if volume and not volume[0].takes(volume[1]):
            return []
        made = self._fill(payload[0], self._sample, at, size, self._check_crc, self._own, stamp_ns, self._ratio, forms)
        if made is None:
            return None
        source_ns, told_ns = made[0], made[1]
        watched = self._watched
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], self._place, self._place_at):
            return []
        entries = [Entry(seq, stamp_ns, Kind.IGTL_IN, self._channel, self._type, payload, links, source_ns)]
        step = 0
        for (topic, ros_type, _, published), cdr in zip(told, made[2:], strict=True):
            if cdr is None:
                continue
            step += 1
            published["published"] = published.get("published", 0) + 1
            entries.append(Entry(seq + step, stamp_ns + step, Kind.ROS_OUT, topic, ros_type, (cdr,), (), told_ns))
        for topic in self._latched:
            self._unmade.pop(topic, None)
        if volume:
            assembler, form, dtype = volume
            assembler.keep(form, dtype, memoryview(payload[0])[at : len(payload[0]) - size])
        count = self._count
        count["received"] = count.get("received", 0) + 1
        count["decoded"] = count.get("decoded", 0) + 1
        fate = "converted" if step or heard is None else "unheard"
        count[fate] = count.get(fate, 0) + 1
        return entries


class ToIgtlPlan:
    """A message of one topic, to the peers that are there: fill the templates of its messages.

    Args:
        fill: ``pose_to_igtl`` or ``bulk_to_igtl``, with the ``sample``, ``names`` and ``size`` that it takes.
        told: a reply and its form for each kind of peers.
        latest: the last message of each topic.
        place_at: where the translation is in the message, of a pose.
    """

    def __init__(
        self,
        fill: Fill,
        sample: bytes,
        names: tuple[int, ...],
        size: int,
        told: Sequence[tuple[Reply, tuple[Any, ...]]],
        peers: Sequence[Peer],
        ratio: tuple[float, float],
        own: bool,
        ledger: Ledger,
        channel: str,
        latest: dict[str, Entry],
        watched: Watched | None,
        place_at: int | None,
    ) -> None:
        self._fill = fill
        self._sample = sample
        self._names = names
        self._size = size
        self._told = tuple((reply, len(reply.links), ledger.counter("igtl_out", reply.channel)) for reply, _ in told)
        self._forms = tuple(form for _, form in told)
        self._peers = tuple(peers)
        self._ratio = ratio
        self._own = own
        self._count = ledger.counter("ros_in", channel)
        self._latest = latest
        self._watched = watched
        self._place, self._place_at = _PLACE_ROS if place_at else None, place_at or 0

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], channel: str, ros_type: str, source_ns: int
    ) -> list[Entry] | None:
        made = self._fill(
            payload[0],
            self._sample,
            self._names,
            self._size,
            self._own,
            source_ns,
            stamp_ns,
            self._ratio,
            self._forms,
        )
        if made is None:
            return None
        told_ns = made[0]
        watched = self._watched
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], self._place, self._place_at):
            return []
        count = self._count
        count["received"] = count.get("received", 0) + 1
        count["converted"] = count.get("converted", 0) + 1
        for peer in self._peers:
            peer.said_ns = stamp_ns
            peer.sent += 1
        entry = self._latest[channel] = Entry(seq, stamp_ns, Kind.ROS_IN, channel, ros_type, payload, (), source_ns)
        entries = [entry]
        step = 0
        for reply, links, sent in self._told:
            step += 1
            sent["sent"] = sent.get("sent", 0) + links
            entries.append(
                Entry(
                    seq + step,
                    stamp_ns + step,
                    Kind.IGTL_OUT,
                    reply.channel,
                    reply.type,
                    (made[step],),
                    reply.links,
                    told_ns,
                )
            )
        return entries


def plan_to_ros(
    entry: Entry,
    message: Message,
    stream: ToRosStream,
    to: ToRos,
    config: Config,
    ledger: Ledger,
    watched: Watched | None = None,
    qos: Callable[[str], Qos | None] = lambda _topic: None,
    unmade: dict[str, Any] | None = None,
    assembler: VolumeAssembler | None = None,
) -> ToRosPlan | None:
    """The plan that follows from a message that was converted without a word; None where there can be none."""
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
    own = config.stamp_of(stream.row) == "source"
    if stream.row.max_age_s and not own:  # judged by a stamp that is not told
        return None
    fill: Fill | None = express.pose_to_ros if size else express.bulk_to_ros
    if fill is None:
        return None
    sample, places, place_at = bytes(data), (at, size), at + _PLACE_AT.get(size, 0) if size else None
    if not size:
        sample, places = bytes(data[:at]) + bytes(data[len(data) - tail :]), (at, tail)
    latched = frozenset(topic for topic, _, _ in forms if (known := qos(topic)) and known.latched)
    return ToRosPlan(
        fill,
        sample,
        places,
        entry,
        forms,
        to.lengths.ratio_to_ros,
        config.check_crc,
        own,
        ledger,
        watched,
        place_at,
        ({} if unmade is None else unmade, latched),
        volume,
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


def plan_to_igtl(
    entry: Entry,
    stream: ToIgtlStream,
    out: Outbound,
    peers: Sequence[Peer],
    config: Config,
    ledger: Ledger,
    latest: dict[str, Entry],
    watched: Watched | None = None,
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
    own = config.stamp_of(stream.row) == "source"
    if stream.row.max_age_s and not own:
        return None
    sample = bytes(cdr) if size else bytes(cdr[: names[1] if names else 4])
    place_at = len(sample) - _POSE_SIZE if size else None
    what = size or form or 0
    ratio = stream.lengths.ratio_to_igtl
    return ToIgtlPlan(
        fill, sample, names, what, told, peers, ratio, own, ledger, entry.channel, latest, watched, place_at
    )


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

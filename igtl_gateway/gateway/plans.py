"""Express lanes: what the gateway does with the next message of a stream when nothing but its numbers is new.

The general way of a message (`igtl_gateway.gateway.core`) asks many questions whose answers are the same for every
message of a stream: which rows, names, frames, peers.  For poses, which come a thousand times a second, the
answers of the last message are kept as a *plan*.  A plan gives exactly the entries, and the ledger exactly the
counts, that the general way would have given, or None: then the message takes the general way.

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

from igtl_gateway.buffers import Buffer, join
from igtl_gateway.config import Config
from igtl_gateway.convert import poses, tracking
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.context import ToRos
from igtl_gateway.convert.express import MATRIX, QUATERNION, pose_to_igtl, pose_to_ros
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.guard import Watched
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.reply import Reply
from igtl_gateway.gateway.sender import Outbound, send
from igtl_gateway.gateway.streams import ToIgtlStream, ToRosStream
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.wire import HEADER_SIZE, Message
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
Counter = dict[str, int]

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
POSES = {"TRANSFORM": MATRIX, "POSITION": QUATERNION, "QTRANS": QUATERNION}
POSE_TOPICS = frozenset({TransformStamped.TYPE, PoseStamped.TYPE})
_LITTLE_ENDIAN = b"\x00\x01"
#: A translation in OpenIGTLink, and at the beginning of a pose in CDR.
_PLACE_IGTL, _PLACE_ROS = struct.Struct(">3f"), struct.Struct("<3d")
_POSE_SIZE = 56
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
    """A pose of one device, from one link: fill the CDR templates of its topics."""

    def __init__(
        self,
        sample: bytes,
        numbers: tuple[int, int],
        entry: Entry,
        forms: Sequence[tuple[str, str, tuple[bytes, int]]],
        ratio: tuple[float, float],
        check_crc: bool,
        own: bool,
        ledger: Ledger,
        watched: Watched | None,
    ) -> None:
        self._sample = sample
        self._numbers = numbers
        self._watched, self._place_at = watched, numbers[0] + _PLACE_AT[numbers[1]]
        self._channel, self._type = entry.channel, entry.type
        self._forms = tuple(form for _, _, form in forms)
        self._told = tuple((topic, ros_type, form, ledger.counter("ros_out", topic)) for topic, ros_type, form in forms)
        self._ratio = ratio
        self._check_crc = check_crc
        self._own = own
        self._count = ledger.counter("igtl_in", entry.channel)

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], links: tuple[int, ...], heard: Heard | None
    ) -> list[Entry] | None:
        told, forms = self._told, self._forms
        if heard is not None:
            told = tuple(one for one in told if heard(one[0], one[1]))
            forms = tuple(form for _, _, form, _ in told)
        at, size = self._numbers
        made = pose_to_ros(payload[0], self._sample, at, size, self._check_crc, self._own, stamp_ns, self._ratio, forms)
        if made is None:
            return None
        source_ns, told_ns = made[0], made[1]
        watched = self._watched
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], _PLACE_IGTL, self._place_at):
            return []
        count = self._count
        count["received"] = count.get("received", 0) + 1
        count["decoded"] = count.get("decoded", 0) + 1
        fate = "converted" if told or heard is None else "unheard"
        count[fate] = count.get(fate, 0) + 1
        entries = [Entry(seq, stamp_ns, Kind.IGTL_IN, self._channel, self._type, payload, links, source_ns)]
        step = 0
        for topic, ros_type, _, published in told:
            step += 1
            published["published"] = published.get("published", 0) + 1
            entries.append(
                Entry(seq + step, stamp_ns + step, Kind.ROS_OUT, topic, ros_type, (made[1 + step],), (), told_ns)
            )
        return entries


class ToIgtlPlan:
    """A pose of one topic, to the peers that are there: fill the templates of its messages."""

    def __init__(
        self,
        sample: bytes,
        names: tuple[int, int, int],
        size: int,
        told: Sequence[tuple[Reply, tuple[bytes, int, int]]],
        peers: Sequence[Peer],
        ratio: tuple[float, float],
        own: bool,
        ledger: Ledger,
        channel: str,
        latest: dict[str, Entry],
        watched: Watched | None,
    ) -> None:
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
        self._watched, self._place_at = watched, len(sample) - _POSE_SIZE

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], channel: str, ros_type: str, source_ns: int
    ) -> list[Entry] | None:
        made = pose_to_igtl(
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
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], _PLACE_ROS, self._place_at):
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
) -> ToRosPlan | None:
    """The plan that follows from a message that was converted without a word; None where there can be none."""
    data, size = entry.payload[0], POSES.get(entry.type, 0)
    at = HEADER_SIZE + (EXTENDED_SIZE if message.header_version > 1 else 0)
    # behind the numbers: nothing, or the count of no metadata
    plain = size and not message.metadata and message.layout is None and len(data) - at - size in (0, 2)
    if not plain or not isinstance(data, bytes):
        return None
    forms: list[tuple[str, str, tuple[bytes, int]]] = []
    for row, topic in stream.outputs:
        stamp_at = _TO_ROS.get(row.convert)
        if stamp_at is None or not isinstance(message.content, row.content) or not row.applies(message.content):
            return None
        made: Any = row.convert(message.content, to)
        forms.append((topic, made.TYPE, (made.pack(), stamp_at)))
    if to.warnings:
        return None
    own = config.stamp_of(stream.row) == "source"
    if stream.row.max_age_s and not own:  # judged by a stamp that is not told
        return None
    return ToRosPlan(data, (at, size), entry, forms, to.lengths.ratio_to_ros, config.check_crc, own, ledger, watched)


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
    if not size or not isinstance(cdr, bytes) or cdr[:2] != _LITTLE_ENDIAN:
        return None
    if any(peer.wishes or type(out.content) in peer.profile.adapt for peer in peers):
        return None
    names = _names_of(cdr, two=entry.type == TransformStamped.TYPE)
    if names is None:
        return None
    first, second = (
        send(replace(out, ros_stamp_ns=stamp_ns if out.ros_stamp_ns else 0), peers, entry.stamp_ns)
        for stamp_ns in _TWO_STAMPS
    )
    if first.refused or first.warnings or not first.replies:
        return None
    told = []
    for one, other in zip(first.replies, second.replies, strict=True):
        version_1 = one.payload[0][1] == 1
        template = join(one.payload)
        at = HEADER_SIZE + (0 if version_1 else EXTENDED_SIZE)
        told.append((one, (template, at, 0 if version_1 else _difference(template, join(other.payload)))))
    own = config.stamp_of(stream.row) == "source"
    if stream.row.max_age_s and not own:
        return None
    ratio = stream.lengths.ratio_to_igtl
    return ToIgtlPlan(cdr, names, size, told, peers, ratio, own, ledger, entry.channel, latest, watched)


#: Stamps of 19 digits, no two the same at the same place: they show where in a message the stamp is.
_TWO_STAMPS = (1_111_111_111_111_111_111, 2_222_222_222_222_222_222)


def _difference(one: bytes, other: bytes) -> int:
    """Where two bodies begin to differ; −1 where they do not."""
    pairs = zip(one[HEADER_SIZE:], other[HEADER_SIZE:], strict=True)
    return next((HEADER_SIZE + index for index, (left, right) in enumerate(pairs) if left != right), -1)


def _names_of(cdr: bytes, *, two: bool) -> tuple[int, int, int] | None:
    """Offsets behind the first name, before and behind the second one; None where no pose follows at once."""
    first_end = second = end = _behind_name(cdr, 12)
    if two:
        second = first_end + -first_end % 4
        end = _behind_name(cdr, second)
    pose = end + (4 - end) % 8
    return (first_end, second, end) if len(cdr) == pose + _POSE_SIZE else None


def _behind_name(cdr: bytes, at: int) -> int:
    return at + 4 + int.from_bytes(cdr[at : at + 4], "little")

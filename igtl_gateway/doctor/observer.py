"""What was seen of a session: entry after entry is counted and measured, and nothing is judged.

The rules read the observer's attributes.  Memory is bounded by the numbers of links and streams, which are limited.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from igtl_gateway.config import Config
from igtl_gateway.convert.units import UNITS, ieee_754
from igtl_gateway.doctor.content import NOTHING, ContentMeasures, measure_content
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.protocols import is_openigtlink
from igtl_gateway.errors import ChecksumMismatch, WireError
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, metadata
from igtl_gateway.session.clocksteps import ClockStep, without_jump
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note
from igtl_gateway.session.timing import StampTiming
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import HEADER_SIZE, Header, Message, decode
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_VERSIONS
from igtl_gateway.wire.message import ExtendedHeader
from igtl_gateway.wire.registry import BODIES, read_content

#: Streams, links and topics looked at one by one: sessions have dozens; a peer that invents names must not cost memory.
MAX_STREAMS = 2_000
#: Values that are kept of one stream, such as names of its elements.
MAX_KEPT = 100
#: A rotation is one if the products of its directions are within this of 0 and 1: float32 and a tracker's noise.
ORTHONORMAL = 0.02
_IDENTITY = np.eye(3)

Role = Literal["server", "client"]


@dataclass(frozen=True, slots=True)
class ExpectedLinks:
    """What was to happen on the OpenIGTLink side, where somebody waits for it.

    Attributes:
        role: our own.
        place: the address that we listen at or connect to.
    """

    role: Role
    place: str


@dataclass(slots=True)
class LengthStats:
    """Lengths in the messages of one stream, in millimetres if the stream's unit is what the configuration says.

    Attributes:
        messages: those that hold any.
        positions: of how many places.
        poses: they are poses.
        largest: greatest distance from the origin.
        moved: not all are the same.
        smallest_spacing: of images; 0 = one has none, None = there was no image.
    """

    messages: int = 0
    positions: int = 0
    poses: bool = True
    largest: float = 0.0
    moved: bool = False
    smallest_spacing: float | None = None
    _first: Any = None

    def add(self, measured: ContentMeasures, millimetres: float) -> None:
        """Look at the lengths of a message, which are finite; so many millimetres are their unit."""
        if measured.spacing:
            spacing = min(measured.spacing) * millimetres
            self.smallest_spacing = min(spacing, self.smallest_spacing or spacing)
        positions = measured.positions
        if not len(positions):
            return
        self.messages += 1
        self.positions += len(positions)
        self.poses = measured.pose
        self.largest = max(self.largest, float(np.linalg.norm(positions, axis=1).max()) * millimetres)
        if self._first is None:
            self._first = positions[0].copy()
        self.moved = self.moved or bool((positions != self._first).any())


@dataclass(slots=True)
class ObservedStream:
    """What came from one peer under one type and name.

    Attributes:
        link, type, device: which; names as people read them.
        raw_type, raw_device: as they are on the wire.
        messages, bytes: whole messages.
        first_ns, last_ns, longest_pause_ns: when, UTC ns, and the longest pause between two.
        good: messages that could be decoded, with their checksum right.
        bad_crc, no_crc: checksums that are wrong, and those of them that are 0, of a body that has another.
        versions: header versions.
        misfits: messages whose body is that of the other header version.
        malformed: other messages that cannot be decoded; ``error`` is the first reason.
        unknown: its type has no codec here.
        millimetres: its unit of length, by the configuration.
        full_names: names in the metadata of those whose name in the header was cut.
        element_names: names inside the body that fill their field.
        not_finite, not_orthonormal, mirrored: poses with NaN or infinity, and those whose rotation is none.
        timing, lengths: see there.
    """

    link: int
    type: str
    device: str
    raw_type: str
    raw_device: str
    messages: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_pause_ns: int = 0
    good: int = 0
    bad_crc: int = 0
    no_crc: int = 0
    versions: Counter[int] = field(default_factory=Counter)
    misfits: int = 0
    malformed: int = 0
    error: str = ""
    unknown: bool = False
    millimetres: float = 1.0
    full_names: set[str] = field(default_factory=set)
    element_names: set[str] = field(default_factory=set)
    not_finite: int = 0
    not_orthonormal: int = 0
    mirrored: int = 0
    timing: StampTiming = field(default_factory=StampTiming)
    lengths: LengthStats = field(default_factory=LengthStats)

    @property
    def name(self) -> str:
        """``TYPE/device``."""
        return f"{self.type}/{self.device}"

    @property
    def rate_hz(self) -> float:
        """Mean rate between the first and the last message; 0 where that says nothing."""
        span_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0


@dataclass(slots=True)
class ObservedPeer:
    """One connection.

    Attributes:
        number: of the link.
        address: the peer's.
        role: ours: ``"server"``: it connected to us.
        up_ns, down_ns: UTC ns; 0 = not seen.
        reason: why it ended.
        messages: that came from it.
        received_bytes: that came from it, as far as told: at its end.
        heard: messages that came, by header version.
        told: UTC ns of the first message that it was sent in each header version.
        sent: messages that it was sent.
        head: the first bytes of something that is no whole message.
        head_why: code of the note that told of them.
    """

    number: int
    address: str = ""
    role: str = ""
    up_ns: int = 0
    down_ns: int = 0
    reason: str = ""
    messages: int = 0
    received_bytes: int = 0
    received_versions: Counter[int] = field(default_factory=Counter)
    first_sent_ns: dict[int, int] = field(default_factory=dict)
    sent: int = 0
    head: bytes = b""
    head_why: str = ""

    @property
    def name(self) -> str:
        """For people."""
        return self.address or f"link {self.number}"


@dataclass(slots=True)
class NoteCount:
    """Notes of one code: how many, and the first."""

    count: int
    first: Note


class Observer:
    """See the module.

    Attributes:
        config: what the gateway does with the messages.
        intent: None for a recording.
        ended_ns: UTC ns of the last entry.
        peers: by number of the link.
        streams: what came in over OpenIGTLink, in order of appearance; ``crowded``: there were more.
        published: ROS topic → type of what the gateway made of it.
        ros_topics: ROS topic → type of what came from ROS.
        said: what edges and gateway noted, by code; links that come and go are in ``peers``.
        graph: publishers and subscriptions in ROS that concern the gateway; None where nobody looked.
        damage: what is wrong with the recording itself.
        losses: messages that were lost, by the ledger of the recording: words → number.
    """

    def __init__(self, config: Config, intent: ExpectedLinks | None = None) -> None:
        self.config = config
        self.intent = intent
        self.ended_ns = 0
        self.peers: dict[int, ObservedPeer] = {}
        self.streams: dict[tuple[int, str, str], ObservedStream] = {}
        self.crowded = False
        self.published: dict[str, str] = {}
        self.ros_topics: dict[str, str] = {}
        self.noted: dict[str, NoteCount] = {}
        self.graph: Graph | None = None
        self.damage = ""
        self.losses: dict[str, int] = {}
        self._ahead_ns = 0  # of gateway time to the host's clock

    def add(self, entry: Entry) -> None:
        """Look at the next entry."""
        self.ended_ns = entry.stamp_ns
        match entry.kind:
            case Kind.IGTL_IN:
                self._received(entry)
            case Kind.IGTL_OUT:
                self._sent(entry)
            case Kind.LINK:
                self._link(entry)
            case Kind.ROS_OUT:
                _keep(self.published, entry)
            case Kind.ROS_IN:
                _keep(self.ros_topics, entry)
            case _:
                self._noted(entry)

    @property
    def good(self) -> int:
        """Messages that arrived and could be read."""
        return sum(stream.good for stream in self.streams.values())

    def peer(self, number: int) -> ObservedPeer:
        """The peer of a link; one that was never announced has no address."""
        peer = self.peers.get(number)
        if peer is None:
            peer = ObservedPeer(number)
            if len(self.peers) < MAX_STREAMS:
                self.peers[number] = peer
            else:
                self.crowded = True
        return peer

    # ── links and notes ───────────────────────────────────────────────────────────────────────────────────────────

    def _link(self, entry: Entry) -> None:
        note = Note.of(entry.data())
        for number in entry.links:
            peer = self.peer(number)
            peer.address = str(note.data.get("peer", "")) or peer.address
            peer.role = str(note.data.get("role", "")) or peer.role
            if note.code == LINK_UP:
                peer.up_ns = entry.stamp_ns
            elif note.code == LINK_DOWN:
                peer.down_ns = entry.stamp_ns
                peer.reason = str(note.data.get("reason", ""))
                peer.received_bytes = int(note.data.get("received_bytes", 0))

    def _noted(self, entry: Entry) -> None:
        note = Note.of(entry.data())
        noted = self.noted.setdefault(note.code, NoteCount(0, note))
        noted.count += 1
        if step := ClockStep.of(entry):
            self._ahead_ns = step.ahead_ns
            for stream in self.streams.values():
                without_jump(stream, step)
                stream.timing.reset()
        if head := note.data.get("head"):
            for number in entry.links:
                peer = self.peer(number)
                if not peer.head:
                    peer.head, peer.head_why = bytes.fromhex(head), note.code

    # ── messages ──────────────────────────────────────────────────────────────────────────────────────────────────

    def _sent(self, entry: Entry) -> None:
        version = Header.unpack(entry.data()[:HEADER_SIZE]).version
        for number in entry.links:
            peer = self.peer(number)
            peer.sent += 1
            peer.first_sent_ns.setdefault(version, entry.stamp_ns)

    def _received(self, entry: Entry) -> None:
        data = entry.data()
        header = Header.unpack(data)
        number = entry.links[0] if entry.links else 0
        peer = self.peer(number)
        if not is_openigtlink(data[:HEADER_SIZE]):
            # bytes of something else, whose length happened to look like one
            peer.head = peer.head or data[:HEADER_SIZE]
            return
        peer.messages += 1
        peer.received_versions[header.version] += 1
        stream = self._stream(number, header)
        if stream is None:
            return
        if stream.messages:
            stream.longest_pause_ns = max(stream.longest_pause_ns, entry.stamp_ns - stream.last_ns)
        else:
            stream.first_ns = entry.stamp_ns
        stream.last_ns = entry.stamp_ns
        stream.messages += 1
        stream.bytes += len(data)
        stream.versions[header.version] += 1
        stream.timing.add(entry.source_ns, entry.stamp_ns - self._ahead_ns)
        if header.version in HEADER_VERSIONS:
            message = _decoded(stream, header, data)
            if message is not None:
                self._measure(stream, message)

    def _stream(self, number: int, header: Header) -> ObservedStream | None:
        key = (number, header.type, header.device_name)
        stream = self.streams.get(key)
        if stream is None:
            if len(self.streams) >= MAX_STREAMS:
                self.crowded = True
                return None
            kind, device = visible(header.type), visible(header.device_name)
            stream = self.streams[key] = ObservedStream(number, kind, device, header.type, header.device_name)
            stream.unknown = kind not in BODIES
            unit = self.config.lengths(self.config.row_to_ros(kind, device)).igtl
            stream.millimetres = UNITS[unit] / UNITS["mm"]
        return stream

    @ieee_754
    def _measure(self, stream: ObservedStream, message: Message) -> None:
        for item in message.metadata:
            if item.key == metadata.FULL_NAME and len(stream.full_names) < MAX_KEPT:
                stream.full_names.add(item.text)
        measured = measure_content(message.content)
        if measured is NOTHING:
            return
        if len(stream.element_names) < MAX_KEPT:
            stream.element_names.update(measured.full_names)
        if not measured.is_finite:
            stream.not_finite += 1
            return
        stream.lengths.add(measured, stream.millimetres)
        if len(measured.rotations):
            products = measured.rotations.transpose(0, 2, 1) @ measured.rotations
            if float(np.abs(products - _IDENTITY).max()) > ORTHONORMAL:
                stream.not_orthonormal += 1
            elif float(np.linalg.det(measured.rotations).min()) < 0:
                stream.mirrored += 1
        if len(measured.quaternions):
            lengths = np.linalg.norm(measured.quaternions, axis=1)
            stream.not_orthonormal += bool((np.abs(lengths - 1) > ORTHONORMAL).any())


def _keep(topics: dict[str, str], entry: Entry) -> None:
    if len(topics) < MAX_STREAMS:
        topics.setdefault(entry.channel, entry.type)


def _decoded(stream: ObservedStream, header: Header, data: bytes) -> Message | None:
    """The message, be its checksum right or wrong; None if it cannot be read.  What is wrong is counted."""
    try:
        message = decode(data)
        stream.good += 1
        return message
    except ChecksumMismatch:
        stream.bad_crc += 1
        stream.no_crc += header.crc == 0
        try:
            return decode(data, check_crc=False)
        except WireError:
            return None  # what is damaged need not be readable
    except WireError as error:
        if _fits_other_version(header, memoryview(data)[HEADER_SIZE:]):
            stream.misfits += 1
        else:
            stream.malformed += 1
            stream.error = stream.error or str(error)
        return None


def _fits_other_version(header: Header, body: memoryview) -> bool:
    """Whether the body is that of header version 1 under version 2, or the other way round."""
    try:
        content = body if header.version != 1 else ExtendedHeader.unpack(body).split(body)[0]
        read_content(header.type, content)
    except WireError:
        return False
    return visible(header.type) in BODIES

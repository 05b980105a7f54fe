"""The observer of a session: counts and measures each entry.  The rules check its attributes.

Memory is bounded: the numbers of links, streams and names are limited.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from igtl_gateway.base.errors import ChecksumMismatch, WireError
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.units import ieee_754, scale
from igtl_gateway.doctor.content import NOTHING, measure_content
from igtl_gateway.doctor.denormals import LEAST_FLOAT32, denormal_in_ros, denormal_of
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.observations import NoteCount, ObservedPeer, ObservedStream, ObservedTopic
from igtl_gateway.doctor.protocols import is_openigtlink
from igtl_gateway.doctor.sources import TF_TOPICS, ObservedSources
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, metadata
from igtl_gateway.gateway.dialogue.probing import PROBE_DEVICE, is_of_replay, is_reply
from igtl_gateway.gateway.log.clocksteps import ClockStep, without_jump
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import HEADER_SIZE, Header, Message, decode
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_VERSIONS
from igtl_gateway.wire.message import ExtendedHeader
from igtl_gateway.wire.registry import BODIES, read_content

#: Maximum number of streams, links and topics: sessions have dozens, but a peer can send a new name each time.
MAX_STREAMS = 2_000
#: Maximum number of reasons of refusals, and of servers.
MAX_SUBJECTS = 50
#: Maximum number of names that are kept of one stream.
MAX_KEPT = 100
#: Number of messages of a topic of ROS whose numbers are looked at: a sender's type error is in all of them.
MAX_LOOKED_AT = 1_000
#: Tolerance for an orthonormal rotation matrix: float32 and the noise of a tracker.
ORTHONORMAL = 0.02
_IDENTITY = np.eye(3)

Role = Literal["server", "client"]


@dataclass(frozen=True, slots=True)
class ExpectedLinks:
    """The link that ``doctor`` waits for.

    Attributes:
        role: of this program.
        place: the address that it listens on or connects to.
    """

    role: Role
    place: str


class Observer:
    """Counts and measures the entries of a session.

    Attributes:
        config: the configuration of the gateway.
        expected: the link that is expected; None for a recording.
        ended_ns: gateway time of the last entry, UTC.
        peers: by number of the link.
        streams: the OpenIGTLink streams from peers, in order of appearance.
        topics: the topics from ROS, in order of appearance.
        too_many_streams: whether there are more streams or links than are observed.
        published: ROS topic → type that the gateway publishes.
        notes: notes of edges and gateway, by code; begin and end of links are in ``peers``.
        subjects: those of refused connections, by reason, and of servers that were not there: each has its own remedy.
        sources: what of the configuration is there.
        graph: publishers and subscriptions in ROS that concern the gateway; None if not observed.
        damage: damage of the recording itself; "" without damage.
        growing: that another program still writes the recording; "" if none does.
        damaged_indexes: number of chunks of the recording whose index of messages is damaged.
        losses: reason → number of lost messages, by the ledger of the recording.
        lags: (stream, the one that it is behind, lag in s) of streams with the same movement.
    """

    def __init__(self, config: Config, expected: ExpectedLinks | None = None) -> None:
        self.config = config
        self.expected = expected
        self.ended_ns = 0
        self.peers: dict[int, ObservedPeer] = {}
        self.streams: dict[tuple[int, str, str], ObservedStream] = {}
        self.topics: dict[str, ObservedTopic] = {}
        self.too_many_streams = False
        self.published: dict[str, str] = {}
        self.notes: dict[str, NoteCount] = {}
        self.subjects: dict[str, dict[str, NoteCount]] = {"refused": {}, "connect_failed": {}}
        self.sources = ObservedSources(config)
        self.graph: Graph | None = None
        self.damage = ""
        self.growing = ""
        self.damaged_indexes = 0
        self.losses: dict[str, int] = {}
        self.lags: list[tuple[str, str, float]] = []
        self._ahead_ns = 0  # gateway time less the host's clock

    def add(self, entry: Entry) -> None:
        """Observe the next entry."""
        self.ended_ns = entry.stamp_ns
        match entry.kind:
            case Kind.IGTL_IN:
                self._received(entry)
            case Kind.IGTL_OUT:
                self._sent(entry)
            case Kind.LINK:
                self._link(entry)
            case Kind.ROS_OUT:
                if len(self.published) < MAX_STREAMS:
                    self.published.setdefault(entry.channel, entry.type)
            case Kind.ROS_IN:
                self._from_ros(entry)
            case _:
                self._noted(entry)

    @property
    def good(self) -> int:
        """Number of messages from peers that were decoded."""
        return sum(stream.good for stream in self.streams.values())

    def peer(self, number: int) -> ObservedPeer:
        """Return the peer of a link, which has no address if the session has no entry for the link."""
        peer = self.peers.get(number)
        if peer is None:
            peer = ObservedPeer(number)
            if len(self.peers) < MAX_STREAMS:
                self.peers[number] = peer
            else:
                self.too_many_streams = True
        return peer

    # ── links and notes ───────────────────────────────────────────────────────────────────────────────────────────

    def _link(self, entry: Entry) -> None:
        note = Note.of(entry.data())
        for number in entry.links:
            peer = self.peer(number)
            peer.address = str(note.data.get("peer", "")) or peer.address
            peer.local = str(note.data.get("local", "")) or peer.local
            peer.asked = str(note.data.get("asked", "")) or peer.asked
            peer.role = str(note.data.get("role", "")) or peer.role
            if note.code == LINK_UP:
                peer.up_ns = entry.stamp_ns
            elif note.code == LINK_DOWN:
                peer.down_ns = entry.stamp_ns
                peer.reason = str(note.data.get("reason", ""))
                peer.received_bytes = int(note.data.get("received_bytes", 0))

    def _noted(self, entry: Entry) -> None:
        note = Note.of(entry.data())
        self.notes.setdefault(note.code, NoteCount(0, note)).count += 1
        if (found := self.subjects.get(note.code)) is not None and (note.subject in found or len(found) < MAX_SUBJECTS):
            found.setdefault(note.subject, NoteCount(0, note)).count += 1
        self.sources.noted(note)
        if step := ClockStep.of(entry):
            self._ahead_ns = step.ahead_ns
            for stream in self.streams.values():
                without_jump(stream, step)
                stream.timing.reset()
                stream.fractions.reset()
        if head := note.data.get("head"):
            for number in entry.links:
                peer = self.peer(number)
                if not peer.head:
                    peer.head, peer.head_code, peer.head_text = bytes.fromhex(head), note.code, note.text

    # ── messages ──────────────────────────────────────────────────────────────────────────────────────────────────

    def _sent(self, entry: Entry) -> None:
        version = Header.unpack(entry.data()[:HEADER_SIZE]).version
        for number in entry.links:
            self.peer(number).first_sent_ns.setdefault(version, entry.stamp_ns)

    def _received(self, entry: Entry) -> None:
        data = entry.data()
        header = Header.unpack(data)
        number = entry.links[0] if entry.links else 0
        peer = self.peer(number)
        if not is_openigtlink(data[:HEADER_SIZE]):
            # bytes of another protocol, which contain a plausible body size by chance
            peer.head = peer.head or data[:HEADER_SIZE]
            return
        peer.messages += 1
        peer.received_versions[header.version] += 1
        if header.version != peer.version:
            rises = header.version > peer.version
            peer.follows &= not peer.version or (rises and header.version in peer.first_sent_ns)
            peer.version = header.version
        if header.device_name == PROBE_DEVICE and header.type == "STATUS":
            return  # of a `doctor` that examines this session: no part of its traffic
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
        stream.fractions.add(header.ticks, entry.stamp_ns - self._ahead_ns)
        message = _decoded(stream, header, data, self.config.reading)
        if message is not None:
            stream.milliseconds += entry.source_ns != ticks_to_ns(header.ticks)
            peer.is_gateway |= is_reply(message)
            peer.is_replay |= is_of_replay(message)
            self._measure(stream, message)

    def _from_ros(self, entry: Entry) -> None:
        topic = self.topics.get(entry.channel)
        if topic is None:
            if len(self.topics) >= MAX_STREAMS:
                return
            topic = self.topics[entry.channel] = ObservedTopic(entry.type)
        topic.messages += 1
        if entry.channel in TF_TOPICS:
            self.sources.transforms(entry.channel, entry.data())
        if topic.messages > MAX_LOOKED_AT or not entry.payload:
            return
        if found := denormal_in_ros(entry.type, entry.data()):
            topic.denormal += 1
            if not topic.field:
                topic.field, topic.value = found

    def _stream(self, number: int, header: Header) -> ObservedStream | None:
        key = (number, header.type, header.device_name)
        stream = self.streams.get(key)
        if stream is None:
            if len(self.streams) >= MAX_STREAMS:
                self.too_many_streams = True
                return None
            kind, device = visible(header.type), visible(header.device_name)
            stream = self.streams[key] = ObservedStream(number, kind, device, header.type, header.device_name)
            stream.unknown = kind not in BODIES
            unit = self.config.lengths(self.config.row_to_ros(kind, device)).igtl
            stream.millimetres = scale(unit, "mm")
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
                stream.by_rows += measured.has_rotations_by_rows
            elif float(np.linalg.det(measured.rotations).min()) < 0:
                stream.mirrored += 1
        if len(measured.quaternions):
            lengths = np.linalg.norm(measured.quaternions, axis=1)
            stream.not_unit += bool((np.abs(lengths - 1) > ORTHONORMAL).any())
            stream.shortest = min(stream.shortest, float(lengths.min()))
            stream.longest = max(stream.longest, float(lengths.max()))
        for numbers in (measured.positions, measured.rotations, measured.quaternions):
            if found := denormal_of(numbers, LEAST_FLOAT32):
                stream.denormal += 1
                stream.denormal_value = stream.denormal_value or found
                break


def _decoded(stream: ObservedStream, header: Header, data: bytes, reading: int) -> Message | None:
    """Return the message, with a right or a wrong CRC; None if it cannot be decoded.  Defects are counted."""
    try:
        message = decode(data, reading=reading)
        stream.good += 1
        if message.deviation:
            stream.deviations[message.deviation] += 1
        return message
    except ChecksumMismatch:
        stream.bad_crc += 1
        stream.no_crc += header.crc == 0
        try:
            return decode(data, check_crc=False, reading=reading)
        except WireError:
            return None  # the wrong CRC is already counted
    except WireError as error:
        if header.version not in HEADER_VERSIONS:
            stream.wrong_versions[header.version] += 1
        elif _fits_other_version(header, memoryview(data)[HEADER_SIZE:]):
            stream.misfits += 1
        else:
            stream.malformed += 1
            stream.error = stream.error or str(error)
        return None


def _fits_other_version(header: Header, body: memoryview) -> bool:
    """Return whether the body has the format of header version 1 behind a header of version 2, or vice versa."""
    try:
        content = body if header.version != 1 else ExtendedHeader.unpack(body).split(body)[0]
        read_content(header.type, content)
    except WireError:
        return False
    return visible(header.type) in BODIES

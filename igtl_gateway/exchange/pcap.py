"""Captured network traffic (``.pcap`` of tcpdump or Wireshark): the OpenIGTLink messages in its TCP connections.

Both directions of every connection are put together by sequence number: repeated and overlapping segments count
once, early ones wait.  Each direction is a peer with a link of its own, as a gateway between the two would see it;
a message has the time of the packet that completed it.  Connections that do not begin with an OpenIGTLink header
are left out and named.  The account is in bytes by direction: what the sequence numbers span against what came out
in whole messages, so a packet that was not captured shows.

Bounds, each counted in the account: ``MAX_WAITING`` bytes wait for missing segments in all connections together, a
segment counting ``_SEGMENT_COST`` more, and ``MAX_BEGUN`` bytes are there for messages that have begun; beyond, the
direction that holds most is given up.  ``MAX_OPEN`` connections are followed at once; beyond, that which was silent
for longest is closed.  Beyond ``MAX_ROWS`` rows connections share two rows: OpenIGTLink, and what is none.
"""

from __future__ import annotations

import heapq
import ipaddress
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import DamagedRecording, MessageTooLarge, UnsupportedRecording
from igtl_gateway.exchange.capture import count_message, looks_like_igtl
from igtl_gateway.exchange.source import (
    BYTES,
    ImportedItem,
    ImportedStream,
    NonRosSource,
    library_errors_as_damage,
    link_down_item,
    link_up_item,
    peer_item,
)
from igtl_gateway.untrusted import files, limits
from igtl_gateway.wire import HEADER_SIZE
from igtl_gateway.wire.framer import Framer

#: What may wait for missing segments: more than the largest TCP window of a usual host.
MAX_WAITING = 32 << 20
#: Connections that are followed at once, and rows of the account.
MAX_OPEN, MAX_ROWS = 1_000, 2_000
#: Room for messages that have begun, in all connections together.
MAX_BEGUN = 512 << 20
#: What a waiting segment takes besides its bytes.
_SEGMENT_COST = 256
IGTL_PORT = 18944

PCAPNG = b"\x0a\x0d\x0d\x0a"
#: First four bytes → byte order and nanoseconds of a unit of the time stamp's second word.
MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_MAX_PACKET = 1 << 22
_DEADLINE_PACKETS = 1_000
_FIN, _SYN, _RST, _ACK = 0x01, 0x02, 0x04, 0x10
_SEQUENCES = 1 << 32

#: Link type → bytes before the network layer and where in them its type is (None: told by the IP version).
_LINKS = {
    0: (4, None),  # BSD loopback
    1: (14, 12),  # Ethernet
    12: (0, None),  # raw IP, as OpenBSD numbers it
    14: (0, None),
    101: (0, None),  # raw IP
    108: (4, None),  # OpenBSD loopback
    113: (16, 14),  # Linux "any"
    228: (0, None),  # raw IPv4
    229: (0, None),  # raw IPv6
    276: (20, 0),  # Linux "any", version 2
}
_ETHERTYPES = {0x0800: 4, 0x86DD: 6}
_VLAN = (0x8100, 0x88A8)
#: IPv6 extension headers that may stand before TCP: hop by hop, routing, destination.
_EXTENSIONS = (0, 43, 60)
_TCP = 6

_Address = tuple[bytes, int]


@dataclass(frozen=True, slots=True)
class Segment:
    """A TCP segment at ``time_ns``."""

    time_ns: int
    source: _Address
    target: _Address
    seq: int
    flags: int
    data: bytes


@dataclass(slots=True)
class _Direction:
    """One direction of a connection; sequence numbers are counted from the first byte, without wrapping."""

    link: int
    name: str
    row: ImportedStream
    is_listed: bool
    start: int | None = None  # sequence number of the first byte
    taken: int = 0  # bytes in order
    end: int = 0  # the furthest byte that was seen
    waiting: dict[int, bytes] = field(default_factory=dict)
    order: list[int] = field(default_factory=list)  # of what waits, a heap
    waiting_cost: int = 0
    framer: Framer | None = None  # of OpenIGTLink only
    begun: int = 0  # bytes of the framer's storage
    head: bytes = b""  # the first bytes, until they tell whether this is OpenIGTLink
    is_igtl: bool | None = None
    given_up: bool = False
    ended: bool = False

    def place(self, segment: Segment) -> int:
        """Where the segment's first byte lies, counted from the start of the direction."""
        seq = segment.seq + (1 if segment.flags & _SYN else 0)
        if self.start is None:
            self.start = seq % _SEQUENCES
        near = (seq - self.start - self.taken) % _SEQUENCES
        return self.taken + (near if near < _SEQUENCES // 2 else near - _SEQUENCES)

    def in_order(self, at: int, data: bytes) -> bytes:
        """What can be read on, now that ``data`` is there."""
        if data:
            self.end = max(self.end, at + len(data))
        if self.given_up or not data or at + len(data) <= self.taken:
            return b""
        if at > self.taken:
            before = self.waiting.get(at)
            if before is None:
                heapq.heappush(self.order, at)
                self.waiting_cost += _SEGMENT_COST
            if len(data) > len(before or b""):
                self.waiting_cost += len(data) - len(before or b"")
                self.waiting[at] = data
            return b""
        parts = [data[self.taken - at :]]
        self.taken = at + len(data)
        while self.order and self.order[0] <= self.taken:
            first = heapq.heappop(self.order)
            more = self.waiting.pop(first)
            self.waiting_cost -= len(more) + _SEGMENT_COST
            if first + len(more) > self.taken:
                parts.append(more[self.taken - first :])
                self.taken = first + len(more)
        return b"".join(parts)

    def give_up(self, why: str) -> None:
        self.given_up, self.row.why = True, why
        self.waiting.clear()
        self.order.clear()
        self.waiting_cost = self.begun = 0
        self.framer = None


@dataclass(slots=True)
class _Connection:
    directions: dict[_Address, _Direction]
    facts: dict[_Address, dict[str, str]]
    up: set[_Address] = field(default_factory=set)


class Pcap(NonRosSource):
    """An open capture of packets.  Raises UnsupportedRecording for pcapng and unknown link types."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"captured packets {path.name}", {"imported_format": "pcap"})
        self._path = path
        self._streams: dict[str, ImportedStream] = {}
        self._links = 0
        self._last_ns = 0
        self._cut = self._fragments = self._dropped = 0
        self._connections: dict[frozenset[_Address], _Connection] = {}
        self._waiting = self._begun = 0  # bytes, in all connections
        self._further: dict[bool, ImportedStream] = {}
        with library_errors_as_damage(path):
            self._stream = files.open_file(path)
            self._deadline = limits.Deadline(files.size_of(path))
        try:
            with library_errors_as_damage(path):
                self._open()
        except BaseException:
            self._stream.close()
            raise

    def _open(self) -> None:
        head = self._stream.read(24)
        if head[:4] == PCAPNG:
            raise UnsupportedRecording(f"{self._path}: found pcapng, expected classic pcap: `editcap -F pcap` makes it")
        if head[:4] not in MAGICS or len(head) < 24:
            raise UnsupportedRecording(f"{self._path}: found {head[:4].hex(' ')}, expected a pcap file")
        self._order, self._unit_ns = MAGICS[head[:4]]
        self._link_type = struct.unpack(f"{self._order}I", head[20:])[0] & 0x0FFF_FFFF
        if self._link_type not in _LINKS:
            raise UnsupportedRecording(
                f"{self._path}: found link type {self._link_type}, expected one of {', '.join(map(str, _LINKS))}"
            )

    def items(self) -> Iterator[ImportedItem]:
        connections = self._connections  # the one that was silent for longest comes first
        for segment in self._segments():
            key = frozenset((segment.source, segment.target))
            connection = connections.pop(key, None)
            starts = segment.flags & _SYN and not segment.flags & _ACK
            if connection and starts and _is_new(connection, segment):
                yield from self._close(connection, "replaced by a new connection")
                connection = None
            if connection is None:
                if segment.flags & _RST or not (segment.data or segment.flags & _SYN):
                    continue  # what is left of a connection that has ended
                if len(connections) >= MAX_OPEN:
                    yield from self._close(connections.pop(next(iter(connections))), "silent for longest of too many")
                    self._dropped += 1
                connection = self._connect(segment)
            connections[key] = connection
            yield from self._receive(connection, segment)
            if segment.flags & _RST or all(one.ended for one in connection.directions.values()):
                del connections[key]
                yield from self._close(connection, "reset" if segment.flags & _RST else "closed by the peer")
        for connection in connections.values():
            yield from self._close(connection, "the end of the file")
        if self._dropped:
            self.notes.append(
                f"{self._dropped} connections were closed early: at most {MAX_OPEN} are followed at once, "
                "and that which was silent for longest makes room"
            )
        if self._cut:
            self.notes.append(f"{self._cut} packets were captured in part only")
        if self._fragments:
            self.notes.append(f"{self._fragments} fragments of IP packets are not put together")

    def _connect(self, segment: Segment) -> _Connection:
        ends = (segment.source, segment.target)
        if segment.flags & _SYN:
            server = segment.source if segment.flags & _ACK else segment.target
        else:
            server = min(ends, key=lambda end: (end[1] != IGTL_PORT, end[1]))
        directions, facts = {}, {}
        for source, target in (ends, ends[::-1]):
            self._links += 1
            name = f"{_text(source)} to {_text(target)}"
            row = ImportedStream(name, 0, unit=BYTES)
            is_listed = len(self.rows) < MAX_ROWS
            if is_listed:
                self.rows.append(row)
            directions[source] = _Direction(self._links, name, row, is_listed)
            role = "client" if source == server else "server"
            facts[source] = {"peer": _text(source), "local": _text(target), "role": role}
        return _Connection(directions, facts)

    def _receive(self, connection: _Connection, segment: Segment) -> Iterator[ImportedItem]:
        direction = connection.directions[segment.source]
        at = direction.place(segment)
        held = direction.waiting_cost
        data = direction.in_order(at, segment.data)
        self._waiting += direction.waiting_cost - held
        if self._waiting > MAX_WAITING:
            self._make_room("waiting_cost", "too much waits for a segment that is missing")
        if segment.flags & _FIN and direction.taken >= at + len(segment.data):
            direction.ended = True
        for message in self._framed(direction, data):
            if segment.source not in connection.up:
                connection.up.add(segment.source)
                yield link_up_item(segment.time_ns, direction.link, connection.facts[segment.source])
            direction.row.taken += len(message)
            item = peer_item(segment.time_ns, direction.link, message)
            count_message(self._streams, self.rows, item)
            yield item

    def _framed(self, direction: _Direction, data: bytes) -> Iterator[Buffer]:
        if not data or direction.given_up:
            return
        if direction.is_igtl is None:
            direction.head += data
            if len(direction.head) < HEADER_SIZE:
                return
            direction.is_igtl, data, direction.head = looks_like_igtl(direction.head), direction.head, b""
        if not direction.is_igtl:
            return
        if direction.framer is None:
            direction.framer = Framer()
        framer, before = direction.framer, direction.begun
        try:
            yield from framer.feed(data)
            yield from framer.received(0)  # raises what the last bytes announced
            direction.begun = framer.pending + len(framer.buffer())
            self._begun += direction.begun - before
            if self._begun > MAX_BEGUN:
                self._make_room("begun", "too many messages have begun and do not end")
        except MessageTooLarge as error:
            self._begun -= before
            direction.give_up(str(error))

    def _make_room(self, what: str, why: str) -> None:
        """Give up the direction that holds most."""
        directions = [one for connection in self._connections.values() for one in connection.directions.values()]
        most = max(directions, key=lambda one: int(getattr(one, what)))
        self._waiting -= most.waiting_cost
        self._begun -= most.begun
        most.give_up(f"{why}: given up after {most.taken} bytes")

    def _close(self, connection: _Connection, reason: str) -> Iterator[ImportedItem]:
        for source, direction in connection.directions.items():
            row = direction.row
            row.declared = direction.end
            self._waiting -= direction.waiting_cost
            self._begun -= direction.begun
            if not direction.end:
                row.why = "nothing was sent"
            elif direction.given_up:
                pass  # and the row says why
            elif not direction.is_igtl:
                row.left_out, row.why = row.declared, "not OpenIGTLink"
            elif direction.waiting:
                row.why = f"a segment is missing after {direction.taken} bytes"
            elif direction.framer and direction.framer.pending and not row.why:
                row.why = f"ends inside a message, of which {direction.framer.pending} bytes are there"
            if not direction.is_listed:
                self._add(row, is_igtl=bool(direction.is_igtl))
            if source in connection.up:
                yield link_down_item(self._last_ns, direction.link, connection.facts[source], reason)

    def _add(self, row: ImportedStream, *, is_igtl: bool) -> None:
        """Count a connection that has no row of its own."""
        if is_igtl not in self._further:
            kind = "OpenIGTLink" if is_igtl else "not OpenIGTLink"
            self._further[is_igtl] = ImportedStream(
                f"(further connections, {kind})", 0, unit=BYTES, why=f"more than {MAX_ROWS} rows"
            )
            self.rows.append(self._further[is_igtl])
        into = self._further[is_igtl]
        into.declared += row.declared
        into.taken += row.taken
        into.left_out += row.left_out

    # -- packets ------------------------------------------------------------------------------------------------

    def _segments(self) -> Iterator[Segment]:
        record = struct.Struct(f"{self._order}4I")
        number = 0
        while head := self._stream.read(record.size):
            number += 1
            if number % _DEADLINE_PACKETS == 0:
                self._deadline.check(str(self._path))
            if len(head) < record.size:
                raise DamagedRecording(f"{self._path}: cut off inside the header of packet {number}")
            seconds, rest, size, original = record.unpack(head)
            if size > _MAX_PACKET:
                raise DamagedRecording(
                    f"{self._path}: packet {number}: found {size} bytes, expected at most {_MAX_PACKET}"
                )
            packet = self._stream.read(size)
            if len(packet) < size:
                raise DamagedRecording(
                    f"{self._path}: cut off inside packet {number}, {size - len(packet)} bytes short"
                )
            self._cut += size < original
            self._last_ns = seconds * 1_000_000_000 + rest * self._unit_ns
            try:
                segment = self._segment(packet)
            except (struct.error, IndexError):
                continue  # shorter than its own headers: nothing of TCP's stream is in it
            if segment:
                yield segment

    def _segment(self, packet: bytes) -> Segment | None:
        """The TCP segment of a packet, if it is one."""
        at, type_at = _LINKS[self._link_type]
        version = packet[at] >> 4
        if type_at is not None:
            (ethertype,) = struct.unpack_from(">H", packet, type_at)
            while ethertype in _VLAN:
                (ethertype,) = struct.unpack_from(">H", packet, at + 2)
                at += 4
            version = _ETHERTYPES.get(ethertype, 0)
        ip = packet[at:]
        if version == 4:
            (total,) = struct.unpack_from(">H", ip, 2)
            fragment = struct.unpack_from(">H", ip, 6)[0] & 0x3FFF
            protocol, offset, source, target = ip[9], (ip[0] & 15) * 4, ip[12:16], ip[16:20]
            end = total or len(ip)  # 0: the network card was to cut it in pieces
        elif version == 6:
            (payload,) = struct.unpack_from(">H", ip, 4)
            protocol, offset, source, target, fragment = ip[6], 40, ip[8:24], ip[24:40], 0
            end = payload + 40 if payload else len(ip)
            while protocol in _EXTENSIONS:
                protocol, offset = ip[offset], offset + 8 + ip[offset + 1] * 8
        else:
            return None
        if protocol != _TCP:
            return None
        if fragment:
            self._fragments += 1
            return None
        tcp = ip[offset:end]
        source_port, target_port, seq, _, words, flags = struct.unpack_from(">HHIIBB", tcp)
        data = tcp[(words >> 4) * 4 :]
        return Segment(self._last_ns, (source, source_port), (target, target_port), seq, flags, data)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _is_new(connection: _Connection, segment: Segment) -> bool:
    """Whether a SYN opens another connection between the same ports, rather than being sent again."""
    start = connection.directions[segment.source].start
    return start is None or (segment.seq + 1) % _SEQUENCES != start


@lru_cache(maxsize=4_096)  # asked for several times in each connection
def _text(address: _Address) -> str:
    host = ipaddress.ip_address(address[0])
    return f"[{host}]:{address[1]}" if host.version == 6 else f"{host}:{address[1]}"

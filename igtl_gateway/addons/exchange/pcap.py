"""Captured network traffic (``.pcap``, ``.pcapng``): the OpenIGTLink messages in its TCP connections.

Both directions of every connection are reassembled by sequence number: repeated and overlapping segments count once,
segments that arrive early wait.  Each direction is a peer with its own link, as for a gateway between the two
programs.  A message has the time of the packet that completed it.  Connections that do not begin with an OpenIGTLink
header are left out and listed.  The account is in bytes by direction: it compares the range of the sequence numbers
with the bytes of complete messages, so a packet that was not captured is visible.

The account counts what each bound leaves out.  In all connections together, at most ``MAX_WAITING`` bytes wait for
missing segments (a segment counts ``_SEGMENT_COST`` more), and at most ``MAX_BEGUN`` bytes are used for incomplete
messages.  Beyond that, the direction that uses most memory is given up.  At most ``MAX_OPEN`` connections are followed
at the same time; for a further one, the connection without traffic for the longest time is closed.  Beyond
``MAX_ROWS`` rows all further connections share two rows: OpenIGTLink, and other protocols.
"""

from __future__ import annotations

import heapq
import ipaddress
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from igtl_gateway.addon import MessageTooLarge
from igtl_gateway.addon.igtl import HEADER_SIZE, Framer
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addons.exchange.capture import count_message, looks_like_igtl
from igtl_gateway.addons.exchange.pcap_file import PacketFile
from igtl_gateway.addons.exchange.pcap_segments import ACK, FIN, LINKS, RST, SYN, Address, Segment, Segments
from igtl_gateway.addons.exchange.source import (
    BYTES,
    ImportedItem,
    ImportedStream,
    NonRosSource,
    link_down_item,
    link_up_item,
    peer_item,
)

#: Bytes that may wait for missing segments: more than the largest TCP window of a usual host.
MAX_WAITING = 32 << 20
#: Connections that are followed at the same time, and rows of the account.
MAX_OPEN, MAX_ROWS = 1_000, 2_000
#: Bytes for incomplete messages, in all connections together.
MAX_BEGUN = 512 << 20
#: Memory of a waiting segment in addition to its bytes.
_SEGMENT_COST = 256
#: Number of link types that a note lists.
_MAX_NAMED = 5
IGTL_PORT = 18944

_SEQUENCES = 1 << 32


@dataclass(slots=True)
class _Direction:
    """One direction of a connection; offsets are counted from its first byte, without wrapping."""

    link: int
    name: str
    row: ImportedStream
    is_listed: bool
    start: int | None = None  # sequence number of the first byte
    taken: int = 0  # bytes in order
    end: int = 0  # offset after the last received byte
    waiting: dict[int, bytes] = field(default_factory=dict)
    order: list[int] = field(default_factory=list)  # offsets of the waiting segments, a heap
    waiting_cost: int = 0
    framer: Framer | None = None  # for OpenIGTLink only
    begun: int = 0  # bytes that the framer uses
    head: bytes = b""  # the first bytes, until they suffice to detect OpenIGTLink
    is_igtl: bool | None = None
    given_up: bool = False
    ended: bool = False

    def place(self, segment: Segment) -> int:
        """Return the offset of the segment's first byte from the start of the direction."""
        seq = segment.seq + (1 if segment.flags & SYN else 0)
        if self.start is None:
            self.start = seq % _SEQUENCES
        near = (seq - self.start - self.taken) % _SEQUENCES
        return self.taken + (near if near < _SEQUENCES // 2 else near - _SEQUENCES)

    def in_order(self, at: int, data: bytes) -> bytes:
        """Add the bytes of a segment at offset ``at``; return the bytes that are in order and were not returned yet."""
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
        """Stop reading this direction and release its memory; ``why`` goes to its row."""
        self.given_up, self.row.why = True, why
        self.waiting.clear()
        self.order.clear()
        self.waiting_cost = self.begun = 0
        self.framer = None


@dataclass(slots=True)
class _Connection:
    directions: dict[Address, _Direction]
    facts: dict[Address, dict[str, str]]
    up: set[Address] = field(default_factory=set)


class Pcap(NonRosSource):
    """An open capture of packets.  Raises UnsupportedRecording and Unavailable like ``PacketFile``."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"captured packets {path.name}", {"imported_format": "pcap"})
        self._streams: dict[str, ImportedStream] = {}
        self._links = self._dropped = 0
        self._connections: dict[frozenset[Address], _Connection] = {}
        self._waiting = self._begun = 0  # bytes, in all connections
        self._further: dict[bool, ImportedStream] = {}
        self._file = PacketFile(path, frozenset(LINKS))
        self._segments = Segments(self._file.packets())

    def items(self) -> Iterator[ImportedItem]:
        connections = self._connections  # ordered by the time of the last packet, oldest first
        for segment in self._segments:
            key = frozenset((segment.source, segment.target))
            connection = connections.pop(key, None)
            starts = segment.flags & SYN and not segment.flags & ACK
            if connection and starts and _is_new(connection, segment):
                yield from self._close(connection, "replaced by a new connection")
                connection = None
            if connection is None:
                if segment.flags & RST or not (segment.data or segment.flags & SYN):
                    continue  # late packets of a closed connection
                if len(connections) >= MAX_OPEN:
                    oldest = connections.pop(next(iter(connections)))
                    yield from self._close(oldest, f"no traffic for the longest time of {MAX_OPEN} connections")
                    self._dropped += 1
                connection = self._connect(segment)
            connections[key] = connection
            yield from self._receive(connection, segment)
            if segment.flags & RST or all(one.ended for one in connection.directions.values()):
                del connections[key]
                yield from self._close(connection, "reset" if segment.flags & RST else "closed by the peer")
        for connection in connections.values():
            yield from self._close(connection, "the end of the file")
        if self._dropped:
            self.notes.append(
                f"{counted(self._dropped, 'connection')} {by_count(self._dropped, 'was', 'were')} closed early: at "
                f"most {MAX_OPEN} are followed at the same time, "
                "so the one without traffic for the longest time is closed for a further one"
            )
        if self._segments.cut:
            self.notes.append(
                f"{counted(self._segments.cut, 'packet')} {by_count(self._segments.cut, 'was', 'were')} captured "
                "only in part"
            )
        if self._segments.fragments:
            self.notes.append(
                f"{counted(self._segments.fragments, 'fragment')} of IP packets "
                f"{by_count(self._segments.fragments, 'is', 'are')} not reassembled"
            )
        if others := self._file.other_links:
            kinds = ", ".join(str(link_type) for link_type, _ in others.most_common(_MAX_NAMED))
            self.notes.append(f"{counted(others.total(), 'packet')} of other link types ({kinds}) are left out")

    def _connect(self, segment: Segment) -> _Connection:
        ends = (segment.source, segment.target)
        if segment.flags & SYN:
            server = segment.source if segment.flags & ACK else segment.target
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
            self._make_room("waiting_cost", "too many bytes wait for a missing segment")
        if segment.flags & FIN and direction.taken >= at + len(segment.data):
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
            yield from framer.received(0)  # raises if the last bytes begin a message that is too large
            direction.begun = framer.pending + len(framer.buffer())
            self._begun += direction.begun - before
            if self._begun > MAX_BEGUN:
                self._make_room("begun", "too many bytes of incomplete messages")
        except MessageTooLarge as error:
            self._begun -= before
            direction.give_up(str(error))

    def _make_room(self, what: str, why: str) -> None:
        """Give up the direction with the highest value of the attribute ``what``, in bytes."""
        directions = [one for connection in self._connections.values() for one in connection.directions.values()]
        most = max(directions, key=lambda one: int(getattr(one, what)))
        self._waiting -= most.waiting_cost
        self._begun -= most.begun
        most.give_up(f"{why}: given up after {counted(most.taken, 'byte')}")

    def _close(self, connection: _Connection, reason: str) -> Iterator[ImportedItem]:
        for source, direction in connection.directions.items():
            row = direction.row
            row.declared = direction.end
            self._waiting -= direction.waiting_cost
            self._begun -= direction.begun
            if not direction.end:
                row.why = "no data was sent"
            elif direction.given_up:
                pass  # the row has the reason
            elif not direction.is_igtl:
                row.left_out, row.why = row.declared, "not OpenIGTLink"
            elif direction.waiting:
                row.why = f"a segment is missing after {counted(direction.taken, 'byte')}"
            elif direction.framer and direction.framer.pending and not row.why:
                row.why = f"ends inside a message, after {counted(direction.framer.pending, 'byte')} of it"
            if not direction.is_listed:
                self._add(row, is_igtl=bool(direction.is_igtl))
            if source in connection.up:
                yield link_down_item(self._segments.last_ns, direction.link, connection.facts[source], reason)

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

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _is_new(connection: _Connection, segment: Segment) -> bool:
    """Return whether a SYN opens a new connection between the same ports; False for a retransmitted SYN."""
    start = connection.directions[segment.source].start
    return start is None or (segment.seq + 1) % _SEQUENCES != start


@lru_cache(maxsize=4_096)  # used several times for each connection
def _text(address: Address) -> str:
    host = ipaddress.ip_address(address[0])
    return f"[{host}]:{address[1]}" if host.version == 6 else f"{host}:{address[1]}"

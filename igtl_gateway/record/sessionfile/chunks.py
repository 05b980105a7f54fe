"""One chunk: read from the file, unpacked, and taken apart into messages: a row of numbers each, not an object."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import IO

import numpy as np

from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.compression import decompress
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.records import (
    CHUNK_HEAD,
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_RECORD,
    Malformed,
    RecordFields,
)

#: Channel, sequence, log_time, publish_time; first and last offset of the payload in the bytes that follow.
Row = tuple[int, int, int, int, int, int, bytes]

#: All of a chunk before its data, with the longest name that a compression has.
_CHUNK_BEGIN = HEAD.size + CHUNK_HEAD.size + records.U32.size + len("zstd") + records.U64.size
#: The highest plausible ratio of compression of chunks of hundreds of megabytes.
_PLAUSIBLE_RATIO = 20
#: Rows of chunks above this are made in batches.
SMALL_BYTES = 8 << 20
BATCH = 10_000

_log_time = itemgetter(2)


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk as it lies in the file; ``place`` is where, for errors."""

    place: str
    compression: str
    data: bytes
    size: int
    crc: int

    def unpack(self) -> bytes:
        """Its records.  Asks for no limits, so that another thread may call it.  Raises Malformed."""
        try:
            return decompress(self.compression, self.data, self.size, self.crc)
        except Malformed as error:
            raise Malformed(f"{self.place}: {error}") from None


def check_chunk(packed: int, size: int, place: str) -> None:
    """Raise LimitExceeded if ``packed`` bytes of a chunk may not unpack to ``size`` bytes.

    With lz4, zeros pack to a 250th, and label maps nearly do: the ratio alone does not bound what a small file costs.
    """
    limits.check_unpacked(packed, size, place)
    limits.check_limit("free", size, place, max(3 * limits.current_limits().free, _PLAUSIBLE_RATIO * packed))


def packed_chunk(stream: IO[bytes], entry: ChunkEntry, path: str) -> PackedChunk:
    """Read a chunk.  Raises Malformed, or LimitExceeded for one that needs too much memory."""
    place = f"chunk at offset {entry.at:,}"
    limits.check_limit("memory", entry.length, f"{path}: {place}")
    stream.seek(entry.at)
    if entry.loose:
        return PackedChunk(place, "", stream.read(entry.length), entry.length, 0)
    fields = RecordFields(stream.read(min(entry.length, _CHUNK_BEGIN)), place)
    head = fields.take(HEAD.size)
    if HEAD.unpack(head) != (records.CHUNK, entry.length - HEAD.size):
        raise Malformed(f"{place}: found {head.hex(' ')}, expected a chunk of {entry.length} bytes")
    _, _, size, crc = CHUNK_HEAD.unpack(fields.take(CHUNK_HEAD.size))
    compression, packed = fields.text(), fields.number(records.U64)
    if packed > entry.length - fields.at:
        raise Malformed(f"{place}: found {packed} bytes of data, expected at most {entry.length - fields.at}")
    check_chunk(packed, size, f"{path}: {place}")
    stream.seek(entry.at + fields.at)
    return PackedChunk(place, compression, stream.read(packed), size, crc)


def batches(data: bytes) -> Iterator[list[Row]]:
    """The messages in the bytes of a chunk, in order of time; of a large chunk in several lists.  Raises Malformed."""
    if len(data) <= SMALL_BYTES:
        yield _rows(data)
        return
    starts, stamps = array("Q"), array("Q")
    for at, stamp_ns in _heads(data):
        starts.append(at)
        stamps.append(stamp_ns)
    # stable: of equal times, the order in the file
    order = np.argsort(np.frombuffer(stamps, np.uint64), kind="stable") if starts else np.zeros(0, np.intp)
    for first in range(0, len(order), BATCH):
        rows: list[Row] = []
        for i in order[first : first + BATCH].tolist():
            at = starts[i]
            _, length, *numbers = MESSAGE_RECORD.unpack_from(data, at)
            rows.append((*numbers, at + MESSAGE_RECORD.size, at + HEAD.size + length, data))
        yield rows


def _heads(data: bytes) -> Iterator[tuple[int, int]]:
    """Offset and time of each message."""
    at, size = 0, len(data)
    while at < size:
        opcode, length = _head(data, at)
        if opcode == MESSAGE:
            yield at, MESSAGE_HEAD.unpack_from(data, at + HEAD.size)[2]
        at += HEAD.size + length


def _rows(data: bytes) -> list[Row]:
    """The messages in the bytes of a chunk."""
    rows: list[Row] = []
    at, last_ns, sorted_by_time = 0, 0, True
    size, heads, unpack = len(data), MESSAGE_RECORD.size, MESSAGE_RECORD.unpack_from
    while at < size:
        if size - at < heads:
            _, length = _head(data, at)
            end = at + HEAD.size + length
        else:
            opcode, length, channel, sequence, log_ns, publish_ns = unpack(data, at)
            end = at + HEAD.size + length
            if end > size or (opcode == MESSAGE and length < MESSAGE_HEAD.size):
                _head(data, at)
            if opcode == MESSAGE:
                rows.append((channel, sequence, log_ns, publish_ns, at + heads, end, data))
                if log_ns < last_ns:
                    sorted_by_time = False
                last_ns = log_ns
        at = end
    if not sorted_by_time:
        rows.sort(key=_log_time)  # stable: of equal times, the order in the file
    return rows


def _head(data: bytes, at: int) -> tuple[int, int]:
    """Opcode and length of the record at ``at``.  Raises Malformed where it does not fit."""
    size = len(data) - at
    opcode, length = HEAD.unpack_from(data, at) if size >= HEAD.size else (0, -1)
    least = MESSAGE_HEAD.size if opcode == MESSAGE else 0
    if not least <= length <= size - HEAD.size:
        raise Malformed(f"found {size} bytes at the end of a chunk, expected a whole record")
    return opcode, length

"""One chunk: read from the file, unpacked, and taken apart into messages: a row of numbers each, not an object."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat
from operator import itemgetter
from typing import IO

import numpy as np

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row, count_of, rows_of, take
from igtl_gateway.record.sessionfile.compression import decompress
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.records import (
    CHUNK_HEAD,
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    Malformed,
    RecordFields,
)

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
        raise Malformed(f"{place}: found {head.hex(' ')}, expected a chunk of {counted(entry.length, 'byte')}")
    _, _, size, crc = CHUNK_HEAD.unpack(fields.take(CHUNK_HEAD.size))
    compression, packed = fields.text(), fields.number(records.U64)
    if packed > entry.length - fields.at:
        raise Malformed(
            f"{place}: found {counted(packed, 'byte')} of data, expected at most {entry.length - fields.at}"
        )
    check_chunk(packed, size, f"{path}: {place}")
    stream.seek(entry.at + fields.at)
    return PackedChunk(place, compression, stream.read(packed), size, crc)


def batches(data: bytes) -> Iterator[list[Row]]:
    """The messages in the bytes of a chunk, in order of time; of a large chunk in several lists.  Raises Malformed."""
    if len(data) <= SMALL_BYTES:
        rows, in_order, end = rows_of(data)
        _check_end(data, end)
        if not in_order:
            rows.sort(key=_log_time)  # stable: of equal times, the order in the file
        yield rows
        return
    for each in column_batches(data):
        yield list(zip(*(column.tolist() for column in each), repeat(data)))


def column_batches(data: bytes) -> Iterator[Columns]:
    """As :func:`batches`, in columns."""
    count, in_order, end, _ = count_of(data)
    _check_end(data, end)
    most = count if len(data) <= SMALL_BYTES else BATCH
    if in_order or count <= most:
        at = 0
        for first in range(0, max(count, 1), max(most, 1)):
            found = Columns.empty(min(most, count - first))
            at = take(data, at, *found)
            yield found if in_order else found.where(np.argsort(found.times, kind="stable"))
        return
    starts, stamps = array("Q"), array("Q")
    at = 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        if opcode == MESSAGE:
            starts.append(at)
            stamps.append(MESSAGE_HEAD.unpack_from(data, at + HEAD.size)[2])
        at += HEAD.size + length
    places = np.frombuffer(starts, np.uint64)
    # stable: of equal times, the order in the file
    order = np.argsort(np.frombuffer(stamps, np.uint64), kind="stable")
    for first in range(0, count, BATCH):
        one = Columns.empty(1)
        found = Columns.empty(min(BATCH, count - first))
        for row, place in enumerate(places[order[first : first + BATCH]].tolist()):
            take(data, place, *one)
            for number, value in enumerate(one):
                found[number][row] = value[0]
        yield found


def _check_end(data: bytes, end: int) -> None:
    """Raise Malformed where the records of a chunk end before it."""
    if end < len(data):
        raise Malformed(f"found {counted(len(data) - end, 'byte')} at the end of a chunk, expected a whole record")

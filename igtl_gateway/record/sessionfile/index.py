"""The index of a file: from its summary, or by a scan where the summary does not have what reading needs.

What the summary claims is compared with itself (its checksum, its counts) and with the file: chunks lie in the data
section and do not overlap, so that none is read twice.

The ``mcap`` library's ``SeekingReader`` is not used, neither here nor for look-ups.  It allocates what a file claims: a
file of 16 kB made it allocate 1 GB.  It finds chunks by time only, while a look-up needs the places of single messages
by channel.  And it is slower, because it makes an object of each message (0.30 s against 0.20 s for star.mcap).
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import IO

from mcap.records import Statistics

from igtl_gateway.base.errors import BeingRecorded, DamagedRecording, UnsupportedRecording
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, RecordPlace
from igtl_gateway.record.sessionfile.records import (
    FOOTER_COVERED,
    FOOTER_RECORD,
    HEAD,
    INDEX_OFFSET,
    MAGIC,
    Malformed,
    RecordFields,
)
from igtl_gateway.record.sessionfile.scan import scan


class NoEnd(Malformed):
    """A file without an end: it is being written, or was cut off."""


@dataclass(frozen=True, slots=True)
class Summary:
    """The summary section of a file.

    Attributes:
        start: its offset; 0: the file has none.
        end: offset of the footer behind it.
        data: its records.
        has_checksum: whether they are under a checksum, which is then right.
    """

    start: int
    end: int
    data: bytes
    has_checksum: bool

    @property
    def data_end(self) -> int:
        """Where the data section ends."""
        return self.start or self.end


def read_summary(stream: IO[bytes], size: int, place: str, most: int | None = None) -> Summary:
    """The summary section of a file of ``size`` bytes, of at most ``most``.  Raises Malformed, LimitExceeded."""
    end = size - FOOTER_RECORD.size
    if end < len(MAGIC):
        raise NoEnd("found no room for a footer")
    stream.seek(end)
    footer = stream.read(FOOTER_RECORD.size)
    opcode, length, start, _, crc, magic = FOOTER_RECORD.unpack(footer)
    if magic != MAGIC:
        raise NoEnd(f"found {magic.hex(' ')} at the end, expected {MAGIC.hex(' ')}")
    if (opcode, length) != (records.FOOTER, records.FOOTER_LENGTH) or start > end or 0 < start < len(MAGIC):
        raise Malformed("its footer is damaged")
    begin = start or end
    limits.check_limit("memory", end - begin, f"{place}: summary", most)
    stream.seek(begin)
    data = stream.read(end - begin)
    if crc and (found := records.crc32(footer[:FOOTER_COVERED], records.crc32(data))) != crc:
        raise Malformed(f"found checksum {found:08x}, expected {crc:08x}")
    return Summary(start, end, data, bool(crc))


def read_index(path: Path, stream: IO[bytes]) -> Index:
    """The index of a file.

    Raises UnsupportedRecording for what is not an MCAP file, DamagedRecording for one that is damaged or cut off,
    LimitExceeded.
    """
    try:
        size = _check_start(path, stream)
        try:
            summary = read_summary(stream, size, str(path))
            index, statistics = _parse_summary(path, size, summary.data)
            if not _is_complete(index, statistics):
                index = scan(path, stream, size, summary.data_end)
                if statistics and statistics.message_count != (found := sum(index.counts.values())):
                    raise Malformed(f"found {count_text(found, 'message')}, expected {statistics.message_count}")
            _check_chunks(index, summary.data_end)
        except NoEnd:
            raise _no_end_error(path, stream, size) from None
        except Malformed as error:
            raise DamagedRecording(f"{path}: index: {error}{recover_hint(path)}") from None
    except OSError as error:
        raise DamagedRecording(f"{path}: cannot be read: {error.strerror}") from None
    return index


def stated_index(path: Path, stream: IO[bytes], size: int, most: int) -> Index | None:
    """The index as the summary states it: the file is never scanned, so it may have less than the file.

    Args:
        most: longest summary that is read, bytes.

    Returns None for a file without an end.  Raises Malformed, DamagedRecording, LimitExceeded, OSError.
    """
    try:
        summary = read_summary(stream, size, str(path), most)
    except NoEnd:
        return None
    return _parse_summary(path, size, summary.data)[0]


def read_record(stream: IO[bytes], index: Index, opcode: int, place: RecordPlace, path: str) -> bytes:
    """The content of a record that the index names.  Raises Malformed, LimitExceeded, OSError."""
    if place.at + place.length > index.size or place.length < HEAD.size:
        raise Malformed(f"found {counted(place.length, 'byte')} at {place.at}, which the file does not have")
    limits.check_limit("memory", place.length, path)
    stream.seek(place.at)
    data = stream.read(place.length)
    if HEAD.unpack_from(data) != (opcode, place.length - HEAD.size):
        raise Malformed(f"found {data[: HEAD.size].hex(' ')} at {place.at}, expected the record")
    return data[HEAD.size :]


def recover_hint(path: Path) -> str:
    """The remedy for a damaged file, as the end of the sentence that describes the damage."""
    return f"; run: igtl-gateway recover {shlex.quote(str(path))}"


def not_mcap(path: Path, start: bytes) -> UnsupportedRecording:
    """The error for a file that begins with other bytes than MCAP's."""
    return UnsupportedRecording(f"{path}: not an MCAP file: found {start.hex(' ')}, expected {MAGIC.hex(' ')}")


def _check_start(path: Path, stream: IO[bytes]) -> int:
    """The size of the file.  Raises UnsupportedRecording."""
    size = stream.seek(0, 2)
    stream.seek(0)
    start = stream.read(len(MAGIC))
    if not start:
        raise UnsupportedRecording(f"{path}: the file is empty")
    if not MAGIC.startswith(start):
        raise not_mcap(path, start)
    return size


def _no_end_error(path: Path, stream: IO[bytes], size: int) -> DamagedRecording:
    if files.is_being_written(stream):
        return BeingRecorded(
            f"{path}: is being recorded ({count_text(size, 'byte')} so far) and can be read when the recording has "
            "ended; "
            f"igtl-gateway info {shlex.quote(str(path))} shows what is there"
        )
    return DamagedRecording(f"{path}: was cut off after {count_text(size, 'byte')}{recover_hint(path)}")


def _parse_summary(path: Path, size: int, data: bytes) -> tuple[Index, Statistics | None]:
    """What the summary claims."""
    index, statistics, place = Index(size), None, f"{path}: summary"
    for opcode, at, stop in records.records(data, "summary"):
        content = data[at:stop]
        if opcode in records.DEFINITIONS:
            index.define(opcode, content)
        elif opcode == records.STATISTICS:
            statistics = records.parse_statistics(content)
        elif opcode == records.CHUNK_INDEX:
            index.chunks.append(_parse_chunk_index(content))
            limits.check_limit("count", len(index.chunks), place)
        elif opcode in (records.ATTACHMENT_INDEX, records.METADATA_INDEX):
            places = index.attachments if opcode == records.ATTACHMENT_INDEX else index.metadata
            places.append(_parse_place(opcode, content))
            limits.check_limit("count", len(places), place)
    if statistics:
        index.counts = statistics.channel_message_counts
        index.start_ns, index.end_ns = statistics.message_start_time, statistics.message_end_time
        if (found := sum(index.counts.values())) != statistics.message_count:
            raise Malformed(f"found {count_text(found, 'message')} by channel, expected {statistics.message_count}")
    index.chunks.sort(key=attrgetter("at"))
    return index, statistics


def _parse_chunk_index(data: bytes) -> ChunkEntry:
    fields = RecordFields(data, "chunk index")
    start_ns, end_ns, at, length = (fields.number(records.U64) for _ in range(4))
    places = fields.blob()
    if len(places) % INDEX_OFFSET.size:
        raise Malformed(
            f"chunk index: found {counted(len(places), 'byte')} of offsets, expected a multiple of {INDEX_OFFSET.size}"
        )
    index_length = fields.number(records.U64)
    fields.text()
    fields.number(records.U64)
    return ChunkEntry(start_ns, end_ns, at, length, fields.number(records.U64), places, index_length)


def _parse_place(opcode: int, data: bytes) -> RecordPlace:
    fields = RecordFields(data, "index")
    at, length = fields.number(records.U64), fields.number(records.U64)
    if opcode == records.ATTACHMENT_INDEX:
        fields.take(3 * records.U64.size)
    return RecordPlace(fields.text(), at, length)


def _is_complete(index: Index, statistics: Statistics | None) -> bool:
    """Whether the summary has all that reading needs, by its own counts."""
    return (
        statistics is not None
        and statistics.chunk_count == len(index.chunks)
        and (bool(index.chunks) or not statistics.message_count)
        and statistics.channel_count <= len(index.channels)
        and index.counts.keys() <= index.channels.keys()
        and statistics.attachment_count == len(index.attachments)
        and statistics.metadata_count == len(index.metadata)
        and all(channel.schema_id in index.schemas for channel in index.channels.values() if channel.schema_id)
    )


def _check_chunks(index: Index, data_end: int) -> None:
    """Raise Malformed where chunks are not in the data section, or overlap."""
    for chunk in index.chunks:
        if chunk.at < len(MAGIC) or chunk.length < HEAD.size or chunk.at + chunk.length + chunk.index_length > data_end:
            raise Malformed(
                f"found a chunk of {counted(chunk.length, 'byte')} at {chunk.at}, expected it before {data_end}"
            )
    for one, two in pairwise(index.chunks):
        if one.at + one.length > two.at:
            raise Malformed(f"found a chunk at {two.at}, expected none before {one.at + one.length}")

"""What is in an MCAP file and where: from its summary, or from one pass over the file where the summary does not say.

MCAP lets a writer leave out nearly everything of the summary: a file without an index, or with half of one, is as sound
as any other.  What the summary claims is held against itself (its checksum, its counts) and against the file: chunks
lie in the data section and do not overlap, so that none is read twice.
"""

from __future__ import annotations

import shlex
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import IO

from mcap.records import Channel, Schema, Statistics

from igtl_gateway.errors import BeingRecorded, DamagedRecording, UnsupportedRecording
from igtl_gateway.sessionfile import records
from igtl_gateway.sessionfile.records import (
    CHUNK_HEAD,
    FOOTER_RECORD,
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    Malformed,
    RecordFields,
)
from igtl_gateway.sessionfile.unpack import unpacked
from igtl_gateway.untrusted import files, limits

_FOOTER_CRC_COVERS = 1 + 8 + 8 + 8
_PLACE = struct.Struct("<HQ")
#: All of a chunk before its data, with the longest name that a compression has.
_CHUNK_BEGIN = HEAD.size + CHUNK_HEAD.size + records.U32.size + len("zstd") + records.U64.size
#: Messages outside of chunks are read in pieces of about so many bytes.
_PIECE = 1 << 20
#: What a slow machine unpacks and checks in a second: the limit of time as a limit of bytes, which does not depend on
#: whoever takes the messages.
_BYTES_PER_SECOND = 100_000_000
#: What chunks of hundreds of megabytes may be packed to, to the utmost.
_PLAUSIBLE_RATIO = 20


@dataclass(frozen=True, slots=True)
class ChunkEntry:
    """A chunk, or a run of messages outside of chunks.

    Attributes:
        start_ns, end_ns: log_time of its first and last message.
        at, length: its record in the file; of a run all its records.
        size: bytes unpacked.
        places: channel and offset of each of its message indexes, 10 bytes each.
        index_length: bytes of the message indexes behind it.
        loose: it is a run of records without a chunk around them.
    """

    start_ns: int
    end_ns: int
    at: int
    length: int
    size: int
    places: bytes = b""
    index_length: int = 0
    loose: bool = False

    @property
    def channels(self) -> list[int]:
        """Channels of its messages; none where nothing tells."""
        return [channel for channel, _ in _PLACE.iter_unpack(self.places)]

    @property
    def message_indexes(self) -> dict[int, int]:
        """Channel → offset of its message index."""
        return dict(_PLACE.iter_unpack(self.places))


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """An attachment or a metadata record: its name, and where it is."""

    name: str
    at: int
    length: int


@dataclass(slots=True)
class Index:
    """What is in a file.

    Attributes:
        size: bytes of the file.
        schemas, channels: by number.
        counts: messages by channel.
        start_ns, end_ns: log_time of the first and the last message; 0 without any.
        chunks: in the order of the file.
        attachments, metadata: in the order of the summary, or of the file.
        scanned: made by a pass over the file.
    """

    size: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    chunks: list[ChunkEntry] = field(default_factory=list)
    attachments: list[RecordPlace] = field(default_factory=list)
    metadata: list[RecordPlace] = field(default_factory=list)
    scanned: bool = False

    def define(self, opcode: int, content: bytes) -> None:
        """Learn a schema or a channel.

        Of a definition that is longer than any that is parsed, the beginning is kept; it is refused like the whole.
        """
        if opcode == records.SCHEMA:
            schema = records.parse_schema(content)
            most = 4 * limits.current_limits().definition + 1  # a character of UTF-8 has at most 4 bytes
            self.schemas[schema.id] = schema if len(schema.data) <= most else replace(schema, data=schema.data[:most])
        elif opcode == records.CHANNEL:
            channel = records.parse_channel(content)
            self.channels[channel.id] = channel


def read_index(path: Path, stream: IO[bytes]) -> Index:
    """The index of a file.

    Raises UnsupportedRecording for what is no MCAP file, DamagedRecording for one that is damaged or cut off,
    LimitExceeded.
    """
    size, start, end = _ends(path, stream)
    try:
        index, told = _summary(path, stream, size, start, end)
        if not _is_complete(index, told):
            index = _Scan(path, stream, size, start or end).run(told)
        _check_chunks(index, start or end)
    except Malformed as error:
        raise DamagedRecording(f"{path}: index: {error}{recover_hint(path)}") from None
    except OSError as error:
        raise DamagedRecording(f"{path}: cannot be read: {error.strerror}") from None
    return index


def recover_hint(path: Path) -> str:
    """What to do about a damaged file, as the end of the sentence that says what is wrong with it."""
    return f"; run: igtl-gateway recover {shlex.quote(str(path))}"


def message_bound(size: int) -> int:
    """Messages that a file of so many bytes may have: one for each byte, as they differ in their times at least."""
    return max(limits.current_limits().count // 10, size)


def check_chunk(packed: int, size: int, place: str) -> None:
    """Raise LimitExceeded if ``packed`` bytes of a chunk may not become ``size``.

    Zeros pack to a 250th with lz4, as label maps nearly do: the ratio alone does not bound what a small file costs.
    """
    limits.check_unpacked(packed, size, place)
    limits.check_limit("free", size, place, max(3 * limits.current_limits().free, _PLAUSIBLE_RATIO * packed))


def check_work(file_size: int, work: int, place: str) -> None:
    """Raise LimitExceeded if unpacking so many bytes of a file takes too long."""
    current = limits.current_limits()
    most = (current.seconds + current.seconds_per_mb * file_size // 1_000_000) * _BYTES_PER_SECOND
    if work > most:
        raise limits.exceeded("seconds", f"{work} bytes unpacked", place, f"{most} bytes")


def work_of(chunks: Iterable[ChunkEntry]) -> int:
    """Bytes of all of these chunks, unpacked."""
    return sum(chunk.size for chunk in chunks)


def _ends(path: Path, stream: IO[bytes]) -> tuple[int, int, int]:
    """Size of the file, start of its summary (0: there is none) and of its footer; both ends are checked."""
    try:
        size = stream.seek(0, 2)
        stream.seek(0)
        start = stream.read(len(MAGIC))
        if not start:
            raise UnsupportedRecording(f"{path}: the file is empty")
        if not MAGIC.startswith(start):
            raise UnsupportedRecording(f"{path}: not an MCAP file: found {start.hex(' ')}, expected {MAGIC.hex(' ')}")
        if size < len(MAGIC) + FOOTER_RECORD.size:
            raise _no_end_error(path, stream, size)
        end = stream.seek(-FOOTER_RECORD.size, 2)
        footer = stream.read(FOOTER_RECORD.size)
        opcode, length, summary_start, _, crc, magic = FOOTER_RECORD.unpack(footer)
        if magic != MAGIC:
            raise _no_end_error(path, stream, size)
        if (
            (opcode, length) != (records.FOOTER, records.FOOTER_LENGTH)
            or summary_start > end
            or 0 < summary_start < len(MAGIC)
        ):
            raise DamagedRecording(f"{path}: its footer is damaged{recover_hint(path)}")
        if crc:
            begin = summary_start or end
            limits.check_limit("memory", end - begin, f"{path}: summary")
            stream.seek(begin)
            found = zlib.crc32(footer[:_FOOTER_CRC_COVERS], zlib.crc32(stream.read(end - begin)))
            if found != crc:
                raise DamagedRecording(
                    f"{path}: found checksum {found:08x} of its index, expected {crc:08x}{recover_hint(path)}"
                )
    except OSError as error:
        raise DamagedRecording(f"{path}: cannot be read: {error.strerror}") from None
    return size, summary_start, end


def _no_end_error(path: Path, stream: IO[bytes], size: int) -> DamagedRecording:
    """The error for a file without an end: somebody is writing it, or it was cut off."""
    if files.is_being_written(stream):
        return BeingRecorded(
            f"{path}: is being recorded ({size:,} bytes so far) and can be read when the recording has ended; "
            f"igtl-gateway info {shlex.quote(str(path))} tells what is there"
        )
    return DamagedRecording(f"{path}: was cut off after {size:,} bytes{recover_hint(path)}")


def _summary(path: Path, stream: IO[bytes], size: int, start: int, end: int) -> tuple[Index, Statistics | None]:
    """What the summary says."""
    index, told = Index(size), None
    if not start:
        return index, None
    place = f"{path}: summary"
    limits.check_limit("memory", end - start, place)
    stream.seek(start)
    data = stream.read(end - start)
    for opcode, at, stop in records.records(data, "summary"):
        content = data[at:stop]
        if opcode in (records.SCHEMA, records.CHANNEL):
            index.define(opcode, content)
        elif opcode == records.STATISTICS:
            told = records.parse_statistics(content)
        elif opcode == records.CHUNK_INDEX:
            index.chunks.append(_chunk_index(content))
            limits.check_limit("count", len(index.chunks), place)
        elif opcode in (records.ATTACHMENT_INDEX, records.METADATA_INDEX):
            places = index.attachments if opcode == records.ATTACHMENT_INDEX else index.metadata
            places.append(_place(opcode, content))
            limits.check_limit("count", len(places), place)
    if told:
        index.counts = told.channel_message_counts
        index.start_ns, index.end_ns = told.message_start_time, told.message_end_time
        if sum(index.counts.values()) != told.message_count:
            raise Malformed(f"found {sum(index.counts.values())} messages by channel, expected {told.message_count}")
    index.chunks.sort(key=_at)
    return index, told


def _at(chunk: ChunkEntry) -> int:
    return chunk.at


def _chunk_index(data: bytes) -> ChunkEntry:
    content = RecordFields(data, "chunk index")
    start_ns, end_ns, at, length = (content.number(records.U64) for _ in range(4))
    places = content.blob()
    if len(places) % _PLACE.size:
        raise Malformed(f"chunk index: found {len(places)} bytes of offsets, expected a multiple of {_PLACE.size}")
    index_length = content.number(records.U64)
    content.text()
    content.number(records.U64)
    return ChunkEntry(start_ns, end_ns, at, length, content.number(records.U64), places, index_length)


def _place(opcode: int, data: bytes) -> RecordPlace:
    content = RecordFields(data, "index")
    at, length = content.number(records.U64), content.number(records.U64)
    if opcode == records.ATTACHMENT_INDEX:
        content.take(3 * records.U64.size)
    return RecordPlace(content.text(), at, length)


def _is_complete(index: Index, told: Statistics | None) -> bool:
    """Whether the summary has all that reading needs, by its own counts."""
    return (
        told is not None
        and told.chunk_count == len(index.chunks)
        and (bool(index.chunks) or not told.message_count)
        and told.channel_count <= len(index.channels)
        and index.counts.keys() <= index.channels.keys()
        and told.attachment_count == len(index.attachments)
        and told.metadata_count == len(index.metadata)
        and all(channel.schema_id in index.schemas for channel in index.channels.values() if channel.schema_id)
    )


def _check_chunks(index: Index, data_end: int) -> None:
    """Raise Malformed where chunks are not in the data section, or overlap."""
    for chunk in index.chunks:
        if chunk.at < len(MAGIC) or chunk.length < HEAD.size or chunk.at + chunk.length + chunk.index_length > data_end:
            raise Malformed(f"found a chunk of {chunk.length} bytes at {chunk.at}, expected it before {data_end}")
    for one, two in pairwise(index.chunks):
        if one.at + one.length > two.at:
            raise Malformed(f"found a chunk at {two.at}, expected none before {one.at + one.length}")


class _Scan:
    """One pass over the data section of a file."""

    def __init__(self, path: Path, stream: IO[bytes], size: int, data_end: int) -> None:
        self._place, self._stream, self._end = str(path), stream, data_end
        self._index = Index(size, scanned=True)
        self._messages = self._work = 0
        # loose messages: where they begin, first and last time, how many
        self._run: tuple[int, int, int, int] | None = None
        self._deadline = limits.Deadline(files.stored_bytes(path, size))

    def run(self, told: Statistics | None) -> Index:
        """The index.  Raises Malformed where it does not have as many messages as it was told."""
        index, at = self._index, len(MAGIC)
        while at < self._end:
            opcode, end = self._head(at)
            if self._run and (opcode != records.MESSAGE or at - self._run[0] >= _PIECE):
                self._end_run(at)
            if opcode == records.MESSAGE:
                self._loose(at, end)
            elif opcode in (records.SCHEMA, records.CHANNEL):
                index.define(opcode, self._content(at, end))
            elif opcode == records.CHUNK:
                self._chunk(at, end)
            elif opcode in (records.ATTACHMENT, records.METADATA):
                self._named(opcode, at, end)
            at = end
            if opcode == records.DATA_END:
                break
            self._deadline.check(self._place)
        if self._run:
            self._end_run(at)
        if told and told.message_count != self._messages:
            raise Malformed(f"found {self._messages} messages, expected {told.message_count}")
        return index

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode of the record at ``at``, and where it ends."""
        self._stream.seek(at)
        head = self._stream.read(HEAD.size)
        if len(head) < HEAD.size or at + HEAD.size > self._end:
            raise Malformed(f"found {self._end - at} bytes at {at}, expected a record")
        opcode, length = HEAD.unpack(head)
        end = at + HEAD.size + length
        if end > self._end:
            raise Malformed(f"found a record of {length} bytes at {at}, expected it before {self._end}")
        return opcode, end

    def _content(self, at: int, end: int, most: int | None = None) -> bytes:
        size = end - at - HEAD.size
        limits.check_limit("memory", size, f"{self._place}: record at offset {at}")
        self._stream.seek(at + HEAD.size)
        return self._stream.read(size if most is None else min(size, most))

    def _named(self, opcode: int, at: int, end: int) -> None:
        """An attachment or a metadata record."""
        self._stream.seek(at + HEAD.size + (2 * records.U64.size if opcode == records.ATTACHMENT else 0))
        size = int.from_bytes(self._stream.read(records.U32.size), "little")
        limits.check_limit("free", size, f"{self._place}: name at offset {at}")
        places = self._index.attachments if opcode == records.ATTACHMENT else self._index.metadata
        name = self._stream.read(min(size, end - at))
        places.append(RecordPlace(name.decode("utf-8", "replace"), at, end - at))
        limits.check_limit("count", len(places), self._place)

    def _count(self, channel: int) -> None:
        counts = self._index.counts
        counts[channel] = counts.get(channel, 0) + 1
        self._messages += 1
        if not self._messages & 0xFFFF:
            limits.check_limit("count", self._messages, self._place, message_bound(self._index.size))
            self._deadline.check(self._place)

    def _add(self, chunk: ChunkEntry, messages: int) -> None:
        index = self._index
        if messages:
            first = self._messages == messages
            index.start_ns = chunk.start_ns if first else min(index.start_ns, chunk.start_ns)
            index.end_ns = max(index.end_ns, chunk.end_ns)
        index.chunks.append(chunk)
        limits.check_limit("count", len(index.chunks), self._place)

    def _loose(self, at: int, end: int) -> None:
        head = self._content(at, end, MESSAGE_HEAD.size)
        if len(head) < MESSAGE_HEAD.size:
            raise Malformed(f"found a message of {len(head)} bytes at {at}, expected {MESSAGE_HEAD.size} and more")
        channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack(head)
        self._count(channel)
        begin, first, last, number = self._run or (at, stamp_ns, stamp_ns, 0)
        self._run = begin, min(first, stamp_ns), max(last, stamp_ns), number + 1

    def _end_run(self, end: int) -> None:
        assert self._run
        begin, first, last, number = self._run
        self._add(ChunkEntry(first, last, begin, end - begin, end - begin, loose=True), number)
        self._run = None

    def _chunk(self, at: int, end: int) -> None:
        data = packed_chunk(self._stream, ChunkEntry(0, 0, at, end - at, 0), self._place).unpack()
        self._work += len(data)
        check_work(self._index.size, self._work, self._place)
        before, first, last = self._messages, 1 << 64, 0
        for opcode, start, stop in records.records(data, f"chunk at offset {at}"):
            if opcode == records.MESSAGE:
                if stop - start < MESSAGE_HEAD.size:
                    raise Malformed(f"found a message of {stop - start} bytes in the chunk at {at}")
                channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
                first, last = min(first, stamp_ns), max(last, stamp_ns)
                self._count(channel)
            elif opcode in (records.SCHEMA, records.CHANNEL):
                self._index.define(opcode, data[start:stop])
        number = self._messages - before
        self._add(ChunkEntry(first if number else 0, last, at, end - at, len(data)), number)


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk as it lies in the file; ``place`` is where, for errors."""

    place: str
    compression: str
    data: bytes
    size: int
    crc: int

    def unpack(self) -> bytes:
        """Its records.  Raises Malformed."""
        try:
            return unpacked(self.compression, self.data, self.size, self.crc)
        except Malformed as error:
            raise Malformed(f"{self.place}: {error}") from None


def packed_chunk(stream: IO[bytes], entry: ChunkEntry, path: str) -> PackedChunk:
    """Read a chunk.  Raises Malformed, or LimitExceeded for one that asks for too much memory."""
    place = f"chunk at offset {entry.at:,}"
    limits.check_limit("memory", entry.length, f"{path}: {place}")
    stream.seek(entry.at)
    if entry.loose:
        return PackedChunk(place, "", stream.read(entry.length), entry.length, 0)
    content = RecordFields(stream.read(min(entry.length, _CHUNK_BEGIN)), place)
    head = content.take(HEAD.size)
    if HEAD.unpack(head) != (records.CHUNK, entry.length - HEAD.size):
        raise Malformed(f"{place}: found {head.hex(' ')}, expected a chunk of {entry.length} bytes")
    _, _, size, crc = CHUNK_HEAD.unpack(content.take(CHUNK_HEAD.size))
    compression, packed = content.text(), content.number(records.U64)
    if packed > entry.length - content.at:
        raise Malformed(f"{place}: found {packed} bytes of data, expected at most {entry.length - content.at}")
    check_chunk(packed, size, f"{path}: {place}")
    stream.seek(entry.at + content.at)
    return PackedChunk(place, compression, stream.read(packed), size, crc)

"""An MCAP file being written: chunks of messages, then the summary.  What is said of it elsewhere is written here.

The library's own writer makes objects of each message and copies a payload seven times.  Here a message is packed
once, behind those before it; a large one is not even that: it ends its chunk, and goes from where it lies into the
compressor or into the file.

lz4 is for speed: where several large chunks of a stream in a row hardly get smaller, the next ones are written as they
are, and now and then one is tried again.  zstd is for size: everything is compressed, and a chunk goes
on behind a large message, since what an input has become has much in common with it.
"""

from __future__ import annotations

import struct
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import lru_cache
from io import BufferedWriter, BytesIO
from typing import Literal

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from fastcrc import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from igtl_gateway.buffers import Buffer

Compression = Literal["lz4", "zstd", "none"]

#: Uncompressed size of a chunk: what a reader has to hold, and unpacks to see one message.
CHUNK_BYTES = 1 << 20

#: A message of this part of a chunk's size is large.
_LARGE = 4

#: Compressed size, of the uncompressed one, from which on compressing is not worth the while.
_POOR = 0.9
#: After so many such chunks in a row ...
_TRIES = 4
#: ... so many are written as they are, before the next is tried.
_REST = 31


def _lz4(parts: Sequence[Buffer], size: int) -> tuple[bytes, ...]:
    """One frame of all parts, which are not put together for it."""
    context = lz4.frame.create_compression_context()
    begin = lz4.frame.compress_begin(context, source_size=size)
    middle = [lz4.frame.compress_chunk(context, part) for part in parts]
    return begin, *middle, lz4.frame.compress_flush(context)


def _zstd(parts: Sequence[Buffer], _size: int) -> tuple[bytes, ...]:
    return (zstandard.compress(b"".join(parts)),)


_Compress = Callable[[Sequence[Buffer], int], tuple[bytes, ...]]
_COMPRESS: dict[Compression, tuple[str, _Compress | None]] = {
    "lz4": ("lz4", _lz4),
    "zstd": ("zstd", _zstd),
    "none": ("", None),
}

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode and length; channel, sequence, log and publish time
_MESSAGE_BYTES = _MESSAGE.size - 9
_CHUNK = struct.Struct("<BQQQQII")  # opcode and length; first and last time, size, CRC, length of what follows: a name
_CHUNK_BYTES = _CHUNK.size - 9
_INDEX_BYTES = struct.calcsize("<HI")  # of a message index before its pairs of times and places
_SIZE = struct.Struct("<Q")
_FOOTER = struct.Struct("<BQQQ")  # the part of it that its CRC covers
_FOOTER_BYTES = 20


@lru_cache(maxsize=1024)
def _index(numbers: int) -> struct.Struct:
    """A message index: opcode and length; channel, length of the rest, pairs of times and places."""
    return struct.Struct(f"<BQHI{numbers}Q")


@lru_cache(maxsize=256)
def _chunk_index(channels: int, name: int) -> struct.Struct:
    """A chunk's index: opcode and length; first and last time, place and size of the chunk; size of what follows,
    channels and the places of their message indexes; their size; the compression's name, size after and before it."""
    return struct.Struct(f"<BQQQQQI{'HQ' * channels}QI{name}sQQ")


class McapStream:
    """Writes one file.  Every call may raise OSError; after that nothing else may be called.

    Args:
        file: takes the bytes; it is not closed here.
        chunk_bytes: size at which a chunk ends.
        compression: of the chunks.
    """

    def __init__(self, file: BufferedWriter | BytesIO, *, chunk_bytes: int, compression: Compression) -> None:
        #: Bytes written so far.
        self.size = 0
        self._file = file
        self._chunk_bytes = chunk_bytes
        self._large = sys.maxsize if compression == "zstd" else chunk_bytes // _LARGE
        self._compression, self._compress = _COMPRESS[compression]
        self._poor: dict[int, int] = {}  # large chunks in a row that gained little, by channel of the large message
        self._chunk = bytearray()
        self._messages: defaultdict[int, list[int]] = defaultdict(list)  # of the chunk, by channel: time, place, time …
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks = bytearray()  # the records that tell of them
        self._chunk_count = self._first = self._last = 0
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}

    def start(self, profile: str, library: str) -> None:
        """To be called first."""
        self._put(MCAP0_MAGIC)
        self._put(_packed(Header(profile, library)))

    def add_metadata(self, name: str, items: dict[str, str]) -> None:
        """A metadata record, before the messages that wait for their chunk's end."""
        data = _packed(Metadata(name=name, metadata=items))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(data), name=name))
        self._put(data)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """An attachment without times, as add_metadata."""
        record = _packed(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self._attachments.append(
            AttachmentIndex(
                offset=self.size, length=len(record), create_time=0, log_time=0, data_size=len(data), name=name,
                media_type=media_type,
            )
        )  # fmt: skip
        self._put(record)

    def register_schema(self, name: str, encoding: str, text: bytes) -> int:
        """A schema, in the chunk and between the chunks; gives its number."""
        schema = Schema(id=len(self._schemas) + 1, data=text, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._define(schema)
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """A channel, in the chunk and between the chunks; gives its number."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=metadata)
        self._channels.append(channel)
        self._define(channel)
        return number

    def _define(self, record: McapRecord) -> None:
        data = _packed(record)
        self._chunk += data
        self._end_full_chunk()
        self._put(data)

    def add_message(
        self, channel: int, log_time: int, head: bytes, data: Buffer, publish_time: int, sequence: int
    ) -> None:
        """A message, in two pieces; ``data`` may change as soon as this returns.  Times and numbers have to fit."""
        size = len(head) + len(data)
        chunk = self._chunk
        begin = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_BYTES + size, channel, sequence, log_time, publish_time)
        self._messages[channel] += (log_time, len(chunk))
        chunk += begin
        chunk += head
        if size >= self._large:
            self._end_chunk(channel, data)
        else:
            chunk += data
            if len(chunk) > self._chunk_bytes:
                self._end_chunk()

    def flush(self) -> None:
        """End the chunk, and hand all to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """Write the end of the file; nothing can be added after that."""
        self._end_chunk()
        self._put(_packed(DataEnd(0)))
        start = self.size
        data = bytearray()
        offsets: list[SummaryOffset] = []
        groups: tuple[tuple[Opcode, Buffer], ...] = (
            (Opcode.SCHEMA, _packed(*self._schemas)),
            (Opcode.CHANNEL, _packed(*self._channels)),
            (Opcode.STATISTICS, _packed(self._statistics())),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, _packed(*self._attachments)),
            (Opcode.METADATA_INDEX, _packed(*self._metadata)),
        )
        for opcode, records in groups:
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + len(data), group_length=len(records)))
            data += records
        offset_start = start + len(data)
        data += _packed(*offsets)
        crc = crc32.iso_hdlc(_FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offset_start), crc32.iso_hdlc(data))
        self._put(data)
        self._put(_packed(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)))
        self._put(MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self._first,
            message_end_time=self._last,
            schema_count=len(self._schemas),
        )

    def _end_chunk(self, channel: int = 0, rest: Buffer = b"") -> None:
        """Write the chunk, if there is a message in it; ``rest``: the end of its last one, a large one of a channel."""
        if not self._messages:
            return
        size = len(self._chunk) + len(rest)
        crc = crc32.iso_hdlc(self._chunk)
        if rest:
            crc = crc32.iso_hdlc(rest, crc)
        compression, parts = self._compressed(channel, rest, size)
        length = sum(map(len, parts))
        first = min(min(found[::2]) for found in self._messages.values())
        last = max(max(found[::2]) for found in self._messages.values())
        name = compression.encode()
        begin = self.size
        rest_of_head = name + _SIZE.pack(length)
        head_size = _CHUNK_BYTES + len(rest_of_head)
        self._put(_CHUNK.pack(Opcode.CHUNK, head_size + length, first, last, size, crc, len(name)) + rest_of_head)
        for part in parts:
            self._put(part)
        end = self.size
        places: list[int] = []  # by channel: its number, the place of its index
        index = bytearray()
        counts = self._counts
        for number, found in self._messages.items():
            places += (number, end + len(index))
            numbers = len(found)
            index += _index(numbers).pack(Opcode.MESSAGE_INDEX, _INDEX_BYTES + 8 * numbers, number, 8 * numbers, *found)
            counts[number] = counts.get(number, 0) + numbers // 2
        self._put(index)
        record = _chunk_index(len(places) // 2, len(name))
        self._chunks += record.pack(
            Opcode.CHUNK_INDEX, record.size - 9, first, last, begin, end - begin, 5 * len(places), *places, len(index),
            len(name), name, length, size,
        )  # fmt: skip
        self._first = min(self._first, first) if self._chunk_count else first
        self._last = max(self._last, last)
        self._chunk_count += 1
        self._chunk.clear()
        self._messages.clear()

    def _end_full_chunk(self) -> None:
        if len(self._chunk) > self._chunk_bytes:
            self._end_chunk()

    def _compressed(self, channel: int, rest: Buffer, size: int) -> tuple[str, tuple[Buffer, ...]]:
        """How the chunk is compressed, and the parts of what is to be written."""
        plain = (self._chunk, rest) if rest else (self._chunk,)
        if self._compress is None:
            return "", plain
        poor = self._poor.get(channel, 0) if size >= self._large else 0
        if _TRIES <= poor < _TRIES + _REST:
            self._poor[channel] = poor + 1
            return "", plain
        packed = self._compress(plain, size)
        if size < self._large:
            return self._compression, packed
        if sum(map(len, packed)) <= size * _POOR:
            self._poor[channel] = 0
            return self._compression, packed
        self._poor[channel] = min(poor + 1, _TRIES)
        return "", plain

    def _put(self, data: Buffer) -> None:
        self._file.write(data)
        self.size += len(data)


def _packed(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()  # type: ignore[no-untyped-call, no-any-return]

"""MCAP records as bytes: opcodes, layouts, and the fields of each record, packed and parsed.

This is the only place that knows how MCAP lays out its records.  The library's record classes (``mcap.records``) hold
the values and pack small records; only code of this folder parses.  Bytes behind the fields of a record belong to later
versions of MCAP and are ignored.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache

from fastcrc.crc32 import iso_hdlc
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, Header, McapRecord, Metadata, Schema, Statistics

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.quantities import counted

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
#: Opcodes from here on are for applications.
PRIVATE = 0x80
#: Records that describe messages.
DEFINITIONS = (SCHEMA, CHANNEL)

U16, U32, U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
#: Opcode and length of the content.
HEAD = struct.Struct("<BQ")
#: Channel, sequence, log_time, publish_time.
MESSAGE_HEAD = struct.Struct("<HIQQ")
#: A message with its HEAD.
MESSAGE_RECORD = struct.Struct("<BQHIQQ")
#: First and last time, uncompressed size and checksum.
CHUNK_HEAD = struct.Struct("<QQQI")
#: Channel, and bytes of the pairs (time, offset) that follow.
MESSAGE_INDEX_HEAD = struct.Struct("<HI")
#: In a chunk index: channel, and offset of its message index.
INDEX_OFFSET = struct.Struct("<HQ")
#: The end of every file: opcode, length, summary_start, summary_offset_start, summary_crc, magic.
FOOTER_RECORD = struct.Struct("<BQQQI8s")
FOOTER_LENGTH = 20
#: Bytes of the footer that the checksum of the summary covers.
FOOTER_COVERED = FOOTER_RECORD.size - U32.size - len(MAGIC)

#: Fields of each record of a data section: bytes of fixed size, or a length (4 or 8 bytes) with that number of bytes.
FIELDS: dict[int, tuple[int | struct.Struct, ...]] = {
    HEADER: (U32, U32),
    SCHEMA: (2, U32, U32, U32),
    CHANNEL: (4, U32, U32, U32),
    CHUNK: (CHUNK_HEAD.size, U32, U64),
    MESSAGE_INDEX: (2, U32),
    ATTACHMENT: (16, U32, U32, U64, 4),
    METADATA: (U32, U32),
    DATA_END: (4,),
}


class Malformed(ValueError):
    """Bytes that are not the expected record."""


def crc32(data: Buffer, before: int = 0) -> int:
    """The checksum that MCAP uses everywhere; ``before``: that of the bytes in front of ``data``."""
    return iso_hdlc(data, before)


# --- parsing ---------------------------------------------------------------------------------------------------


class RecordFields:
    """The fields of a record, taken one after the other.

    Args:
        data: the content of the record.
        name: of the record, for errors.

    Every method raises Malformed where the content ends too early.
    """

    __slots__ = ("_data", "_name", "at")

    def __init__(self, data: bytes, name: str) -> None:
        self._data, self._name, self.at = data, name, 0

    def number(self, size: struct.Struct) -> int:
        """An unsigned number."""
        return int(size.unpack(self.take(size.size))[0])

    def text(self) -> str:
        """A string with its length in front."""
        data = self.blob()
        try:
            return str(data, "utf-8")
        except UnicodeDecodeError:
            raise Malformed(f"{self._name}: found the text {data[:40]!r}, expected UTF-8") from None

    def blob(self, size: struct.Struct = U32) -> bytes:
        """Bytes with their length in front."""
        return self.take(self.number(size))

    def texts(self) -> dict[str, str]:
        """A map of strings."""
        inner = RecordFields(self.blob(), self._name)
        found = {}
        while inner.at < len(inner._data):
            key = inner.text()
            found[key] = inner.text()
        return found

    def take(self, size: int) -> bytes:
        """The next ``size`` bytes."""
        end = self.at + size
        if end > len(self._data):
            left = len(self._data) - self.at
            raise Malformed(
                f"{self._name}: found {counted(left, 'byte')} at byte {self.at} of its content, expected {size}"
            )
        data = self._data[self.at : end]
        self.at = end
        return data


def parse_header(data: bytes) -> Header:
    """Parse the content of a record.  Raises Malformed, like the following functions."""
    fields = RecordFields(data, "header")
    profile = fields.text()
    return Header(profile=profile, library=fields.text())


def parse_schema(data: bytes) -> Schema:
    fields = RecordFields(data, "schema")
    number = fields.number(U16)
    if not number:
        raise Malformed("schema: found the number 0, expected another one")
    name, encoding = fields.text(), fields.text()
    return Schema(id=number, data=fields.blob(), encoding=encoding, name=name)


def parse_channel(data: bytes) -> Channel:
    fields = RecordFields(data, "channel")
    number, schema_id = fields.number(U16), fields.number(U16)
    topic, encoding = fields.text(), fields.text()
    return Channel(id=number, topic=topic, message_encoding=encoding, metadata=fields.texts(), schema_id=schema_id)


def parse_metadata(data: bytes) -> Metadata:
    fields = RecordFields(data, "metadata")
    name = fields.text()
    return Metadata(name=name, metadata=fields.texts())


def parse_attachment(data: bytes) -> Attachment:
    fields = RecordFields(data, "attachment")
    log_time, create_time = fields.number(U64), fields.number(U64)
    name, media_type = fields.text(), fields.text()
    content = fields.blob(U64)
    covered = fields.at
    if (crc := fields.number(U32)) and crc != crc32(data[:covered]):  # 0: it has none
        raise Malformed("attachment: its checksum is wrong")
    return Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=content)


def parse_statistics(data: bytes) -> Statistics:
    fields = RecordFields(data, "statistics")
    messages, schemas = fields.number(U64), fields.number(U16)
    channels, attachments, metadata_count, chunks = (fields.number(U32) for _ in range(4))
    start, end = fields.number(U64), fields.number(U64)
    pairs = fields.blob()
    if len(pairs) % 10:
        raise Malformed(f"statistics: found {counted(len(pairs), 'byte')} of counts, expected a multiple of 10")
    return Statistics(
        attachment_count=attachments,
        channel_count=channels,
        channel_message_counts=dict(struct.iter_unpack("<HQ", pairs)),
        chunk_count=chunks,
        message_count=messages,
        message_end_time=end,
        message_start_time=start,
        metadata_count=metadata_count,
        schema_count=schemas,
    )


def records(data: bytes, place: str) -> Iterator[tuple[int, int, int]]:
    """Opcode, first and last offset of the content of consecutive records.  Raises Malformed at one that is cut."""
    at, size = 0, len(data)
    while at < size:
        if size - at < HEAD.size:
            raise Malformed(f"{place}: found {counted(size - at, 'byte')} after {at}, expected a record")
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > size - at:
            raise Malformed(
                f"{place}: found a record of {counted(length, 'byte')} at {at}, expected at most {size - at}"
            )
        yield opcode, at, at + length
        at += length


# --- packing ---------------------------------------------------------------------------------------------------


def pack(*given: McapRecord) -> bytes:
    """Records as bytes, by the library."""
    builder = RecordBuilder()
    for record in given:
        record.write(builder)
    return builder.end()  # type: ignore[no-untyped-call]


def pack_chunk_head(first: int, last: int, size: int, crc: int, compression: str, packed: int) -> bytes:
    """A chunk record up to its data, which are ``packed`` bytes; the other arguments are fields of the record."""
    name = compression.encode()
    length = CHUNK_HEAD.size + U32.size + len(name) + U64.size + packed
    return b"".join(
        (HEAD.pack(CHUNK, length), CHUNK_HEAD.pack(first, last, size, crc), U32.pack(len(name)), name, U64.pack(packed))
    )


def pack_message_index(channel: int, pairs: Sequence[int]) -> bytes:
    """A message index: ``pairs`` are time, offset, time, offset …"""
    size = 8 * len(pairs)
    return _message_index(len(pairs)).pack(MESSAGE_INDEX, MESSAGE_INDEX_HEAD.size + size, channel, size, *pairs)


def pack_chunk_index(
    first: int, last: int, at: int, length: int, offsets: Sequence[int], index_length: int, compression: str,
    packed: int, size: int,
) -> bytes:  # fmt: skip
    """A chunk index: ``offsets`` are channel, offset of its message index, channel …"""
    name = compression.encode()
    record = _chunk_index(len(offsets) // 2, len(name))
    return record.pack(
        CHUNK_INDEX, record.size - HEAD.size, first, last, at, length, 5 * len(offsets), *offsets, index_length,
        len(name), name, packed, size,
    )  # fmt: skip


@lru_cache(maxsize=1024)
def _message_index(numbers: int) -> struct.Struct:
    return struct.Struct(f"<BQHI{numbers}Q")


@lru_cache(maxsize=256)
def _chunk_index(channels: int, name: int) -> struct.Struct:
    return struct.Struct(f"<BQQQQQI{'HQ' * channels}QI{name}sQQ")

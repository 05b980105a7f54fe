"""MCAP records as bytes: opcodes, heads, and the fields of a record's content.

Records of the library (``mcap.records``) hold the values; nothing of the library reads them.  Bytes behind the fields
of a record belong to later versions of MCAP and are passed over.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from mcap.records import Attachment, Channel, Header, Metadata, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
#: Opcodes from here on are for whoever wants them.
PRIVATE = 0x80

#: Opcode and length of the content.
HEAD = struct.Struct("<BQ")
#: Channel, sequence, log_time, publish_time.
MESSAGE_HEAD = struct.Struct("<HIQQ")
#: First and last time, uncompressed size and checksum.
CHUNK_HEAD = struct.Struct("<QQQI")
#: The end of every file: opcode, length, summary_start, summary_offset_start, summary_crc, magic.
FOOTER_RECORD = struct.Struct("<BQQQI8s")
FOOTER_LENGTH = 20

U16, U32, U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class Malformed(ValueError):
    """Bytes that are not the record that they should be."""


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
        """So many bytes."""
        end = self.at + size
        if end > len(self._data):
            left = len(self._data) - self.at
            raise Malformed(f"{self._name}: found {left} bytes at byte {self.at} of its content, expected {size}")
        data = self._data[self.at : end]
        self.at = end
        return data


def parse_header(data: bytes) -> Header:
    """Raises Malformed, like the following."""
    content = RecordFields(data, "header")
    profile = content.text()
    return Header(profile=profile, library=content.text())


def parse_schema(data: bytes) -> Schema:
    content = RecordFields(data, "schema")
    number = content.number(U16)
    if not number:
        raise Malformed("schema: found the number 0, expected another one")
    name, encoding = content.text(), content.text()
    return Schema(id=number, data=content.blob(), encoding=encoding, name=name)


def parse_channel(data: bytes) -> Channel:
    content = RecordFields(data, "channel")
    number, schema_id = content.number(U16), content.number(U16)
    topic, encoding = content.text(), content.text()
    return Channel(
        id=number, topic=topic, message_encoding=encoding, metadata=content.texts(), schema_id=schema_id
    )  # fmt: skip


def parse_metadata(data: bytes) -> Metadata:
    content = RecordFields(data, "metadata")
    name = content.text()
    return Metadata(name=name, metadata=content.texts())


def parse_attachment(data: bytes) -> tuple[Attachment, int]:
    """The attachment, and how many of the bytes its checksum covers."""
    content = RecordFields(data, "attachment")
    log_time, create_time = content.number(U64), content.number(U64)
    name, media_type = content.text(), content.text()
    found = Attachment(
        create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=content.blob(U64)
    )
    return found, content.at


def parse_statistics(data: bytes) -> Statistics:
    content = RecordFields(data, "statistics")
    messages, schemas = content.number(U64), content.number(U16)
    channels, attachments, metadata_count, chunks = (content.number(U32) for _ in range(4))
    start, end = content.number(U64), content.number(U64)
    pairs = content.blob()
    if len(pairs) % 10:
        raise Malformed(f"statistics: found {len(pairs)} bytes of counts, expected a multiple of 10")
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
    """Opcode, first and last offset of the content of the records in a row.  Raises Malformed at one that is cut."""
    at, size = 0, len(data)
    while at < size:
        if size - at < HEAD.size:
            raise Malformed(f"{place}: found {size - at} bytes after {at}, expected a record")
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > size - at:
            raise Malformed(f"{place}: found a record of {length} bytes at {at}, expected at most {size - at}")
        yield opcode, at, at + length
        at += length

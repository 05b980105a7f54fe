"""MCAP files made record by record, right or wrong as the caller wants: for tests and for fuzzing.

Nothing here checks anything.  A file is a list of records of the data section, from which :func:`assemble` makes the
summary: a caller that changes a record gets right offsets, lengths and checksums around it, unless it asks for others.
https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MAGIC = b"\x89MCAP0\r\n"
(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS,
 METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END) = range(1, 16)  # fmt: skip

_MESSAGE_HEAD = struct.Struct("<HIQQ")


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """Opcode, length (that of the content, or what the caller claims) and content."""
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(value: str | bytes) -> bytes:
    """A string with its length in front."""
    data = value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def array(content: bytes) -> bytes:
    """An array or a map with its length in bytes in front."""
    return struct.pack("<I", len(content)) + content


def texts(items: Mapping[str, str]) -> bytes:
    """A map of strings."""
    return array(b"".join(text(key) + text(value) for key, value in items.items()))


def header(profile: str = "", library: str = "") -> bytes:
    return text(profile) + text(library)


def schema(number: int, name: str | bytes, encoding: str, data: bytes) -> bytes:
    return struct.pack("<H", number) + text(name) + text(encoding) + array(data)


def channel(
    number: int, schema_id: int, topic: str | bytes, encoding: str, metadata: Mapping[str, str] | None = None
) -> bytes:
    return struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + texts(metadata or {})


def message(channel_id: int, sequence: int, log_time: int, publish_time: int, data: bytes) -> bytes:
    return _MESSAGE_HEAD.pack(channel_id, sequence, log_time, publish_time) + data


def metadata(name: str | bytes, items: Mapping[str, str]) -> bytes:
    return text(name) + texts(items)


def attachment(name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0) -> bytes:
    begin = struct.pack("<QQ", log_time, create_time) + text(name) + text(media_type)
    begin += struct.pack("<Q", len(data)) + data
    return begin + struct.pack("<I", zlib.crc32(begin))


def statistics(
    messages: int, schemas: int, channels: int, attachments: int, metadata: int, chunks: int, start: int, end: int,
    counts: Mapping[int, int],
) -> bytes:  # fmt: skip
    numbers = struct.pack("<QHIIIIQQ", messages, schemas, channels, attachments, metadata, chunks, start, end)
    return numbers + array(b"".join(struct.pack("<HQ", *each) for each in counts.items()))


COMPRESS: Mapping[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "lz4": lz4.frame.compress,
    "zstd": zstandard.ZstdCompressor(level=1).compress,
}

#: Opcode and content of a record.
Record = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk; what is None is made right.

    Attributes:
        records: what is in it.
        compression: how, and what it calls that.
        packed: its compressed bytes, in place of those of the records.
        size, crc: uncompressed size and checksum that it claims.
        start, end: times that it claims.
    """

    records: tuple[Record, ...]
    compression: str = ""
    packed: bytes | None = None
    size: int | None = None
    crc: int | None = None
    start: int | None = None
    end: int | None = None

    def times(self) -> tuple[int, int]:
        stamps = [_MESSAGE_HEAD.unpack_from(content)[2] for content in _messages(self.records)]
        start, end = min(stamps, default=0), max(stamps, default=0)
        return start if self.start is None else self.start, end if self.end is None else self.end

    def plain(self) -> bytes:
        return b"".join(record(*each) for each in self.records)

    def content(self) -> bytes:
        plain = self.plain()
        packed = COMPRESS.get(self.compression, bytes)(plain) if self.packed is None else self.packed
        size = len(plain) if self.size is None else self.size
        crc = zlib.crc32(plain) if self.crc is None else self.crc
        return struct.pack("<QQQI", *self.times(), size, crc) + text(self.compression) + struct.pack(
            "<Q", len(packed)
        ) + packed  # fmt: skip

    def indexes(self) -> dict[int, list[tuple[int, int]]]:
        """By channel: time and offset of each message."""
        found: dict[int, list[tuple[int, int]]] = {}
        at = 0
        for opcode, content in self.records:
            if opcode == MESSAGE and len(content) >= _MESSAGE_HEAD.size:
                number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
                found.setdefault(number, []).append((log_time, at))
            at += 9 + len(content)
        return found


def _messages(records: Iterable[Record]) -> list[bytes]:
    return [content for opcode, content in records if opcode == MESSAGE and len(content) >= _MESSAGE_HEAD.size]


@dataclass(slots=True)
class Assembly:
    """A file in its two sections.

    Attributes:
        data: magic, header and data section, up to where the summary begins.
        summary: the records of the summary, in order.
    """

    data: bytes
    summary: list[Record] = field(default_factory=list)

    def finish(self, *, crc: int | None = None, offsets: bool = True, start: int | None = None) -> bytes:
        """The whole file; ``offsets``: with summary offsets; ``crc``, ``start``: what the footer claims."""
        return finish(self.data, self.summary, crc=crc, offsets=offsets, start=start)


def assemble(records: Sequence[Record | Chunk], *, message_index: bool = True) -> Assembly:
    """Lay out a data section, and make the summary that fits it."""
    data = bytearray(MAGIC)
    known: dict[tuple[int, int], bytes] = {}
    chunks: list[bytes] = []
    attachments: list[bytes] = []
    metadata_indexes: list[bytes] = []
    counts: dict[int, int] = {}
    stamps: list[int] = []

    def learn(opcode: int, content: bytes) -> None:
        if opcode in (SCHEMA, CHANNEL) and len(content) > 2:
            known.setdefault((opcode, int.from_bytes(content[:2], "little")), content)
        elif opcode == MESSAGE and len(content) >= _MESSAGE_HEAD.size:
            number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
            counts[number] = counts.get(number, 0) + 1
            stamps.append(log_time)

    for each in records:
        at = len(data)
        if isinstance(each, Chunk):
            data += record(CHUNK, each.content())
            end = len(data)
            places = b""
            for number, pairs in each.indexes().items() if message_index else ():
                places += struct.pack("<HQ", number, len(data))
                packed = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
                data += record(MESSAGE_INDEX, struct.pack("<H", number) + array(packed))
            packed_size = end - at - 9 - 40 - len(each.compression.encode())
            chunks.append(
                struct.pack("<QQQQ", *each.times(), at, end - at) + array(places) + struct.pack("<Q", len(data) - end)
                + text(each.compression) + struct.pack("<QQ", packed_size, len(each.plain()) if each.size is None
                                                       else each.size)
            )  # fmt: skip
            for inner in each.records:
                learn(*inner)
            continue
        opcode, content = each
        data += record(opcode, content)
        learn(opcode, content)
        place = struct.pack("<QQ", at, len(data) - at)
        if opcode == METADATA:
            metadata_indexes.append(place + content[: 4 + int.from_bytes(content[:4], "little")])
        elif opcode == ATTACHMENT and len(content) > 16:
            attachments.append(place + content[:16] + _rest_of_attachment_index(content))
    data += record(DATA_END, struct.pack("<I", 0))
    told = statistics(
        len(stamps), sum(opcode == SCHEMA for opcode, _ in known), sum(opcode == CHANNEL for opcode, _ in known),
        len(attachments), len(metadata_indexes), len(chunks), min(stamps, default=0), max(stamps, default=0), counts,
    )  # fmt: skip
    summary = [(opcode, content) for (opcode, _), content in sorted(known.items())]
    summary.append((STATISTICS, told))
    for opcode, indexes in (
        (CHUNK_INDEX, chunks), (ATTACHMENT_INDEX, attachments), (METADATA_INDEX, metadata_indexes),
    ):  # fmt: skip
        summary += [(opcode, index) for index in indexes]
    return Assembly(bytes(data), summary)


def _rest_of_attachment_index(content: bytes) -> bytes:
    """Data size, name and media type of an attachment, as its index has them."""
    name_end = 20 + int.from_bytes(content[16:20], "little")
    media_end = name_end + 4 + int.from_bytes(content[name_end : name_end + 4], "little")
    return content[media_end : media_end + 8] + content[16:media_end]


def finish(
    data: bytes, summary: Sequence[Record], *, crc: int | None = None, offsets: bool = True, start: int | None = None
) -> bytes:
    """A file of its data section and its summary; see :meth:`Assembly.finish`."""
    section = bytearray()
    groups: dict[int, tuple[int, int]] = {}
    for opcode, content in summary:
        first, size = groups.get(opcode, (len(data) + len(section), 0))
        packed = record(opcode, content)
        groups[opcode] = first, size + len(packed)
        section += packed
    offset_start = len(data) + len(section) if offsets and groups else 0
    for opcode, (first, size) in groups.items() if offsets else ():
        section += record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, first, size))
    begin = (len(data) if summary else 0) if start is None else start
    footer = struct.pack("<BQQQ", FOOTER, 20, begin, offset_start)
    found = zlib.crc32(footer, zlib.crc32(section)) if crc is None else crc
    return data + bytes(section) + footer + struct.pack("<I", found) + MAGIC


def parse(data: bytes) -> list[Record | Chunk]:
    """The data section of a sound file, chunks unpacked; its indexes are left out, as :func:`assemble` makes them."""
    found: list[Record | Chunk] = []
    for opcode, content in walk(data[len(MAGIC) :]):
        if opcode == DATA_END:
            break
        if opcode == CHUNK:
            size = struct.unpack_from("<Q", content, 16)[0]
            name = content[32 : 32 + int.from_bytes(content[28:32], "little")].decode()
            packed = content[40 + len(name) :]
            match name:
                case "zstd":
                    plain = zstandard.decompress(packed, max_output_size=size)
                case "lz4":
                    plain = lz4.frame.decompress(packed)
                case _:
                    plain = packed
            found.append(Chunk(tuple(walk(plain)), name))
        elif opcode != MESSAGE_INDEX:
            found.append((opcode, content))
    return found


def walk(data: bytes) -> Iterable[Record]:
    """Opcode and content of records in a row."""
    at = 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, data[at + 9 : at + 9 + length]
        at += 9 + length

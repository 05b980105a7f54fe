"""MCAP's conformance set, built: 416 files of six cases in every combination of features that makes sense.

The names, the cases and the order of records are facts of the published set (github.com/foxglove/mcap,
``tests/conformance``, commit 95d067356); none of its code or files is here.  ``conformance.sha256`` has the SHA-256 of
each published file; a test compares it with the built one.

Features, as they are in the names: ``ax`` attachment index, ``ch`` chunk, ``chx`` chunk index, ``mdx`` metadata index,
``mx`` message index, ``pad`` three more bytes at the end of records than their fields need, ``rch`` and ``rsh``
channels and schemas repeated in the summary, ``st`` statistics, ``sum`` summary offsets.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from tools import mcap_build as build
from tools.mcap_build import Record

FEATURES = ("ax", "ch", "chx", "mdx", "mx", "pad", "rch", "rsh", "st", "sum")
HASHES = Path(__file__).with_name("conformance.sha256")

_SCHEMA = (build.SCHEMA, build.schema(1, "Example", "c", b"\4\5\6"))
_CHANNEL = (build.CHANNEL, build.channel(1, 1, "example", "a", {"foo": "bar"}))
_TIMES = (0, 2, 1, 3, 3, 5, 4, 7, 8, 9)
CASES: dict[str, tuple[Record, ...]] = {
    "NoData": (),
    "OneSchemalessMessage": (
        (build.CHANNEL, build.channel(1, 0, "example", "text")),
        (build.MESSAGE, build.message(1, 10, 2, 1, b"\1\2\3")),
    ),
    "OneMessage": (_SCHEMA, _CHANNEL, (build.MESSAGE, build.message(1, 10, 2, 1, b"\1\2\3"))),
    "OneAttachment": (
        (build.ATTACHMENT, build.attachment("myFile", "application/octet-stream", b"\1\2\3", 2, 1)),
    ),
    "OneMetadata": ((build.METADATA, build.metadata("myMetadata", {"foo": "bar"})),),
    "TenMessages": (
        _SCHEMA,
        _CHANNEL,
        *((build.MESSAGE, build.message(1, at, time, time, b"\1\2\3")) for at, time in enumerate(_TIMES)),
    ),
}  # fmt: skip

_PAD = b"\x01\xff\xff"
_NOT_PADDED = frozenset({build.MESSAGE, build.CHUNK, build.DATA_END})
#: Feature → what a case must have for it.
_NEEDS = {
    "ax": {build.ATTACHMENT},
    "mdx": {build.METADATA},
    "rsh": {build.SCHEMA},
    "rch": {build.CHANNEL},
    **{name: {build.SCHEMA, build.CHANNEL, build.MESSAGE} for name in ("ch", "chx", "mx")},
}
#: What a summary offset may point at.
_GROUPS = frozenset({"ax", "chx", "mdx", "rch", "rsh", "st"})


@dataclass(frozen=True, slots=True)
class File:
    """A file of the set: its name, its bytes, and how many of each record are in its data section."""

    name: str
    data: bytes
    messages: int
    attachments: int
    metadata: int


def files() -> Iterator[File]:
    """All files of the set."""
    for case, given in CASES.items():
        for features in _variants(given):
            name = "-".join((case, *sorted(features)))
            counts = (sum(opcode == each for opcode, _ in given) for each in _COUNTED)
            yield File(name, _file(given, features), *counts)


_COUNTED = (build.MESSAGE, build.ATTACHMENT, build.METADATA)


def _variants(given: tuple[Record, ...]) -> Iterator[frozenset[str]]:
    opcodes = {opcode for opcode, _ in given}
    for number in range(len(FEATURES) + 1):
        for some in combinations(FEATURES, number):
            features = frozenset(some)
            if any(needed.isdisjoint(opcodes) for name, needed in _NEEDS.items() if name in features):
                continue
            if "sum" in features and not features & _GROUPS:
                continue
            if features & {"chx", "mx"} and "ch" not in features:
                continue
            yield features


def _file(given: tuple[Record, ...], features: frozenset[str]) -> bytes:
    def packed(opcode: int, content: bytes) -> bytes:
        return build.record(opcode, content + _PAD if "pad" in features and opcode not in _NOT_PADDED else content)

    data = bytearray(build.MAGIC + packed(build.HEADER, build.header()))
    groups: dict[int, list[bytes]] = {}
    in_chunk = [each for each in given if "ch" in features and each[0] in _NEEDS["ch"]]
    for opcode, content in given:
        if (opcode, content) in in_chunk:
            continue
        at = len(data)
        data += packed(opcode, content)
        place = struct.pack("<QQ", at, len(data) - at)
        if opcode == build.ATTACHMENT and "ax" in features:
            index = place + content[:16] + struct.pack("<Q", 3) + content[16 : -8 - 3 - 4]
            groups.setdefault(build.ATTACHMENT_INDEX, []).append(index)
        elif opcode == build.METADATA and "mdx" in features:
            groups.setdefault(build.METADATA_INDEX, []).append(place + content[: 4 + len("myMetadata")])
    if "ch" in features:
        chunk = build.Chunk(tuple(in_chunk))
        start, end = chunk.times()
        at = len(data)
        data += build.record(build.CHUNK, chunk.content())
        length, places = len(data) - at, b""
        for channel, pairs in chunk.indexes().items() if "mx" in features else ():
            places += struct.pack("<HQ", channel, len(data))
            content = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
            data += packed(build.MESSAGE_INDEX, struct.pack("<H", channel) + build.array(content))
        size = len(chunk.plain())
        if "chx" in features:
            index = struct.pack("<QQQQ", start, end, at, length) + build.array(places)
            index += struct.pack("<Q", len(data) - at - length) + build.text("") + struct.pack("<QQ", size, size)
            groups[build.CHUNK_INDEX] = [index]
    data += build.record(build.DATA_END, struct.pack("<I", zlib.crc32(data)))
    for opcode, name in ((build.SCHEMA, "rsh"), (build.CHANNEL, "rch")):
        if name in features:
            groups[opcode] = [content for each, content in given if each == opcode]
    if "st" in features:
        groups[build.STATISTICS] = [_statistics(given, "ch" in features)]
    return _end(data, {opcode: [packed(opcode, each) for each in some] for opcode, some in groups.items()}, features)


def _statistics(given: tuple[Record, ...], chunked: bool) -> bytes:
    number = {opcode: sum(each == opcode for each, _ in given) for opcode in range(16)}
    times = [int.from_bytes(content[6:14], "little") for opcode, content in given if opcode == build.MESSAGE]
    return build.statistics(
        len(times), number[build.SCHEMA], number[build.CHANNEL], number[build.ATTACHMENT], number[build.METADATA],
        int(chunked), min(times, default=0), max(times, default=0), {1: len(times)} if times else {},
    )  # fmt: skip


#: The groups of the summary in their order.
_ORDER = (
    build.SCHEMA,
    build.CHANNEL,
    build.STATISTICS,
    build.METADATA_INDEX,
    build.ATTACHMENT_INDEX,
    build.CHUNK_INDEX,
)


def _end(data: bytearray, groups: dict[int, list[bytes]], features: frozenset[str]) -> bytes:
    """The summary, the footer and the magic."""
    start = len(data)
    offsets = b""
    for opcode in _ORDER:
        group = b"".join(groups.get(opcode, ()))
        if group:
            content = struct.pack("<BQQ", opcode, len(data), len(group)) + (_PAD if "pad" in features else b"")
            offsets += build.record(build.SUMMARY_OFFSET, content)
            data += group
    has_summary = len(data) > start
    offset_start = 0
    if "sum" in features:
        offset_start = len(data)
        data += offsets
    footer = struct.pack("<BQQQ", build.FOOTER, 20, start if has_summary else 0, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(data[start:]))
    return bytes(data) + footer + struct.pack("<I", crc) + build.MAGIC

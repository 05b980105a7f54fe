"""Mutants of MCAP files for fuzzing: damage that gets past checksums, lengths and indexes.

Small valid files (our own sessions, one of them a part with a prologue, and files of other programs) are split into
records, mutated in one to three places, and assembled again with valid offsets and checksums around the damage, so
that readers reach it.  Some are mutated again as bytes.  The seed determines the sequence.

:func:`cases` is the interface: names and bytes, without end.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from io import BytesIO
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples
from tools import mcap_build as build
from tools.mcap_build import Chunk, Record

ROOT = Path(__file__).resolve().parents[1]

Parts = list[Record | Chunk]
_Bend = Callable[[Parts, Random], None]

#: Numbers at the edges of what fields and programs can hold.
EDGES = (0, 1, 2, 7, 0x7F, 0xFF, 0xFFFF, 10**9, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 10**18, 2**62, 2**63 - 1, 2**63,
         2**64 - 1)  # fmt: skip
#: Strings that cause trouble in terminals, parsers and file systems.
TEXTS = (b"", b"\x1b[2J\x1b]0;x\x07", b"a\nb: forged line\r", b"\xff\xfe", b"../../etc/passwd", b"\0", b"x" * 5_000,
         "\u202egnp.exe".encode(), b"%s%n{}", b"std_msgs/msg/String", b"/tf", b"-" * 300)  # fmt: skip
#: JSON values of every other type, depth and size.
VALUES: tuple[Any, ...] = (None, True, -1, 0, 1.5, 1e308, 10**30, "", "text", [], {}, [None], [[[]]], {"a": None},
                           {"dropped": 5}, {"": {"": {}}}, "9" * 5_000, float("nan"))  # fmt: skip


def cases(seed: int) -> Iterator[tuple[str, bytes]]:
    """Mutants without end: a name, which has the seed and the number of the case, and the bytes of the file."""
    chance = Random(seed)
    for number in count():
        base, parts = chance.choice(bases())
        name, data = mutant(list(parts), chance)
        yield f"{seed}-{number}:{base}:{name}", data


def mutant(parts: Parts, chance: Random) -> tuple[str, bytes]:
    """One mutant of a file, and what was done to it."""
    names = []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        name = chance.choice(tuple(BENDS))
        BENDS[name](parts, chance)
        names.append(name)
    made = build.assemble(parts, message_index=chance.random() < 0.9)
    if chance.random() < 0.3:
        name = chance.choice(tuple(SUMMARY_BENDS))
        SUMMARY_BENDS[name](made.summary, chance)
        names.append(name)
    footer: dict[str, Any] = {"offsets": chance.random() < 0.8}
    if chance.random() < 0.05:
        footer["start"] = chance.choice((*EDGES, chance.randrange(len(made.data))))
    if chance.random() < 0.1:
        footer["crc"] = 0
    data = made.finish(**footer)
    if chance.random() < 0.15:
        name = chance.choice(tuple(BYTE_BENDS))
        data = BYTE_BENDS[name](data, chance)
        names.append(name)
    return "+".join(names), data


@cache
def bases() -> tuple[tuple[str, Parts], ...]:
    """The sound files that mutants are made of."""
    every_type = _head_of(ROOT / "fixtures/every-type.mcap", 150)
    string = "string data\n"
    foreign: Parts = [
        (build.HEADER, build.header("ros2", "somebody")),
        *(Chunk((
            (build.SCHEMA, build.schema(1, "std_msgs/msg/String", "ros2msg", string.encode())),
            (build.CHANNEL, build.channel(1, 1, "/chatter", "cdr", {"offered_qos_profiles": ""})),
            *((build.MESSAGE, build.message(1, at, 10**18 + at, 10**18, samples.string_cdr("hello")))
              for at in range(first, first + 4)),
        ), compression) for first, compression in ((0, "lz4"), (4, "zstd"), (2, ""))),
    ]  # fmt: skip
    loose: Parts = [
        (build.HEADER, build.header()),
        (build.SCHEMA, build.schema(1, "Example", "c", b"\4\5\6")),
        (build.CHANNEL, build.channel(1, 1, "example", "a", {"foo": "bar"})),
        *((build.MESSAGE, build.message(1, at, at, at, b"\1\2\3")) for at in range(5)),
        (build.ATTACHMENT, build.attachment("myFile", "application/octet-stream", b"\1\2\3", 2, 1)),
        (build.METADATA, build.metadata("myMetadata", {"foo": "bar"})),
    ]
    return (
        ("session", build.parse(_session())),
        ("part", build.parse(_session(layout.PART_KEY))),
        ("every-type", build.parse(every_type)),
        ("foreign", foreign),
        ("loose", loose),
    )


def _session(*midway: str) -> bytes:
    """A session with every kind of entry; a part of a split one begins with a prologue."""
    memory = BytesIO()
    facts = {**samples.SESSION, **dict.fromkeys(midway, "1"), layout.CUSTOM_KEY: '{"patient": "phantom"}'}
    writer = SessionWriter(
        Path("fuzz.mcap"), facts, memory=memory, chunk_bytes=1500, prologue=samples.every_kind()[:3] if midway else ()
    )
    for entry in samples.every_kind(3):
        writer.write(entry)
    writer.close(dict(LEDGER))
    return memory.getvalue()


def _head_of(path: Path, entries: int) -> bytes:
    """The first entries of a recording, as a recording."""
    memory = BytesIO()
    with SessionFile.open(path) as file:
        writer = SessionWriter(path, file.session, memory=memory, chunk_bytes=20_000)
        for entry in file.entries():
            if entry.size < 20_000:
                writer.write(entry)
            if writer.entries >= entries and entry.kind is Kind.ROS_OUT:
                break
        writer.close(file.ledger or {})
    return memory.getvalue()


#: A ledger with every section.
LEDGER: Mapping[str, Any] = {
    "streams": {
        "igtl_in": {"TRANSFORM/ProbeToTracker": {"received": 3, "converted": 2, "dropped": {"bad_crc": 1}}},
        "igtl_out": {"STRING/chatter": {"sent": 3}},
        "peers": {"1 127.0.0.1:1": {"sent": 3, "delivered": 3}},
    },
    "links": {"1": {"sent_messages": 3, "received_messages": 3, "queued_messages": 0, "dropped": {}, "ignored": {}}},
    "link_faults": {"truncated": 1},
    "recorder": {"written_entries": 21, "dropped_entries": 0, "dropped": {}, "left_out_entries": 0, "left_out": {},
                 "failure": ""},
    "ros_topics": {"/chatter": {"lost": 1}},
    "recovered": {"by": "igtl-gateway 1", "from": "a.mcap", "from_bytes": 5, "whole": True, "closed": True,
                  "messages": 3, "missing": None, "missing_numbers": 0, "lost": [], "more_lost": 0},
}  # fmt: skip


# -- what is done to records ----------------------------------------------------------------------------------------


def _pick(parts: Parts, chance: Random, opcodes: Sequence[int] = ()) -> tuple[int, int, Record] | None:
    """A record, in a chunk or not: number of its part, number in the chunk (-1: in none), the record."""
    found = [
        (at, inner, each)
        for at, part in enumerate(parts)
        for inner, each in (enumerate(part.records) if isinstance(part, Chunk) else [(-1, part)])
        if not opcodes or each[0] in opcodes
    ]
    return chance.choice(found) if found else None


def _put(parts: Parts, at: int, inner: int, *records: Record) -> None:
    """Other records in place of one."""
    part = parts[at]
    if isinstance(part, Chunk):
        parts[at] = replace(part, records=(*part.records[:inner], *records, *part.records[inner + 1 :]))
    else:
        parts[at : at + 1] = records


def _each(
    *opcodes: int,
) -> Callable[[Callable[[bytes, Random], bytes]], _Bend]:
    """A bend of the content of one record."""

    def bend_of(change: Callable[[bytes, Random], bytes]) -> _Bend:
        def bend(parts: Parts, chance: Random) -> None:
            if found := _pick(parts, chance, opcodes):
                at, inner, (opcode, content) = found
                _put(parts, at, inner, (opcode, change(content, chance)))

        return bend

    return bend_of


def _number(content: bytes, chance: Random) -> bytes:
    """A field of 1, 2, 4 or 8 bytes is at an edge."""
    size = chance.choice((1, 2, 4, 8))
    if len(content) < size:
        return content
    at = chance.randrange(min(len(content) - size + 1, 120))
    return content[:at] + (chance.choice(EDGES) % (1 << 8 * size)).to_bytes(size, "little") + content[at + size :]


def _bits(content: bytes, chance: Random) -> bytes:
    bent = bytearray(content)
    for _ in range(chance.choice((1, 1, 4)) if bent else 0):
        bent[chance.randrange(len(bent))] ^= 1 << chance.randrange(8)
    return bytes(bent)


def _cut(content: bytes, chance: Random) -> bytes:
    return content[: chance.randrange(len(content) + 1)]


def _padded(content: bytes, chance: Random) -> bytes:
    return content + chance.choice((b"\x01\xff\xff", bytes(9), chance.randbytes(chance.randrange(1, 60))))


def _times(content: bytes, chance: Random) -> bytes:
    """Of a message: log or publish time."""
    at = chance.choice((6, 14))
    if len(content) < 22:
        return content
    old = int.from_bytes(content[at : at + 8], "little")
    new = chance.choice((*EDGES, old + chance.choice((-1, 1)) * 10 ** chance.randrange(19)))
    return content[:at] + struct.pack("<Q", new % (1 << 64)) + content[at + 8 :]


def _texts(content: bytes, chance: Random) -> bytes:
    """A string somewhere in the record becomes another one, with its length."""
    places = [
        at
        for at in range(0, min(len(content), 400) - 3)
        if 0 < (size := int.from_bytes(content[at : at + 4], "little")) <= len(content) - at - 4
        and content[at + 4 : at + 3 + size].isascii()
    ]
    if not places:
        return content
    at = chance.choice(places)
    end = at + 4 + int.from_bytes(content[at : at + 4], "little")
    nul = b"\0" if content[end - 1 : end] == b"\0" else b""
    return content[:at] + build.text(chance.choice(TEXTS) + nul) + content[end:]


def _sealed_json(content: bytes, chance: Random) -> bytes:
    """Of the session's or the ledger's metadata: an item, or a value of its JSON, has another type, depth or size."""
    name_size = int.from_bytes(content[:4], "little")
    items: dict[str, str] = {}
    at = 8 + name_size
    while at + 4 <= len(content):
        words = []
        for _ in range(2):
            size = int.from_bytes(content[at : at + 4], "little")
            words.append(content[at + 4 : at + 4 + size].decode("utf-8", "replace"))
            at += 4 + size
        items[words[0]] = words[1]
    items.pop(layout.CHECKSUM_KEY, None)
    # what a reader acts on, whether the file has it or not
    known = (layout.PART_KEY, layout.SNAPSHOT_KEY, layout.INCLUDE_KEY, layout.CUSTOM_KEY, layout.FORMAT_VERSION_KEY,
             layout.CONFIGURATION_KEY, "slice_of", "slice_start_ns", "slice_end_ns", "slice_streams", "synthetic",
             "scenario", "igtl_gateway_version", "imported_format", "imported_from")  # fmt: skip
    key = chance.choice((*items, *known))
    items[key] = chance.choice((bent_json, _bent_text))(items.get(key, '{"a": 1}'), chance)
    if key == "slice_of":
        items |= {"slice_start_ns": chance.choice(("0", str(2**70), "x")), "slice_end_ns": str(chance.choice(EDGES))}
    return build.metadata(content[4 : 4 + name_size], layout.seal(items))


def _bent_text(_text: str, chance: Random) -> str:
    return chance.choice((*TEXTS, b"[" * 5_000, b"9" * 5_000, b"1e999", b'{"a":' * 90 + b"1" + b"}" * 90)).decode(
        "utf-8", "replace"
    )


def bent_json(text: str, chance: Random) -> str:
    """JSON with another value at one place; invalid JSON is replaced."""
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    if not isinstance(value, dict | list) or not value:
        return json.dumps(chance.choice(VALUES))
    node = value
    while True:
        key: Any = chance.choice(list(node)) if isinstance(node, dict) else chance.randrange(len(node))
        if isinstance(node[key], dict | list) and node[key] and chance.random() < 0.7:
            node = node[key]
            continue
        break
    match chance.randrange(4):
        case 0 if isinstance(node, dict):
            del node[key]
        case 1 if isinstance(node, dict):
            node[chance.choice(TEXTS).decode("utf-8", "replace")] = chance.choice(VALUES)
        case _:
            node[key] = chance.choice(VALUES)
    return json.dumps(value)


def _note(content: bytes, chance: Random) -> bytes:
    """Of a note: the JSON at its end, or its level."""
    at = content.rfind(b"\x00\x00\x00{")  # its length is below 2^24
    if at < 0 or b"{" not in content:
        return _number(content, chance)
    start = content.rindex(b"{", 0, at + 4)
    bent = bent_json(content[start:-1].decode("utf-8", "replace"), chance).encode("utf-8", "surrogateescape")
    return content[: start - 4] + struct.pack("<I", len(bent) + 1) + bent + b"\0"


def _gone(parts: Parts, chance: Random) -> None:
    if found := _pick(parts, chance):
        _put(parts, *found[:2])


def _repeated(parts: Parts, chance: Random) -> None:
    if found := _pick(parts, chance):
        _put(parts, *found[:2], *[found[2]] * chance.choice((2, 3, 50)))


def _moved(parts: Parts, chance: Random) -> None:
    at, to = (chance.randrange(len(parts)) for _ in range(2))
    parts[at], parts[to] = parts[to], parts[at]


def _other_opcode(parts: Parts, chance: Random) -> None:
    if found := _pick(parts, chance):
        at, inner, (_, content) = found
        _put(parts, at, inner, (chance.choice((*range(17), 0x80, 0xFF)), content))


def _chunk(change: Callable[[Chunk, Random], Chunk]) -> _Bend:
    """A bend of one chunk."""

    def bend(parts: Parts, chance: Random) -> None:
        places = [at for at, part in enumerate(parts) if isinstance(part, Chunk)]
        if places:
            at = chance.choice(places)
            part = parts[at]
            assert isinstance(part, Chunk)
            parts[at] = change(part, chance)

    return bend


def _bomb(chunk: Chunk, chance: Random) -> Chunk:
    """Zeros or messages that pack to little, with an honest size or a lying one."""
    number = chance.choice((1 << 16, 1 << 20, 1 << 23))
    one = build.record(build.MESSAGE, build.message(1, 1, 10**18, 10**18, b""))
    plain = chance.choice((bytes(number), one * (number // len(one))))
    compression = chance.choice(("lz4", "zstd"))
    size = chance.choice((len(plain), len(plain), 10, 1 << 31, 1 << 40, 2**64 - 1, len(plain) + 1))
    return replace(chunk, compression=compression, packed=build.COMPRESS[compression](plain), size=size, crc=0)


def _shuffled(chunk: Chunk, chance: Random) -> Chunk:
    return replace(chunk, records=tuple(chance.sample(chunk.records, len(chunk.records))))


def _nested(parts: Parts, chance: Random) -> None:
    """A chunk in a chunk; or the whole file as the prologue of itself."""
    whole = build.assemble(parts).finish()
    if chance.random() < 0.5:
        data = build.attachment(layout.PROLOGUE_ATTACHMENT, "application/octet-stream", whole)
        places = [at for at, part in enumerate(parts) if not isinstance(part, Chunk) and part[0] == build.ATTACHMENT]
        parts[chance.choice(places) if places else len(parts) :] = [(build.ATTACHMENT, data)]
    else:
        parts.append(Chunk(((build.CHUNK, Chunk(((build.HEADER, whole),), "zstd").content()),), "lz4"))


BENDS: Mapping[str, _Bend] = {
    "number": _each()(_number),
    "bits": _each()(_bits),
    "cut": _each()(_cut),
    "padded": _each()(_padded),
    "text": _each()(_texts),
    "times": _each(build.MESSAGE)(_times),
    "sealed": _each(build.METADATA)(_sealed_json),
    "sealed-2": _each(build.METADATA)(_sealed_json),
    "note": _each(build.MESSAGE)(_note),
    "payload": _each(build.MESSAGE)(lambda content, chance: content[:22] + _number(content[22:], chance)),
    "definition": _each(build.SCHEMA, build.CHANNEL)(_texts),
    "gone": _gone,
    "repeated": _repeated,
    "moved": _moved,
    "opcode": _other_opcode,
    "nested": _nested,
    "bomb": _chunk(_bomb),
    "shuffled": _chunk(_shuffled),
    "compression": _chunk(lambda chunk, chance: replace(chunk, compression=chance.choice(("", "lz4", "zstd", "bz2")))),
    "chunk-times": _chunk(lambda chunk, chance: replace(chunk, start=chance.choice(EDGES), end=chance.choice(EDGES))),
    "chunk-size": _chunk(lambda chunk, chance: replace(chunk, size=chance.choice(EDGES), crc=chance.choice((0, None)))),
    "chunk-crc": _chunk(lambda chunk, chance: replace(chunk, crc=chance.choice((0, 1)))),
    "chunk-bytes": _chunk(lambda chunk, chance: replace(chunk, packed=_bits(chunk.content()[44:], chance), crc=0)),
}


def _summary_record(summary: list[Record], chance: Random) -> None:
    if summary:
        at = chance.randrange(len(summary))
        opcode, content = summary[at]
        summary[at] = opcode, chance.choice((_number, _bits, _texts, _padded, _cut))(content, chance)


def _summary_repeated(summary: list[Record], chance: Random) -> None:
    if summary:
        at = chance.randrange(len(summary))
        summary[at:at] = [summary[at]] * chance.choice((1, 3, 300))


def _summary_without(summary: list[Record], chance: Random) -> None:
    """Without one sort of records, as MCAP allows."""
    opcode = chance.choice((build.SCHEMA, build.CHANNEL, build.STATISTICS, build.CHUNK_INDEX, build.METADATA_INDEX))
    summary[:] = [each for each in summary if each[0] != opcode]


SUMMARY_BENDS: Mapping[str, Callable[[list[Record], Random], None]] = {
    "summary": _summary_record,
    "summary-repeated": _summary_repeated,
    "summary-without": _summary_without,
    "summary-empty": lambda summary, chance: summary.clear(),
}


def _grown(data: bytes, chance: Random) -> bytes:
    at = chance.randrange(len(data))
    return data[:at] + chance.randbytes(chance.randrange(1, 40)) + data[at:]


BYTE_BENDS: Mapping[str, Callable[[bytes, Random], bytes]] = {
    "flipped": _bits,
    "cut-off": _cut,
    "grown": _grown,
    "without": lambda data, chance: data[: (at := chance.randrange(len(data)))] + data[at + chance.randrange(1, 200) :],
}

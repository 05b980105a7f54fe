"""Hostile session recordings: files of our own layout with wrong values in trusted places."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.integration.hostile_files.case import (
    ESCAPE,
    FORGED,
    GIB,
    MIB,
    NAUGHTY,
    Danger,
    Hostile,
    file,
    lz4_zeros,
    zstd_zeros,
)
from tests.places import ROOT
from tests.record import samples
from tools import mcap_build as build
from tools.mcap_build import Chunk, Record

Parts = list[Record | Chunk]
_DEEP = "[" * 100_000 + "]" * 100_000
_CONFIG = json.dumps(Config().to_dict())


def session(
    facts: Mapping[str, str] | None = None,
    ledger: Any = None,
    entries: Sequence[Entry] | None = None,
    prologue: Sequence[Entry] = (),
) -> bytes:
    """A session as the recorder writes it."""
    memory = BytesIO()
    writer = SessionWriter(
        Path("hostile.mcap"),
        {"config": _CONFIG, "host": "theatre-2", **(facts or {})},
        memory=memory,
        chunk_bytes=1500,
        prologue=prologue,
    )
    for entry in samples.every_kind(2) if entries is None else entries:
        writer.write(entry)
    writer.close({} if ledger is None else ledger)
    return memory.getvalue()


def changed(change: Callable[[Parts], Any], **facts: Any) -> Callable[[], bytes]:
    """A session whose records were changed, with right offsets and checksums around that."""

    def make() -> bytes:
        parts = build.parse(session(**facts))
        change(parts)
        return build.assemble(parts).finish()

    return make


def metadata(items: Mapping[str, str], name: str = layout.SESSION_METADATA) -> Callable[[Parts], None]:
    """Replace the metadata record of this name (and the copy of the session's), with a right checksum."""

    def change(parts: Parts) -> None:
        names = {name, layout.SESSION_COPY_METADATA} if name == layout.SESSION_METADATA else {name}
        for number, part in enumerate(parts):
            if isinstance(part, Chunk) or part[0] != build.METADATA:
                continue
            length = int.from_bytes(part[1][:4], "little")
            found = part[1][4 : 4 + length].decode()
            if found in names:
                parts[number] = build.METADATA, build.metadata(found, layout.seal(dict(items)))

    return change


def with_chunk(chunk: Chunk) -> Callable[[Parts], None]:
    """Put a chunk before the last one."""

    def change(parts: Parts) -> None:
        places = [number for number, part in enumerate(parts) if isinstance(part, Chunk)]
        parts.insert(places[-1], chunk)

    return change


def attachment(name: str, data: bytes) -> Callable[[Parts], None]:
    """Replace, or add, an attachment."""

    def change(parts: Parts) -> None:
        kept = [
            part
            for part in parts
            if isinstance(part, Chunk) or part[0] != build.ATTACHMENT or name.encode() not in part[1][:200]
        ]
        parts[:] = [*kept, (build.ATTACHMENT, build.attachment(name, "application/octet-stream", data))]

    return change


def packed(compression: str, data: Callable[[int], bytes], size: int, claimed: int | None = None) -> Chunk:
    """A chunk of zeros, which unpacks to ``size`` bytes and claims as many or ``claimed``."""
    return Chunk((), compression, packed=data(size), size=size if claimed is None else claimed, crc=0, start=1, end=2)


def noted(**fields: Any) -> list[Entry]:
    """A session in which a note has other fields."""
    given: dict[str, Any] = {
        "level": 30,
        "code": "bad_crc",
        "text": "a fact",
        "stream": "IMAGE/probe",
        "data": {},
    } | fields
    entries = samples.every_kind()
    at = len(entries) + 1
    note = Note(Level(given["level"]), given["code"], given["text"], given["stream"], given["data"])
    return [*entries, Entry(at, samples.START_NS + at, Kind.NOTE, payload=(note.pack(),), links=(1,))]


def link(data: Any) -> list[Entry]:
    """A session whose links have other facts."""
    note = Note(Level.INFO, "link_up", f"peer {ESCAPE} connected", "", data)
    up = Entry(1, samples.START_NS + 1, Kind.LINK, payload=(note.pack(),), links=(1,))
    return [up, *(replace(each, seq=each.seq + 1, stamp_ns=each.stamp_ns + 1) for each in samples.every_kind()[1:])]


def raw_schema(text: bytes) -> Callable[[Parts], None]:
    """Give all ROS types in the file another definition."""

    def change(parts: Parts) -> None:
        for number, part in enumerate(parts):
            if isinstance(part, Chunk):
                parts[number] = replace(part, records=tuple(map(one, part.records)), packed=None)
            else:
                parts[number] = one(part)

    def one(record: Record) -> Record:
        if record[0] != build.SCHEMA or b"String" not in record[1][:60]:
            return record
        number = int.from_bytes(record[1][:2], "little")
        return build.SCHEMA, build.schema(number, "std_msgs/msg/String", "ros2msg", text)

    return change


def stamped(stamps: Sequence[int]) -> Callable[[Parts], None]:
    """Give the messages of the file these times, in turn."""

    def change(parts: Parts) -> None:
        turn = 0
        for number, part in enumerate(parts):
            if isinstance(part, Chunk):
                records = []
                for opcode, content in part.records:
                    stamp = stamps[turn % len(stamps)]
                    is_message = opcode == build.MESSAGE
                    turn += is_message
                    moved = content[:6] + struct.pack("<QQ", stamp, stamp) + content[22:]
                    records.append((opcode, moved if is_message else content))
                parts[number] = replace(part, records=tuple(records), packed=None)

    return change


def nested(depth: int) -> bytes:
    """A prologue within a prologue within ..."""
    data = session()
    for _ in range(depth):
        parts = build.parse(session({layout.PART_KEY: "1"}))
        attachment(layout.PROLOGUE_ATTACHMENT, data)(parts)
        data = build.assemble(parts).finish()
    return data


def prologue_bomb() -> bytes:
    """A prologue of a few kB whose chunk unpacks to 2 GB."""
    parts = build.parse(session())
    with_chunk(packed("zstd", zstd_zeros, 2 * GIB))(parts)
    inner = build.assemble(parts).finish()
    outer = build.parse(session({layout.PART_KEY: "1"}))
    attachment(layout.PROLOGUE_ATTACHMENT, inner)(outer)
    return build.assemble(outer).finish()


def flipped(seed: int) -> bytes:
    """A part of every-type.mcap in which single bits of messages are wrong, under right checksums."""
    from random import Random  # the sequence depends on the seed only

    chance = Random(seed)
    parts = build.parse((ROOT / "fixtures/every-type.mcap").read_bytes())
    for number, part in enumerate(parts):
        if isinstance(part, Chunk):
            records = []
            for opcode, content in part.records:
                data = bytearray(content)
                if opcode == build.MESSAGE and chance.random() < 0.5:
                    data[chance.randrange(22, len(data))] ^= 1 << chance.randrange(8)
                records.append((opcode, bytes(data)))
            parts[number] = replace(part, records=tuple(records), packed=None)
    return build.assemble(parts).finish()


def lying(**claims: Any) -> bytes:
    """A session whose footer claims something else."""
    return build.assemble(build.parse(session())).finish(**claims)


def cut(share: float) -> bytes:
    data = session()
    return data[: int(len(data) * share)]


def record_of(length: int) -> bytes:
    """A record in the data section that claims a length."""
    parts = build.parse(session())
    data = build.assemble(parts).data
    return data[:-13] + build.record(build.MESSAGE, b"x" * 100, length)


_WRONG = {
    "a list": "[1, 2]",
    "a number": "17",
    "null": "null",
    "a string": '"text"',
    "nested 100,000 deep": _DEEP,
    "invalid JSON": "{",
    "an integer of 5,000 digits": "9" * 5000,
    "another type inside": '{"streams": 5, "links": [1], "base_frame": 7, "to_ros": {"a": 1}, "watch": "x"}',
    "without most settings": '{"base_frame": "world"}',
    "infinity": '{"stamp": 1e999, "max_age": -Infinity, "igtl_unit": NaN}',
}


def _shape(name: str, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(name, "session", Danger.SHAPE, what, file(f"{name}.mcap", data))


def _lie(name: str, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(name, "session", Danger.LIE, what, file(f"{name}.mcap", data))


def _bomb(name: str, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(name, "session", Danger.BOMB, what, file(f"{name}.mcap", data))


def _terminal(name: str, what: str, data: Callable[[], bytes], filename: str = "") -> Hostile:
    return Hostile(name, "session", Danger.TERMINAL, what, file(filename or f"{name}.mcap", data))


def _slug(text: str) -> str:
    return "".join(char if char.isalnum() else "-" for char in text)


def _wrong_ledger(text: str) -> Callable[[], bytes]:
    return changed(metadata({layout.LEDGER_KEY: text}, layout.LEDGER_METADATA))


def _wrong_fact(key: str, text: str) -> Callable[[], bytes]:
    facts = {layout.FORMAT_VERSION_KEY: "1", "config": _CONFIG, key: text}
    return changed(metadata(facts))


CASES: tuple[Hostile, ...] = (
    *(
        _bomb(
            f"chunk-{name}-{size // GIB}g",
            f"a chunk of {name} that decompresses to {size // GIB} GiB, as declared",
            changed(with_chunk(packed(name, pack, size))),
        )
        for name, pack, size in (
            ("zstd", zstd_zeros, 2 * GIB),
            ("zstd", zstd_zeros, 16 * GIB),
            ("lz4", lz4_zeros, 2 * GIB),
        )
    ),
    *(
        _bomb(
            f"chunk-{name}-lie-{claimed}",
            f"the same with {name}, which claims {claimed:,} bytes",
            changed(with_chunk(packed(name, pack, 2 * GIB, claimed))),
        )
        for name, pack in (("zstd", zstd_zeros), ("lz4", lz4_zeros))
        for claimed in (100, 1 << 40, (1 << 64) - 1)
    ),
    _bomb(
        "chunk-zstd-undeclared",
        "a zstd frame of 2 GiB that declares no size, in a chunk that claims 1,000 bytes",
        changed(with_chunk(Chunk((), "zstd", packed=zstd_zeros(2 * GIB, 0), size=1000, crc=0, start=1, end=2))),
    ),
    _bomb(
        "chunk-zstd-frame-lies",
        "a zstd frame of 2 GiB that declares 64 EiB",
        changed(
            with_chunk(Chunk((), "zstd", packed=zstd_zeros(2 * GIB, 1 << 62), size=1 << 62, crc=0, start=1, end=2))
        ),
    ),
    _bomb(
        "chunks-64",
        "64 chunks of zstd with 200 MiB each",
        changed(lambda parts: [with_chunk(packed("zstd", zstd_zeros, 200 * MIB))(parts) for _ in range(64)]),
    ),
    _bomb("prologue-zstd", "a prologue whose chunk unpacks to 2 GiB", prologue_bomb),
    _bomb("prologue-nested", "a prologue within a prologue, 60 deep", lambda: nested(60)),
    _bomb(
        "attachment-zeros",
        "an attachment of a configuration with 64 MiB of brackets",
        changed(attachment(layout.CONFIGURATION_ATTACHMENT, b"[" * (64 * MIB))),
    ),
    # Lies
    _lie("record-length", "a record that claims 2^63 bytes", lambda: record_of(1 << 63)),
    _lie("record-length-1g", "a record that claims 1 GB", lambda: record_of(10**9)),
    _lie("summary-start", "a footer whose summary begins behind the file", lambda: lying(start=1 << 62)),
    _lie("summary-loop", "a footer whose summary begins at the start of the file", lambda: lying(start=8)),
    _lie("summary-crc", "a summary with a wrong checksum", lambda: lying(crc=7)),
    *(
        _lie(f"cut-{round(100 * share)}", f"cut off at {share:.0%}", partial(cut, share))
        for share in (0.1, 0.5, 0.9, 0.99)
    ),
    _lie(
        "channels-60000",
        "60,000 channels of nothing",
        changed(
            lambda parts: parts.extend(
                (build.CHANNEL, build.channel(number, 1, f"/t{number}", "cdr")) for number in range(2000, 62_000)
            )
        ),
    ),
    _lie(
        "metadata-50000",
        "50,000 metadata records",
        changed(
            lambda parts: parts.extend((build.METADATA, build.metadata(f"m{number}", {})) for number in range(50_000))
        ),
    ),
    _lie(
        "no-channel",
        "messages of a channel that is not there",
        changed(with_chunk(Chunk(((build.MESSAGE, build.message(999, 1, 2, 3, b"x")),)))),
    ),
    *(
        _lie(f"chunk-{name}", what, changed(with_chunk(chunk)))
        for name, what, chunk in (
            ("in-chunk", "a chunk in a chunk", Chunk(((build.CHUNK, b"x" * 50),))),
            (
                "garbage",
                "a chunk of random bytes that claims to be lz4",
                Chunk((), "lz4", packed=bytes(range(256)) * 9, size=99),
            ),
            ("unknown", "a chunk of an unknown compression", Chunk((), f"zip{ESCAPE}", packed=b"x", size=1)),
            ("huge-message", "a message whose fields claim 4 GiB", Chunk(((build.MESSAGE, b"\xff" * 40),))),
        )
    ),
    # Wrong shapes
    *(
        _shape(f"ledger-{_slug(what)}", f"a ledger that is {what}", _wrong_ledger(text))
        for what, text in _WRONG.items()
    ),
    *(
        _shape(f"config-{_slug(what)}", f"a configuration that is {what}", _wrong_fact("config", text))
        for what, text in _WRONG.items()
    ),
    *(
        _shape(f"custom-{_slug(what)}", f"custom data that is {what}", _wrong_fact(layout.CUSTOM_KEY, text))
        for what, text in _WRONG.items()
        if what not in {"infinity", "without most settings"}
    ),
    *(
        _shape(
            f"slice-{_slug(key)}-{number}",
            f"`{key}` is {text[:20]!r}",
            changed(
                metadata(
                    {
                        layout.FORMAT_VERSION_KEY: "1",
                        "config": _CONFIG,
                        "slice_of": "x.mcap",
                        "slice_start_ns": "1",
                        "slice_end_ns": "2",
                        key: text,
                    }
                )
            ),
        )
        for key in ("slice_start_ns", "slice_end_ns", "slice_streams")
        for number, text in enumerate(("", "x", "9" * 5000, "[[[1]]]", "-1e99"))
    ),
    *(
        _shape(
            f"version-{number}",
            f"`format_version` is {text[:20]!r}",
            changed(metadata({layout.FORMAT_VERSION_KEY: text, "config": _CONFIG})),
        )
        for number, text in enumerate(("", "x", "-1", "1.0", "9" * 5000, "\u0661", "1\n2", "999999"))
    ),
    *(
        _shape(
            f"globs-{number}", f"globs of the recorded streams are {text[:20]!r}", _wrong_fact(layout.INCLUDE_KEY, text)
        )
        for number, text in enumerate(("7", "[1, 2]", "{", _DEEP, '["*" , ["a"]]'))
    ),
    _shape("part-key", "a part whose number is a string", _wrong_fact(layout.PART_KEY, "x" * 100)),
    _shape("snapshot-key", "a snapshot whose length is a string", _wrong_fact(layout.SNAPSHOT_KEY, NAUGHTY)),
    *(
        _shape(
            f"link-{number}",
            f"facts of a link that are {str(data)[:30]}",
            partial(session, entries=link(data)),
        )
        for number, data in enumerate(({"peer": 7}, {"peer": {"a": [1]}}, {"peer": None, "jump_ns": "x"}, {}))
    ),
    *(
        _shape(
            f"note-{number}",
            f"a note with the data {json.dumps(data)[:30]}",
            partial(session, entries=noted(code="clock_step", data=data)),
        )
        for number, data in enumerate(({"step_ns": "x"}, {"step_ns": [1]}, {"step_ns": 10**30}, {"jump_ns": None}))
    ),
    *(
        _shape(f"stamps-{number}", f"times {what}", changed(stamped(stamps)))
        for number, (what, stamps) in enumerate(
            (
                ("that are all 0", (0,)),
                ("of 2^64 − 1 ns", ((1 << 64) - 1,)),
                ("of 2^63 ns", (1 << 63, (1 << 63) + 1)),
                ("from 0 to 2^64 − 1 ns", (0, (1 << 64) - 1)),
                ("that go backwards", tuple(range(10**18, 10**18 - 10**13, -(10**11)))),
            )
        )
    ),
    *(
        _shape(
            f"bits-{seed}",
            f"every-type.mcap with wrong bits under right checksums, {seed}",
            partial(flipped, seed),
        )
        for seed in range(8)
    ),
    *(
        _shape(f"definition-{name}", f"a definition {what}", changed(raw_schema(text)))
        for name, what, text in (
            ("no-utf8", "that is invalid UTF-8", b"string \xff\xfe data\n"),
            ("empty", "that is empty", b""),
            ("recursive", "that names itself", b"std_msgs/String data\n"),
            ("huge-array", "with an array of 2^62 elements", b"string[4611686018427387904] data\n"),
            ("garbage", "that is invalid", b"\x00\x01\x02 = = = [[[["),
        )
    ),
    # Terminal
    _terminal(
        "device",
        "escape sequences and a forged line in a device name",
        lambda: session(entries=[samples.igtl(number, device=NAUGHTY) for number in range(1, 9)]),
    ),
    _terminal(
        "topic",
        "the same in a topic",
        lambda: session(entries=[samples.ros(number, Kind.ROS_OUT, topic=f"/{NAUGHTY}") for number in range(1, 9)]),
    ),
    _terminal(
        "type",
        "the same in a message type",
        lambda: session(entries=[samples.igtl(number, message_type=f"T{ESCAPE[:6]}\nX") for number in range(1, 9)]),
    ),
    _terminal(
        "text",
        "the same in a string",
        lambda: session(entries=[samples.ros(number, Kind.ROS_OUT, text=NAUGHTY) for number in range(1, 9)]),
    ),
    _terminal(
        "note",
        "the same in every field of a note",
        lambda: session(entries=noted(code=NAUGHTY, text=NAUGHTY, stream=NAUGHTY, data={NAUGHTY: NAUGHTY})),
    ),
    _terminal(
        "peer",
        "the same in the address of a peer",
        lambda: session(entries=link({"peer": NAUGHTY, "local": NAUGHTY, "role": NAUGHTY})),
    ),
    _terminal(
        "custom", "the same in custom data", lambda: session({layout.CUSTOM_KEY: json.dumps({NAUGHTY: NAUGHTY})})
    ),
    *(
        _terminal(f"fact-{key}", f"the same in `{key}`", partial(session, {key: NAUGHTY}))
        for key in ("igtl_gateway_version", "scenario", "synthetic", "slice_of", layout.PREVIOUS_KEY, "host")
    ),
    _terminal(
        "ledger",
        "the same in the ledger",
        lambda: session(
            ledger={
                "links": {NAUGHTY: {"dropped": {NAUGHTY: 3}, "ignored": {}}},
                "ros_topics": {NAUGHTY: {"lost": 4}},
                "streams": {"igtl_in": {NAUGHTY: {"received": 5, "dropped": {NAUGHTY: 1}}}},
            }
        ),
    ),
    _terminal(
        "config", "the same in the configuration", lambda: session({"config": json.dumps({"base_frame": NAUGHTY})})
    ),
    _terminal("file-name", "the same in the file name", session, f"a{ESCAPE}\n{FORGED}.mcap".replace("/", "")),
    _terminal(
        "long-name",
        "a device name of 3 MB",
        lambda: session(
            entries=[samples.igtl(1, device="x" * 3_000_000), samples.igtl(2), samples.igtl(3, device="y")]
        ),
    ),
)

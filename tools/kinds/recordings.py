"""MCAP files: our own sessions with ROS messages of each type and OpenIGTLink bytes, record by record."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype

from igtl_gateway.base.untrusted.definitions import parse_definition
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.header import crc64
from tests.record import samples
from tools import mcap_build as build
from tools.kinds.values import Maker
from tools.mcap_build import Chunk, Record
from tools.mcap_mutations import LEDGER

_FIXTURE = Path(__file__).resolve().parents[2] / "fixtures" / "every-type.mcap"
_HEADER = 58
_NUMBERS = {
    "bool": ("u8", "<B"), "byte": ("u8", "<B"), "char": ("u8", "<B"), "octet": ("u8", "<B"), "int8": ("i8", "<b"),
    "uint8": ("u8", "<B"), "int16": ("i16", "<h"), "uint16": ("u16", "<H"), "int32": ("i32", "<i"),
    "uint32": ("u32", "<I"), "int64": ("i64", "<q"), "uint64": ("u64", "<Q"),
}  # fmt: skip
_FLOATS = {"float32": "<f", "float64": "<d"}
_CONFIG = Config().to_dict() | {
    "to_igtl": [{"topic": "/chatter", "device": "Chat", "type": "STRING", "metadata": {"operator": "A"}}],
    "to_ros": [{"device": "Probe*", "topic": "/p/{device}", "frame_id": "f", "kinds": ["pose"]}],
    "tf_out": [{"frames": ["Probe"], "base": "Tracker", "device": "P"}],
    "peers": [{"at": "127.0.0.1", "profile": "slicer"}],
    "crtk": [{"arms": "/PSM1", "workspace": [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], "max_speed": 0.5}],
    "deny_in": ["STRING"], "max_age_s": 1.0,
}  # fmt: skip


@cache
def recorded() -> tuple[list[Entry], dict[str, Any]]:
    """The inputs of the fixture, small ones, and type → parsed definitions."""
    with SessionFile.open(_FIXTURE) as file:
        entries = [samples.flat(each) for each in file.entries() if each.kind.is_input and each.size < 6_000]
        types = {name: parse_definition(text, name) for name, text in sorted(file.definitions.items()) if text}
    return entries, types


def session(make: Maker) -> Mapping[str, bytes]:
    """A session: a few inputs of two kinds, the configuration, the ledger, and all records around them."""
    entries, types = recorded()
    peers = {each.type: each for each in entries if each.kind is Kind.IGTL_IN}
    ros_type = make.one_of("cdr", [name for name in types if name.split("/")[1] == "msg"])
    igtl_type = make.one_of("igtl", sorted(peers))
    count = make.rng.choice((1, 2, 5, 40))
    given: list[Entry] = []
    for number in range(count):
        data = b"\0\1\0\0" + _cdr(make, f"cdr.{ros_type}", ros_type, types[ros_type])
        given.append(replace(samples.ros(0), type=ros_type, channel="/made", payload=(data,)))
        given.append(
            replace(peers[igtl_type], payload=(igtl_message(make, f"igtl.{igtl_type}", peers[igtl_type].data()),))
        )
        if number % 4 == 0:
            given.append(replace(samples.note(0, Kind.LINK, code="link_up"), payload=(_note(make),)))
    numbered = [replace(each, seq=at, stamp_ns=samples.START_NS + at * 50_000_000) for at, each in enumerate(given, 1)]
    facts = {"config": make.json("config", _CONFIG), "host": make.text("host", "theatre-2"),
             layout.CUSTOM_KEY: make.json("custom", {"patient": "phantom"})}  # fmt: skip
    memory = BytesIO()
    known = {name: text for name, text in _texts().items() if name == ros_type}
    writer = SessionWriter(
        Path("a.mcap"), {key: _plain(text) for key, text in facts.items()}, memory=memory, chunk_bytes=3_000,
        definition_of=lambda name: Definition(known[name].encode()) if name in known else None,
    )  # fmt: skip
    for each in numbered:
        writer.write(each)
    writer.close({})
    parts = [strike(make, part) for part in build.parse(memory.getvalue())]
    made = build.assemble(parts)
    names = {build.STATISTICS: "statistics", build.CHUNK_INDEX: "chunk index", build.METADATA_INDEX: "metadata index",
             build.SCHEMA: "summary schema", build.CHANNEL: "summary channel"}  # fmt: skip
    made.summary = [(code, make.words(names.get(code, "other"), data, 80)) for code, data in made.summary]
    return {"a.mcap": made.finish(start=make.length("footer.summary", len(made.data), 64))}


@cache
def _texts() -> dict[str, str]:
    with SessionFile.open(_FIXTURE) as file:
        return dict(file.definitions)


def _plain(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


def strike(make: Maker, part: Record | Chunk) -> Record | Chunk:
    """A record, or the chunk around some, with its fields."""
    if isinstance(part, Chunk):
        records = tuple(_record(make, each) for each in part.records)
        made = replace(part, records=records)
        start, end = made.times()
        return replace(
            made,
            start=make.number("chunk.start", start, "u64"),
            end=make.number("chunk.end", end, "u64"),
            size=make.length("chunk.size", len(made.plain()), 64),
        )
    return _record(make, part)


def _record(make: Maker, record: Record) -> Record:
    code, data = record
    if code == build.MESSAGE:
        channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", data)
        return code, build.message(
            make.number("message.channel", channel, "u16"),
            make.number("message.sequence", sequence, "u32"),
            make.number("message.log_time", log_time, "u64"),
            make.number("message.publish_time", publish_time, "u64"),
            data[22:],
        )
    if code == build.CHANNEL:
        number, schema, topic, encoding, items = _channel(data)
        if layout_key := next((key for key in items if "qos" in key), ""):
            depth = make.written("qos.depth", "10")
            items[layout_key] = make.text("qos", items[layout_key].replace("depth: 10", f"depth: {depth}"))
        items = {_text(make, "channel.(key)", key): _text(make, "channel.value", text) for key, text in items.items()}
        return code, build.channel(
            make.number("channel.number", number, "u16"), make.number("channel.schema", schema, "u16"),
            make.coded("channel.topic", topic), encoding, items,
        )  # fmt: skip
    if code == build.SCHEMA:
        return code, make.words("schema", make.blob("schema", data), 40)
    if code == build.METADATA:
        name = data[4 : 4 + int.from_bytes(data[:4], "little")].decode()
        if name == layout.LEDGER_METADATA:
            text = _plain(make.json("ledger", LEDGER))
            return code, build.metadata(name, layout.seal({layout.LEDGER_KEY: text}))
        return code, make.blob("metadata", data)
    return code, data


def _text(make: Maker, name: str, true: str) -> str:
    return make.coded(name, true).decode("utf-8", "replace")


def _channel(data: bytes) -> tuple[int, int, str, str, dict[str, str]]:
    number, schema = struct.unpack_from("<HH", data)
    words, at = [], 4
    for _ in range(2):
        size = int.from_bytes(data[at : at + 4], "little")
        words.append(data[at + 4 : at + 4 + size].decode("utf-8", "surrogateescape"))
        at += 4 + size
    rest, at = [], at + 4
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        rest.append(data[at + 4 : at + 4 + size].decode("utf-8", "surrogateescape"))
        at += 4 + size
    return number, schema, words[0], words[1], dict(zip(rest[::2], rest[1::2], strict=True))


def _note(make: Maker) -> bytes:
    facts = {"peer": "127.0.0.1:1", "local": "127.0.0.1:2", "role": "server", "count": 5, "dropped": {"a": 1},
             "received_bytes": 100, "head": "00ff"}  # fmt: skip
    document = {"level": "WARN", "code": "link_up", "text": "a fact", "stream": "IMAGE/p", "data": facts}
    return make.json("note", document).encode("utf-8", "surrogatepass")


def igtl_message(make: Maker, name: str, data: bytes) -> bytes:
    """A message of a peer: any word of its body and any number of its header, with the right checksum."""
    body = make.words(f"{name}.body", make.blob(f"{name}.bytes", data[_HEADER:]))
    version, kind, device, ticks, _, _ = struct.unpack_from(">H12s20sQQQ", data)
    head = struct.pack(
        ">H12s20sQQQ",
        make.number(f"{name}.version", version, "u16"),
        kind,
        make.coded(f"{name}.device", device.rstrip(b"\0").decode("ascii", "replace"))[:20],
        make.number(f"{name}.ticks", ticks, "u64"),
        make.length(f"{name}.size", len(body), 64),
        crc64(body),
    )
    return head + body


def _cdr(make: Maker, name: str, ros_type: str, types: Mapping[str, Any]) -> bytes:
    """A message of any type, field by field, in CDR."""
    data = bytearray()

    def put(form: str, value: Any) -> None:
        size = struct.calcsize(form)
        data.extend(bytes(-len(data) % size))
        data.extend(struct.pack(form, value))

    def value_of(at: str, description: Any) -> None:
        kind, inner = description
        if kind == Nodetype.NAME:
            fields_of(at, inner)
        elif inner[0] in ("string", "wstring"):
            text = make.coded(at, make.rng.choice(("", "map", "rgb8", "ProbeToTracker")))
            put("<I", make.length(f"{at}.(length)", len(text) + 1))
            data.extend(text + b"\0")
        elif inner[0] in _FLOATS:
            value = make.float(at, make.rng.uniform(-1, 1))
            put(_FLOATS[inner[0]], value if inner[0] == "float64" or abs(value) < 3.4e38 else float("inf"))
        elif inner[0] in _NUMBERS:
            code, form = _NUMBERS[inner[0]]
            put(form, make.number(at, make.rng.choice((0, 1, 1, 2, 4)), code))

    def fields_of(at: str, of_type: str) -> None:
        for field, (kind, inner) in types[of_type][1]:
            where = f"{at}.{field}"
            if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                each, size = inner
                count = size if kind == Nodetype.ARRAY else make.rng.choice((0, 1, 3, 4, 12))
                if kind == Nodetype.SEQUENCE:
                    put("<I", make.length(f"{where}.(count)", count))
                for _ in range(count):
                    value_of(where, each)
            else:
                value_of(where, (kind, inner))

    fields_of(name, ros_type)
    return bytes(data)

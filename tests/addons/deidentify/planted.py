"""Sessions with an identifier in every text: planted by walks over the fields, not by the rules that remove it."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.records import Attachment
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import WireError
from igtl_gateway.base.untrusted import definitions
from igtl_gateway.base.untrusted.decoding import new_store, register_types
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.interfaces import PACKAGES, interface_files
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.session import header_names
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Item, decode, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.query import GetBind, StartBind
from igtl_gateway.wire.registry import read_child
from tests.places import ROOT

SOURCE = ROOT / "fixtures" / "every-type.mcap"
#: No six characters of it are anywhere else.
MARK = "Qx7Kmvz3WpJg"
#: Strings that choose how a message is read: without them it would be another message.
_STRUCTURE = {"encoding", "format", "codec", "unit_text"}
_TYPES = {"type", "types"}


def planted_session(path: Path, *, prologue: bool = False) -> None:
    """Write the session with every type, an identifier in all its strings, and the outputs for that.

    Args:
        path: the file.
        prologue: whether its first inputs are a prologue, as in a snapshot.
    """
    with SessionFile.open(SOURCE) as file:
        given = json.loads(file.session[layout.CONFIGURATION_KEY])
        inputs = [planted(entry) for entry in file.entries() if entry.kind.is_input]
    config = dataclasses.replace(
        Config.from_dict(given),
        base_frame=f"{MARK}_base",
        mark_from=(f"{MARK}*", MARK),
        allow_in=(f"{MARK}/servo_*", f"{MARK}/servo_cp"),
        allow_out=(f"{MARK}/move_*", f"{MARK}/move_cp"),
        crtk=(ArmsRow(f"/{MARK}", frame_id=MARK), ArmsRow(f"/{MARK}*")),
        to_igtl=(ToIgtlRow(topic=f"/igtl/out/{MARK}*", device=f"{MARK}_out", metadata=((MARK, MARK),)),),
        to_ros=(ToRosRow(device=f"{MARK}*", topic=f"/{MARK}/{{device}}/{{kind}}", frame_id=f"{MARK}_frame"),),
    )
    facts = {"host": MARK, "command": MARK, "platform": MARK, "operator": MARK, layout.CUSTOM_KEY: f'{{"a": "{MARK}"}}',
             "igtl_gateway_version": MARK, layout.CONFIGURATION_KEY: json.dumps(config.to_dict())}  # fmt: skip
    session = Session(make_core(config, fast_path=False))
    before, inputs = (inputs[:20], inputs[20:]) if prologue else ([], inputs)
    for entry in before:
        session.recorded(entry)
    writer = SessionWriter(path, facts, compression="zstd", prologue=before)
    seq = stamp_ns = 0
    for entry in inputs:
        first = dataclasses.replace(entry, seq=seq + 1, stamp_ns=max(entry.stamp_ns, stamp_ns + 1))
        for each in (first, *session.recorded(first)):
            writer.write(each)
            seq, stamp_ns = each.seq, each.stamp_ns
    writer.close({"streams": session.gateway.ledger.to_dict(), "links": {}})


def planted(entry: Entry) -> Entry:
    """Return an input with the identifier in all strings that it has room for."""
    match entry.kind:
        case Kind.IGTL_IN:
            try:
                message = decode(entry.data())
            except WireError:
                return dataclasses.replace(entry, payload=(entry.data() + MARK.encode(),))
            items = (Item.of(MARK, MARK), Item.of("Patient", MARK)) if message.header_version == 2 else ()
            new = dataclasses.replace(
                message, device_name=MARK + message.device_name[:8], content=_content(message.content), metadata=items
            )
            data = join(encode(new))
            channel, kind, source_ns = header_names(data)
            return dataclasses.replace(entry, channel=channel, type=kind, payload=(data,), source_ns=source_ns)
        case Kind.ROS_IN:
            data = _ros(entry.type, entry.data())
            return dataclasses.replace(entry, channel=f"{entry.channel}/{MARK}", payload=(data,))
        case _:
            note = Note.of(entry.data())
            facts = {**note.data, "who": MARK, MARK: {MARK: 1}}
            facts |= {key: f"{MARK}:{facts[key]}" for key in ("peer", "local", "reason") if key in facts}
            return dataclasses.replace(entry, payload=(Note(Level.INFO, note.code, MARK, f"/{MARK}", facts).pack(),))


def _content(content: Any) -> Any:
    if isinstance(content, Elements):
        new = content.elements.copy()
        for name in content.DTYPE.names or ():
            if content.DTYPE[name].kind == "S":
                new[name] = MARK.encode()
        return dataclasses.replace(content, elements=new)
    if isinstance(content, Bind):
        children = (BindChild(child.type, MARK, _child(child)) for child in content.children)
        return Bind(tuple(children))
    if isinstance(content, GetBind | StartBind):
        return dataclasses.replace(content, children=tuple((kind, MARK) for kind, _ in content.children), kept=None)
    texts: dict[str, Any] = {}
    for field in dataclasses.fields(content):
        value = getattr(content, field.name)
        if isinstance(value, str) and field.name not in ("codec", "form"):
            texts[field.name] = MARK
        elif field.name == "data" and type(value) is bytes and hasattr(content, "encoding"):
            texts |= {
                "data": MARK.encode(("utf-8", "utf-16-be")[len(value) % 2]),
                "encoding": (106, 1013)[len(value) % 2],
            }
        elif field.name == "types":
            texts["types"] = (*value, MARK)
        elif field.name == "attributes":
            texts["attributes"] = tuple(dataclasses.replace(each, name=MARK) for each in value)
    return dataclasses.replace(content, **texts)


def _child(child: BindChild) -> bytes:
    try:
        return join(_content(read_child(child)).pack())
    except WireError:
        return bytes(child.content) + MARK.encode()


def ros_store() -> Any:
    """Return a store with the types of ROS 2 Jazzy and of this project."""
    store = new_store(Stores.ROS2_JAZZY)
    for package in PACKAGES:
        for path in interface_files(package):
            name = f"{package}/msg/{path.stem}"
            if path.suffix == ".msg" and name not in store.fielddefs:
                register_types(store, definitions.parse_definition(path.read_text(), name))
    return store


_STORE = ros_store()


def _ros(ros_type: str, data: bytes) -> bytes:
    try:
        message = _STORE.deserialize_cdr(data, ros_type)
        _plant(message, ros_type)
        return bytes(_STORE.serialize_cdr(message, ros_type))
    except Exception:  # one of the messages of this session that are deliberately damaged
        return data


def _plant(message: Any, name: str) -> None:
    fields: Any = _STORE.fielddefs[name][1]
    for field, (kind, inner) in fields:
        value: Any = getattr(message, field, None)
        several = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (kind_of_each, each), _ = inner if several else ((kind, inner), 0)
        if kind_of_each == Nodetype.NAME:
            for one in value if several else [value]:
                _plant(one, each)
        elif each[0] == "string" and field not in _STRUCTURE and not (field in _TYPES and name.startswith("igtl_msgs")):
            setattr(message, field, [MARK for _ in value] if several else MARK)


def all_bytes(path: Path) -> Iterator[bytes]:
    """Yield the records of an MCAP file, unpacked, and those of files inside it."""
    yield from _records(path.read_bytes())


def _records(data: bytes) -> Iterator[bytes]:
    for record in StreamReader(io.BytesIO(data)).records:
        yield repr(record).encode()
        if isinstance(record, Attachment) and record.name.endswith(".mcap"):
            yield from _records(record.data)
        content = getattr(record, "data", b"")
        yield bytes(content)


def found(path: Path, text: str = MARK, least: int = 6) -> list[str]:
    """Return the parts of a string that are anywhere in a file, in several encodings."""
    parts = {text[at : at + least] for at in range(len(text) - least + 1)}
    needles = {
        form.encode(code): form
        for part in parts
        for form in (part, part.lower(), part.upper())
        for code in ("utf-8", "utf-16-le", "utf-16-be")
    }
    digits = {part.encode().hex(): part for part in parts}
    needles |= {form.encode(): part for each, part in digits.items() for form in (each, each.upper())}
    # of the three alignments in base64, the characters that no neighbour changes
    needles |= {base64.b64encode(bytes(shift) + text.encode())[4 if shift else 0 : -4]: text for shift in range(3)}
    return sorted({part for data in all_bytes(path) for needle, part in needles.items() if needle in data})

"""The rules for OpenIGTLink by tables: each field of each list, each class of contents, and the header.

What a table does not name fails: a new field or a new class needs a row, so no part of a message is without a rule.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.messages import _RULES, MessageCleaner
from igtl_gateway.addons.deidentify.profile import BASIC, Profile, TextRule
from igtl_gateway.addons.deidentify.rules import RULES
from igtl_gateway.base.buffers import join
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.gateway.metadata import CHILD_FRAME_ID, FRAME_ID, FULL_NAME, STAMP
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.polydata import Attribute, PolyData
from igtl_gateway.wire.query import (
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
)
from igtl_gateway.wire.registry import ALIASES, BODIES
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video
from tests.tables import table

SECOND = 1_000_000_000
KEY, SHIFT_S = bytes(range(32)), -864_000
#: Ticks of a date with a fraction that must stay to the bit, of that date moved, and of a time since a start.
DATE, MOVED, UPTIME = (1_600_000_000 << 32) | 0x12345678, ((1_600_000_000 + SHIFT_S) << 32) | 0x12345678, 77 << 32
NAME = "Qx7Kmvz3"

NAMED, TEXT, WORD, EMPTY, IDENTIFIER, TIME, ZERO, STAYS = (
    "pseudonym", "removed", "a word of DICOM stays", "empty", "identifier", "moved", "zero", "stays"
)  # fmt: skip
#: What each field is afterwards, by its name, in all lists.
FIELDS = {
    "name": NAMED, "device_name": NAMED, "owner": NAMED, "group": TEXT, "modality": WORD, "patient_name": EMPTY,
    "patient_id": IDENTIFIER, "ticks": TIME, "reserved": ZERO,
    **dict.fromkeys("size scalar_type label rgba position diameter type entry target matrix quaternion".split(), STAYS),
    **dict.fromkeys(("zoom_level", "focal_length"), STAYS),
}  # fmt: skip
LISTS = {name: codec for name, codec in BODIES.items() if issubclass(codec, Elements) and name not in ALIASES}


def context_of(profile: Profile = BASIC) -> Context:
    return Context.of(profile, KEY, SHIFT_S * SECOND)


def cleaned(message: Message, profile: Profile = BASIC) -> tuple[Message, Context]:
    context = context_of(profile)
    data = join(encode(message))
    return decode(MessageCleaner(context).clean(data, f"{message.type}/{message.device_name}")), context


def names(*given: str) -> list[str]:
    new = context_of().names
    return [new.name(each) for each in given]


def planted(codec: type[Elements]) -> Any:
    """Two elements: every string is a name, every number another one, every time a date; then with none of it."""
    elements = np.zeros(2, codec.DTYPE)
    for number, name in enumerate(codec.DTYPE.names or (), 1):
        if codec.DTYPE[name].kind == "S":
            elements[name][0] = b"CT" if name == "modality" else f"{NAME}{number}".encode()
        else:
            elements[name][0] = DATE if name == "ticks" else number
    return elements


def name_of(text: str) -> str:
    return names(text)[0]


def _expected(fate: str, before: Any) -> Any:
    match fate:
        case "pseudonym":
            return name_of(before.decode()).encode()
        case "identifier":
            return context_of().names.identifier(before.decode()).encode()
        case "removed" | "empty":
            return b""
        case "moved":
            return MOVED
        case "zero":
            return 0
        case _:
            return before


@table("kind", LISTS)
def test_each_field_of_each_list_has_a_rule(kind: str) -> None:
    codec = LISTS[kind]
    given = planted(codec)
    new, context = cleaned(Message(kind, "List", codec(given)))
    assert isinstance(new.content, Elements)
    found = new.content.elements
    for name in codec.DTYPE.names or ():
        before, after = given[name][0], found[name][0]
        assert np.array_equal(after, _expected(FIELDS[name], before)), name
        assert np.array_equal(found[name][1], given[name][1]), f"{name}: an element without contents stays so"
    wanted = {"patient": EMPTY, "time": TIME, "text": TEXT, "name": NAMED}
    fates = {FIELDS[name] for name in codec.DTYPE.names or ()}
    for rule, fate in wanted.items():
        assert (context.report.rules[rule] > (rule == "name")) == (fate in fates), rule  # the device has a name, too


def test_the_time_of_a_scan_is_moved_and_what_is_unset_stays() -> None:
    """The stamps inside IMGMETA are dates of a patient."""
    codec = LISTS["IMGMETA"]
    elements = np.zeros(4, codec.DTYPE)
    elements["ticks"] = [DATE, 0, UPTIME, DATE + (5 << 32)]
    message = Message("IMGMETA", "List", codec(elements))
    new, context = cleaned(message)
    assert isinstance(new.content, Elements)
    assert new.content.elements["ticks"].tolist() == [MOVED, 0, UPTIME, MOVED + (5 << 32)]
    assert context.report.rules["time"] == 2
    kept = Context.of(BASIC, KEY, 0)
    same = decode(MessageCleaner(kept).clean(join(encode(message)), "IMGMETA/List")).content
    assert isinstance(same, Elements)
    assert same.elements["ticks"].tolist() == elements["ticks"].tolist() and not kept.report.rules["time"]


@table("word", ["CT", "MR", "US", "Doe, Jane", "ct", "CT Doe"])
def test_a_modality_stays_if_it_is_one(word: str) -> None:
    codec = LISTS["IMGMETA"]
    elements = np.zeros(1, codec.DTYPE)
    elements["modality"] = word.encode()
    new, context = cleaned(Message("IMGMETA", "List", codec(elements)))
    assert isinstance(new.content, Elements)
    is_word = len(word) == 2 and word.isupper()
    assert new.content.elements["modality"][0].decode() == (word if is_word else "")
    assert context.report.rules["text"] == (not is_word)


@dataclass(frozen=True)
class Row:
    """A content, what it becomes (None: the message is removed, by the first of the rules), and the counted rules."""

    kind: str
    content: Any
    expected: Callable[[], Any] | None
    rules: dict[str, int] = field(default_factory=dict)
    profile: Profile = BASIC


def _same(content: Any) -> Callable[[], Any]:
    return lambda: content


def _keeps(kind: str) -> Profile:
    return replace(BASIC, keep_types=(kind,))


_TRANSFORM = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 7.0, 8.0, 9.0))
_POSITION = Position((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
_SENSOR = Sensor(np.array([1.0, 2.0]), 3, 4)
_POINTS = np.zeros((1, 3), np.float32)
_KEEP_TEXT = Profile(text_rules=(TextRule("**", "keep"),))
_REPLACE_TEXT = Profile(text_rules=(TextRule("STRING/*", "replace", "new"),))
_CHILD = join(String.of(NAME).pack())

ROWS = {
    "TRANSFORM": Row("TRANSFORM", _TRANSFORM, _same(_TRANSFORM)),
    "POSITION": Row("POSITION", _POSITION, _same(_POSITION)),
    "SENSOR": Row("SENSOR", _SENSOR, _same(_SENSOR)),
    "RTS": Row("RTS_TDATA", QueryReply(1), _same(QueryReply(1))),
    "STT_POLYDATA": Row("STT_POLYDATA", StartPolyData(5), _same(StartPolyData(5))),
    "STRING": Row("STRING", String.of(NAME), lambda: String.of(""), {"text": 1}),
    "STRING, kept": Row("STRING", String.of(NAME), lambda: String.of(NAME), {}, _KEEP_TEXT),
    "STRING, replaced": Row("STRING", String.of(NAME), lambda: String.of("new"), {"text": 1}, _REPLACE_TEXT),
    "CLIENTINFO": Row("CLIENTINFO", ClientInfo.of(NAME), lambda: ClientInfo.of(""), {"text": 1}),
    "STATUS": Row("STATUS", Status(13, 5, NAME, f"about {NAME}"), lambda: Status(13, 5, "", ""), {"text": 2}),
    "STATUS, kept as long as it may be": Row(
        "STATUS", Status(13, 5, "n" * 20, "why"), lambda: Status(13, 5, "n" * 20, "why"), {}, _KEEP_TEXT
    ),
    "STATUS, kept": Row("STATUS", Status(13, 5, NAME, "why"), lambda: Status(13, 5, NAME, "why"), {}, _KEEP_TEXT),
    "COMMAND": Row(
        "COMMAND", Command.of(9, NAME, f"<{NAME}/>"), lambda: Command.of(9, name_of(NAME), ""), {"text": 1, "name": 1}
    ),
    "COMMAND, kept": Row(
        "COMMAND", Command.of(9, NAME, "go"), lambda: Command.of(9, name_of(NAME), "go"), {"name": 1}, _KEEP_TEXT
    ),
    "NDARRAY, 16 bits": Row("NDARRAY", NdArray(5, (2,), bytes(4)), _same(NdArray(5, (2,), bytes(4)))),
    "NDARRAY, 8 bits": Row("NDARRAY", NdArray(3, (2,), b"Qx"), None, {"bytes": 1}),
    "NDARRAY, 8 bits with a sign": Row("NDARRAY", NdArray(2, (2,), b"Qx"), None, {"bytes": 1}),
    "NDARRAY, kept": Row("NDARRAY", NdArray(3, (2,), b"Qx"), _same(NdArray(3, (2,), b"Qx")), {}, _keeps("NDARRAY")),
    "POLYDATA": Row(
        "POLYDATA",
        PolyData(_POINTS, attributes=(Attribute.of(0, NAME, np.ones((1, 1), np.float32)),)),
        lambda: PolyData(_POINTS, attributes=(Attribute.of(0, name_of(NAME), np.ones((1, 1), np.float32)),)),
        {"name": 1},
    ),
    "CAPABILITY": Row(
        "CAPABILITY",
        Capability(("TRANSFORM", NAME, "GET_IMAGE")),
        lambda: Capability(("TRANSFORM", "GET_IMAGE")),
        {"type": 1},
    ),
    "BIND": Row(
        "BIND",
        Bind((BindChild("STRING", NAME, _CHILD), BindChild("UNKNOWN", NAME, b"Qx"), BindChild("STRING", "", b"Q"))),
        lambda: Bind((BindChild("STRING", name_of(NAME), join(String.of("").pack())),)),
        {"text": 1, "name": 1, "type": 1, "damaged": 1},
    ),
    "GET_BIND": Row(
        "GET_BIND",
        GetBind((("TRANSFORM", NAME), ("UNKNOWN", NAME))),
        lambda: GetBind((("TRANSFORM", name_of(NAME)),)),
        {"name": 2},
    ),
    "STT_BIND": Row(
        "STT_BIND",
        StartBind(7, (("TRANSFORM", NAME), ("UNKNOWN", NAME))),
        lambda: StartBind(7, (("TRANSFORM", name_of(NAME)),)),
        {"name": 2},
    ),
    "STT_TDATA": Row("STT_TDATA", StartTracking(50, NAME), lambda: StartTracking(50, name_of(NAME)), {"name": 1}),
    "STT_VIDEO": Row("STT_VIDEO", StartVideo("H264", 3, b"Q"), _same(StartVideo("H264", 3))),
    "GET_TRANS": Row("GET_TRANS", EmptyQuery(NAME.encode()), _same(EmptyQuery())),
}
#: Classes whose rules have tests of pixels.
_PIXELS = {Image, Video}


@table("name", ROWS)
def test_each_class_of_contents_has_a_rule(name: str) -> None:
    row = ROWS[name]
    message = Message(row.kind, "Device", row.content)
    if row.expected is None:
        context = context_of(row.profile)
        (rule,) = row.rules
        with pytest.raises(Removed, match=f"^{rule}$"):
            MessageCleaner(context).clean(join(encode(message)), f"{row.kind}/Device")
        return
    new, context = cleaned(message, row.profile)
    assert new.content == row.expected()
    assert type(new.content) is type(row.content)
    counts = +context.report.rules
    counts["name"] -= 1  # that of the device
    assert +counts == row.rules


def test_each_class_with_a_rule_has_a_row() -> None:
    tested = {type(row.content) for row in ROWS.values()} | _PIXELS
    assert {each.__name__ for each in _RULES.keys() - tested} == {"Raw", "ColorTable"}, "which have no text"


def test_each_rule_of_the_profile_is_counted_by_a_test() -> None:
    """The rules that are not here have rows in the tables of ROS, notes, settings and sessions."""
    here = {rule for row in ROWS.values() for rule in row.rules} | {
        "patient",
        "time",
        "metadata",
        "padding",
        "kept type",
    }
    there = {"place", "pixels", "picture data", "address", "note", "setting", "session"}
    assert here | there == RULES.keys() and not here & there


def test_the_header_has_a_new_name_and_a_moved_stamp() -> None:
    new, context = cleaned(Message("TRANSFORM", NAME, _TRANSFORM, DATE))
    assert (new.device_name, new.ticks) == (*names(NAME), MOVED)
    assert (context.report.rules["name"], context.report.rules["time"]) == (1, 1)


def test_metadata_keep_what_the_profile_names_and_what_the_gateway_needs() -> None:
    full = f"{NAME}ToReferenceOfTheTracker"
    items = (
        Item.of("Patient", NAME), Item.of("Kept", "value"), Item.of(FULL_NAME, full),
        Item.of(STAMP, str(1_600_000_000 * SECOND + 5)), Item.of(FRAME_ID, "Reference"), Item.of(CHILD_FRAME_ID, NAME),
    )  # fmt: skip
    message = Message("TRANSFORM", short_device_name(full), _TRANSFORM, header_version=2, metadata=items)
    new, context = cleaned(message, replace(BASIC, keep_metadata=("Kep*",)))
    name, frame, child = names(full, "Reference", NAME)
    found = {item.key: item.text for item in new.metadata}
    assert found == {
        "Kept": "value", STAMP: str((1_600_000_000 + SHIFT_S) * SECOND + 5), FRAME_ID: frame, CHILD_FRAME_ID: child,
        **({FULL_NAME: name} if len(name) > 20 else {}),
    }  # fmt: skip
    assert new.device_name == short_device_name(name)
    assert context.report.rules["metadata"] == 1


def test_a_message_that_is_damaged_or_of_an_unknown_type_is_removed() -> None:
    data = bytearray(join(encode(Message("STRING", "Device", String.of(NAME)))))
    data[-1] ^= 1
    with pytest.raises(Removed, match=r"^damaged$"):
        MessageCleaner(context_of()).clean(bytes(data), "STRING/Device")
    unknown = join(encode(Message("MYTYPE", "Device", String.of(NAME))))
    with pytest.raises(Removed, match=r"^type$"):
        MessageCleaner(context_of()).clean(unknown, "MYTYPE/Device")
    context = context_of(_keeps("MYTYPE"))
    assert NAME.encode() in MessageCleaner(context).clean(unknown, "MYTYPE/Device")
    assert context.report.rules["kept type"] == 1

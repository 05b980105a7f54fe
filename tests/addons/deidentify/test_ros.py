"""The rules for ROS messages by tables: names, words, times, places and bytes, in fields of known types."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from igtl_gateway.addons.deidentify import ros
from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.messages import MessageCleaner
from igtl_gateway.addons.deidentify.profile import BASIC, Profile
from igtl_gateway.addons.deidentify.ros import RosCleaner, bare_definition
from tests.addons.deidentify.planted import ros_store
from tests.addons.deidentify.test_rules import planted_message
from tests.tables import table

SECOND, NAME = 1_000_000_000, "Qx7Kmvz3"
KEY, SHIFT_S, DATE_S = bytes(range(32)), -864_000, 1_600_000_000
STORE = ros_store()


def cleaner_of(profile: Profile = BASIC, recorded: dict[str, str] | None = None) -> tuple[RosCleaner, Context]:
    context = Context.of(profile, KEY, SHIFT_S * SECOND)
    return RosCleaner(context, MessageCleaner(context), recorded or {}), context


def cleaned(ros_type: str, message: Any, profile: Profile = BASIC) -> tuple[Any, Context]:
    cleaner, context = cleaner_of(profile)
    data = bytes(STORE.serialize_cdr(message, ros_type))
    return STORE.deserialize_cdr(cleaner.clean(ros_type, data, "/topic"), ros_type), context


def empty(ros_type: str, **fields: Any) -> Any:
    """A message without contents, apart from some fields."""
    given = {}
    for name, (kind, inner) in STORE.fielddefs[ros_type][1]:
        if kind == Nodetype.NAME:
            given[name] = empty(inner)
        elif kind == Nodetype.BASE:
            given[name] = {"string": "", "bool": False}.get(inner[0], 0.0 if inner[0].startswith("float") else 0)
        else:
            (each_kind, each), length = inner
            count = length if kind == Nodetype.ARRAY else 0
            if each_kind == Nodetype.BASE and each[0] != "string":
                given[name] = np.zeros(count, {"octet": "uint8", "byte": "uint8"}.get(each[0], each[0]))
            else:
                given[name] = [empty(each) if each_kind == Nodetype.NAME else "" for _ in range(count)]
    return STORE.types[ros_type](**(given | fields))


def of_name(text: str) -> str:
    return cleaner_of()[1].names.name(text)


#: Type, field, value → new value: the words of protocols stay, names become pseudonyms, other text goes.
FIELDS = {
    "frame": ("std_msgs/msg/Header", "frame_id", NAME, of_name(NAME)),
    "child frame": ("nav_msgs/msg/Odometry", "child_frame_id", NAME, of_name(NAME)),
    "joints": ("sensor_msgs/msg/JointState", "name", [NAME, "jaw"], [of_name(NAME), of_name("jaw")]),
    "joints of several axes": ("sensor_msgs/msg/MultiDOFJointState", "joint_names", [NAME], [of_name(NAME)]),
    "joints of a trajectory": ("trajectory_msgs/msg/JointTrajectory", "joint_names", [NAME], [of_name(NAME)]),
    "owner": ("igtl_msgs/msg/LabeledPoint", "owner", NAME, of_name(NAME)),
    "device": ("igtl_msgs/msg/ImageMeta", "device_name", NAME, of_name(NAME)),
    "picture": ("igtl_msgs/msg/ImageMeta", "name", NAME, of_name(NAME)),
    "label": ("igtl_msgs/msg/LabelMeta", "name", NAME, of_name(NAME)),
    "video": ("igtl_msgs/msg/VideoMeta", "name", NAME, of_name(NAME)),
    "point": ("igtl_msgs/msg/LabeledPoint", "name", NAME, of_name(NAME)),
    "trajectory": ("igtl_msgs/msg/Trajectory", "name", NAME, of_name(NAME)),
    "tool": ("igtl_msgs/msg/TrackedTool", "name", NAME, of_name(NAME)),
    "attribute": ("igtl_msgs/msg/PolyDataAttribute", "name", NAME, of_name(NAME)),
    "command": ("igtl_msgs/msg/Command", "name", NAME, of_name(NAME)),
    "reply": ("igtl_msgs/msg/CommandReply", "name", NAME, of_name(NAME)),
    "patient": ("igtl_msgs/msg/ImageMeta", "patient_name", NAME, ""),
    "identifier": ("igtl_msgs/msg/VideoMeta", "patient_id", NAME, cleaner_of()[1].names.identifier(NAME)),
    "text": ("std_msgs/msg/String", "data", NAME, ""),
    "types of a capability": ("igtl_msgs/msg/Capability", "types", ["TRANSFORM", NAME], ["TRANSFORM", ""]),
    "type of a query": ("igtl_msgs/msg/Query", "type", "GET_IMAGE", "GET_IMAGE"),
    "type of a query, any": ("igtl_msgs/msg/Query", "type", NAME, ""),
    "codec of a query": ("igtl_msgs/msg/Query", "codec", "H264", "H264"),
    "codec of a query, any": ("igtl_msgs/msg/Query", "codec", NAME, ""),
    "type of metadata": ("igtl_msgs/msg/Metadata", "type", "STRING", "STRING"),
    "type of metadata, any": ("igtl_msgs/msg/Metadata", "type", NAME, ""),
    "field of a cloud": ("sensor_msgs/msg/PointField", "name", "intensity", "intensity"),
    "field of a cloud, any": ("sensor_msgs/msg/PointField", "name", NAME, ""),
    "unit": ("igtl_msgs/msg/Sensor", "unit_text", "mm", "mm"),
    "unit, any": ("igtl_msgs/msg/Sensor", "unit_text", NAME, ""),
    "kind of picture": ("sensor_msgs/msg/CompressedImage", "format", f"{NAME}; jpeg compressed bgr8", "jpeg"),
    "kind of picture, any": ("sensor_msgs/msg/CompressedImage", "format", NAME, ""),
}  # fmt: skip


@table("name", FIELDS)
def test_each_field_of_text_has_a_rule(name: str) -> None:
    ros_type, place, value, expected = FIELDS[name]
    new, _ = cleaned(ros_type, empty(ros_type, **{place: value}))
    found = getattr(new, place)
    assert (list(found) if isinstance(value, list) else found) == expected


def test_the_tables_of_fields_have_a_test_each() -> None:
    tested = {(ros_type, place) for ros_type, place, _, _ in FIELDS.values()}
    elsewhere = {
        ("igtl_msgs/msg/BoundMessage", "name"), ("igtl_msgs/msg/BoundMessage", "type"),
        ("igtl_msgs/msg/VideoFrame", "codec"), ("foxglove_msgs/msg/CompressedVideo", "format"),
    }  # fmt: skip
    assert set(ros._NAMES_OF.items()) | ros._WORDS.keys() <= tested | elsewhere
    assert {place for _, place in tested} >= ros._NAMES - {"coordinate_name"}


def _times(message: Any, ros_type: str) -> Iterator[Any]:
    for name, (kind, inner) in STORE.fielddefs[ros_type][1]:
        several = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (each_kind, each), _ = inner if several else ((kind, inner), 0)
        if each_kind != Nodetype.NAME:
            continue
        value = getattr(message, name)
        for one in value if several else [value]:
            if each == "builtin_interfaces/msg/Time":
                yield one
            else:
                yield from _times(one, each)


def test_each_time_of_each_type_is_moved() -> None:
    """In headers, in elements of lists and in parts of parts; times since a start stay."""
    moved = 0
    for ros_type in sorted(name for name in STORE.fielddefs if "/msg/" in name):
        message = planted_message(STORE, ros_type)
        times = list(_times(message, ros_type))
        for number, one in enumerate(times):
            one.sec, one.nanosec = DATE_S + number, 5
        if not times:
            continue
        try:
            new, context = cleaned(ros_type, message)
        except Removed:
            continue
        found = [(one.sec, one.nanosec) for one in _times(new, ros_type)]
        assert found == [(DATE_S + SHIFT_S + number, 5) for number in range(len(times))], ros_type
        assert context.report.rules["time"] >= len(times)
        moved += len(times)
    assert moved > 80
    header = empty("std_msgs/msg/Header")
    header.stamp.sec = 77
    assert cleaned("std_msgs/msg/Header", header)[0].stamp.sec == 77, "the time since a machine was started"


#: Type → the rule that removes its messages, with an empty profile.
REMOVED = {
    "sensor_msgs/msg/NavSatFix": "place",
    "geographic_msgs/msg/GeoPoint": "place",
    "igtl_msgs/msg/RawMessage": "type",
    "some_msgs/msg/Unknown": "type",
    "std_msgs/msg/UInt8MultiArray": "bytes",
    "std_msgs/msg/Int8MultiArray": "bytes",
    "igtl_msgs/msg/MetadataItem": "metadata",
}


@table("ros_type", REMOVED)
def test_what_is_removed(ros_type: str) -> None:
    data = bytes(STORE.serialize_cdr(planted_message(STORE, ros_type), ros_type)) if ros_type in STORE.types else b""
    with pytest.raises(Removed, match=f"^{REMOVED[ros_type]}$"):
        cleaner_of()[0].clean(ros_type, data, "/topic")


@table("scalar", [2, 3])
def test_an_array_of_bytes_is_removed_unless_the_profile_keeps_its_type(scalar: int) -> None:
    name = "igtl_msgs/msg/NdArray"
    message = empty(name, scalar_type=scalar, data=np.frombuffer(b"Qx", np.uint8))
    with pytest.raises(Removed, match=r"^bytes$"):
        cleaned(name, message)
    assert bytes(cleaned(name, message, replace(BASIC, keep_types=(name,)))[0].data) == b"Qx"
    message.scalar_type = 5
    assert bytes(cleaned(name, message)[0].data) == b"Qx"


def test_metadata_lose_the_items_that_the_profile_does_not_keep() -> None:
    name, item = "igtl_msgs/msg/Metadata", STORE.types["igtl_msgs/msg/MetadataItem"]
    message = empty(name, items=[item("Patient", 3, NAME), item("Kept", 3, "value")])
    new, context = cleaned(name, message, replace(BASIC, keep_metadata=("Kept",)))
    assert [(each.key, each.value) for each in new.items] == [("Kept", "value")]
    assert context.report.rules["metadata"] == 1


@table("padding", [0, 3])
def test_what_follows_a_row_of_a_picture_is_zero(padding: int) -> None:
    rows = np.full((2, 4 + padding), 9, np.uint8)
    message = empty(
        "sensor_msgs/msg/Image", height=2, width=4, step=4 + padding, encoding="mono8", data=rows.reshape(-1)
    )
    new, context = cleaned("sensor_msgs/msg/Image", message)
    assert new.data.reshape(2, -1)[:, :4].tolist() == [[9] * 4] * 2
    assert not new.data.reshape(2, -1)[:, 4:].any()
    assert context.report.rules["padding"] == bool(padding)


#: Fields of a picture that do not fit each other → the rule.
PICTURES: dict[str, tuple[dict[str, Any], str]] = {
    "short rows": ({"step": 3, "data": np.zeros(6, np.uint8)}, "damaged"),
    "too little": ({"data": np.zeros(7, np.uint8)}, "damaged"),
    "unknown encoding": ({"encoding": NAME}, "pixels"),
}


@table("name", PICTURES)
def test_a_picture_that_is_none_is_removed(name: str) -> None:
    fields, rule = PICTURES[name]
    good: dict[str, Any] = {"height": 2, "width": 4, "step": 4, "encoding": "mono8", "data": np.zeros(8, np.uint8)}
    cleaned("sensor_msgs/msg/Image", empty("sensor_msgs/msg/Image", **good))
    with pytest.raises(Removed, match=f"^{rule}$"):
        cleaned("sensor_msgs/msg/Image", empty("sensor_msgs/msg/Image", **(good | fields)))


def test_a_type_that_the_profile_keeps_is_read_by_its_recorded_definition() -> None:
    name = "some_msgs/msg/Unknown"
    text = "string patient_name\nint32 number  # of a person\n"
    profile = replace(BASIC, keep_types=("some_msgs/**",))
    cdr = b"\0\1\0\0" + b"\x09\0\0\0" + NAME.encode() + b"\0\0\0\0" + b"\x05\0\0\0"
    cleaner, _ = cleaner_of(profile, {name: text})
    new = cleaner.clean(name, cdr, "/topic")
    assert NAME.encode() not in new and new.endswith(b"\x05\0\0\0")
    unread, context = cleaner_of(profile, {name: "= [[["})
    assert unread.clean(name, cdr, "/topic") == cdr and context.report.rules["kept type"] == 1
    assert bare_definition(text, name) == "string patient_name\nint32 number"

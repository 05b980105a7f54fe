"""The places of the stamps, compared with rosbags: unpack, set all stamps, pack gives the same bytes."""

from __future__ import annotations

import struct
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.convert.interfaces import SHARES, definition_folder
from igtl_gateway.replay.stamp_places import StampPlaces
from tests.tables import table

STORE = get_typestore(Stores.ROS2_JAZZY)
for _package in ("igtl_msgs", "foxglove_msgs", "crtk_msgs"):
    _found: dict[str, Any] = {}
    for _path in sorted(definition_folder(_package).glob("msg/*.msg")):
        _found |= get_types_from_msg(_path.read_text("utf-8"), f"{_package}/msg/{_path.stem}")
    STORE.register({name: told for name, told in _found.items() if name not in STORE.fielddefs})

TIME = "builtin_interfaces/msg/Time"
#: Of each with how many stamps in a message that has two elements in each sequence.
TYPES = {
    "action_msgs/msg/GoalStatusArray": 2,
    "diagnostic_msgs/msg/DiagnosticArray": 1,
    "geometry_msgs/msg/PoseArray": 1,
    "igtl_msgs/msg/ImageMeta": 0,
    "igtl_msgs/msg/Note": 1,
    "nav_msgs/msg/OccupancyGrid": 1,  # its map_load_time is no stamp
    "nav_msgs/msg/Path": 3,
    "rcl_interfaces/msg/Log": 1,
    "rosgraph_msgs/msg/Clock": 1,
    "sensor_msgs/msg/PointCloud2": 1,
    "sensor_msgs/msg/TimeReference": 1,
    "std_msgs/msg/String": 0,
    "tf2_msgs/msg/TFMessage": 2,
    "trajectory_msgs/msg/JointTrajectory": 1,
    "visualization_msgs/msg/InteractiveMarkerInit": 2 * (1 + 2 * (2 * 2)),
    "visualization_msgs/msg/Marker": 2,
    "visualization_msgs/msg/MarkerArray": 4,
} | {name: -1 for name in STORE.fielddefs if name.startswith(("igtl_msgs/", "foxglove_msgs/", "crtk_msgs/"))}

_NUMBERS = {"float32": "f4", "float64": "f8", "bool": "?", "octet": "u1", "byte": "u1", "char": "u1"}


class Made:
    """Makes a message of a type; counts its stamps, which ``change`` gives another value."""

    def __init__(self, chance: Random, fixed: bool) -> None:
        self._chance, self._fixed = chance, fixed
        self.stamps: list[Any] = []

    def struct(self, name: str) -> Any:
        values = {}
        for field, (kind, inner) in STORE.fielddefs[name][1]:
            values[field] = self.value(int(kind), inner)
            if inner == TIME and (field in ("stamp", "timestamp") or name == "rosgraph_msgs/msg/Clock"):
                self.stamps.append(values[field])
        return STORE.types[name](**values)

    def value(self, kind: int, inner: Any) -> Any:
        if kind == 1:
            if inner[0] == "string":
                return "x" * self._chance.randrange(10)
            kind_of = np.dtype(_NUMBERS.get(inner[0], inner[0]))
            return kind_of.type(self._chance.randrange(2)).item()
        if kind == 2:
            return self.struct(inner)
        count = inner[1] if kind == 3 else 2 if self._fixed else self._chance.randrange(4)
        items = [self.value(int(inner[0][0]), inner[0][1]) for _ in range(count)]
        if inner[0][0] == 1 and inner[0][1][0] != "string":
            return np.array(items, np.dtype(_NUMBERS.get(inner[0][1][0], inner[0][1][0])))
        return items


@table("ros_type", sorted(TYPES))
@table("little", [True, False])
@table("fixed", [True, False])
def test_all_stamps_and_nothing_else(ros_type: str, fixed: bool, little: bool) -> None:
    for seed in range(1 if fixed else 4):
        made = Made(Random(seed), fixed)
        check(ros_type, made.struct(ros_type), made, little)
        if fixed and TYPES[ros_type] >= 0:
            assert len(made.stamps) == TYPES[ros_type]


def check(ros_type: str, message: Any, made: Made, little: bool) -> None:
    before = bytearray(STORE.serialize_cdr(message, ros_type, little_endian=little))
    places = StampPlaces({}).of(ros_type, bytes(before))
    assert places is not None and len(places) == len(made.stamps)
    for number, (place, stamp) in enumerate(zip(places, made.stamps, strict=True)):
        object.__setattr__(stamp, "sec", 1_000 + number)
        object.__setattr__(stamp, "nanosec", number)
        struct.pack_into("<iI" if little else ">iI", before, place, 1_000 + number, number)
    assert bytes(before) == bytes(STORE.serialize_cdr(message, ros_type, little_endian=little))


@pytest.mark.parametrize("ros_type", ["tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"])
@given(data=st.binary(max_size=80))
@settings(max_examples=100)
def test_any_bytes_give_places_inside_or_none(ros_type: str, data: bytes) -> None:
    places = StampPlaces({}).of(ros_type, b"\0\1\0\0" + data)
    assert places is None or all(4 <= place <= len(data) - 4 for place in places)


def test_an_impossible_length_ends_at_once() -> None:
    assert StampPlaces({}).of("visualization_msgs/msg/MarkerArray", b"\0\1\0\0" + b"\xff" * 40) is None


def test_what_cannot_be_walked_past_matters_only_before_a_stamp() -> None:
    text = "wstring name\nstd_msgs/Header header"
    told = "std_msgs/Header header\nwstring name"
    places = StampPlaces({"a/msg/A": text, "a/msg/B": told, "a/msg/C": "not a definition", "a/msg/D": "a/E e"})
    data = b"\0\1\0\0" + bytes(40)
    assert places.of("a/msg/A", data) is None
    assert places.of("a/msg/B", data) == [4]
    assert places.of("a/msg/C", data) is None
    assert places.of("a/msg/D", data) is None
    assert places.of("a/msg/None", data) is None
    assert places.of("std_msgs/msg/Header", b"\0\3\0\0" + bytes(40)) is None, "another encapsulation"


def test_definitions_of_ours_are_where_they_are_looked_for() -> None:
    assert any((share / "igtl_msgs" / "msg" / "Note.msg").is_file() for share in SHARES)


def test_all_times_of_a_message_whatever_their_names() -> None:
    """As a bag of ROS 1 needs it: other structures and durations are no times."""
    text = (
        "builtin_interfaces/Time when\nbuiltin_interfaces/Duration last\nstd_msgs/Header header\n"
        "builtin_interfaces/Time[2] pair\ngeometry_msgs/Point at"
    )
    definitions, data = {"a/msg/A": text}, b"\0\1\0\0" + bytes(100)
    assert StampPlaces(definitions, all_times=True).of("a/msg/A", data) == [4, 20, 32, 40]
    assert StampPlaces(definitions).of("a/msg/A", data) == [20]

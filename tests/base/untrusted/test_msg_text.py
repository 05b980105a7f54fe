"""Text of ``.msg`` files: the fields that rosidl reads, and those of ROS 1."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from mcap_ros2._vendor.rosidl_adapter import parser as rosidl
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.base.untrusted.msg_text import line_count, needed_types, read_types
from tests.tables import table

A = "p/msg/A"


def described(text: str, name: str) -> list[tuple[str, str]]:
    """Fields as rosidl names their types, by this reader."""
    found = []
    for field, (kind, inner) in read_types(text, name)[name][1]:
        (kind_of, each), size = inner if kind in (3, 4) else ((kind, inner), 0)
        word = each.replace("/msg/", "/") if kind_of == 2 else f"{each[0]}<={each[1]}" if each[1] else each[0]
        ends = {3: f"[{size}]", 4: f"[<={size}]" if size else "[]"}
        found.append((word + ends.get(kind, ""), field))
    return found


def test_the_installed_types_have_the_fields_that_rosidl_reads() -> None:
    files = [path for path in sorted((Path(sys.prefix) / "share").glob("*/msg/*.msg"))]
    if not files:
        pytest.skip("no ROS is installed here")
    for path in files:
        text, package = path.read_text("utf-8"), path.parent.parent.name
        expected = rosidl.parse_message_string(package, path.stem, text)
        assert described(text, f"{package}/msg/{path.stem}") == [
            (str(each.type), each.name) for each in expected.fields
        ], path
        constants = read_types(text, f"{package}/msg/{path.stem}")[f"{package}/msg/{path.stem}"][0]
        assert constants == [(each.name, each.type, each.value) for each in expected.constants], path


@table("store", [Stores.ROS1_NOETIC, Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_known_types_are_those_of_rosbags(store: Stores) -> None:
    known = get_typestore(store)
    for name in known.fielddefs:
        text = known.generate_msgdef(name, ros_version=2)[0]
        expected = {one: (list(each[0]), list(each[1])) for one, each in get_types_from_msg(text, name).items()}
        assert read_types(text, name) == expected


CONSTANTS = {
    "uint8 X=0o17": 15, "uint8 X=0x1F": 31, "int8 X = -0b11 # words": -3, "uint8 X=017": 17, "int32 X=1_000": 1000,
    "bool X=True": True, "bool X=0": False, "float32 X=1": 1.0, "string X=": "", "char X=65": 65,
    "float64 X=.5e3": 500.0, "string X=two words # c": "two words",
    'string X="a#b" # words': "a#b", "string X='it\\'s'": "it\\'s", "string<=5 X='a'": "a",
}  # fmt: skip


@table(("line", "value"), CONSTANTS.items(), ids=CONSTANTS)
def test_constants(line: str, value: object) -> None:
    ((name, _, found),) = read_types(line, A)[A][0]
    assert (name, found, type(found)) == ("X", value, type(value))


def test_names_of_ros_1() -> None:
    text = f"Header header\ntime t\nduration[2] d\nP p\nuint8 Kp\n{RULE}\nMSG: p/P\nbyte b\n"
    found = read_types(text, A)
    assert found[A][1][0][1][1] == "std_msgs/msg/Header"
    assert [field for field, _ in found[A][1]] == ["header", "t", "d", "p", "Kp"]
    assert needed_types(text, A) == ["p/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"]
    own = read_types(f"Header header\n{RULE}\nMSG: p/Header\nint8 z\n", A)
    assert own[A][1][0][1][1] == "p/msg/Header"


BAD = ["int32", "int32 8", "int32 a;b", "int32 a'", "p/B():pass x", "int32[3 x", "int32[x] y", "p/B X=3",
       "int32 X=three", "bool X=perhaps", f"int8 x\n{RULE}\nint8 y", f"int8 x\n{RULE}\n",
       "int8 x\nMSG: p/B"]  # fmt: skip


@table("text", BAD)
def test_what_is_no_field(text: str) -> None:
    with pytest.raises(ValueError):
        read_types(text, A)


def test_wide_strings() -> None:
    found = read_types("wstring w\nwstring[] x\nwstring<=5[<=3] y\nwstring X='a'", A)[A]
    assert found[0] == [("X", "wstring", "a")]
    assert [described for _, described in found[1]] == [
        (1, ("wstring", 0)), (4, ((1, ("wstring", 0)), 0)), (4, ((1, ("wstring", 5)), 3))
    ]  # fmt: skip


def test_lines() -> None:
    assert line_count(f"# words\r\n\r\nint8 x\n{RULE}\nMSG: p/B\n@optional\nint8 y\n") == 3

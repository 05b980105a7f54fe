"""Definitions of ROS types: good ones as rosbags and ROS have them, hostile ones refused before code is made."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import pytest
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.definitions import IDL, PLACEHOLDER, definition_text, parse_definition, type_hash
from igtl_gateway.record.sessionfile.schemas import RosTypes
from tests.places import ROOT
from tests.tables import table
from tests.timing import quick
from tools.import_mutations import Bend, definition

PACKAGE = ROOT / "igtl_gateway"
RULE = "=" * 80 + "\n"


def part(name: str, fields: str) -> str:
    return f"{RULE}MSG: {name}\n{fields}"


def chain(length: int, fields: str) -> str:
    """Each type holds the next; ``fields`` has ``{}`` in the place of its name."""
    return fields.format("p/T1") + "".join(part(f"p/T{i}", fields.format(f"p/T{i + 1}")) for i in range(1, length))


HOSTILE = {
    "recursive": ("p/A a\n", "found p/msg/A inside itself"),
    "recursive through others": (f"p/B[] b\n{part('p/B', 'p/A[2] a')}\n", "found p/msg/. inside itself"),
    "deep": (chain(200, "{} x\n"), r"nesting: found 65, expected at most 64 \(--limit depth=64\)"),
    "a chain of arrays": (chain(30, "{}[10] x\n"), r"elements of one p/msg/T\d+: found \d+, expected at most 200000"),
    "a chain of fields": (
        chain(40, "{0} x\n{0} y\n"),
        "fields of p/msg/T.* and of all in it: found .* expected at most 3000",
    ),
    "a giant array of strings": ("string[100000000] x\n", "found 100000001, expected at most 3000"),
    "a giant array of numbers": ("float64[1000000000] x\n", "bytes of one .*: found 8000000000"),
    "giant arrays of numbers": (f"p/B[2000] x\n{part('p/B', 'uint8[1000000] x')}\n", "bytes of one"),
    "many fields": ("".join(f"int8 x{i}\n" for i in range(20_000)), "lines: found 20000, expected at most 3000"),
    "many types": ("int8 x\n" + "".join(part(f"p/T{i}", "") for i in range(2000)), "found 4002, expected at most 3000"),
    "much text": ("# " + "x" * 300_000 + "\nint8 x\n", "found 300010, expected at most 262144"),
    "no elements": ("p/A[0] x\n", "found 0 elements"),
    "fewer than none": ("int8[-5] x\n", "found -5 elements"),
    "a number without end": ("float64 X=1e999\n", "constant X: found inf"),
    "a number of many bits": ("int64 X=0x" + "f" * 9000 + "\n", "constant X: found a number of 36000 bits"),
    "a number of many digits": ("int64 X=" + "9" * 9000 + "\n", "expected ros2msg"),
    "two of a name": ("int8 x\nint8 x\n", "two fields with the same name"),
    "a name that is code": ("int8 x;import os\n", "expected ros2msg"),
    "a name that runs on": ("int8 x'\n", "expected ros2msg"),
    "a type that is code": (f"int8 x\n{part('p/B():pass', 'int8 x')}\n", "expected ros2msg"),
    "a type of many parts": (f"int8 x\n{part('a/b/c/d/e/f', 'int8 x')}\n", "found the type"),
    "quotes that nothing closes": ("".join(f"string X{i}='x\n" for i in range(2900)), ""),
    "one line": ("int8 x " * 30_000, ""),
    "spaces": ("int8" + " " * 250_000 + "\n", "expected ros2msg"),
}
HOSTILE_IDL = {
    "shifts": ("const long X = 1 << 99999999999;", "found '<<'"),
    "products": ("const long X = 9*9*9;", r"found '\*'"),
    "parentheses": ("const long X = " + "(" * 60 + "1" + ")" * 60 + ";", r"found '\('"),
    "sequences": ("struct A { " + "sequence<" * 300 + "long" + ">" * 300 + " x; };", "nesting of <"),
    "modules": ("module a { " * 300 + "};" * 300, "nesting of {"),
    "comments": ("/*" * 30_000, r"found '\*'"),
    "annotations": ("@a(" * 40_000, "annotations: found 40000"),
    "array": ("struct A { long x[99999999]; };", "bytes of one A|expected package/msg/Name|found the type"),
    "nonsense": ("what is this", "expected ros2idl"),
}


def whole(types: Mapping[str, Any]) -> dict[str, Any]:
    """With what rosidl puts into a type without fields."""
    return {name: (constants, fields or [PLACEHOLDER]) for name, (constants, fields) in types.items()}


@table(("text", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_definitions_are_refused_at_once(text: str, reason: str) -> None:
    if not reason:
        with quick():
            parse_definition(text, "p/msg/A")
        return
    with quick(), pytest.raises(DamagedRecording, match=reason) as found:
        parse_definition(text, "p/msg/A")
    assert str(found.value).startswith("definition of p/msg/A")
    assert len(str(found.value)) < 400


@table(("text", "reason"), HOSTILE_IDL.values(), ids=HOSTILE_IDL)
def test_hostile_idl_is_refused_at_once(text: str, reason: str) -> None:
    with quick(), pytest.raises(DamagedRecording, match=reason):
        parse_definition(text, "p/msg/A", IDL)


@pytest.mark.parametrize("name", ["A", "p/msg/A\nint8 x", "p/msg/A b", "", "p//A", "p/msg/é", "p/msg/" + "A" * 300])
def test_names_of_types_are_identifiers(name: str) -> None:
    with pytest.raises(DamagedRecording, match="expected package/msg/Name"):
        parse_definition("int8 x\n", name)


def test_limits_can_be_set() -> None:
    text = "".join(f"int8 x{i}\n" for i in range(3500))
    with limits.limits_in_force(limits.parse_limits(["fields=4000"])):
        assert len(parse_definition(text, "p/msg/A")["p/msg/A"][1]) == 3500
    with pytest.raises(LimitExceeded):
        parse_definition(text, "p/msg/A")


@pytest.mark.parametrize("store", [Stores.ROS1_NOETIC, Stores.ROS2_JAZZY], ids=str)
def test_known_types_come_as_rosbags_reads_them(store: Stores) -> None:
    known = get_typestore(store)
    for name in list(known.fielddefs)[::4]:
        text = known.generate_msgdef(name, ros_version=2)[0]
        found = parse_definition(text, name)
        expected = get_types_from_msg(text, name)
        assert found == whole(expected)
        assert definition_text(found, name) == text


def test_constants_are_written_as_others_read_them() -> None:
    text = 'bool SAFE=true\nbool OFF=false\nstring S="a#b"\nstring T=\'an "a"\'\nfloat64 X=1.5\nint8 x\n'
    found = parse_definition(text, "p/msg/A")
    assert definition_text(found, "p/msg/A") == text


def test_whatever_is_accepted_is_what_rosbags_reads() -> None:
    """Random definitions, most of them nonsense."""
    accepted = 0
    for seed in range(400):
        text = definition(Bend(Random(seed), 0.05), "p/msg/A")
        try:
            found = parse_definition(text, "p/msg/A")
        except DamagedRecording:
            continue
        expected = get_types_from_msg(text, "p/msg/A")
        assert found == whole(expected)
        accepted += 1
    assert accepted > 100


def test_idl_of_ros_is_read() -> None:
    text = """module p { module msg {
      module A_Constants { @verbatim (language="comment", text="a (b) << c") const short X = -3; };
      typedef double double__3[3];  // comment
      /* comment << */
      struct A { @unit(value="m") double__3 x; sequence<string<5>, 7> y; @default (value=TRUE) boolean z; }; }; };"""
    found = parse_definition(text, "p/msg/A", IDL)
    assert dict(found) == {name: (consts, fields) for name, (consts, fields) in get_types_from_idl(text).items()}
    with pytest.raises(TypesysError):
        definition_text(found, "p/msg/B")


def test_hashes_are_those_of_the_installed_ros() -> None:
    """Every wheel of ROS carries the hashes of its types; ``char`` of a ``.msg`` is a uint8.

    The computed ones, too, except those with ``wstring``, of test_msgs only: rosbags has no such type.
    """
    share = Path(sys.prefix) / "share"
    files = sorted(share.glob("*/msg/*.json"))
    if not files:
        pytest.skip("no ROS is installed here")
    types, wrong = RosTypes(), []
    for file in files:
        name = f"{file.parent.parent.name}/msg/{file.stem}"
        told = {row["type_name"]: row["hash_string"] for row in json.loads(file.read_text())["type_hashes"]}
        found = types.find(name)
        if not found or found.type_hash != told[name]:
            wrong.append(name)
        elif file.stem != "WStrings" and type_hash(parse_definition(found.text(name), name), name) != told[name]:
            wrong.append(name)
    assert wrong == []
    assert len(files) >= 100


def test_wide_strings_are_refused_in_both_dialects() -> None:
    idl = f"{RULE}IDL: p/msg/A\nmodule p {{ module msg {{ struct A {{ wstring w; }}; }}; }};"
    for text in ("wstring<=5[<=3] w\n", idl):
        with pytest.raises(DamagedRecording, match="messages with wstring are not decoded"):
            parse_definition(text, "p/msg/A")


def test_char_is_hashed_as_jazzy_does() -> None:
    found = parse_definition("char data\n", "std_msgs/msg/Char")
    told = "RIHS01_3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9"  # share/std_msgs/msg/Char.json
    assert type_hash(found, "std_msgs/msg/Char") == told
    bytes_ = parse_definition("uint8[] a\nuint8[<=4] b\nuint8[3] c\n", "p/msg/A")
    chars = parse_definition("char[] a\nchar[<=4] b\nchar[3] c\n", "p/msg/A")
    assert type_hash(bytes_, "p/msg/A") == type_hash(chars, "p/msg/A")


def test_no_other_module_gives_text_to_rosbags() -> None:
    found = [
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        for word in ("get_types_from_msg", "get_types_from_idl", "MSGParser", "IDLParser", ".register(get")
        if word in path.read_text("utf-8")
    ]
    assert set(found) == {"base/untrusted/definitions.py"}

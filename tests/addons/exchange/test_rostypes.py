"""Definitions that foreign files carry."""

from __future__ import annotations

from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addons.exchange.rostypes import with_hash
from igtl_gateway.record.sessionfile.definition import Definition

TEXT = """# words that people wrote
std_msgs/Header header   # kept as it is
float32 depth
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
RULE = "=" * 80
IDL = f"""{RULE}
IDL: std_msgs/msg/String
module std_msgs {{ module msg {{ struct String {{ string data; }}; }}; }};
"""
STORE = get_typestore(Stores.ROS2_JAZZY)


def definition(ros_type: str, text: str, encoding: str) -> Definition | None:
    return with_hash(ros_type, Definition(text.encode(), encoding))


def test_a_definition_stays_as_it_is_with_its_hash() -> None:
    found = definition("lab/msg/Probe", TEXT, "ros2msg")
    assert found
    assert found.data == TEXT.encode()
    assert found.type_hash.startswith("RIHS01_")
    of_idl = definition("std_msgs/msg/String", IDL, "ros2idl")
    assert of_idl == Definition(IDL.encode(), "ros2idl", STORE.hash_rihs01("std_msgs/msg/String"))


def test_a_text_without_what_it_depends_on_has_no_hash() -> None:
    text = TEXT.partition("====")[0]
    assert definition("lab/msg/Probe", text, "ros2msg") == Definition(text.encode())


def test_what_is_no_definition() -> None:
    assert definition("lab/msg/Probe", "", "ros2msg") is None
    assert definition("lab/msg/Probe", TEXT, "protobuf") is None


def test_what_cannot_be_read_is_kept_and_said() -> None:
    notes: list[str] = []
    strange = Definition(b"what is this", "ros2idl")
    assert with_hash("lab/msg/Probe", strange, notes.append) == strange
    assert len(notes) == 1 and "not decoded" in notes[0]
    notes.clear()
    assert with_hash("lab/msg/Probe", Definition(b"# " + bytes(300_000)), notes.append) is None
    assert len(notes) == 1 and notes[0].endswith("left out")

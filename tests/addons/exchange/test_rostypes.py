"""Definitions that foreign files carry."""

from __future__ import annotations

from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addons.exchange.rostypes import definition

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


def test_ros2msg_stays_as_it_is_with_its_hash() -> None:
    found = definition("lab/msg/Probe", TEXT, "ros2msg")
    assert found
    assert found[0] == TEXT
    assert found[1].startswith("RIHS01_")


def test_idl_becomes_ros2msg() -> None:
    found = definition("std_msgs/msg/String", IDL, "ros2idl")
    assert found
    assert "string data" in found[0]
    assert found[1] == STORE.hash_rihs01("std_msgs/msg/String")


def test_a_text_without_what_it_depends_on_has_no_hash() -> None:
    text = TEXT.partition("====")[0]
    assert definition("lab/msg/Probe", text, "ros2msg") == (text, "")


def test_what_is_no_definition() -> None:
    assert definition("lab/msg/Probe", "", "ros2msg") is None
    assert definition("lab/msg/Probe", TEXT, "protobuf") is None
    assert definition("lab/msg/Probe", "what is this", "ros2idl") is None

"""What travels as metadata, and comes back."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert.igtl_msgs import Metadata, MetadataItem, Sensor
from igtl_gateway.convert.rosmsg import Header, String, TransformStamped
from igtl_gateway.gateway.metadata import FRAME_ID, FULL_NAME, STAMP, compose_metadata, restore_metadata
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.text import UTF_8, Status
from igtl_gateway.wire.text import String as IgtlString
from tests.script import T0_NS, Script

HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item("a", b"b"),))
TOOL = TransformStamped(Header(T0_NS - 5, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))


def test_stamp_frames_and_full_name_come_back() -> None:
    script = Script()
    script.up(1)
    script.igtl(HELLO)
    script.ros("/igtl/out/the_probe_of_the_second_robot", TOOL)
    (message,) = script.sent()
    told = {item.key: item.text for item in message.metadata}
    assert told == {
        "DeviceName": "the_probe_of_the_second_robot",
        "ros.child_frame_id": "tool",
        "ros.frame_id": "base",
        "ros.stamp": str(T0_NS - 5),
    }
    assert list(told) == sorted(told)
    # a program that leaves the stamp of the header at 0, as 3D Slicer does, but passes metadata on
    passed_on = Message(message.type, message.device_name, message.content, 0, 2, 0, message.metadata)
    assert script.igtl(passed_on) == ["ros /igtl/in/the_probe_of_the_second_robot/transform"]
    assert TransformStamped.unpack(script.last[0].data()) == TOOL


def test_a_version_1_peer_gets_none() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/Tool", TOOL)
    assert script.sent()[0].metadata == ()


def test_what_is_not_as_we_write_it_is_the_users() -> None:
    items = (Item(STAMP, b"yesterday"), Item(FULL_NAME, b"Somebody else"), Item(FRAME_ID, b""), Item(STAMP, b"9" * 30))
    restored = restore_metadata(Message("STRING", "Probe", IgtlString.of("x"), 0, 2, 0, items))
    assert (restored.device_name, restored.stamp_ns, restored.frame_id) == ("Probe", 0, "")
    assert [item.key for item in restored.items] == [STAMP, FULL_NAME, FRAME_ID, STAMP]


def test_users_metadata_is_exposed_beside_a_standard_message() -> None:
    script = Script()
    script.up(1)
    items = (Item("Operator", "Ä. B.".encode(), 106), Item("Site", b"\xc4", 4), Item("Odd", b"\xff\x00", 3))
    message = Message("STRING", "Log", IgtlString.of("x"), 0, 2, 77, items)
    assert script.igtl(message) == ["ros /igtl/in/Log/string", "ros /igtl/in/Log/metadata"]
    told = Metadata.unpack(script.published("/igtl/in/Log/metadata"))
    assert (told.type, told.device_name, told.message_id) == ("STRING", "Log", 77)
    assert [(item.key, item.encoding, item.value) for item in told.items] == [
        ("Operator", 106, "Ä. B."),
        ("Site", 4, "Ä"),
        ("Odd", 3, "\ufffd\ufffd"),
    ]


def test_metadata_of_the_configuration_and_of_the_message_go_along() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(topic="/force", metadata=(("Site", "A"), ("Operator", "B"))),)))
    script.up(1)
    script.igtl(HELLO)
    sensor = Sensor(Header(), 0, 0, "N", np.array([1.0]), (MetadataItem("Operator", 106, "Ö"),))
    script.ros("/force", sensor)
    assert script.sent()[0].metadata == (Item("Operator", "Ö".encode(), 106), Item("Site", b"A", 3))


@pytest.mark.parametrize("size", [100, 66_000])
def test_too_much_metadata_costs_the_message(size: int) -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(topic="/text", metadata=(("Long", "x" * size),)),)))
    script.up(1)
    script.igtl(HELLO)
    lines = script.ros("/text", String("x"))
    assert lines == (["igtl STRING/text v2 to 1"] if size < 65_536 else ["note conversion"])


def test_a_value_that_its_encoding_cannot_hold_is_sent_as_utf_8() -> None:
    latin_1 = 4
    made = compose_metadata(
        "A", "A", 0, "", "", [MetadataItem("a", latin_1, "für"), MetadataItem("b", latin_1, "日本")]
    )
    assert [(item.key, item.value, item.encoding) for item in made] == [
        ("a", "für".encode("latin-1"), latin_1),
        ("b", "日本".encode(), UTF_8),
    ]

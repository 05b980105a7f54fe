"""Names: each mapping keeps different names apart, or a note names those it does not."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.naming import FRAME_RENAMED, FRAME_SHARED, MAX_NAMES, NAME_CUT, NAME_SHARED, FrameNames
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.tracking import TRACKING_DTYPE, TrackingData
from igtl_gateway.wire.transform import Transform
from tests.script import Script
from tests.tables import table

#: Names that differ in signs, case, length, or at their ends; each is another tool.
TOOLS = (
    "Tool A", "Tool_A", "Tool-A", "Tool.A", "Tool/A", "tool a", "TOOL_A", "ToolA", "Tool A ", "/Tool_A", "Tool+A",
    "Tool:A",
    "Tööl", "T__l", "1Tool", "_1Tool", "1.Tool", "unnamed", "", "Probe-ToTracker", "Probe_ToTracker", "Probe.ToTracker",
    "ProbeToTracker", "ProbeTo Tracker", "ProbeTo_Tracker", "Probe", "x" * 20, "x" * 19 + " ", "x" * 19 + "_",
)  # fmt: skip


def pose(name: str, x: float = 0.0, **metadata: str) -> Message:
    matrix = (1, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0)
    items = tuple(Item.of(key, value) for key, value in metadata.items())
    return Message("TRANSFORM", name, Transform(matrix), 1 << 32, header_version=2 if items else 1, metadata=items)


def tracking(device: str, *tools: str) -> Message:
    elements = np.zeros(len(tools), TRACKING_DTYPE)
    elements["name"] = [tool.encode() for tool in tools]
    elements["matrix"] = [(1, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0) for x in range(len(tools))]
    return Message("TDATA", device, TrackingData(elements), 1 << 32)


def frames(script: Script) -> list[tuple[str, str]]:
    """Parent and child of the frames in the last outputs."""
    messages = (TFMessage.unpack(entry.data()) for entry in script.last if entry.channel == "/tf")
    return [(one.header.frame_id, one.child_frame_id) for message in messages for one in message.transforms]


def connected(config: Config | None = None, links: int = 1) -> Script:
    script = Script(config, news=True)
    for link in range(1, links + 1):
        script.up(link)
    return script


def notes(lines: list[str], *codes: str) -> list[str]:
    return [line for line in lines if line in {f"note {code}" for code in codes}]


@pytest.mark.parametrize("in_one", [False, True], ids=["devices", "tools of one device"])
@pytest.mark.parametrize("order", [1, -1])
def test_each_tool_has_a_frame_of_its_own(in_one: bool, order: int) -> None:
    tools = [tool for tool in TOOLS[::order] if tool or not in_one]
    script, found, said = connected(), {}, []
    if in_one:
        said += script.igtl(tracking("Tracker", *tools))
        found = dict(zip(tools, frames(script), strict=True))
    for tool in () if in_one else tools:
        said += script.igtl(pose(tool))
        (found[tool],) = frames(script)
    shared = [pair for pair in combinations(tools, 2) if found[pair[0]] == found[pair[1]]]
    assert not shared
    plain = Script(Config(naming=0))
    plain.up(1)
    count = 0
    for tool in tools:
        plain.igtl(pose(tool) if not in_one else tracking("Tracker", tool))
        count += frames(plain) != [found[tool]]
    assert len(notes(said, FRAME_RENAMED)) == count > 5, "each other name than before is noted"
    assert verify(iter(script.log), Config()).good


def test_a_tool_and_a_device_of_one_name_are_one_frame() -> None:
    script = connected()
    script.igtl(pose("ProbeToTracker"))
    assert not notes(script.igtl(tracking("TDATA", "ProbeToTracker")), FRAME_RENAMED, FRAME_SHARED)
    assert frames(script) == [("Tracker", "Probe")]


def test_a_recording_without_the_rule_is_computed_as_before() -> None:
    old = Config.from_dict({})
    script = connected(old, links=2)
    said = script.igtl(pose("Tool A")) + script.igtl(pose("Tool_A")) + script.igtl(pose("Tool A"), link=2)
    assert frames(script) == [("igtl", "Tool_A")] and not notes(said, NAME_SHARED, FRAME_SHARED, FRAME_RENAMED)
    assert verify(iter(script.log), old).good
    assert not verify(iter(script.log), Config()).good


def test_two_peers_with_one_device_are_noted_once_and_a_peer_that_returns_is_not() -> None:
    script = connected(links=2)
    said = script.igtl(pose("Tool"), link=1) + script.igtl(pose("Tool"), link=1)
    assert not notes(said, NAME_SHARED)
    assert notes(script.igtl(pose("Tool"), link=2), NAME_SHARED)
    assert not notes(script.igtl(pose("Tool"), link=2) + script.igtl(pose("Tool"), link=1), NAME_SHARED, FRAME_SHARED)
    script.down(1)
    script.down(2)
    script.up(3)
    assert not notes(script.igtl(pose("Tool"), link=3), NAME_SHARED, FRAME_SHARED)
    script.igtl(Message("STATUS", "Robot", Status(1)), link=3)
    script.up(4)
    assert not notes(script.igtl(Message("STATUS", "Robot", Status(1)), link=4), NAME_SHARED)
    assert verify(iter(script.log), Config()).good


def test_a_frame_with_two_parents_or_of_two_peers_is_noted() -> None:
    script = connected(links=2)
    script.igtl(pose("ProbeToTracker"))
    assert notes(script.igtl(pose("ProbeToReference")), FRAME_SHARED)
    script.igtl(tracking("Left", "Needle"))
    assert not notes(script.igtl(tracking("Left", "Needle")), FRAME_SHARED)
    assert notes(script.igtl(tracking("Right", "Needle"), link=2), FRAME_SHARED)
    assert verify(iter(script.log), Config()).good


def test_what_is_remembered_of_names_is_bounded() -> None:
    names = FrameNames()
    for number in range(MAX_NAMES + 10):
        names.of(f"Tool{number}", "igtl")
    assert names.of("Tool-1", "igtl") == ("igtl", "Tool_1") and len(names._owners) == MAX_NAMES
    assert names.of("Tool1", "igtl") == ("igtl", "Tool1") and not names.news


def test_a_topic_of_several_devices_is_noted() -> None:
    script = connected(Config(to_ros=(ToRosRow(device="Tool*", topic="/tools/{kind}"),)))
    assert not notes(script.igtl(pose("Tool1")), NAME_SHARED)
    assert notes(script.igtl(pose("Tool2")), NAME_SHARED)


def test_topics_of_one_default_device_are_sent_under_different_names() -> None:
    config = Config(
        to_igtl=(ToIgtlRow(topic="/camera/**"), ToIgtlRow(topic="/camera_*"), ToIgtlRow(topic="/set/*", device="Set"))
    )
    script = connected(config)
    sent = []
    for topic in ("/camera/image", "/camera_image", "/igtl/out/Note", "/igtl/out/Note/string"):
        script.ros(topic, RosString("a"))
        sent += [message.device_name for message in script.sent()]
    assert sent[0] == "camera_image" and sent[2] == "Note" and len(set(sent)) == 4, sent
    script.ros("/set/a", RosString("a"))
    assert notes(script.ros("/set/b", RosString("b")), NAME_SHARED), "a name that the configuration gives is kept"
    assert [message.device_name for message in script.sent()] == ["Set"]


def test_a_frame_and_a_topic_that_are_sent_as_one_device_do_not_share_it() -> None:
    script = connected(Config(tf_out=(TfOutRow(frames=("tool",), base="base"),)))
    pose_of = TransformStamped(RosHeader(1, "base"), "tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    script.ros("/igtl/out/toolTobase", pose_of)
    assert [message.device_name for message in script.sent()] not in ([], ["toolTobase"])


@table("profile", ("plus", "plus-v1"))
def test_plus_names_the_frame_of_a_picture(profile: str) -> None:
    script = connected(Config(profile=profile))
    image = Image((2, 2, 1), 3, b"abcd")
    for device, frame in {
        "Image_Tracker": "Tracker", "Image_Reference": "Reference", "US_Image_Probe": "Probe", "Image": "igtl",
        "_Tracker": "igtl", "Image_": "igtl", "Image_2": "igtl",
    }.items():  # fmt: skip
        script.igtl(Message("IMAGE", device, image, 1))
        pictures = [RosImage.unpack(entry.data()) for entry in script.last if entry.type == RosImage.TYPE]
        assert [picture.header.frame_id for picture in pictures] == [frame], device
    assert verify(iter(script.log), Config(profile=profile)).good


def test_who_is_not_plus_has_no_frame_in_the_name_of_a_picture_and_a_row_decides() -> None:
    for config, frame in (
        (Config(profile="slicer"), "igtl"),
        (Config(profile="plus", naming=0), "igtl"),
        (Config(profile="plus", to_ros=(ToRosRow(device="Image*", frame_id="bed"),)), "bed"),
    ):
        script = connected(config)
        script.igtl(Message("IMAGE", "Image_Tracker", Image((2, 2, 1), 3, b"abcd"), 1))
        (picture,) = (RosImage.unpack(entry.data()) for entry in script.last if entry.type == RosImage.TYPE)
        assert picture.header.frame_id == frame


def test_a_peer_that_shows_to_be_plus_gets_the_frame_from_then_on() -> None:
    script, found = connected(), []
    for number in range(1, 6):
        script.igtl(Message("IMAGE", "Image_Tracker", Image((2, 2, 1), 3, b"abcd"), number << 32))
        found += [RosImage.unpack(entry.data()).header.frame_id for entry in script.last if entry.type == RosImage.TYPE]
        if number == 3:
            script.igtl(pose("ProbeToTracker", TransformValid="1"))
    assert found == ["igtl"] * 3 + ["Tracker"] * 2
    assert verify(iter(script.log), Config()).good


def test_a_name_that_slicer_has_cut_is_whole_by_its_metadata() -> None:
    script, whole = connected(), "NeedleToReferenceTransform"
    assert len(whole[:20]) == 20
    said = script.igtl(pose(whole[:20], MRMLNodeName=whole))
    assert frames(script) == [("ReferenceTransform", "Needle")] and not notes(said, NAME_CUT)
    said = script.igtl(pose(whole[:20], MRMLNodeName="NeedleToReferenceTracker"))
    assert frames(script) == [("ReferenceTracker", "Needle")] and not notes(said, NAME_CUT)
    script = connected()
    for name, node in (("Short", "Other"), ("a" * 20, "b" * 30), ("a" * 20, "a" * 20)):
        script.igtl(pose(name, MRMLNodeName=node))
        assert frames(script)[0][1] == name
    umlaut = ("ü" * 20).encode()[:20].decode()  # a cut in the middle of a sign
    script.igtl(pose(umlaut, MRMLNodeName="ü" * 15))
    assert any(entry.channel.startswith("/igtl/in/_______________/") for entry in script.last)


def test_a_name_that_fills_its_field_is_noted_once() -> None:
    script = connected()
    assert notes(script.igtl(pose("NeedleToReferenceTra")), NAME_CUT)
    assert not notes(script.igtl(pose("NeedleToReferenceTra")) + script.igtl(pose("a" * 19)), NAME_CUT)
    long = "a device with a name that is long"
    assert not notes(script.igtl(pose(short_device_name(long), DeviceName=long)), NAME_CUT), "a gateway states it"


def test_a_reply_without_a_name_goes_to_the_device_of_its_command() -> None:
    script = connected(links=2)
    topic = "/igtl/out/Robot/command"
    script.ros(topic, RosCommand(RosHeader(), "Robot", 7, "Move", 0, "", link=1))
    script.ros(topic.replace("Robot", "Pump"), RosCommand(RosHeader(), "Pump", 7, "Stop", 0, "", link=2))
    for link, device in ((2, "Pump"), (1, "Robot")):
        script.igtl(Message("RTS_COMMAND", "", Command(7, "", b""), 1), link=link)
        replies = [
            (entry.channel, CommandReply.unpack(entry.data()).device_name)
            for entry in script.last
            if entry.type == CommandReply.TYPE
        ]
        assert replies == [(f"/igtl/in/{device}/command_reply", device)]
    script.igtl(Message("RTS_COMMAND", "", Command(7, "", b""), 1), link=1)
    assert any(entry.channel == "/igtl/in/unnamed/command_reply" for entry in script.last), "no command waits for it"
    assert verify(iter(script.log), Config()).good


def test_the_greeting_of_slicer_is_no_state() -> None:
    script = connected()
    hello = Message("STATUS", "", Status(26_624), 0, header_version=2, metadata=(Item.of("dummy", "dummy"),))
    script.igtl(hello)
    assert not [entry for entry in script.last if entry.channel.endswith("/status")]
    assert script.gateway.ledger.to_dict()["igtl_in"]["STATUS/"]["greeted"] == 1
    assert "dropped" not in script.gateway.ledger.to_dict()["igtl_in"]["STATUS/"]
    assert script.gateway.profile_of(1) == "slicer"
    script.igtl(Message("STATUS", "", Status(2), 0))
    assert [entry for entry in script.last if entry.channel == "/igtl/in/unnamed/status"], "any other state is one"
    assert verify(iter(script.log), Config()).good

"""The way of a message through the gateway: scripted scenarios on manual time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert import rosmsg, surfaces, trajectories
from igtl_gateway.convert.igtl_msgs import RawMessage, VideoFrame, Volume
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import LISTENED
from igtl_gateway.gateway.fastpath import FastPath
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.metadata import FULL_NAME
from igtl_gateway.gateway.to_ros.convert import RAW_QOS
from igtl_gateway.gateway.to_ros.route import Router
from igtl_gateway.wire import Item, Message, Raw, decode, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script

POSE = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 100.0, 200.0, 300.0))
TRANSFORM = Message("TRANSFORM", "ProbeToTracker", POSE, ns_to_ticks(T0_NS))
TOOL = rosmsg.TransformStamped(Header(T0_NS - 5, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
SLICER_HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item("dummy", b"dummy"),))


def unstamped(message: Message) -> Message:
    return replace(message, ticks=0)


# -- routing ------------------------------------------------------------------------------------------------------


def test_a_transform_becomes_a_stamped_transform_in_metres_between_the_frames_of_its_name() -> None:
    script = Script()
    assert script.igtl(TRANSFORM) == ["ros /igtl/in/ProbeToTracker/transform"]
    message = rosmsg.TransformStamped.unpack(script.last[0].data())
    assert message == rosmsg.TransformStamped(Header(T0_NS, "Tracker"), "Probe", (0.1, 0.2, 0.3), (0, 0, 0, 1))


def test_a_name_without_to_is_a_child_of_the_base_frame() -> None:
    script = Script(Config(base_frame="world"))
    script.igtl(replace(TRANSFORM, device_name="Needle"))
    message = rosmsg.TransformStamped.unpack(script.last[0].data())
    assert (message.header.frame_id, message.child_frame_id) == ("world", "Needle")


def test_a_ros_message_goes_to_all_links_in_one_entry() -> None:
    script = Script()
    script.up(1)
    script.up(2)
    assert script.ros("/igtl/out/Tool", TOOL) == ["igtl TRANSFORM/Tool v1 to 1,2"]
    message = decode(script.last[0].data())
    assert message == Message("TRANSFORM", "Tool", POSE, ns_to_ticks(T0_NS - 5))


def test_without_links_a_ros_message_is_dropped_and_counted() -> None:
    script = Script()
    assert script.ros("/igtl/out/Tool", TOOL) == []
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Tool"] == {"received": 1, "dropped": {"no_peer": 1}}
    script.up(1)
    assert script.ros("/igtl/out/Tool", TOOL) == ["igtl TRANSFORM/Tool v1 to 1"]
    script.down(1)
    assert script.ros("/igtl/out/Tool", TOOL) == []


@pytest.mark.parametrize(
    ("topic", "device"),
    [
        ("/igtl/out/Tool", "Tool"),
        ("/igtl/out/Tool/transform", "Tool"),
        ("/igtl/out/arm/tool", "arm_tool"),
        ("/igtl/out/Tool/image", "Tool_image"),
    ],
)
def test_device_names_come_from_topics(topic: str, device: str) -> None:
    script = Script()
    script.up(1)
    assert script.ros(topic, TOOL) == [f"igtl TRANSFORM/{device} v1 to 1"]


def test_a_topic_of_no_row_is_recorded_only() -> None:
    script = Script()
    script.up(1)
    assert script.ros("/joint_states", TOOL) == []
    assert script.gateway.ledger.to_dict()["ros_in"]["/joint_states"] == {"received": 1, "recorded_only": 1}
    assert script.gateway.subscription("/joint_states", TOOL.TYPE) is None


def test_rows_choose_device_type_units_and_stamps() -> None:
    row = ToIgtlRow(topic="/arm/*", device="Arm", type="POSITION", ros_unit="mm", stamp="receive", qos=Qos(depth=7))
    script = Script(Config(to_igtl=(row,)))
    script.up(1)
    assert script.gateway.subscription("/arm/pose", TOOL.TYPE) == Qos(depth=7)
    assert script.ros("/arm/pose", TOOL) == ["igtl POSITION/Arm v1 to 1"]
    message = decode(script.last[0].data())
    assert message.content.describe()["position"] == pytest.approx([0.1, 0.2, 0.3])
    assert message.ticks == ns_to_ticks(script.now_ns)


def test_to_ros_rows_choose_topic_frames_and_units() -> None:
    row = ToRosRow(
        device="Probe*", topic="/us/{device}/{type}_{kind}", frame_id="map", child_frame_id="us", ros_unit="mm"
    )
    script = Script(Config(to_ros=(row,)))
    assert script.igtl(TRANSFORM) == ["ros /us/ProbeToTracker/transform_transform"]
    message = rosmsg.TransformStamped.unpack(script.last[0].data())
    assert (message.header.frame_id, message.child_frame_id) == ("map", "us")
    assert message.translation == (100.0, 200.0, 300.0)


def test_one_message_may_become_several() -> None:
    script = Script()
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]).astype(">f4")
    surface = PolyData(points, polygons=Cells.of([[0, 1, 2]]), lines=Cells.of([[0, 1]]))
    assert script.igtl(Message("POLYDATA", "Model", surface)) == [
        "ros /igtl/in/Model/mesh",
        "ros /igtl/in/Model/marker",
        "ros /igtl/in/Model/lines",
        "ros /igtl/in/Model/polydata",
    ]
    assert script.igtl(Message("POLYDATA", "Cloud", PolyData(points))) == ["ros /igtl/in/Cloud/points"]
    assert script.igtl(Message("POINT", "One", Points.of(points[:1]))) == [
        "ros /igtl/in/One/point",
        "ros /igtl/in/One/points",
    ]
    assert script.igtl(Message("POINT", "Many", Points.of(points))) == ["ros /igtl/in/Many/points"]


def test_new_streams_are_announced_once() -> None:
    script = Script(news=True)
    assert script.igtl(TRANSFORM) == ["ros /igtl/in/ProbeToTracker/transform", "ros /tf", "note stream"]
    assert script.igtl(TRANSFORM) == ["ros /igtl/in/ProbeToTracker/transform", "ros /tf"]


# -- what goes by several rows, what is several messages ----------------------------------------------------------


def test_what_one_row_refuses_costs_the_others_nothing() -> None:
    """Points with too many names for single markers are nevertheless converted to a cloud."""
    script = Script()
    points = Points.of(np.zeros((trajectories.MAX_POINTS + 1, 3)))
    points.elements["name"] = b"P"
    assert script.igtl(Message("POINT", "Cloud", points)) == ["ros /igtl/in/Cloud/points", "note conversion"]
    (why,) = (note.text for note in script.notes if note.code == "conversion")
    found = f"POINT: found {trajectories.MAX_POINTS + 1} elements"
    assert why.startswith(f"not published as igtl_msgs/msg/PointList: {found}")


def test_what_all_rows_refuse_is_told_once() -> None:
    reflection = Transform((-1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0))
    script = Script()
    assert script.igtl(Message("TRANSFORM", "Mirror", reflection)) == ["note conversion"]


def test_the_children_of_a_bind_go_their_own_ways() -> None:
    script = Script()
    text, broken = BindChild("STRING", "Text", b"\0\3\0\1x"), BindChild("TRANSFORM", "Broken", b"?")
    inner = BindChild("BIND", "", join(Bind((replace(text, name="Deep"),)).pack()))
    assert script.igtl(Message("BIND", "All", Bind((text, broken, inner)))) == [
        "ros /igtl/in/All/bind",
        "ros /igtl/in/Text/string",
        "note malformed",
        "ros /igtl/in/All/bind",
        "ros /igtl/in/Deep/string",
    ]
    assert rosmsg.String.unpack(script.published("/igtl/in/Text/string")).data == "x"


def test_a_child_that_nobody_converts_is_published_alone() -> None:
    """Not the whole BIND for each of its children: a message of megabytes with thousands would fill the memory."""
    script = Script()
    name = "ALongNameOfAChildOfABind"
    script.igtl(
        Message("BIND", "All", Bind((BindChild("STRING", "", bytes(99)), BindChild("CUSTOM", name, b"ab"))), 5 << 32)
    )
    (raw,) = (RawMessage.unpack(entry.data()) for entry in script.last if entry.type == RawMessage.TYPE)
    sent = decode(raw.data)
    assert (sent.type, sent.content, sent.ticks, sent.header_version) == ("CUSTOM", Raw(b"ab"), 5 << 32, 1)
    assert sent.device_name == raw.device_name == short_device_name(name)


# -- header versions ----------------------------------------------------------------------------------------------


def test_a_peer_gets_version_1_until_it_has_shown_version_2() -> None:
    script = Script()
    script.up(1)
    script.up(2)
    script.igtl(SLICER_HELLO, link=2)
    assert script.ros("/igtl/out/Tool", TOOL) == ["igtl TRANSFORM/Tool v1 to 1", "igtl TRANSFORM/Tool v2 to 2"]
    script.igtl(TRANSFORM, link=2)
    assert script.ros("/igtl/out/Tool", TOOL)[1] == "igtl TRANSFORM/Tool v2 to 2", "shown once is shown"
    script.down(2)
    script.up(3)
    assert script.ros("/igtl/out/Tool", TOOL) == ["igtl TRANSFORM/Tool v1 to 1,3"]


def test_a_message_of_a_damaged_version_2_shows_nothing() -> None:
    script = Script()
    script.up(1)
    data = bytearray(join(encode(SLICER_HELLO)))
    data[-1] ^= 1
    assert script.igtl(bytes(data)) == ["note bad_crc"]
    assert script.ros("/igtl/out/Tool", TOOL) == ["igtl TRANSFORM/Tool v1 to 1"]


# -- latched streams -------------------------------------------------------------------------------------------------

MESH = rosmsg.Mesh(np.array([[0, 1, 2]], np.uint32), np.eye(3))


def test_whoever_comes_later_gets_the_last_plan() -> None:
    script = Script()
    assert script.ros("/igtl/out/Plan", rosmsg.Mesh(MESH.triangles, np.zeros((3, 3)))) == []
    assert script.ros("/igtl/out/Plan", MESH, source_ns=T0_NS) == []
    assert script.ros("/igtl/out/Tool", TOOL) == [], "a pose is not worth keeping"
    assert script.up(1) == ["igtl POLYDATA/Plan v1 to 1"]
    first = script.last[0].data()
    assert decode(first).ticks == ns_to_ticks(T0_NS), "its stamp is that of its sender, not of the link"
    assert script.up(2) == ["igtl POLYDATA/Plan v1 to 2"]
    assert script.last[0].data() == first


def test_a_plan_that_cannot_be_sent_is_refused_to_each_link_with_a_note() -> None:
    script = Script()
    script.ros("/igtl/out/Plan", rosmsg.Mesh(np.array([[0, 1, 9]], np.uint32), np.eye(3)))
    assert script.up(1) == ["note conversion"]


# -- pictures -------------------------------------------------------------------------------------------------------


def part(offset: int, value: int, size: int = 1) -> Message:
    image = Image((2, 2, 2), 3, bytes([value]) * 4 * size, subvol_offset=(0, 0, offset), subvol_size=(2, 2, size))
    return Message("IMAGE", "CT", image)


def test_a_volume_is_published_when_all_its_parts_have_come_and_then_with_each_part() -> None:
    script = Script()
    assert script.igtl(part(0, 1)) == []
    assert script.gateway.ledger.to_dict()["igtl_in"]["IMAGE/CT"]["dropped"] == {"part_of_volume": 1}
    assert script.igtl(part(1, 2)) == ["ros /igtl/in/CT/volume"]
    first = script.last[0].data()
    assert bytes(Volume.unpack(first).data) == bytes([1] * 4 + [2] * 4)
    assert script.igtl(part(0, 9)) == ["ros /igtl/in/CT/volume"]
    assert bytes(Volume.unpack(script.last[0].data()).data) == bytes([9] * 4 + [2] * 4)
    assert bytes(Volume.unpack(first).data) == bytes([1] * 4 + [2] * 4), "the earlier output does not change"


def test_slices_are_published_on_request() -> None:
    script = Script(Config(to_ros=(ToRosRow(device="CT", kinds=("+slices",)),)))
    assert script.igtl(part(0, 7, 2)) == ["ros /igtl/in/CT/volume", *["ros /igtl/in/CT/slices"] * 2]


def test_every_frame_of_a_video_tells_the_size_that_the_key_frame_told() -> None:
    script = Script()
    script.up(1)
    key = VideoFrame(
        *(Header(T0_NS, "us"), "H264", 1, False, (64, 48, 1), (0, 0, 0), (64, 48, 1), 1),
        *((1.0, 0, 0, 0, 1, 0, 0, 0, 1), (0.001, 0.001, 0.001), (0.0, 0.0, 0.0), b"key"),
    )
    later = replace(key, frame_type=3, size=(0, 0, 1), part_size=(0, 0, 1), data=b"delta")
    script.ros("/igtl/out/US", key)
    assert script.ros("/igtl/out/US", later) == ["igtl VIDEO/US v1 to 1"]
    assert script.sent()[0].content.describe()["size"] == [64, 48, 1]
    assert script.sent()[0].content.describe()["subvol_size"] == [64, 48, 1]


# -- time -----------------------------------------------------------------------------------------------------------


def test_an_unset_stamp_is_the_time_of_receipt_never_1970() -> None:
    script = Script()
    script.igtl(unstamped(TRANSFORM))
    assert rosmsg.TransformStamped.unpack(script.last[0].data()).header.stamp_ns == script.now_ns


def test_a_ros_message_without_a_header_takes_the_stamp_of_its_sender_else_the_receipt() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/Text", rosmsg.String("a"), source_ns=T0_NS - 77)
    assert decode(script.last[0].data()).ticks == ns_to_ticks(T0_NS - 77)
    script.ros("/igtl/out/Text", rosmsg.String("a"))
    assert decode(script.last[0].data()).ticks == ns_to_ticks(script.now_ns)


def test_the_log_is_ordered_even_where_the_clock_steps_back() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/Tool", TOOL)
    script.now_ns -= 3_600_000_000_000
    script.ros("/igtl/out/Tool", TOOL)
    stamps = [entry.stamp_ns for entry in script.log]
    assert stamps == sorted(set(stamps))
    assert [entry.seq for entry in script.log] == list(range(1, len(script.log) + 1))


# -- names ----------------------------------------------------------------------------------------------------------


def test_long_names_are_shortened_and_travel_whole_in_the_metadata() -> None:
    script = Script()
    script.up(1)
    script.igtl(SLICER_HELLO)
    topic = "/igtl/out/a_very_long_name_of_a_tool"
    (line,) = script.ros(topic, TOOL)
    message = decode(script.last[0].data())
    assert len(message.device_name) == 20 and message.device_name.startswith("a_very_long_nam_")
    assert Item.of(FULL_NAME, "a_very_long_name_of_a_tool") in message.metadata
    assert line == f"igtl TRANSFORM/{message.device_name} v2 to 1"
    assert script.igtl(message) == ["ros /igtl/in/a_very_long_name_of_a_tool/transform"], "restored on the way back"


def test_names_that_collide_on_a_topic_are_kept_apart() -> None:
    script = Script()
    first, second = (script.igtl(replace(TRANSFORM, device_name=name)) for name in ("Tip 1", "Tip-1"))
    assert first == ["ros /igtl/in/Tip_1/transform"]
    assert second != first and second[0].startswith("ros /igtl/in/Tip_1_")
    assert script.igtl(replace(TRANSFORM, device_name="Tip 1")) == first


@pytest.mark.parametrize("name", ["", "7th", "Sonde é", "\x01\x02", "a/b"])
def test_any_name_gives_a_valid_topic(name: str) -> None:
    script = Script()
    (line,) = script.igtl(replace(TRANSFORM, device_name=name))
    topic = line.removeprefix("ros ")
    assert topic.isascii() and all(part and not part[0].isdigit() for part in topic[1:].split("/"))
    assert topic.count("/") == 4


# -- faults ---------------------------------------------------------------------------------------------------------


def test_a_bad_message_costs_itself_only() -> None:
    script = Script()
    good = join(encode(TRANSFORM))
    corrupt = good[:-1] + bytes([good[-1] ^ 0xFF])
    assert script.igtl(corrupt) == ["note bad_crc"]
    assert script.notes[0].stream == "TRANSFORM/ProbeToTracker"
    assert script.igtl(b"\x00\x09" + good[2:]) == ["note malformed"]
    assert script.igtl(good) == ["ros /igtl/in/ProbeToTracker/transform"]
    counts = script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/ProbeToTracker"]
    assert counts == {"received": 3, "decoded": 1, "converted": 1, "dropped": {"bad_crc": 1, "malformed": 1}}


def test_the_crc_check_can_be_switched_off() -> None:
    script = Script(Config(check_crc=False))
    good = join(encode(TRANSFORM))
    assert script.igtl(good[:50] + bytes(8) + good[58:]) == ["ros /igtl/in/ProbeToTracker/transform"]


def test_unknown_types_are_published_as_they_are() -> None:
    script = Script()
    unknown = Message("MYSTERY", "Box", Raw(b"abc"))
    assert script.igtl(unknown) == ["ros /igtl/in/Box/raw", "note no_conversion"]
    raw = RawMessage.unpack(script.last[0].data())
    assert (raw.type, raw.device_name, list(raw.links)) == ("MYSTERY", "Box", [1])
    assert decode(raw.data) == unknown
    assert script.igtl(unknown) == ["ros /igtl/in/Box/raw"], "reported once"
    counts = script.gateway.ledger.to_dict()["igtl_in"]["MYSTERY/Box"]
    assert counts == {"received": 2, "decoded": 2, "converted": 2}


def test_kinds_on_request_leave_unknown_types_as_they_are() -> None:
    unknown = Message("MYSTERY", "Odd", Raw(b"payload"))
    assert Script(Config(to_ros=(ToRosRow(kinds=("+slices",)),))).igtl(unknown)[0] == "ros /igtl/in/Odd/raw"
    assert Script(Config(to_ros=(ToRosRow(kinds=("image",)),))).igtl(unknown) == []


def test_a_type_name_ends_at_its_first_nul() -> None:
    script = Script()
    data = join(encode(Message("STRING\0xy", "Sloppy", String.of("a"))))
    assert script.igtl(data) == ["ros /igtl/in/Sloppy/string"]
    assert join(encode(decode(data))) == data


def test_an_empty_image_is_no_fault() -> None:
    script = Script()
    assert script.igtl(Message("IMAGE", "BrainLab", Raw(b""))) == ["note empty"]


@pytest.mark.parametrize(
    "message",
    [
        replace(TRANSFORM, content=Transform((float("nan"),) * 12)),
        replace(TRANSFORM, content=Transform((1, 0, 0, 0, 1, 0, 0, 0, -1, 0, 0, 0))),
        replace(TRANSFORM, content=Transform((0.0,) * 12)),
    ],
)
def test_what_cannot_be_converted_is_refused_with_a_note(message: Message) -> None:
    script = Script()
    assert script.igtl(message) == ["note conversion"]
    assert "found" in script.notes[0].text and "expected" in script.notes[0].text


def test_a_text_that_does_not_fit_is_refused_with_a_note() -> None:
    script = Script()
    script.up(1)
    assert script.ros("/igtl/out/Text", rosmsg.String("x" * 70_000)) == ["note conversion"]
    assert "70000 bytes" in script.notes[0].text and "65535" in script.notes[0].text
    assert script.ros("/igtl/out/Text", rosmsg.String("x" * 65_535)) == ["igtl STRING/Text v1 to 1"]


def test_a_ros_message_that_is_no_cdr_is_refused_with_a_note() -> None:
    script = Script()
    script.up(1)
    assert script.feed(Kind.ROS_IN, (b"\x00\x01\x00\x00\xff",), "/igtl/out/Tool", TOOL.TYPE) == ["note conversion"]


def test_scale_in_a_matrix_is_told_once_for_a_stream() -> None:
    script = Script()
    scaled = replace(TRANSFORM, content=Transform((2, 0, 0, 0, 2, 0, 0, 0, 2, 1, 2, 3)))
    assert script.igtl(scaled) == ["ros /igtl/in/ProbeToTracker/transform", "note not_a_rotation"]
    assert script.igtl(scaled) == ["ros /igtl/in/ProbeToTracker/transform"]


def test_a_peer_that_invents_names_opens_a_limited_number_of_topics() -> None:
    script = Script(Config(max_streams=3))
    lines = [script.igtl(replace(TRANSFORM, device_name=f"D{index}")) for index in range(6)]
    assert [bool(line and line[0].startswith("ros")) for line in lines] == [True] * 3 + [False] * 3
    assert lines[3:] == [["note too_many_streams"], [], []]
    assert script.igtl(replace(TRANSFORM, device_name="D0")) == ["ros /igtl/in/D0/transform"]


def test_ros_topics_beyond_the_limit_are_recorded_not_sent() -> None:
    script = Script(Config(max_streams=2))
    script.up(1)
    lines = [script.ros(f"/igtl/out/T{index}", TOOL) for index in range(4)]
    assert lines == [["igtl TRANSFORM/T0 v1 to 1"], ["igtl TRANSFORM/T1 v1 to 1"], ["note too_many_streams"], []]
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/T3"]["dropped"] == {"too_many_streams": 1}


def test_the_ledger_closes() -> None:
    script = Script()
    script.up(1)
    for message in (TRANSFORM, Message("STRING", "S", String.of("a")), Message("MYSTERY", "M", Raw(b"x"))):
        script.igtl(message)
    for topic in ("/igtl/out/Tool", "/elsewhere"):
        script.ros(topic, TOOL)
    for direction in ("igtl_in", "ros_in"):
        for counts in script.gateway.ledger.to_dict()[direction].values():
            dropped = sum(counts.get("dropped", {}).values())
            assert counts["received"] == counts.get("converted", 0) + counts.get("recorded_only", 0) + dropped


def test_a_message_that_no_chosen_kind_holds_is_counted_as_such() -> None:
    script = Script(Config(to_ros=(ToRosRow(device="Cloud", kinds=("mesh",)),)))
    assert script.igtl(Message("POLYDATA", "Cloud", PolyData(np.zeros((3, 3), ">f4")))) == []
    counts = script.gateway.ledger.to_dict()["igtl_in"]["POLYDATA/Cloud"]
    assert counts == {"received": 1, "decoded": 1, "dropped": {"not_chosen": 1}}


# -- purity ---------------------------------------------------------------------------------------------------------


def test_the_same_inputs_give_the_same_bytes() -> None:
    def run() -> list[tuple[object, ...]]:
        script = Script()
        script.up(1)
        script.igtl(SLICER_HELLO)
        script.igtl(TRANSFORM)
        script.ros("/igtl/out/Tool", TOOL)
        script.igtl(Message("MYSTERY", "M", Raw(b"x")))
        return [(e.seq, e.stamp_ns, e.kind, e.channel, e.type, e.data(), e.links, e.source_ns) for e in script.log]

    assert run() == run()


def test_a_defect_of_ours_costs_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script()

    def broken(*_: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(Router, "route", broken)
    assert script.igtl(TRANSFORM) == ["note internal_error"]
    monkeypatch.undo()
    assert script.igtl(TRANSFORM) == ["ros /igtl/in/ProbeToTracker/transform"]


# -- without subscribers --------------------------------------------------------------------------------------------


def test_outputs_without_a_subscriber_are_not_built() -> None:
    script = Script(news=True)
    heard = {"/igtl/in/ProbeToTracker/transform"}
    script.gateway.has_subscriber = lambda topic, _type: topic in heard
    script.igtl(TRANSFORM)
    assert [entry.channel for entry in script.last if entry.kind is Kind.ROS_OUT] == list(heard)
    heard.clear()
    script.igtl(TRANSFORM)
    assert script.last == []
    counts = script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/ProbeToTracker"]
    assert counts == {"received": 2, "decoded": 2, "converted": 1, "unheard": 1}


def test_who_listens_late_to_a_latched_topic_gets_its_last_message() -> None:
    script = Script()
    script.gateway.has_subscriber = lambda _topic, _type: False
    for x in (1.0, 2.0):
        assert (
            script.igtl(Message("POINT", "Landmarks", Points.of(np.array([[x, 0.0, 0.0]])), ns_to_ticks(T0_NS))) == []
        )
    listened = Note(Level.INFO, LISTENED, "", "/igtl/in/Landmarks/points")
    assert script.feed(Kind.EDGE_NOTE, (listened.pack(),)) == ["ros /igtl/in/Landmarks/points"]
    cloud = rosmsg.PointCloud2.unpack(script.last[0].data())
    assert np.frombuffer(cloud.data, "<f4")[0] == np.float32(0.002)
    assert script.feed(Kind.EDGE_NOTE, (listened.pack(),)) == []


def test_a_defect_of_the_fast_path_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script()
    script.up(1)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("oops")

    script.igtl(TRANSFORM)  # shows what the peer is; the next one is compiled
    monkeypatch.setattr(FastPath, "learn", broken)
    assert script.igtl(TRANSFORM) == ["note internal_error"]
    row = script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/ProbeToTracker"]
    assert (row["received"], row["converted"], row["dropped"]) == (2, 1, {"internal_error": 1})


# -- questions of the edges -----------------------------------------------------------------------------------------


def test_the_qos_to_subscribe_with() -> None:
    rows = (ToIgtlRow(topic="/fixed/*", qos=Qos(depth=3)), ToIgtlRow(topic="/igtl/out/**"))
    gateway = Script(Config(to_igtl=rows)).gateway
    assert gateway.subscription("/igtl/out/raw", RawMessage.TYPE) == RAW_QOS
    assert gateway.subscription("/fixed/raw", RawMessage.TYPE) == Qos(depth=3)
    assert gateway.subscription("/fixed/tool", TOOL.TYPE) == Qos(depth=3)
    assert gateway.subscription("/igtl/out/tool", TOOL.TYPE) is not None
    assert gateway.subscription("/igtl/out/tool", "lab_msgs/msg/Unknown") is None
    assert gateway.subscription("/elsewhere", RawMessage.TYPE) is None


def test_a_topic_that_no_row_converts() -> None:
    gateway = Script().gateway
    assert gateway.lacks_conversion("/igtl/out/tool", "lab_msgs/msg/Unknown")
    assert not gateway.lacks_conversion("/igtl/out/tool", TOOL.TYPE)
    assert not gateway.lacks_conversion("/igtl/out/raw", RawMessage.TYPE)
    assert not gateway.lacks_conversion("/elsewhere", "lab_msgs/msg/Unknown")


def test_the_qos_of_a_topic_is_known_when_its_stream_opens() -> None:
    script = Script()
    topic = "/igtl/in/ProbeToTracker/transform"
    assert script.gateway.qos(topic) is None
    script.igtl(TRANSFORM)
    assert script.gateway.qos(topic) is not None


@pytest.mark.parametrize(
    ("igtl_type", "kept"),
    [("STRING", True), ("RTS_COMMAND", True), ("GET_IMAGE", True), ("STT_TDATA", True), ("TRANSFORM", False)],
)
def test_what_a_full_send_queue_must_not_drop(igtl_type: str, kept: bool) -> None:
    script = Script()
    assert script.gateway.must_keep(Entry(1, T0_NS, Kind.IGTL_OUT, f"{igtl_type}/A", igtl_type, (b"",))) is kept


def test_an_edge_note_is_counted_for_its_edge() -> None:
    script = Script()
    note = Note(Level.WARN, "queue_full", "", "10.0.0.1:5")
    assert script.feed(Kind.EDGE_NOTE, (note.pack(),)) == []
    assert script.gateway.ledger.to_dict()["edges"] == {"10.0.0.1:5": {"queue_full": 1}}


def test_a_latched_message_that_cannot_be_built_is_reported_to_its_first_subscriber(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    script = Script()
    script.gateway.has_subscriber = lambda _topic, _type: False
    assert script.gateway.has_subscriber is not None
    monkeypatch.setattr(surfaces, "MAX_PIECES", 1)
    triangles = PolyData(np.eye(3), polygons=Cells.of([[0, 1, 2], [2, 1, 0]]))
    assert script.igtl(Message("POLYDATA", "Plan", triangles, ns_to_ticks(T0_NS))) == []
    listened = Note(Level.INFO, LISTENED, "", "/igtl/in/Plan/mesh")
    assert script.feed(Kind.EDGE_NOTE, (listened.pack(),)) == ["note conversion"]
    assert script.feed(Kind.EDGE_NOTE, (listened.pack(),)) == []


def test_outputs_of_a_recording_cause_nothing() -> None:
    script = Script()
    for kind in (Kind.IGTL_OUT, Kind.ROS_OUT, Kind.NOTE):
        assert script.gateway.handle(Entry(1, T0_NS, kind, "", "", (b"",))) == []

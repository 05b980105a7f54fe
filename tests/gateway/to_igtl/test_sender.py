"""3D Slicer gets no type that it does not read, but what shows the same; other peers beside it get the message."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.config.configuration import Config, PeerRow, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import MultiArrayLayout, PoseArray, PoseStamped
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData, Trajectory, TrajectoryList
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.naming import ShownNames
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script
from tests.tables import table

HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item.of("dummy", "dummy"),))
READS = "COMMAND IMAGE IMGMETA LBMETA POINT POLYDATA RTS_COMMAND RTS_TDATA STATUS STRING TRANSFORM".split()
FACING = (0.0, 0.0, 0.0, 1.0)
POSITION = ToIgtlRow(topic="/pose", device="Tool", type="POSITION")


def script(*rows: ToIgtlRow, **settings: Any) -> Script:
    """A session with 3D Slicer (1) and a peer that reads everything (2)."""
    peers = (PeerRow("127.0.0.1:2", "default"),)
    made = Script(replace(Config(peers=peers, to_igtl=rows, **settings).watched()))
    made.up(1, peer="127.0.0.1:1", role="server")
    made.igtl(HELLO)
    made.up(2, peer="127.0.0.1:2", role="client")
    return made


def pose(x: float = 0.001, stamp_ns: int = T0_NS) -> PoseStamped:
    return PoseStamped(Header(stamp_ns, "base"), (x, 0.0, 0.0, *FACING))


def numbers() -> rosmsg.RosMessage:
    return MULTI_ARRAYS["f8"](MultiArrayLayout(), np.arange(3.0))


def tools(*names: str) -> TrackingData:
    return TrackingData(Header(T0_NS, "tracker"), tuple(TrackedTool(name, 2, (0.001, 0, 0, *FACING)) for name in names))


def raw(igtl_type: str, content: object = None, name: str = "D") -> rosmsg.RosMessage:
    data = join(encode(Message(igtl_type, name, Raw(b"") if content is None else content)))  # type: ignore[arg-type]
    return replace(raw_message(data, T0_NS, 0), links=np.zeros(0, np.uint32))


@table("igtl_type", sorted({*BODIES, "MYTYPE"}))
def test_slicer_gets_no_type_that_it_does_not_read(igtl_type: str) -> None:
    made = script()
    made.ros("/igtl/out/any", raw(igtl_type))
    out = [entry for entry in made.last if entry.kind is Kind.IGTL_OUT]
    assert all(entry.type in READS for entry in out if 1 in entry.links)
    assert any(2 in entry.links for entry in out), "others get the message"


def test_what_has_no_substitute_is_noted_once_for_each_stream_and_counted() -> None:
    made = script()
    assert made.ros("/igtl/out/joints", numbers()) == ["igtl NDARRAY/joints v1 to 2", "note not_for_peer"]
    (note,) = [note for note in made.notes if note.code == "not_for_peer"]
    assert note.text.startswith("NDARRAY/joints is not sent to 127.0.0.1:1: ") and "profile slicer" in note.text
    assert made.ros("/igtl/out/joints", numbers()) == ["igtl NDARRAY/joints v1 to 2"]
    assert made.ros("/igtl/out/others", numbers()) == ["igtl NDARRAY/others v1 to 2", "note not_for_peer"]
    rows = made.gateway.ledger.to_dict()["igtl_out"]
    assert rows["NDARRAY/joints"]["dropped"] == {"not_for_slicer": 2}
    assert rows["NDARRAY/others"]["dropped"] == {"not_for_slicer": 1}


def test_a_position_is_a_transform_for_slicer_with_stamp_and_frame() -> None:
    made = script(POSITION)
    lines = ["igtl POSITION/Tool v1 to 2", "igtl TRANSFORM/Tool v2 to 1"]
    assert made.ros("/pose", pose()) == [*lines, "note shown_instead"]
    _, sent = made.sent()
    assert isinstance(sent.content, Transform) and sent.content.rows[0] == [1.0, 0.0, 0.0, 1.0]
    items = {item.key: item.text for item in sent.metadata}
    assert items == {"ros.frame_id": "base", "ros.stamp": str(T0_NS)}
    assert made.ros("/pose", pose()) == lines, "noted once"
    assert "not_for_slicer" not in json.dumps(made.gateway.ledger.to_dict())


def test_each_tool_of_tracking_data_is_a_transform() -> None:
    made = script(ToIgtlRow(topic="/tracking", device="Polaris", type="QTDATA"))
    lines = made.ros("/tracking", tools("Probe", "Stylus"))
    assert lines == [
        "igtl QTDATA/Polaris v1 to 2",
        "igtl TRANSFORM/Probe v2 to 1",
        "igtl TRANSFORM/Stylus v2 to 1",
        "note shown_instead",
        "note shown_instead",
    ]


def test_poses_that_come_once_are_transforms() -> None:
    """In 3D Slicer a tool of TDATA is the identity until the second message that names it."""
    made = script(ToIgtlRow(topic="/grasps", device="Grasps"))
    poses = PoseArray(Header(T0_NS, "base"), np.array([[0.001, 0, 0, *FACING], [0.002, 0, 0, *FACING]]))
    lines = ["igtl TDATA/Grasps v1 to 2", "igtl TRANSFORM/Tool1 v2 to 1", "igtl TRANSFORM/Tool2 v2 to 1"]
    assert made.ros("/grasps", poses) == [*lines, "note shown_instead", "note shown_instead"]
    one, other = (sent.content for sent in made.sent()[1:])
    assert isinstance(one, Transform) and isinstance(other, Transform)
    assert (one.rows[0][3], other.rows[0][3]) == (1.0, 2.0)


@pytest.mark.parametrize("query", ["STT_TDATA", "GET_TDATA"])
def test_slicer_gets_the_tracking_data_that_it_asks_for(query: str) -> None:
    made = script(ToIgtlRow(topic="/tracking", device="Polaris", type="TDATA"))
    made.ros("/tracking", tools("Probe"))
    made.igtl(Message(query, "Polaris", StartTracking(0) if query[0] == "S" else EmptyQuery(), 0, 2))
    for _ in range(3):
        made.now_ns += 50_000_000
        lines = made.ros("/tracking", tools("Probe"))
        assert {line for line in lines if " v2 to 1" in line} == {"igtl TDATA/Polaris v2 to 1"}


def test_a_substitute_has_no_name_of_another_stream() -> None:
    rows = (ToIgtlRow(topic="/tracking", device="Polaris", type="QTDATA"), ToIgtlRow(topic="/tool", device="Probe"))
    made = script(*rows)
    assert made.ros("/tool", rosmsg.TransformStamped(Header(T0_NS, "base"), "Probe", (0, 0, 0), FACING))
    lines = made.ros("/tracking", tools("Probe"))
    (name,) = [line for line in lines if line.startswith("igtl TRANSFORM/")]
    assert name.startswith("igtl TRANSFORM/Probe_") and name.endswith(" v2 to 1")


def test_names_of_substitutes_are_kept_apart() -> None:
    names = ShownNames({"TRANSFORM/C"}.__contains__)
    assert names.of("TRANSFORM", "A", "QTDATA/1") == ("A", "A") == names.of("TRANSFORM", "A", "QTDATA/1")
    other, full = names.of("TRANSFORM", "A", "QTDATA/2")
    assert other == full != "A" and names.of("TRANSFORM", "A", "QTDATA/2") == (other, full)
    assert names.of("TRANSFORM", "C", "QTDATA/1")[0] != "C"
    short, full = names.of("TRANSFORM", "a name of more than twenty bytes", "QTDATA/1")
    assert len(short) == 20 and full == "a name of more than twenty bytes"


def test_a_plan_is_a_model() -> None:
    made = script()
    plan = Trajectory("Needle", "", 3, (255, 0, 0, 255), (0.0, 0.0, 0.0), (0.01, 0.0, 0.0), 0.001, "")
    lines = made.ros("/igtl/out/Plan", TrajectoryList(Header(T0_NS, "base"), (plan,)))
    assert lines == ["igtl TRAJ/Plan v1 to 2", "igtl POLYDATA/Plan v2 to 1", "note shown_instead"]
    content = made.sent()[1].content
    assert isinstance(content, PolyData) and content.points.tolist() == [[0, 0, 0], [10, 0, 0]]
    assert content.attributes[0].name == "RGBA" and content.lines.lists() == [[0, 1]]


def test_the_children_of_a_bind_come_alone_if_slicer_reads_them() -> None:
    made = script()
    text = b"".join(bytes(part) for part in String.of("x").pack())
    position = BODIES["POSITION"].unpack(memoryview(np.array([1, 2, 3, 0, 0, 0, 1], ">f4").tobytes()))
    children = (
        BindChild("STRING", "A", text),
        BindChild("POSITION", "B", b"".join(bytes(part) for part in position.pack())),
        BindChild("SENSOR", "C", bytes(10)),
    )
    lines = made.ros("/igtl/out/any", raw("BIND", Bind(children), "Outer"))
    assert lines[:3] == ["igtl BIND/Outer v1 to 2", "igtl STRING/A v2 to 1", "igtl TRANSFORM/B v2 to 1"]
    assert [note.code for note in made.notes].count("not_for_peer") == 1


def test_a_late_joiner_gets_substitutes_of_latched_streams() -> None:
    made = Script(Config(peers=(PeerRow("127.0.0.1:1", "slicer"),)).watched())
    plan = Trajectory("Needle", "", 3, (255, 0, 0, 255), (0.0, 0.0, 0.0), (0.01, 0.0, 0.0), 0.001, "")
    made.ros("/igtl/out/Plan", TrajectoryList(Header(T0_NS, "base"), (plan,)))
    made.up(1, peer="127.0.0.1:1", role="server")
    assert made.igtl(HELLO) == ["igtl POLYDATA/Plan v2 to 1", "note shown_instead"]


def test_a_pose_without_a_rotation_is_refused_with_a_reason() -> None:
    made = script()
    zero = BODIES["POSITION"].unpack(memoryview(bytes(28)))
    lines = made.ros("/igtl/out/any", raw("POSITION", zero))
    assert lines == ["igtl POSITION/D v1 to 2", "note conversion"]
    assert "quaternion" in made.notes[0].text


def test_older_sessions_are_repeated_as_they_were() -> None:
    made = script(POSITION, fitting=0)
    assert made.ros("/pose", pose()) == ["igtl POSITION/Tool v1 to 2", "igtl POSITION/Tool v2 to 1"]
    assert made.ros("/igtl/out/n", numbers()) == ["igtl NDARRAY/n v1 to 2", "igtl NDARRAY/n v2 to 1"]


def test_until_its_first_message_a_peer_gets_only_what_slicer_reads_too() -> None:
    made = Script(Config(profile="crtk").watched())
    made.up(1, peer="127.0.0.1:1", role="server")
    assert made.ros("/igtl/out/n", numbers()) == ["note not_for_peer"]
    assert made.ros("/igtl/out/n", numbers()) == []
    assert made.ros("/igtl/out/Text", rosmsg.String("x")) == ["igtl STRING/Text v1 to 1"]
    made.tick(0.3)
    assert made.ros("/igtl/out/n", numbers()) == ["igtl NDARRAY/n v1 to 1"], "it is silent"
    made.up(2, peer="127.0.0.1:2", role="server")
    made.igtl(Message("STATUS", "Arm", Status(1)), link=2)
    assert made.ros("/igtl/out/n", numbers()) == ["igtl NDARRAY/n v1 to 1,2"], "it is another program"


def test_a_stream_that_slicer_gets_in_another_type_is_compiled_for_none() -> None:
    made = script(POSITION)
    for number in range(5):
        made.ros("/pose", pose(0.001 * number, T0_NS + number))
        poses = [message.content for message in made.sent()]
        assert isinstance(poses[1], Transform) and poses[1].rows[0][3] == pytest.approx(number)


@pytest.mark.parametrize("version", [1, 2])
def test_each_message_to_slicer_has_its_stamp_as_metadata_if_it_reads_them(version: int) -> None:
    made = Script(Config(profile="slicer").watched())
    made.up(1, peer="127.0.0.1:1", role="server")
    made.igtl(Message("STATUS", "", Status(1)) if version == 1 else HELLO)
    made.igtl(Message("STRING", "A", String.of("x"), 0, version))
    source_ns = T0_NS + 5
    for _ in range(3):
        made.ros("/igtl/out/Text", rosmsg.String("x"), source_ns=source_ns)
        (sent,) = made.sent()
        items = {item.key: item.text for item in sent.metadata}
        assert items == ({"ros.stamp": str(source_ns)} if version == 2 else {})
        assert sent.ticks == ns_to_ticks(source_ns)


def test_other_peers_get_no_stamp_that_ros_does_not_have() -> None:
    made = script()
    made.igtl(Message("STATUS", "Arm", Status(1), header_version=2), link=2)
    made.ros("/igtl/out/Text", rosmsg.String("x"))
    assert [[item.key for item in one.metadata] for one in made.sent()] == [[], ["ros.stamp"]]

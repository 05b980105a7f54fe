"""CRTK arms in the unit of each peer: millimetres for 3D Slicer, metres for others, in the same session."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.config.configuration import Config, PeerRow, ToRosRow
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.stream_units import StreamUnits, arm_units
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.query import StartTracking
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.tracking import TrackingData
from igtl_gateway.wire.transform import Transform
from tests.script import Script

HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item.of("dummy", "dummy"),))
OTHER = Message("STATUS", "saw", Status(1))
FACING = (0.0, 0.0, 0.0, 1.0)
#: The tip of an arm, m.
TIP = (0.1, -0.02, 0.123456789)


def script(**settings: Any) -> Script:
    """A session with 3D Slicer (1) and sawOpenIGTLink (2)."""
    allowed = ("PSM1/servo_cp", "PSM2/measured_cp")
    made = Script(Config(**{"crtk": (ArmsRow("/PSM*", max_speed=0.0),), "allow_in": allowed} | settings).watched())
    made.up(1, peer="127.0.0.1:1", role="server")
    made.igtl(HELLO)
    made.up(2, peer="127.0.0.1:2", role="server")
    made.igtl(OTHER, link=2)
    return made


def measured(made: Script, place: tuple[float, float, float] = TIP) -> list[str]:
    return made.ros("/PSM1/measured_cp", PoseStamped(Header(made.now_ns, "ECM"), (*place, *FACING)))


def translation(message: Message) -> list[float]:
    assert isinstance(message.content, Transform)
    return [row[3] for row in message.content.rows[:3]]


def sent_by(place: tuple[float, ...], device: str, stamp_ns: int) -> Message:
    rows = [[1.0, 0, 0, place[0]], [0, 1.0, 0, place[1]], [0, 0, 1.0, place[2]]]
    return Message("TRANSFORM", device, Transform.from_rows(rows), ns_to_ticks(stamp_ns))


def test_slicer_gets_millimetres_and_others_metres_of_one_message() -> None:
    made = script()
    lines = measured(made)
    assert lines == [
        "igtl TRANSFORM/PSM1/measured_cp v1 to 2",
        "igtl TRANSFORM/PSM1/measured_cp v2 to 1",
        "note arm_unit",
    ]
    metres, millimetres = map(translation, made.sent())
    assert metres == [float(np.float32(one)) for one in TIP]
    assert millimetres == [float(np.float32(1000 * one)) for one in TIP], "rounded once"
    (note,) = [note for note in made.notes if note.code == "arm_unit"]
    assert "mm" in note.text and note.data == {"unit": "mm"}
    assert "note arm_unit" not in measured(made), "noted once"


@pytest.mark.parametrize("link, factor", [(1, 1000.0), (2, 1.0)], ids=["Slicer", "saw"])
def test_a_command_has_the_unit_of_its_sender(link: int, factor: float) -> None:
    made = script()
    measured(made)
    place = tuple(factor * one for one in TIP)
    made.igtl(sent_by(place, "PSM1/servo_cp", made.now_ns), link)
    pose = PoseStamped.unpack(made.published("/PSM1/servo_cp")).pose
    assert pose[:3] == pytest.approx(TIP, abs=1e-8)


def test_the_guard_checks_a_command_in_the_unit_of_its_sender() -> None:
    made = script(crtk=(ArmsRow("/PSM*", workspace=(0.0, 0.0, 0.0, 0.2)),))
    measured(made)
    assert "note command_workspace" in made.igtl(sent_by((210.0, 0.0, 0.0), "PSM1/servo_cp", made.now_ns))
    assert "note command_workspace" in made.igtl(sent_by((0.21, 0.0, 0.0), "PSM1/servo_cp", made.now_ns), 2)
    # 1 mm in one unit is 1 m in the other
    moved = (1000 * TIP[0] + 0.1, 1000 * TIP[1], 1000 * TIP[2])
    measured(made)
    assert "ros /PSM1/servo_cp" in made.igtl(sent_by(moved, "PSM1/servo_cp", made.now_ns))


@pytest.mark.parametrize("device, topic", [("PSM2/measured_cp", "/PSM2/measured_cp"), ("PSM3/measured_cp", "")])
def test_states_of_peers_have_the_unit_of_each(device: str, topic: str) -> None:
    made = script()
    for link, factor in ((1, 1000.0), (2, 1.0)):
        place = tuple(factor * one for one in TIP)
        for _ in range(4):  # compiled from the second on
            lines = made.igtl(sent_by(place, device, made.now_ns + NS_PER_MS), link)
            name = topic or next(line.split()[1] for line in lines if "/igtl/in/" in line)
            data = next(one.data() for one in made.last if one.channel == name)
            x, y, z = np.frombuffer(data[-56:], "<f8")[:3]
            assert (x, y, z) == pytest.approx(TIP, abs=1e-8)


def test_other_devices_and_rows_of_the_user_keep_their_unit() -> None:
    made = script(to_ros=(ToRosRow(device="PSM9/measured_cp", igtl_unit="cm"),))
    for device, unit in (("Probe", 1000.0), ("PSM9/measured_cp", 100.0)):
        made.igtl(sent_by((unit, 0.0, 0.0), device, made.now_ns))
        (data,) = [one.data() for one in made.last if one.channel.endswith("/transform")]
        assert np.frombuffer(data[-56:], "<f8")[0] == pytest.approx(1.0)


def test_tracking_data_that_slicer_asks_for_has_its_unit() -> None:
    made = script()
    measured(made)
    for link in (1, 2):
        made.igtl(Message("STT_TDATA", "", StartTracking(0), header_version=2), link)
    measured(made)
    found = {
        entry.links: message.content
        for entry, message in zip((one for one in made.last if one.kind is Kind.IGTL_OUT), made.sent(), strict=True)
        if isinstance(message.content, TrackingData)
    }
    assert {links: content.elements["matrix"][0][9] for links, content in found.items()} == {
        (1,): np.float32(100.0),
        (2,): np.float32(0.1),
    }


def test_a_session_with_both_verifies_and_its_reader_knows_each_unit() -> None:
    made = script()
    for number in range(5):
        measured(made, (0.1 + 1e-5 * number, 0.0, 0.0))
        made.igtl(sent_by((100.0, 0.0, 0.0), "PSM1/servo_cp", made.now_ns))
    assert verify(made.log, made.gateway.config).equal
    streams = dict.fromkeys((entry.kind, entry.channel, entry.type) for entry in made.log)
    units = StreamUnits(made.gateway.config, streams, arm_units(made.log))
    assert arm_units(made.log) == {1: "mm"}
    for entry in made.log:
        if entry.channel.startswith("TRANSFORM/PSM1/"):
            assert units.of(entry.kind, entry.channel, entry.type, entry.links) == ("mm" if 1 in entry.links else "m")


def test_older_sessions_have_metres_for_all() -> None:
    made = script(fitting=0, peers=(PeerRow("127.0.0.1:1", "slicer"),))
    measured(made)
    assert [translation(message)[0] for message in made.sent()] == [np.float32(0.1), np.float32(0.1)]
    made.igtl(sent_by(TIP, "PSM1/servo_cp", made.now_ns))
    assert PoseStamped.unpack(made.published("/PSM1/servo_cp")).pose[:3] == pytest.approx(TIP, abs=1e-8)

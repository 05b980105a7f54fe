"""Messages to peers: denied types, frames that peers ask for, and content adapted to each profile."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow
from igtl_gateway.convert import profiles, rosmsg
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.gateway.fastpath import compile_to_igtl
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import StartTracking
from igtl_gateway.wire.text import Status
from tests.script import T0_NS, Script

MESH = rosmsg.Mesh(np.array([[0, 1, 2]], np.uint32), np.eye(3))
POSE = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)
SLICER = Message("STATUS", "", Status(1), 0, 2, 0, (Item("dummy", b"dummy"),))


def tool(name: str) -> rosmsg.TransformStamped:
    return rosmsg.TransformStamped(rosmsg.Header(T0_NS, "base"), name, POSE[:3], POSE[3:])


def test_a_latched_message_of_a_denied_type_is_not_sent_to_a_late_joiner() -> None:
    script = Script(Config(deny_out=("POLYDATA",)))
    script.ros("/igtl/out/Plan", MESH)
    assert script.up(1) == ["note denied"]
    assert script.notes[0].text == "POLYDATA/Plan is not sent: POLYDATA is denied (deny_out)"
    assert script.gateway.ledger.to_dict()["igtl_out"]["POLYDATA/Plan"] == {"dropped": {"denied": 1}}


def test_tracking_data_that_no_frame_connects_is_not_sent_to_who_asked_for_that_frame() -> None:
    rows = (ToIgtlRow(topic="/polaris", device="Polaris", type="TDATA"),)
    script = Script(Config(to_igtl=rows, tf_out=(TfOutRow(frames=("base",), base="world"),)))
    script.up(1)
    script.up(2)
    place = FrameTransform(rosmsg.Header(0, "world"), "base", POSE)
    script.ros("/tf_static", TFMessage((place,)))
    script.igtl(Message("STT_TDATA", "Polaris", StartTracking(0, "world")))
    tracked = (TrackedTool("probe", 2, POSE),)
    assert script.ros("/polaris", TrackingData(rosmsg.Header(T0_NS, "elsewhere"), tracked)) == [
        "note unknown_frame",
        "igtl TDATA/Polaris v1 to 2",
    ]
    assert "from its frame 'elsewhere'" in script.notes[0].text
    assert len(script.ros("/polaris", TrackingData(rosmsg.Header(T0_NS, "base"), tracked))) == 2


def test_tracking_data_of_single_poses_keeps_to_the_interval_of_the_peer() -> None:
    script = Script()
    script.up(1)
    script.igtl(Message("STT_TDATA", "", StartTracking(50)))
    lines = [script.ros("/igtl/out/Probe", tool("probe")) for _ in range(3)]
    assert [len(one) for one in lines] == [2, 1, 1], "one millisecond apart"
    script.now_ns += 50_000_000
    assert "igtl TDATA/Tracking v1 to 1" in script.ros("/igtl/out/Probe", tool("probe"))


def test_where_tracking_data_goes_out_none_is_made_of_single_poses() -> None:
    rows = (ToIgtlRow(topic="/polaris", device="Polaris", type="TDATA"), ToIgtlRow())
    script = Script(Config(to_igtl=rows))
    script.up(1)
    script.igtl(Message("STT_TDATA", "", StartTracking(0)))
    script.ros("/polaris", TrackingData(rosmsg.Header(T0_NS, "base"), (TrackedTool("probe", 2, POSE),)))
    assert script.ros("/igtl/out/Probe", tool("probe")) == ["igtl TRANSFORM/Probe v1 to 1"]


@pytest.mark.parametrize(("encoding", "scalar_type"), [("32SC1", 10), ("mono8", 3)])
def test_an_image_is_adapted_once_for_all_peers_of_a_profile(
    encoding: str, scalar_type: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_to_igtl, "TYPES", frozenset())  # which adapts the first one for itself
    adapted: list[Image] = []
    before = profiles.BY_NAME["slicer"].adapt[Image]
    monkeypatch.setitem(
        profiles.BY_NAME["slicer"].adapt,
        Image,
        lambda image: adapted.append(image) or before(image),  # type: ignore[func-returns-value]
    )
    script = Script()
    for link in (1, 2):
        script.up(link)
        script.igtl(SLICER, link)
    script.up(3)
    size = 4 if encoding == "32SC1" else 1
    picture = rosmsg.Image(rosmsg.Header(T0_NS, "camera"), 1, 2, encoding, 0, 2 * size, bytes(2 * size))
    lines = script.ros("/igtl/out/Camera", picture)
    assert sorted(lines) == ["igtl IMAGE/Camera v1 to 3", "igtl IMAGE/Camera v2 to 1,2"]
    assert len(adapted) == 1
    newer = next(message for message in script.sent() if message.header_version == 2)
    assert newer.content.describe()["scalar_type"] == scalar_type

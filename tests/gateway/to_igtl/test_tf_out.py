"""ROS frames on their way to OpenIGTLink, and poses on their way to /tf."""

from __future__ import annotations

import pytest

from igtl_gateway.base.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.config.configuration import Config, TfOutRow
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script

UNIT = (0.0, 0.0, 0.0, 1.0)


def tf(*edges: tuple[str, str, float], stamp_ns: int = T0_NS) -> TFMessage:
    return TFMessage(
        tuple(FrameTransform(Header(stamp_ns, parent), child, (x, 0.0, 0.0, *UNIT)) for parent, child, x in edges)
    )


def test_a_chain_is_composed_and_sent_with_each_change() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("tool",), base="base"),)))
    script.up(1)
    assert script.ros("/tf_static", tf(("base", "arm", 1.0), stamp_ns=0)) == []
    assert script.ros("/tf", tf(("arm", "tool", 0.5))) == ["igtl TRANSFORM/toolTobase v1 to 1"]
    (message,) = script.sent()
    assert isinstance(message.content, Transform)
    assert message.content.wire_matrix[9:] == (1500.0, 0.0, 0.0) and message.ticks == ns_to_ticks(T0_NS)
    assert script.ros("/tf", tf(("map", "odom", 9.0))) == [], "nothing of the chain has changed"
    assert script.ros("/tf", tf(("arm", "tool", 0.6), stamp_ns=T0_NS + 5)) == ["igtl TRANSFORM/toolTobase v1 to 1"]


def test_several_frames_are_tracking_data() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("a", "b"), base="base", device="Tracker"),)))
    script.up(1)
    assert script.ros("/tf", tf(("base", "a", 0.1))) == ["igtl TDATA/Tracker v1 to 1"]
    script.ros("/tf", tf(("base", "b", 0.2)))
    elements = script.sent()[0].content.describe()["elements"]
    assert [(one["name"], one["matrix"][0][3]) for one in elements] == [("a", 100.0), ("b", 200.0)]


def test_frames_are_told_in_the_frame_that_a_peer_asked_for() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("probe",), base="base", device="Scene", type="TDATA"),)))
    script.up(1)
    script.ros("/tf_static", tf(("base", "camera", 1.0), stamp_ns=0))
    script.ros("/tf", tf(("base", "probe", 0.5)))
    script.igtl(Message("STT_TDATA", "Scene", StartTracking(0, "camera")))
    script.ros("/tf", tf(("base", "probe", 0.6), stamp_ns=T0_NS + 5))
    (message,) = script.sent()
    assert message.content.describe()["elements"][0]["matrix"][0][3] == pytest.approx(-400.0)


def test_what_does_not_move_is_told_to_whoever_comes_later() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("arm",), base="base"),)))
    script.ros("/tf_static", tf(("base", "arm", 1.0), stamp_ns=0))
    assert script.up(1) == ["igtl TRANSFORM/armTobase v1 to 1"]


def test_frames_are_found_by_queries() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("tool",), base="base", device="Tool"),)))
    script.ros("/tf", tf(("base", "tool", 0.5)))
    script.up(1)
    assert "igtl TRANSFORM/Tool v1 to 1" in script.igtl(Message("GET_TRANS", "Tool", EmptyQuery()))


def test_what_a_tracker_sends_is_part_of_the_tree() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("Probe",), base="robot"),)))
    script.up(1)
    script.ros("/tf_static", tf(("robot", "Tracker", 1.0), stamp_ns=0))
    pose = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 250.0, 0, 0))
    lines = script.igtl(Message("TRANSFORM", "ProbeToTracker", pose, ns_to_ticks(T0_NS)))
    assert lines == ["ros /igtl/in/ProbeToTracker/transform", "igtl TRANSFORM/ProbeTorobot v1 to 1"]
    content = script.sent()[0].content
    assert isinstance(content, Transform) and content.wire_matrix[9] == 1250.0


def test_tf_is_subscribed_only_where_frames_go_out() -> None:
    assert Script().gateway.subscription("/tf", TFMessage.TYPE) is None
    gateway = Script(Config(tf_out=(TfOutRow(frames=("tool",), base="base"),))).gateway
    static = gateway.subscription("/tf_static", TFMessage.TYPE)
    assert static is not None and static.latched
    assert gateway.subscription("/tf", "std_msgs/msg/String") is None


@pytest.mark.parametrize(
    ("publish", "topics"), [(True, ["/igtl/in/AToB/transform", "/tf"]), (False, ["/igtl/in/AToB/transform"])]
)
def test_poses_appear_on_tf(publish: bool, topics: list[str]) -> None:
    script = Script(Config(publish_tf=publish), news=True)
    pose = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 250.0, 0, 0))
    script.igtl(Message("TRANSFORM", "AToB", pose, ns_to_ticks(T0_NS)))
    assert [entry.channel for entry in script.last if entry.type and entry.kind.value == "ros_out"] == topics
    if publish:
        (transform,) = TFMessage.unpack(script.published("/tf")).transforms
        assert transform == FrameTransform(Header(T0_NS, "B"), "A", (0.25, 0.0, 0.0, *UNIT))


def test_garbage_on_tf_costs_itself() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("tool",), base="base"),)))
    script.up(1)
    assert script.feed(Kind.ROS_IN, (b"\x00\x01\x00\x00\xff",), "/tf", TFMessage.TYPE) == ["note conversion"]


def test_a_frame_beyond_all_numbers_costs_itself() -> None:
    rows = (TfOutRow(frames=("far",), base="base"), TfOutRow(frames=("near",), base="base"))
    script = Script(Config(tf_out=rows))
    script.up(1)
    lines = script.ros("/tf", tf(("base", "far", 1e300), ("base", "near", 1.0)))
    assert lines == ["note conversion", "igtl TRANSFORM/nearTobase v1 to 1"]
    assert script.gateway.ledger.to_dict()["ros_in"]["/tf"] == {"received": 1, "converted": 1}
    assert script.ros("/tf", tf(("base", "far", 1.0), stamp_ns=T0_NS + 5)) == ["igtl TRANSFORM/farTobase v1 to 1"]


def test_single_frames_are_put_together_for_who_asks_for_tracking_data() -> None:
    rows = (TfOutRow(frames=("a",), base="base"), TfOutRow(frames=("b",), base="base"))
    script = Script(Config(tf_out=rows))
    script.up(1)
    script.igtl(Message("STT_TDATA", "", StartTracking(0, "")))
    lines = script.ros("/tf", tf(("base", "a", 0.1), ("base", "b", 0.2)))
    assert lines == [
        "igtl TRANSFORM/aTobase v1 to 1",
        "igtl TRANSFORM/bTobase v1 to 1",
        "igtl TDATA/Tracking v1 to 1",
    ]
    elements = script.sent()[-1].content.describe()["elements"]
    assert [(one["name"], one["matrix"][0][3]) for one in elements] == [("aTobase", 100.0), ("bTobase", 200.0)]


def poses_at(script: Script) -> list[tuple[int, dict[str, float]]]:
    """Of the last messages of tracking data: stamp in ms, and the position of each tool, mm."""
    return [
        (
            round((ticks_to_ns(message.ticks) - T0_NS) / 1e6),
            {one["name"]: one["matrix"][0][3] for one in message.content.describe()["elements"]},
        )
        for message in script.sent()
        if message.type == "TDATA"
    ]


def test_a_pose_in_tracking_data_is_that_of_its_stamp() -> None:
    """The needle comes 300 ms late with right stamps, the probe at once; both move 100 mm/s."""
    script = Script(Config(tf_out=(TfOutRow(frames=("probe", "needle"), base="base", device="Tracker"),)))
    script.up(1)
    seen: dict[str, int] = {}
    for number in range(100):
        updates = [("probe", number * 20)]
        if number % 5 == 0 and number >= 15:
            updates.append(("needle", number * 20 - 300))
        for frame, at in updates:
            script.ros("/tf", tf(("base", frame, at / 10_000), stamp_ns=T0_NS + at * 10**6))
            for stamp_ms, tools in poses_at(script):
                for name, x in tools.items():
                    seen[name] = seen.get(name, 0) + 1
                    assert x == pytest.approx(stamp_ms / 10, abs=0.5)
    assert (seen["probe"], seen["needle"]) == (100, 17)


def test_poses_of_several_moments_in_one_update_are_several_messages() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("a", "b", "c", "still"), base="base", device="Tracker"),)))
    script.up(1)
    script.ros("/tf_static", tf(("base", "still", 4.0), stamp_ns=0))
    edges = tuple(
        FrameTransform(Header(T0_NS + ms * 10**6, "base"), child, (ms / 1000, 0.0, 0.0, *UNIT))
        for child, ms in (("a", 10), ("b", 12), ("c", 300))
    )
    script.ros("/tf", TFMessage(edges))
    assert poses_at(script) == [
        (12, {"a": 10.0, "b": 12.0, "still": 4000.0}),
        (300, {"c": 300.0, "still": 4000.0}),
    ]
    # with one stamp, frames that come one after the other are together again
    script.ros("/tf", tf(("base", "a", 0.4), stamp_ns=T0_NS + 400 * 10**6))
    script.ros("/tf", tf(("base", "b", 0.5), stamp_ns=T0_NS + 400 * 10**6))
    assert poses_at(script) == [(400, {"a": 400.0, "b": 500.0, "still": 4000.0})]


def test_recordings_without_rules_of_names_have_all_poses_in_each_message() -> None:
    script = Script(Config(naming=0, tf_out=(TfOutRow(frames=("a", "b"), base="base", device="Tracker"),)))
    script.up(1)
    script.ros("/tf", tf(("base", "a", 0.1)))
    script.ros("/tf", tf(("base", "b", 0.2), stamp_ns=T0_NS + 300 * 10**6))
    assert poses_at(script) == [(300, {"a": 100.0, "b": 200.0})]


def test_frames_without_stamps_are_of_the_moment_of_their_receipt() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("a", "b", "still"), base="base", device="Tracker"),)))
    script.up(1)
    script.ros("/tf_static", tf(("base", "still", 9.0), stamp_ns=0))
    found = []
    for number, name in enumerate("aba"):
        script.now_ns += 40_000_000
        script.ros("/tf", tf(("base", name, 0.1 * (1 + number)), stamp_ns=0))
        found += [names for _, names in poses_at(script)]
    assert found == [{"a": 100.0, "still": 9000.0}, {"b": 200.0, "still": 9000.0}, {"a": 300.0, "still": 9000.0}]


@pytest.mark.parametrize(
    ("at_ms", "metres"),
    [
        (100, 0.1),  # the sample of its moment
        (110, 0.11),  # between two
        (240, 0.2),  # held after the last one
        (400, None),  # too long after it
        (90, None),  # before the first one
    ],
)
def test_the_frame_that_a_peer_asked_for_is_that_of_the_stamp(at_ms: int, metres: float | None) -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("probe",), base="base", device="Scene", type="TDATA"),)))
    script.up(1)
    for number in range(11):
        stamp_ns = T0_NS + (100 + 10 * number) * 10**6
        script.ros("/tf", tf(("base", "camera", (10 + number) / 100), stamp_ns=stamp_ns))
    script.ros("/tf", tf(("base", "probe", 0.0), stamp_ns=T0_NS))
    script.igtl(Message("STT_TDATA", "Scene", StartTracking(0, "camera")))
    lines = script.ros("/tf", tf(("base", "probe", 0.5), stamp_ns=T0_NS + at_ms * 10**6))
    if metres is None:
        assert lines == ["note unknown_frame"] and "at its stamp" in script.notes[-1].text
        return
    (message,) = script.sent()
    assert message.content.describe()["elements"][0]["matrix"][0][3] == pytest.approx(500 - 1000 * metres)

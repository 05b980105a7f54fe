"""Tracking data that peers requested, composed of single poses that come at different times."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from igtl_gateway.base.stamp import NS_PER_MS, ticks_to_ns
from igtl_gateway.config.configuration import Config, TfOutRow
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from tests.script import T0_NS, Script

UNIT = (0.0, 0.0, 0.0, 1.0)


def pose(at_ms: int, speed: float = 0.1) -> TransformStamped:
    """A tool at a moment, ms after the start: 100 mm/s along x."""
    return TransformStamped(Header(T0_NS + at_ms * NS_PER_MS, "base"), "tool", (at_ms * speed / 1000, 0.0, 0.0), UNIT)


def tracked(script: Script, kind: str = "TDATA") -> list[tuple[int, dict[str, float]]]:
    """Of the last messages of tracking data: stamp in ms, and the position of each tool, mm."""
    return [
        (
            round((ticks_to_ns(message.ticks) - T0_NS) / NS_PER_MS),
            {
                one["name"]: one["matrix"][0][3] if kind == "TDATA" else one["position"][0]
                for one in message.content.describe()["elements"]
            },
        )
        for message in script.sent()
        if message.type == kind
    ]


def started(config: Config | None = None, interval_ms: int = 0, kind: str = "TDATA") -> Script:
    script = Script(config or Config())
    script.up(1)
    script.igtl(Message(f"STT_{kind}", "", StartTracking(interval_ms)))
    return script


@given(
    kind=st.sampled_from(["TDATA", "QTDATA"]),
    late_ms=st.integers(0, 400),
    every=st.integers(1, 5),
    interval_ms=st.sampled_from([0, 50]),
)
@settings(max_examples=30, deadline=None)
def test_a_pose_is_that_of_the_stamp(kind: str, late_ms: int, every: int, interval_ms: int) -> None:
    """The needle comes late with right stamps, the probe at once; both move 100 mm/s."""
    script = started(interval_ms=interval_ms, kind=kind)
    seen = {"Probe": 0, "Needle": 0}
    for number in range(60):
        at_ms = number * 20
        script.now_ns = T0_NS + at_ms * NS_PER_MS
        arrived = [("Probe", at_ms)]
        if number % every == 0:
            arrived.append(("Needle", at_ms - late_ms))
        for device, moment in arrived:
            script.ros(f"/igtl/out/{device}", pose(moment + 1000))
            for stamp_ms, tools in tracked(script, kind):
                for name, x in tools.items():
                    seen[name] += 1
                    assert x == pytest.approx(stamp_ms / 10, abs=0.5)
    most = 60 if interval_ms == 0 else 20
    assert seen["Probe"] >= most
    assert seen["Needle"] >= most // every - 1


def test_with_an_interval_the_moments_follow_one_another() -> None:
    script = started(interval_ms=50)
    seen = []
    for at_ms in range(0, 400, 20):
        for device, moment in (("Probe", at_ms), ("Needle", at_ms - 7)):
            script.now_ns = T0_NS + at_ms * NS_PER_MS
            script.ros(f"/igtl/out/{device}", pose(moment))
            seen += tracked(script)
    assert seen[:3] == [(0, {"Probe": 0.0}), (33, {"Needle": pytest.approx(3.3)}), (60, {"Probe": 6.0})]
    assert {name for _, tools in seen for name in tools} == {"Probe", "Needle"}
    assert len(seen) <= 2 * 400 // 50


def test_poses_of_one_moment_are_together_and_what_does_not_move_is_in_each() -> None:
    rows = (TfOutRow(frames=("still",), base="base"),)
    script = started(Config(tf_out=rows))
    place = FrameTransform(Header(0, "base"), "still", (4.0, 0.0, 0.0, *UNIT))
    script.ros("/tf_static", TFMessage((place,)))
    script.ros("/igtl/out/Probe", pose(1000))
    assert tracked(script) == [(1000, {"Probe": 100.0, "stillTobase": 4000.0})]
    script.ros("/igtl/out/Needle", pose(1004))
    assert tracked(script) == [(1004, {"Probe": 100.0, "Needle": pytest.approx(100.4), "stillTobase": 4000.0})]
    script.ros("/igtl/out/Needle", pose(1300))
    assert tracked(script) == [(1300, {"Needle": 130.0, "stillTobase": 4000.0})]


def test_a_query_is_answered_with_each_moment_the_newest_first() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/Probe", pose(1000))
    script.ros("/igtl/out/Needle", pose(700))
    script.igtl(Message("GET_TDATA", "", EmptyQuery()))
    assert tracked(script) == [(1000, {"Probe": 100.0}), (700, {"Needle": 70.0})]


def test_recordings_without_rules_of_names_have_all_poses_in_one_message() -> None:
    script = started(Config(naming=0))
    script.ros("/igtl/out/Probe", pose(1000))
    script.ros("/igtl/out/Needle", pose(700))
    assert tracked(script) == [(1000, {"Probe": 100.0, "Needle": 70.0})]
    script.igtl(Message("GET_TDATA", "", EmptyQuery()))
    assert tracked(script) == [(1000, {"Probe": 100.0, "Needle": 70.0})]

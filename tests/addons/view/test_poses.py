"""Tools as axes with a trail, and the transform tree."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.canvas import Options
from igtl_gateway.convert.common_msgs import FrameTransform, PoseArray, PoseStamped, TFMessage
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.convert.rosmsg import Header, TransformStamped

from .conftest import Draw

HEADER = Header(0, "base")
PLACE, TURN = (0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8)
POSE = (*PLACE, *TURN)


def moving(count: int) -> list[TransformStamped]:
    return [TransformStamped(HEADER, "tool", (k / 1000, 0.0, 0.0), TURN) for k in range(count)]


def edge(child: str, parent: str = "base") -> FrameTransform:
    return FrameTransform(Header(0, parent), child, POSE)


def test_a_transform_is_a_tool_and_a_frame_of_the_tree(draw: Draw) -> None:
    drawn = draw(TransformStamped(HEADER, "tool", PLACE, TURN))
    for path in ("topic", "frames/tool"):
        row = drawn.one(path)
        np.testing.assert_allclose(row["Transform3D:translation"], [PLACE], atol=1e-7)
        np.testing.assert_allclose(row["Transform3D:quaternion"], [TURN], atol=1e-7)
        assert row["Transform3D:parent_frame"] == ["base"]
    assert drawn.one("frames/tool")["Transform3D:child_frame"] == ["tool"]
    assert drawn.one("frames/tool")["TransformAxes3D:show_frame"] == [True]
    assert drawn.static("topic") == drawn.static("frames/tool") == {}  # what is static would hide every row
    assert drawn.view.seen.parents == {"tool": "base"}


def test_poses_by_the_thousand_are_all_there(draw: Draw) -> None:
    drawn = draw(*moving(5000))
    assert drawn.count("topic") == 5000
    last = drawn.rows("topic")[-1]
    np.testing.assert_allclose(last["Transform3D:translation"], [(4.999, 0, 0)], atol=1e-6)


def test_tools_whose_names_differ_in_signs_have_their_own_paths(draw: Draw) -> None:
    tools = [
        TrackedTool(name, 1, (0.1 * n, 0.0, 0.0, *TURN))
        for n, name in enumerate(("Tool A", "Tool_A", "Tool-A", "Tool/A"))
    ]
    drawn = draw(TrackingData(HEADER, tuple(tools)), TrackingData(HEADER, tuple(tools[::-1])))
    for number, path in enumerate(("Tool_A", "Tool_A_2", "Tool-A", "Tool_A_3")):
        for row in drawn.rows(f"topic/{path}"):
            np.testing.assert_allclose(row["Transform3D:translation"], [(0.1 * number, 0, 0)], atol=1e-7)


def test_a_trail_is_where_the_tool_was_in_the_last_seconds(draw: Draw) -> None:
    drawn = draw(*moving(1000))
    trail = drawn.rows("topic/trail")
    assert 90 <= len(trail) <= 100  # ten times a second
    (strip,) = trail[-1]["LineStrips3D:strips"]
    places = [point[0] for point in strip]
    assert places == sorted(places)
    assert places[-1] > 0.98
    assert places[0] == pytest.approx(places[-1] - 0.5, abs=0.01)  # five seconds of it
    assert trail[-1]["CoordinateFrame:frame"] == ["base"]


def test_no_trails_where_none_are_wanted(draw: Draw) -> None:
    assert draw(*moving(100), options=Options(trails=False)).count("topic/trail") == 0


def test_a_frame_that_two_topics_tell_is_told_once(draw: Draw) -> None:
    drawn = draw(("/tf", TFMessage((edge("tool"),))), ("/tool", TransformStamped(HEADER, "tool", PLACE, TURN)))
    assert drawn.count("frames/tool") == 1
    assert (drawn.count("tf"), drawn.count("tool")) == (1, 1)


def test_the_tree_of_tf_and_static_frames(draw: Draw) -> None:
    drawn = draw(
        ("/tf_static", TFMessage((edge("camera", "/flange"),))),
        ("/tf", TFMessage((edge("flange"), edge("gripper", "flange")))),
    )
    assert drawn.view.seen.parents == {"camera": "flange", "flange": "base", "gripper": "flange"}
    assert drawn.count("frames/camera") == 0
    assert drawn.static("frames/camera")["Transform3D:parent_frame"] == ["flange"]
    assert drawn.one("frames/flange")["Transform3D:parent_frame"] == ["base"]
    assert drawn.view.seen.root_of("camera") == "base"


def test_tools_by_name_and_by_number(draw: Draw) -> None:
    tools = (TrackedTool("Probe #1", 2, POSE), TrackedTool("Stylus", 3, POSE))
    drawn = draw(
        ("/tracking", TrackingData(HEADER, tools)),
        ("/poses", PoseArray(HEADER, np.array([POSE, POSE]))),
        ("/pose", PoseStamped(HEADER, POSE)),
    )
    for path in ("tracking/Probe__1", "tracking/Stylus", "poses/1", "poses/2", "pose"):
        np.testing.assert_allclose(drawn.one(path)["Transform3D:translation"], [PLACE], atol=1e-7)
    assert (drawn.count("tracking"), drawn.count("poses")) == (1, 1)


@pytest.mark.parametrize("pose", [(math.nan, *POSE[1:]), (*PLACE, 0.0, 0.0, 0.0, 0.0)], ids=["nan", "no turn"])
def test_what_is_no_pose_is_said_once_and_counts(pose: tuple[float, ...], draw: Draw) -> None:
    drawn = draw(*[PoseStamped(HEADER, pose)] * 3)  # type: ignore[arg-type]
    assert drawn.count("topic") == 3
    assert all("Transform3D:translation" not in row for row in drawn.rows("topic"))
    assert sum("expected a pose" in line for line in drawn.log()) == 1

"""Plans, clouds and poses in each message type that can contain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.addons.review.messages import DrawnPlan, cloud_of, plan_of, poses_of
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.common_msgs import FrameTransform, PoseStamped, TFMessage
from igtl_gateway.convert.igtl_msgs import LabeledPoint, PointList, PolyData, Trajectory, TrajectoryList
from igtl_gateway.convert.rosmsg import Header, Marker, PointCloud2, PointField, RosMessage
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY
from tests.addons.review.sessions import cloud_message, entry, plan_message, pose_message, xyz
from tests.tables import table

_FIRST = np.array([[0.0, -0.0035, 0.25], [0.003, -0.0035, 0.25], [0.006, -0.0035, 0.25]])
_LAST = _FIRST + np.array([0, 0.007, 0])
_BOTH = np.concatenate([_FIRST, _LAST])
_HEADER = Header(5, "camera")
_WHITE = (255, 255, 255, 255)


def _plan(message: RosMessage) -> DrawnPlan | None:
    return plan_of(entry("/plan", message, 7))


def _labeled(name: str, position: np.ndarray, group: str = "") -> LabeledPoint:
    return LabeledPoint(name, group, _WHITE, xyz(position), 0.0, "")


def _trajectory(name: str, number: int, kind: int = ENTRY_AND_TARGET) -> Trajectory:
    return Trajectory(name, "", kind, _WHITE, xyz(_FIRST[number]), xyz(_LAST[number]), 0.0, "")


_LISTED = [("entry", _FIRST), ("exit", _LAST)]
_MESSAGES: dict[str, RosMessage] = {
    "lines": plan_message(_FIRST, _LAST, 5),
    "cloud": cloud_message(_BOTH[None], 5),
    "trajectories": TrajectoryList(
        _HEADER, (*(_trajectory(f"s{i}", i) for i in range(3)), _trajectory("mark", 0, ENTRY_ONLY))
    ),
    "polydata with lines": PolyData(
        _HEADER, np.stack([_FIRST, _LAST], 1).reshape(-1, 3), lines=np.array([2, 0, 1, 2, 2, 3, 2, 4, 5], np.uint32)
    ),
    "polydata with bent lines": PolyData(
        _HEADER,
        np.concatenate([_BOTH, np.zeros((1, 3))]),
        lines=np.array([3, 0, 6, 3, 3, 1, 6, 4, 2, 2, 5], np.uint32),
    ),
    "polydata of points": PolyData(_HEADER, _BOTH),
    "points by name": PointList(
        _HEADER, tuple(_labeled(f"{kind} s{i}", at[i]) for i in range(3) for kind, at in _LISTED)
    ),
    "points by group": PointList(
        _HEADER, tuple(_labeled(f"s{i}", at[i], kind.upper()) for kind, at in reversed(_LISTED) for i in range(3))
    ),
    "points in halves": PointList(_HEADER, tuple(_labeled(f"s{i % 3}", at) for i, at in enumerate(_BOTH))),
}


@table("name", _MESSAGES)
def test_a_plan_is_read_from(name: str) -> None:
    drawn = _plan(_MESSAGES[name])
    assert drawn is not None
    np.testing.assert_allclose(drawn.entry, _FIRST, atol=1e-7)
    np.testing.assert_allclose(drawn.exit, _LAST, atol=1e-7)
    assert (drawn.topic, drawn.frame_id, drawn.stamp_ns, drawn.source_ns) == ("/plan", "camera", 7, 5)
    assert drawn.labels == (("s0", "s1", "s2") if name.startswith(("points", "traj")) else ())
    assert drawn.lines is (not name.startswith(("points", "cloud", "polydata of")))


def test_the_pose_of_a_marker_counts() -> None:
    half = float(np.sqrt(0.5))
    message = replace(plan_message(_FIRST, _LAST, 5), position=(0.0, 0.0, 1.0), orientation=(0.0, 0.0, half, half))
    drawn = _plan(message)
    assert drawn is not None
    np.testing.assert_allclose(drawn.entry, np.stack([-_FIRST[:, 1], _FIRST[:, 0], _FIRST[:, 2] + 1], 1), atol=1e-12)


_LINES = plan_message(_FIRST, _LAST, 5)


@table(
    "message",
    [
        replace(_LINES, type=Marker.LINE_STRIP),
        replace(_LINES, action=2, points=np.empty((0, 3))),
        replace(_LINES, points=_LINES.points[:3]),
        replace(_LINES, points=np.full((2, 3), np.nan)),
        cloud_message(_BOTH[None, :5], 5),
        cloud_message(np.full((30, 30, 3), 0.25), 5),
        PolyData(_HEADER, _BOTH, polygons=np.array([3, 0, 1, 2], np.uint32)),
        PolyData(_HEADER, _BOTH, lines=np.array([2, 0, 99], np.uint32)),
        PolyData(_HEADER, _BOTH, lines=np.array([7, 0, 1], np.uint32)),
        PointList(_HEADER, tuple(_labeled("p", at) for at in _BOTH[:3])),
        TrajectoryList(_HEADER, (_trajectory("mark", 0, ENTRY_ONLY),)),
        pose_message("a", "b", (0, 0, 0), 5),
    ],
)
def test_a_message_without_pairs_is_not_a_plan(message: RosMessage) -> None:
    assert _plan(message) is None


def test_a_plan_is_the_same_up_to_rounding_and_a_correction_moves_the_smaller_part() -> None:
    drawn = _plan(_LINES)
    assert drawn is not None
    assert drawn.equals(replace(drawn, entry=drawn.entry + 1e-6))
    moved = drawn.exit.copy()
    moved[1, 2] += 0.002
    corrected = replace(drawn, exit=moved)
    assert not corrected.equals(drawn)
    assert corrected.corrects(drawn)
    assert not replace(drawn, entry=drawn.entry + 0.01, exit=moved).corrects(drawn)
    assert not replace(drawn, entry=drawn.entry[:2], exit=drawn.exit[:2]).corrects(drawn)


def test_a_cloud_of_doubles_with_gaps_between_rows_and_fields_is_read() -> None:
    points = np.random.default_rng(1).random((4, 5, 3))
    points[1, 2, 0] = np.inf
    rows = np.zeros((4, 6 * 32), np.uint8)
    packed = np.zeros((4, 5), np.dtype({"names": "zyx", "formats": [">f8"] * 3, "offsets": [0, 8, 20], "itemsize": 32}))
    for axis, name in enumerate("xyz"):
        packed[name] = points[..., axis]
    rows[:, : 5 * 32] = packed.view(np.uint8).reshape(4, -1)
    fields = tuple(PointField(name, offset, 8) for name, offset in zip("zyx", (0, 8, 20), strict=True))
    message = PointCloud2(_HEADER, 4, 5, fields, True, 32, 6 * 32, rows.tobytes(), False)
    cloud = cloud_of(entry("/c", message, 9))
    assert cloud is not None
    points[1, 2] = np.nan
    np.testing.assert_array_equal(cloud.points, points.astype(np.float32))
    assert cloud_of(entry("/c", replace(message, fields=fields[:2]), 9)) is None
    with pytest.raises(ConversionError, match="expected 4 rows of 5 points"):
        cloud_of(entry("/c", replace(message, data=b"short"), 9))


def test_poses_are_read_from_each_type() -> None:
    pose = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    messages: list[tuple[RosMessage, str]] = [
        (pose_message("base", "tool", (1, 2, 3), 5), "tool"),
        (TFMessage((FrameTransform(Header(5, "base"), "tool", pose),)), "tool"),
        (PoseStamped(Header(5, "base"), pose), "/pose"),
    ]
    for message, child in messages:
        assert list(poses_of(entry("/pose", message, 9))) == [("base", child, pose, 5)]

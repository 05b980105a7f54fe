"""Plans: trajectories and landmarks keep every label and every bit; lines only where there is something to draw."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import trajectories
from igtl_gateway.convert.columns import MAX_ROWS
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import LabeledPoint, MetadataItem, PointList, Trajectory, TrajectoryList
from igtl_gateway.convert.rosmsg import Header, Marker
from igtl_gateway.convert.surfaces import GREY
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, Trajectories
from tests import strategies

ITEMS = (MetadataItem("key", 3, "value"),)
TO = ToRosContext("Plan", 5, "ct", "", metadata=ITEMS)
HEADER = Header(5, "ct")


def traj(*rows: tuple[Any, ...]) -> Trajectories:
    """Name, group, type, rgba, entry, target, diameter, owner of each."""
    return Trajectories(np.array([(*row[:3], 0, *row[3:]) for row in rows], Trajectories.DTYPE))


def points(*rows: tuple[Any, ...]) -> Points:
    """Name, group, rgba, position, diameter, owner of each."""
    return Points(np.array(list(rows), Points.DTYPE))


PLAN = traj(
    (b"left", b"DBS", ENTRY_AND_TARGET, (255, 51, 0, 102), (1, -2, 3), (4, 5, -6), 1.5, b"CT1"),
    ("für".encode(), b"", ENTRY_ONLY, (0, 0, 0, 0), (7, 8, 9), (0, 0, 0), 0, b""),
)
ROS_PLAN = (
    Trajectory("left", "DBS", 3, (255, 51, 0, 102), (0.001, -0.002, 0.003), (0.004, 0.005, -0.006), 0.0015, "CT1"),
    Trajectory("für", "", 1, (0, 0, 0, 0), (0.007, 0.008, 0.009), (0, 0, 0), 0, ""),
)
MARKS = points(
    (b"nasion", b"Fiducial", (1, 2, 3, 4), (1, -2, 3), 1.5, b"CT1"),
    (b"", b"", (255, 255, 255, 255), (1000, 0, 0), 0, b""),
)
ROS_MARKS = (
    LabeledPoint("nasion", "Fiducial", (1, 2, 3, 4), (0.001, -0.002, 0.003), 0.0015, "CT1"),
    LabeledPoint("", "", (255, 255, 255, 255), (1, 0, 0), 0, ""),
)


def received(content: Elements) -> Any:
    """As a peer reads it."""
    return type(content).unpack(memoryview(join(content.pack())))


def test_trajectories_by_hand() -> None:
    message = trajectories.trajectories_to_ros(PLAN, TO)
    assert TrajectoryList.unpack(message.pack()) == TrajectoryList(HEADER, ROS_PLAN, ITEMS)
    to = ToIgtlContext()
    outgoing = trajectories.trajectories_to_igtl(TrajectoryList(Header(7, "mr"), ROS_PLAN, ITEMS), to)
    assert (outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata) == (7, "mr", ITEMS)
    assert received(outgoing.content) == PLAN  # type: ignore[arg-type]
    assert to.warnings == []


def test_landmarks_by_hand() -> None:
    message = trajectories.points_to_point_list(MARKS, TO)
    assert PointList.unpack(message.pack()) == PointList(HEADER, ROS_MARKS, ITEMS)
    to = ToIgtlContext()
    outgoing = trajectories.point_list_to_igtl(PointList(Header(7, "mr"), ROS_MARKS, ITEMS), to)
    assert (outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata) == (7, "mr", ITEMS)
    assert received(outgoing.content) == MARKS  # type: ignore[arg-type]
    assert to.warnings == []


def test_empty_lists() -> None:
    plan, marks = traj(), points()
    assert trajectories.trajectories_to_ros(plan, TO) == TrajectoryList(HEADER, (), ITEMS)
    assert trajectories.points_to_point_list(marks, TO) == PointList(HEADER, (), ITEMS)
    assert trajectories.trajectories_to_igtl(TrajectoryList(HEADER, ()), ToIgtlContext()).content == plan
    assert trajectories.point_list_to_igtl(PointList(HEADER, ()), ToIgtlContext()).content == marks


# -- exactness ----------------------------------------------------------------------------------------------------


def texts(width: int) -> st.SearchStrategy[bytes]:
    """What arrives whole: UTF-8 that leaves room for a NUL."""
    return strategies.ros_text.map(lambda text: text.encode()[: width - 1].decode(errors="ignore").encode())


rgba = st.tuples(*[st.integers(0, 255)] * 4)
u8 = st.integers(0, 255)


def lists(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Trajectories | Points]:
    xyz = st.tuples(*[numbers] * 3)
    plan = st.tuples(texts(64), texts(32), u8, rgba, xyz, xyz, numbers, texts(20))
    marks = st.tuples(texts(64), texts(32), rgba, xyz, numbers, texts(20))
    return st.lists(plan, max_size=4).map(lambda rows: traj(*rows)) | st.lists(marks, max_size=4).map(
        lambda rows: points(*rows)
    )


lengths = st.builds(LengthUnits, st.sampled_from(["m", "cm", "mm"]), st.sampled_from(["mm", "m", "um"]))


@given(lists(strategies.finite32), lengths)
def test_igtl_to_ros_and_back_is_exact(content: Any, units: LengthUnits) -> None:
    """Every float32 comes back to its bits, in any unit: rounding to float64 is far too fine to move it."""
    to, back = ToRosContext("Plan", 5, "ct", "", units), ToIgtlContext(units)
    if isinstance(content, Trajectories):
        plan = TrajectoryList.unpack(trajectories.trajectories_to_ros(content, to).pack())
        outgoing = trajectories.trajectories_to_igtl(plan, back)
    else:
        outgoing = trajectories.point_list_to_igtl(
            PointList.unpack(trajectories.points_to_point_list(content, to).pack()), back
        )
    assert received(outgoing.content) == content  # type: ignore[arg-type]
    assert back.warnings == []


@given(lists(strategies.finite32))
def test_ros_to_igtl_and_back_is_exact(content: Any) -> None:
    """For numbers that float32 millimetres can hold; others are rounded to these."""
    if isinstance(content, Trajectories):
        plan = trajectories.trajectories_to_ros(content, TO)
        back = trajectories.trajectories_to_igtl(plan, ToIgtlContext()).content
        assert trajectories.trajectories_to_ros(back, TO) == plan  # type: ignore[arg-type]
    else:
        marks = trajectories.points_to_point_list(content, TO)
        back = trajectories.point_list_to_igtl(marks, ToIgtlContext()).content
        assert trajectories.points_to_point_list(back, TO) == marks  # type: ignore[arg-type]


@given(strategies.bodies()["TRAJ"])
def test_any_trajectories_are_converted(content: Any) -> None:
    assert len(trajectories.trajectories_to_ros(content, TO).trajectories) == len(content)
    marker = trajectories.trajectories_to_lines(content, TO)
    assert np.isfinite(marker.points).all()
    assert Marker.unpack(marker.pack()).points.shape == marker.points.shape


@given(strategies.bodies()["POINT"])
def test_any_points_are_converted(content: Any) -> None:
    message = trajectories.points_to_point_list(content, TO)
    labels = [label for point in message.points for label in (point.name, point.group, point.owner)]
    assert trajectories.is_labeled(content) == (any(labels) or not len(content))


def test_longer_lists_are_refused() -> None:
    """Each of their rows is an object: 16 MB of them would be seconds of work."""
    with pytest.raises(ConversionError, match="TRAJ: found 10001 elements"):
        trajectories.trajectories_to_ros(Trajectories(np.zeros(MAX_ROWS + 1, Trajectories.DTYPE)), TO)
    with pytest.raises(ConversionError, match=f"POINT: found {trajectories.MAX_POINTS + 1} elements"):
        trajectories.points_to_point_list(Points(np.zeros(trajectories.MAX_POINTS + 1, Points.DTYPE)), TO)


# -- what does not fit --------------------------------------------------------------------------------------------


def test_long_labels_are_cut_with_a_warning() -> None:
    mark = LabeledPoint("n" * 64, "g" * 32, (0, 0, 0, 0), (0, 0, 0), 0, "o" * 20)
    to = ToIgtlContext()
    content: Any = trajectories.point_list_to_igtl(PointList(HEADER, (mark,)), to).content
    assert content.elements[["name", "group", "owner"]].tolist() == [(b"n" * 63, b"g" * 31, b"o" * 19)]
    assert [code for code, _ in to.warnings] == ["text_cut"] * 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e36])  # 1e39 mm: none of float32
def test_numbers_that_float32_cannot_hold_are_not_sent(bad: float) -> None:
    good = (0.0, 0.0, 0.0)
    for entry, target, diameter, field in (
        ((0, bad, 0), good, 0, "entry"),
        (good, (0, 0, bad), 0, "target"),
        (good, good, bad, "diameter"),
    ):
        rows = (ROS_PLAN[0], Trajectory("", "", 3, (0, 0, 0, 0), entry, target, diameter, ""))
        with pytest.raises(ConversionError, match=f"element 1: found {field} .*expected finite"):
            trajectories.trajectories_to_igtl(TrajectoryList(HEADER, rows), ToIgtlContext())
    for position, diameter, field in (((bad, 0, 0), 0, "position"), (good, bad, "diameter")):
        marks = (ROS_MARKS[0], LabeledPoint("", "", (0, 0, 0, 0), position, diameter, ""))
        with pytest.raises(ConversionError, match=f"element 1: found {field} .*expected finite"):
            trajectories.point_list_to_igtl(PointList(HEADER, marks), ToIgtlContext())


# -- lines --------------------------------------------------------------------------------------------------------


def test_lines_lead_from_entry_to_target() -> None:
    marker = Marker.unpack(trajectories.trajectories_to_lines(PLAN, TO).pack())
    assert (marker.header, marker.ns, marker.id) == (HEADER, "Plan", 0)
    assert (marker.type, marker.action) == (Marker.LINE_LIST, 0)
    assert marker.points.tolist() == [[0.001, -0.002, 0.003], [0.004, 0.005, -0.006]]
    assert marker.colors.tolist() == [[1.0, np.float32(0.2), 0.0, np.float32(0.4)]] * 2


def test_a_line_without_colour_is_grey() -> None:
    plan = traj((b"", b"", ENTRY_AND_TARGET, (0, 0, 0, 0), (1, 1, 1), (2, 2, 2), 0, b""))
    assert trajectories.trajectories_to_lines(plan, TO).colors.tolist() == [[np.float32(value) for value in GREY]] * 2


@pytest.mark.parametrize("kind", [0, ENTRY_ONLY, TARGET_ONLY, 4])
def test_trajectories_of_one_point_are_no_lines(kind: int) -> None:
    """With nothing left to draw, what an earlier plan drew is deleted."""
    plan = traj((b"", b"", kind, (1, 1, 1, 1), (1, 1, 1), (2, 2, 2), 0, b""))
    for content in (plan, traj()):
        marker = Marker.unpack(trajectories.trajectories_to_lines(content, TO).pack())
        assert (marker.action, len(marker.points), len(marker.colors)) == (2, 0, 0)


@pytest.mark.parametrize(
    ("kind", "meaning"),
    [
        (TARGET_ONLY, "the type 2 (target only, the default of the C++ library)"),
        (ENTRY_ONLY, "the type 1 (entry only)"),
        (0, "the type 0 (undefined)"),  # the default of OpenIGTLink4J
        (128, "the type 128 (undefined)"),
    ],
)
def test_a_path_with_both_ends_that_is_not_drawn_is_said(kind: int, meaning: str) -> None:
    row = (b"path", b"", kind, (0, 0, 0, 0), (1, 2, 3), (4, 5, 6), 2, b"")
    context = replace(TO, warnings=[])
    assert trajectories.trajectories_to_lines(traj(*[row] * 2), context).action == 2
    ((code, text),) = context.warnings
    assert code == "trajectory_not_drawn"
    assert text.startswith("2 of 2 trajectories are not drawn: 'path' has ") and meaning in text and "3" in text


def test_only_a_path_with_both_ends_is_missed() -> None:
    """One point is no line, and no fault of its sender; an end without numbers is."""
    context = replace(TO, warnings=[])
    trajectories.trajectories_to_lines(PLAN, context)
    assert context.warnings == []
    nan = (b"nan", b"", ENTRY_AND_TARGET, (0, 0, 0, 0), (1, 2, 3), (math.nan, 5, 6), 2, b"")
    trajectories.trajectories_to_lines(traj(nan), context)
    assert [code for code, _ in context.warnings] == ["trajectory_not_drawn"]


def test_lines_that_lead_nowhere_are_left_out() -> None:
    good = (b"", b"", ENTRY_AND_TARGET, (1, 1, 1, 1), (1, 1, 1), (2, 2, 2), 0, b"")
    plan = traj((*good[:4], (math.nan, 0, 0), *good[5:]), good, (*good[:5], (0, 0, math.inf), *good[6:]))
    assert trajectories.trajectories_to_lines(plan, TO).points.tolist() == [[0.001] * 3, [0.002] * 3]


# -- which clouds are landmarks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("field", ["name", "group", "owner"])
def test_one_label_among_thousands_makes_landmarks(field: str) -> None:
    content = Points.of(np.zeros((10_000, 3)))
    assert not trajectories.is_labeled(content)
    content.elements[field][9_876] = b"x"
    assert trajectories.is_labeled(content)


def test_what_stands_behind_a_nul_is_no_label() -> None:
    content = Points.of(np.zeros((3, 3)))
    content.elements["name"] = b"\x00junk"
    assert not trajectories.is_labeled(content)


def test_an_empty_list_clears_the_landmarks() -> None:
    assert trajectories.is_labeled(Points.of(np.empty((0, 3))))

"""TRANSFORM and POSITION ⇄ TransformStamped: numbers by hand, all rotations, matrices that are not orthonormal."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.poses import (
    pose_to_position,
    pose_to_transform,
    position_to_igtl,
    position_to_ros,
    rotation_matrix,
    transform_to_igtl,
    transform_to_ros,
    unit_quaternion,
)
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.transform import Position, Transform
from tests.tables import table

H = math.sqrt(0.5)
Rows = list[list[float]]


def to_ros() -> ToRosContext:
    return ToRosContext("Probe", 5, "parent", "child")


def transform(rows: Rows) -> Transform:
    return Transform.from_rows([[*row, float(at)] for at, row in enumerate(rows, start=1)])


def sent(rotation: tuple[float, float, float, float]) -> Transform:
    message = TransformStamped(Header(7, "p"), "c", (0.001, 0.002, 0.003), rotation)
    out = transform_to_igtl(message, ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.child_frame_id) == (7, "p", "c")
    assert isinstance(out.content, Transform)
    return out.content


#: Rotation by 90° about an axis, and by 180°: matrix, quaternion x, y, z, w.
ROTATIONS = [
    ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], (0, 0, 0, 1)),
    ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (H, 0, 0, H)),
    ([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (0, H, 0, H)),
    ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, H, H)),
    ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], (-H, 0, 0, H)),
    ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], (1, 0, 0, 0)),
    ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], (0, 1, 0, 0)),
    ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], (0, 0, 1, 0)),
    ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], (0.5, 0.5, 0.5, 0.5)),
]


@table(("rows", "quaternion"), ROTATIONS)
def test_golden_rotations(rows: Rows, quaternion: tuple[float, float, float, float]) -> None:
    message = transform_to_ros(transform(rows), to_ros())
    assert message.rotation == pytest.approx(quaternion, abs=1e-15)
    assert message.translation == (0.001, 0.002, 0.003)
    assert (message.header, message.child_frame_id) == (Header(5, "parent"), "child")
    content = sent(quaternion)
    assert content.wire_matrix == pytest.approx(transform(rows).wire_matrix, abs=1e-15)


def test_column_vectors() -> None:
    """A quarter turn about z takes x to y: the first column is (0, 1, 0)."""
    assert sent((0, 0, H, H)).wire_matrix[:3] == pytest.approx((0, 1, 0))


@pytest.mark.parametrize("rotation", [(0, 0, 0, -1), (0, 0, -1, 0), (0.5, -0.5, 0.5, -0.5)])
def test_sign_of_the_quaternion(rotation: tuple[float, float, float, float]) -> None:
    """The last component that is not zero is positive; both signs are one rotation."""
    message = position_to_ros(Position((0, 0, 0), rotation), to_ros())
    assert message.rotation == tuple(-value for value in rotation)
    assert transform_to_ros(sent(rotation), to_ros()).rotation == pytest.approx(message.rotation)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 1e-6)


@given(quaternions)
def test_any_rotation_there_and_back(q: tuple[float, float, float, float]) -> None:
    to = to_ros()
    there = sent(q)
    back = transform_to_ros(there, to)
    assert to.warnings == []
    assert math.sqrt(sum(v * v for v in back.rotation)) == pytest.approx(1, abs=1e-15)
    assert sent(back.rotation).wire_matrix == pytest.approx(there.wire_matrix, abs=1e-14)
    dot = sum(a * b for a, b in zip(back.rotation, unit_quaternion(q), strict=True))
    assert abs(dot) == pytest.approx(1, abs=1e-12)


@given(quaternions, st.tuples(*[st.floats(0.2, 5)] * 3))
def test_scale_is_taken_off_with_a_warning(q: tuple[float, float, float, float], scale: tuple[float, ...]) -> None:
    """Scaled columns have the same nearest rotation (the polar factor)."""
    assume(max(abs(s - 1) for s in scale) > 0.01)
    rotation = rotation_matrix(unit_quaternion(q))
    scaled = [[value * s for value, s in zip(row, scale, strict=True)] for row in rotation]
    to = to_ros()
    message = transform_to_ros(transform(scaled), to)
    assert [code for code, _ in to.warnings] == ["not_a_rotation"]
    matrix = rotation_matrix(message.rotation)
    assert [v for row in matrix for v in row] == pytest.approx([v for row in rotation for v in row], abs=1e-9)


def test_a_matrix_that_is_almost_orthonormal_is_projected_without_a_warning() -> None:
    to = to_ros()
    message = transform_to_ros(transform([[1.0001, 0, 0], [0, 1, 0], [0, 0, 1]]), to)
    assert to.warnings == []
    assert message.rotation == pytest.approx((0, 0, 0, 1), abs=1e-12)


@table(
    ("rows", "warns"),
    [
        ([[1.0004, 0, 0], [0, 1, 0], [0, 0, 1]], False),  # RᵀR is off by 0.0008
        ([[1.0006, 0, 0], [0, 1, 0], [0, 0, 1]], True),  # 0.0012
        ([[1, 0, 0], [0, 0.9996, 0], [0, 0, 1]], False),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 0.9994]], True),
        ([[1, 0.0009, 0], [0, 1, 0], [0, 0, 1]], False),  # shear
        ([[1, 0, 0], [0, 1, 0.0011], [0, 0, 1]], True),
    ],
)
def test_scale_and_shear_of_a_thousandth_are_noticed(rows: Rows, warns: bool) -> None:
    to = to_ros()
    transform_to_ros(transform(rows), to)
    assert [code for code, _ in to.warnings] == ["not_a_rotation"] * warns


@pytest.mark.parametrize(
    "rows",
    [
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-2, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[1, 2, 3], [2, 4, 6], [0, 0, 1]],
        [[math.nan, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[math.inf, 0, 0], [0, 1, 0], [0, 0, 1]],
    ],
)
def test_matrices_that_are_no_pose(rows: Rows) -> None:
    with pytest.raises(ConversionError, match="expected"):
        transform_to_ros(transform(rows), to_ros())


@pytest.mark.parametrize("size", [1e-40, 1e38])
def test_sizes_at_the_ends_of_float32(size: float) -> None:
    message = transform_to_ros(transform([[size, 0, 0], [0, size, 0], [0, 0, size]]), to_ros())
    assert message.rotation == pytest.approx((0, 0, 0, 1))


@pytest.mark.parametrize(
    "quaternion",
    [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 0), (1e200, 0, 0, 0), (1e-200, 0, 0, 0)],
)
def test_quaternions_without_a_direction(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(ConversionError):
        sent(quaternion)
    with pytest.raises(ConversionError):
        position_to_ros(Position((0, 0, 0), quaternion), to_ros())


@pytest.mark.parametrize("x", [math.nan, math.inf, 1.7e308])
def test_translations_without_a_place(x: float) -> None:
    message = TransformStamped(Header(), "", (x, 0, 0), (0, 0, 0, 1))
    for convert in (transform_to_igtl, position_to_igtl):
        with pytest.raises(ConversionError, match="TransformStamped: found"):
            convert(message, ToIgtlContext())
    pose = PoseStamped(Header(), (x, 0, 0, 0, 0, 0, 1))
    for convert_pose in (pose_to_transform, pose_to_position):
        with pytest.raises(ConversionError, match="PoseStamped: found"):
            convert_pose(pose, ToIgtlContext())


def test_position_golden() -> None:
    message = position_to_ros(Position((1000, -2, 0.5), (0, 0, 0, 2)), to_ros())
    assert (message.translation, message.rotation) == ((1, -0.002, 0.0005), (0, 0, 0, 1))
    out = position_to_igtl(TransformStamped(Header(9, "p"), "c", (1, -0.002, 0.0005), (0, 0, 3, 4)), ToIgtlContext())
    assert out.content == Position((1000, -2, 0.5), (0, 0, 0.6, 0.8))
    assert (out.stamp_ns, out.frame_id, out.child_frame_id) == (9, "p", "c")


def test_configured_units() -> None:
    to = ToRosContext("d", 0, "", "", LengthUnits("cm", "mm"))
    assert position_to_ros(Position((10, 20, 30)), to).translation == (1, 2, 3)
    message = TransformStamped(Header(), "", (1, 2, 3), (0, 0, 0, 1))
    assert transform_to_igtl(message, ToIgtlContext(LengthUnits("m", "m"))).content.wire_matrix[9:] == (1, 2, 3)  # type: ignore[attr-defined]


@given(quaternions)
def test_a_pose_is_sent_as_the_transform_with_its_numbers(q: tuple[float, float, float, float]) -> None:
    pose = PoseStamped(Header(7, "p"), (0.001, 0.002, 0.003, *q))
    out = pose_to_transform(PoseStamped.unpack(pose.pack()), ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.child_frame_id) == (7, "p", "")
    assert out.content == sent(q)
    out = pose_to_position(pose, ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.child_frame_id) == (7, "p", "")
    assert out.content == position_to_igtl(TransformStamped(Header(), "", pose.pose[:3], q), ToIgtlContext()).content

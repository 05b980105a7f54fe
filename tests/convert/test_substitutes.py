"""What 3D Slicer gets in place of a type that it does not read."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.convert.profiles import BY_NAME
from igtl_gateway.convert.substitutes import FOR_SLICER, SLICER_READS, Shown, row_for
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import String
from igtl_gateway.wire.tracking import QTRACKING_DTYPE, TRACKING_DTYPE, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import TRAJECTORY_DTYPE, Trajectories
from igtl_gateway.wire.transform import Position, Transform
from tests.tables import table

SLICER = BY_NAME["slicer"]
HALF = 0.5**0.5
#: A turn by 90 degrees about z.
TURN = (0.0, 0.0, HALF, HALF)


def shown(igtl_type: str, name: str, content: object) -> list[Shown]:
    row = row_for(SLICER.instead, igtl_type)
    assert row and row.show
    return list(row.show(name, content))


@table("igtl_type", sorted({*BODIES, "MYTYPE"}))
def test_each_type_is_read_or_has_a_row(igtl_type: str) -> None:
    if igtl_type.partition("_")[0] in ("GET", "STT", "STP", "RTS"):
        assert SLICER.may_send(igtl_type) == (igtl_type in ("RTS_TDATA", "RTS_COMMAND"))
        return
    row = row_for(SLICER.instead, igtl_type)
    assert SLICER.may_send(igtl_type) == (igtl_type in SLICER_READS)
    assert row and row.why and bool(row.show) == bool(row.shown_as)


def test_no_row_is_about_a_type_that_is_read() -> None:
    named = [igtl_type for row in FOR_SLICER for igtl_type in row.types]
    assert len(named) == len(set(named)) and not SLICER_READS.intersection(named)


@pytest.mark.parametrize("igtl_type", ["POSITION", "QTRANS"])
def test_a_pose_with_a_quaternion_is_a_matrix(igtl_type: str) -> None:
    ((kind, name, content),) = shown(igtl_type, "Tool", Position((1.0, 2.0, 3.0), (0.0, 0.0, 2 * HALF, 2 * HALF)))
    assert (kind, name) == ("TRANSFORM", "Tool") and isinstance(content, Transform)
    np.testing.assert_allclose(content.rows, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)


def test_each_tool_is_a_pose_of_its_own_and_of_one_name_the_first() -> None:
    elements = np.zeros(4, QTRACKING_DTYPE)
    elements["name"] = [b"A", b"B", b"A", b""]
    elements["position"] = np.arange(12).reshape(4, 3)
    elements["quaternion"] = TURN
    found = shown("QTDATA", "Tracker", QuaternionTrackingData(elements))
    assert [(one.igtl_type, one.name) for one in found] == [("TRANSFORM", "A"), ("TRANSFORM", "B")]
    assert [one.content.rows[0][3] for one in found if isinstance(one.content, Transform)] == [0.0, 3.0]


def test_so_is_each_tool_with_a_matrix() -> None:
    elements = np.zeros(3, TRACKING_DTYPE)
    elements["name"] = [b"A", b"B", b"A"]
    elements["matrix"] = np.arange(36).reshape(3, 12)
    found = shown("TDATA", "Tracker", TrackingData(elements))
    assert [(one.igtl_type, one.name) for one in found] == [("TRANSFORM", "A"), ("TRANSFORM", "B")]
    assert [one.content.wire_matrix for one in found if isinstance(one.content, Transform)] == [
        tuple(range(12)),
        tuple(range(12, 24)),
    ]


def test_a_plan_is_lines_with_its_colours() -> None:
    elements = np.zeros(4, TRAJECTORY_DTYPE)
    elements["type"] = [3, 1, 2, 3]
    elements["entry"] = [[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]]
    elements["target"] = [[9, 0, 0], [8, 8, 8], [7, 7, 7], [np.nan, 0, 0]]
    elements["rgba"] = [[255, 0, 0, 255], [0, 0, 0, 0], [0, 255, 0, 255], [0, 0, 255, 255]]
    ((kind, name, content),) = shown("TRAJ", "Plan", Trajectories(elements))
    assert (kind, name) == ("POLYDATA", "Plan") and isinstance(content, PolyData)
    ends = [[0, 0, 0], [9, 0, 0], [1, 1, 1], [1, 1, 1], [7, 7, 7], [7, 7, 7]]
    assert content.points.tolist() == ends and content.lines.lists() == [[0, 1], [2, 3], [4, 5]]
    assert not content.vertices.count, "the connector corrupts memory at a second vertex cell"
    (colours,) = content.attributes
    np.testing.assert_allclose(colours.values[::2], np.array([(1.0, 0, 0, 1), (0.7, 0.7, 0.7, 1), (0, 1.0, 0, 1)]))
    assert PolyData.unpack(memoryview(b"".join(bytes(part) for part in content.pack()))) == content


def test_an_empty_plan_clears_the_model() -> None:
    ((_, _, content),) = shown("TRAJ", "Plan", Trajectories(np.zeros(0, TRAJECTORY_DTYPE)))
    assert isinstance(content, PolyData) and not len(content.points) and not content.attributes


def test_the_children_of_a_bind_come_alone() -> None:
    text = b"".join(bytes(part) for part in String.of("x").pack())
    found = shown("BIND", "Outer", Bind((BindChild("STRING", "A", text), BindChild("STRING", "", text))))
    assert [(one.igtl_type, one.name) for one in found] == [("STRING", "A"), ("STRING", "Outer")]
    assert found[0].content == String.of("x")

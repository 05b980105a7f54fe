"""Numbers as curves, bars and tensors."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.other_msgs import Float64
from igtl_gateway.convert.common_msgs import JointState, MultiArrayDimension, MultiArrayLayout, WrenchStamped
from igtl_gateway.convert.igtl_msgs import NdArray, Sensor
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.rosmsg import Header

from .conftest import Draw

HEADER = Header()


def test_joints_are_curves_with_their_names(draw: Draw) -> None:
    said = JointState(HEADER, ("a1", "a2"), np.array([0.1, 0.2]), np.array([1.0, 2.0]))
    drawn = draw(said, said)
    assert [row["Scalars:scalars"] for row in drawn.rows("topic")] == [[0.1, 0.2]] * 2
    assert drawn.rows("topic/velocity")[0]["Scalars:scalars"] == [1.0, 2.0]
    assert drawn.static("topic")["SeriesLines:names"] == ["a1 (rad or m)", "a2 (rad or m)"]
    assert drawn.count("topic/effort") == 0


def joints(*names: str, sign: float = 1.0, values: tuple[float, ...] | None = None) -> JointState:
    """A state in which the position of a joint is the number at the end of its name."""
    return JointState(HEADER, names, np.array([sign * int(name[-1]) for name in names] if values is None else values))


def test_curves_of_joints_go_by_name(draw: Draw) -> None:
    left, right = joints("l1", "l2", "l3"), joints("r1", "r2", "r3", sign=-1)
    some = joints("l3", "l1", "l2"), right, joints("l2"), joints("r3", "r1", sign=-1), joints("l1", "x4")
    drawn = draw(left, right, *some)
    of_left = [row["Scalars:scalars"] for row in drawn.rows("topic") if "Scalars:scalars" in row]
    assert [of_left[row] for row in (0, 1)] == [[1.0, 2.0, 3.0]] * 2
    assert np.isnan(of_left[2][0]) and of_left[2][1] == 2.0 and np.isnan(of_left[2][2])
    of_right = [row["Scalars:scalars"] for row in drawn.rows("topic/2")]
    assert of_right[:2] == [[-1.0, -2.0, -3.0]] * 2 and of_right[2][::2] == [-1.0, -3.0]
    assert drawn.static("topic")["SeriesLines:names"] == [f"l{number} (rad or m)" for number in (1, 2, 3)]
    assert drawn.static("topic/2")["SeriesLines:names"] == [f"r{number} (rad or m)" for number in (1, 2, 3)]
    assert drawn.rows("topic/3")[0]["Scalars:scalars"] == [1.0, 4.0]


def test_joints_whose_names_are_unclear_have_none(draw: Draw) -> None:
    drawn = draw(joints("a1", "a2"), joints("a1", "a1"), joints("a1", "a2", values=(5.0,)))
    assert [row.get("Scalars:scalars") for row in drawn.rows("topic")] == [[1.0, 2.0], None, None]
    assert drawn.rows("topic/unnamed")[0]["Scalars:scalars"] == [1.0, 1.0]


def test_joints_without_positions_count(draw: Draw) -> None:
    drawn = draw(JointState(HEADER, ("a1",), effort=np.array([3.0])))
    assert drawn.count("topic") == 1
    assert drawn.one("topic/effort")["Scalars:scalars"] == [3.0]


def test_a_sensor_says_its_unit(draw: Draw) -> None:
    drawn = draw(Sensor(HEADER, 0, 0, "N", np.array([1.0, 2.0, 3.0])))
    assert drawn.one("topic")["Scalars:scalars"] == [1.0, 2.0, 3.0]
    assert drawn.static("topic")["SeriesLines:names"] == ["1 (N)", "2 (N)", "3 (N)"]


def test_one_number(draw: Draw) -> None:
    assert draw(Float64(2.5)).one("topic")["Scalars:scalars"] == [2.5]


def test_a_message_that_changes_its_length_keeps_every_row(draw: Draw) -> None:
    said = [Sensor(HEADER, 0, 0, "", np.arange(float(count))) for count in (1, 3, 0, 3)]
    drawn = draw(*said)
    assert drawn.count("topic") == 4
    assert drawn.rows("topic")[0]["Scalars:scalars"] == [0.0]  # a curve has one length: the viewer warns of others
    assert [row["Scalars:scalars"] for row in drawn.rows("topic/3")] == [[0.0, 1.0, 2.0]] * 2


@pytest.mark.parametrize("code", MULTI_ARRAYS)
def test_arrays_by_their_size(code: str, draw: Draw) -> None:
    kind = MULTI_ARRAYS[code]

    def array(*sizes: int) -> object:
        layout = MultiArrayLayout(tuple(MultiArrayDimension("", size, 1) for size in sizes))
        return kind(layout, np.arange(np.prod(sizes)).astype(code))

    drawn = draw(("/few", array(3)), ("/many", array(40)), ("/table", array(2, 5)), ("/none", array(0)))
    whats = {topic: shown.what for topic, shown in drawn.view.seen.shown.items()}
    assert [whats[topic] for topic in ("/few", "/many", "/table")] == [
        EntityKind.PLOT,
        EntityKind.BARS,
        EntityKind.TENSOR,
    ]
    assert drawn.one("few")["Scalars:scalars"] == [0.0, 1.0, 2.0]
    assert "BarChart:values" in drawn.one("many")
    assert [*drawn.one("table")["Tensor:data"][0]["shape"]] == [2, 5]
    assert drawn.count("none") == 1


def test_an_array_in_either_byte_order(draw: Draw) -> None:
    sizes = np.array([3], np.uint16)
    values = np.array([1.5, 2.5, -3.0])
    for big in (True, False):
        data = values.astype(">f8" if big else "<f8").tobytes()
        assert draw(NdArray(HEADER, 11, sizes, big, data)).one("topic")["Scalars:scalars"] == [1.5, 2.5, -3.0]


def test_complex_numbers_are_shown_by_their_magnitude(draw: Draw) -> None:
    data = np.array([3 + 4j], ">c16").tobytes()
    assert draw(NdArray(HEADER, 13, np.array([1], np.uint16), True, data)).one("topic")["Scalars:scalars"] == [5.0]


def test_forces_and_torques_are_curves(draw: Draw) -> None:
    row = draw(WrenchStamped(Header(), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3))).one("topic")
    assert row["Scalars:scalars"] == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]

"""POINT: the bytes of an element, and points made of positions and colours."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.wire.point import Points
from tests.wire.contents import check_golden, check_list, element, f32, text


def test_a_list_holds_whole_elements() -> None:
    check_list(Points, 136)


def test_golden_bytes() -> None:
    described = check_golden(
        element(Points, "Target 1", "Fiducial", [1, 2, 3, 4], [1, 2, -3], 5, "CT1"),
        text("Target 1", 64) + text("Fiducial", 32) + b"\1\2\3\4" + f32(1, 2, -3, 5) + text("CT1", 20),
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {
            "name": "Target 1",
            "group": "Fiducial",
            "rgba": [1, 2, 3, 4],
            "position": [1, 2, -3],
            "diameter": 5,
            "owner": "CT1",
        }
    ]


def test_points_without_names() -> None:
    positions, colours = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.5]]), np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.uint8)
    expected = [bytes(96), b"\1\2\3\4", f32(1, 2, 3, 5), bytes(20), bytes(96), b"\5\6\7\x08", f32(-4, 5, 6.5, 5)]
    assert join(Points.of(positions, colours, 5.0).pack()) == b"".join([*expected, bytes(20)])
    each = Points.of(positions, colours, np.array([1.0, 2.0]))
    assert each.elements["diameter"].tolist() == [1.0, 2.0]


def test_points_without_colours_are_white_and_opaque() -> None:
    points = Points.of(np.zeros((2, 3)))
    assert points.elements["rgba"].tolist() == [[255] * 4] * 2
    assert points.elements["diameter"].tolist() == [0.0, 0.0]
    assert len(Points.of(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize("columns", [2, 4])
def test_positions_have_three_numbers(columns: int) -> None:
    with pytest.raises(ValueError):
        Points.of(np.zeros((2, columns)))


def test_positions_of_other_arrays() -> None:
    """Every second row, columns in the order of Fortran, float32 of the machine."""
    rows = np.arange(18.0).reshape(6, 3)
    for given in (rows[::2], np.asfortranarray(rows[::2]), rows[::2].astype(np.float32)):
        assert Points.of(given).elements["position"].tolist() == rows[::2].tolist()

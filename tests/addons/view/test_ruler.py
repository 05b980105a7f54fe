"""Rulers: round lengths in millimetres, horizontal at the lower left of what the eye sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.view.eye import HALF_HEIGHT, HALF_WIDTH, Eye
from tests.tables import table

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.ruler import round_length, ruler_of

EYES = {
    "camera": Eye((0.02, 0.05, -0.1), (0.0, 0.0, 0.26), (0.0, -1.0, 0.0)),
    "from above": Eye((0.55, -0.65, 0.52), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "far": Eye((900.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}


@table(
    ("most", "length"),
    [(1.0, 1.0), (1.9, 1.0), (2.0, 2.0), (4.99, 2.0), (5.0, 5.0), (9.9, 5.0), (72.0, 50.0), (0.3, 0.2)],
)
def test_round_lengths(most: float, length: float) -> None:
    assert round_length(most) == pytest.approx(length)


@given(st.floats(1e-3, 1e9))
def test_a_round_length_is_most_of_what_fits(most: float) -> None:
    assert 0.399 * most < round_length(most) <= most * (1 + 1e-6)


@pytest.mark.parametrize("name", EYES)
def test_a_ruler_is_horizontal_and_in_the_view(name: str) -> None:
    eye = EYES[name]
    ruler = ruler_of(eye, 0)
    assert ruler is not None
    place, target, up = (np.array(each) for each in (eye.place, eye.target, eye.up))
    ahead = (target - place) / math.dist(eye.place, eye.target)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    begin, end = np.array(ruler.begin), np.array(ruler.end)
    assert 1000.0 * (end - begin) @ right == pytest.approx(ruler.length_mm)
    assert 1000.0 * np.linalg.norm(end - begin) == pytest.approx(ruler.length_mm)
    for point in (begin, end):
        there = point - place
        assert abs(there @ right) < (there @ ahead) * math.tan(HALF_WIDTH)
        assert 0 < -(there @ np.cross(right, ahead)) < (there @ ahead) * math.tan(HALF_HEIGHT)


@pytest.mark.parametrize("distance_m", [0.0, 1e-9, 1e300])
def test_a_view_without_a_size_has_no_ruler(distance_m: float) -> None:
    assert ruler_of(Eye((distance_m, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 0) is None

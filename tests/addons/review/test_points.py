"""The errors of the planned points themselves."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.review.error import SURE_95
from igtl_gateway.addons.review.model import EndReview
from igtl_gateway.addons.review.points import Assessed, with_own_errors
from igtl_gateway.addons.review.scene import DepthScene
from tests.addons.review.sessions import dome_clouds, xyz

_SCENE = DepthScene.of(dome_clouds(4, sigma=0.0005))


def _ends(number: int, distances_mm: list[float], off_m: float = 0.0) -> list[Assessed]:
    """Return ends on readings of the second cloud, or beside them; the error of the tissue is 0.05 mm."""
    readings = _SCENE.clouds[1].points[30, 10 : 10 + number] * (1 + off_m)
    return [
        (EndReview(xyz(reading), distance_mm=off, error_mm=0.05, interval_mm=0.1), 0.5)
        for reading, off in zip(readings, np.resize(distances_mm, number), strict=True)
    ]


def test_lifted_points_have_the_error_of_a_reading() -> None:
    found = with_own_errors(_SCENE, _ends(4, [0.3]))
    assert all(end.lifted for end in found)
    assert found[0].error_mm == 0.5
    assert found[0].interval_mm == pytest.approx(SURE_95 * 0.5)


def test_a_single_reading_in_a_plan_is_a_coincidence() -> None:
    ends = [*_ends(1, [0.0]), *_ends(5, [0.0], off_m=1e-4)]
    assert [end.error_mm for end in with_own_errors(_SCENE, ends)] == [0.05] * 6
    assert not any(end.lifted for end in with_own_errors(_SCENE, ends))


@pytest.mark.parametrize(
    ("distances_mm", "scatter_mm"),
    [([0.03, -0.03], 0.0), ([0.2, -0.2], pytest.approx(1.5 * 0.292, abs=0.01)), ([3.0, -3.0], 0.5)],
)
def test_the_scatter_of_a_plan_is_at_most_that_of_readings(distances_mm: list[float], scatter_mm: float) -> None:
    found = with_own_errors(_SCENE, _ends(8, distances_mm, off_m=1e-4))
    assert [end.scatter_mm for end in found] == [scatter_mm] * 8


def test_a_short_plan_has_no_scatter() -> None:
    assert [end.scatter_mm for end in with_own_errors(_SCENE, _ends(4, [1.0, -1.0], off_m=1e-4))] == [None] * 4

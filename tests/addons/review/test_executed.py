"""The closest approaches of a tool to the planned points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.addons.review.executed import approaches, driven_depth_mm
from igtl_gateway.addons.review.frames import FramePath
from igtl_gateway.addons.review.scene import DepthScene
from igtl_gateway.addons.review.surface import fit
from tests.addons.review.sessions import dome_clouds, on_dome

_PLAN = np.array([[0.0, 0, 0.25], [0.003, 0, 0.25], [0.006, 0, 0.25]])


def _path(positions: list[list[float]]) -> FramePath:
    return FramePath(np.arange(len(positions)) * 100, np.array(positions), np.ones(len(positions) - 1, np.bool_))


def test_the_closest_approach_is_between_samples() -> None:
    near = approaches(_path([[-0.001, 0.0005, 0.25], [0.003, 0.0005, 0.25]]), _PLAN, 5.0)[0]
    assert near.distance_mm == pytest.approx(0.5)
    assert near.stamp_ns == 25
    np.testing.assert_allclose(near.position, [0, 0.0005, 0.25], atol=1e-12)
    assert near.reached


def test_a_passage_on_the_way_to_a_neighbour_does_not_count() -> None:
    """The second point is missed by 1 mm and reached; the third is 3 mm from where the tool turned back."""
    path = _path([[0, 0, 0.25], [0.003, 0.0, 0.249], [0.003, 0.0, 0.22]])
    first, second, third = approaches(path, _PLAN, 5.0)
    assert (first.reached, second.reached, third.reached) == (True, True, False)
    assert second.distance_mm == pytest.approx(
        0.9487, abs=1e-3
    )  # the way to the sample is a little closer than the sample
    assert not approaches(path, _PLAN, 0.5)[1].reached


def test_a_stationary_tool_has_one_distance() -> None:
    near = approaches(_path([[0, 0, 0.24], [0, 0, 0.24]]), _PLAN, 50.0)[0]
    assert near.distance_mm == pytest.approx(10)
    assert approaches(_path([[0, 0, 0.24]]), _PLAN, 50.0)[0].distance_mm == pytest.approx(10)


def test_the_depth_of_the_tool_below_the_tissue() -> None:
    ends = np.stack([on_dome(-3, 0), on_dome(3, 0)])
    deep = on_dome(0, 0) + np.array([0, 0, 0.002])
    path = FramePath(np.array([0, 1, 2]), np.stack([ends[0], deep, ends[1]]), np.ones(2, np.bool_))
    surface = fit(DepthScene.of(dome_clouds(6)), on_dome(0, 0), 0.005)
    assert surface is not None
    entry, leave = approaches(path, ends, 5.0)
    assert driven_depth_mm(path, entry, leave, surface) == pytest.approx(2.0, abs=0.1)
    assert driven_depth_mm(path, leave, entry, surface) is None
    cut = replace(path, joined=np.array([True, False]))
    entry, leave = approaches(cut, ends, 5.0)
    assert driven_depth_mm(cut, entry, leave, surface) is None


def test_the_tool_does_not_pass_a_point_in_a_gap() -> None:
    path = _path([[-0.001, 0.0005, 0.25], [0.003, 0.0005, 0.25]])
    near = approaches(replace(path, joined=np.array([False])), _PLAN, 5.0)[0]
    assert near.distance_mm == pytest.approx(1.118, abs=1e-3)
    assert near.stamp_ns == 0

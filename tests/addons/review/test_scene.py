"""The depth image of several clouds."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.review.scene import DepthCloud, DepthScene
from igtl_gateway.base.errors import GatewayError
from tests.addons.review.sessions import dome, dome_clouds, rays


def test_the_median_removes_objects_of_few_clouds() -> None:
    clouds = dome_clouds(5, sigma=0.0)
    clouds[2].points[20:30, 20:30] *= 0.9  # a tool
    clouds[3].points[:5] = np.nan
    scene = DepthScene.of(clouds)
    np.testing.assert_allclose(scene.depth, dome(rays()).reshape(-1), rtol=1e-12)


def test_a_hole_in_all_clouds_has_a_ray_and_no_depth() -> None:
    clouds = dome_clouds(2)
    for cloud in clouds:
        cloud.points[10:14, 10:14] = np.nan
    scene = DepthScene.of(clouds)
    assert np.isnan(scene.depth.reshape(60, 80)[10:14, 10:14]).all()
    np.testing.assert_allclose(scene.rays.reshape(60, 80, 2), rays()[..., :2], atol=1e-12)
    assert set(scene.around(rays()[12, 12, :2], 0.0015)) == {12 * 80 + 12, 11 * 80 + 12, 13 * 80 + 12, 971, 973}


def test_of_unorganised_clouds_the_last_is_used() -> None:
    lists = [DepthCloud("/c", "camera", i, i, cloud.points.reshape(1, -1, 3)) for i, cloud in enumerate(dome_clouds(3))]
    scene = DepthScene.of(lists)
    assert len(scene.clouds) == 1
    assert scene.temporal is None
    assert scene.spatial is None
    assert np.isnan(scene.noise).all()


def test_a_cloud_behind_the_camera_is_refused() -> None:
    cloud = dome_clouds(1)[0]
    with pytest.raises(GatewayError, match="expected a cloud in the optical frame"):
        DepthScene.of([DepthCloud("/c", "base", 1, 1, -cloud.points)])

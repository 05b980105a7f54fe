"""The synthetic suturing scene, whose surface, noise and planted errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.review.scene import DepthCloud, DepthScene
from igtl_gateway_lab.simulate import star_scene
from igtl_gateway_lab.simulate.star_arm import held

CLOUDS = 6
SEEDS = (2017, 1)


@pytest.fixture(scope="session")
def stars() -> dict[int, star_scene.StarScene]:
    return {seed: star_scene.StarScene(seed) for seed in SEEDS}


@pytest.fixture(scope="session")
def scenes(stars: dict[int, star_scene.StarScene]) -> dict[int, DepthScene]:
    """Seed → the clouds of the camera, with the moving arm in front of the tissue."""
    found = {}
    for seed, star in stars.items():
        path = star.tool(np.arange(CLOUDS) + np.float64(0.1), star.measured_plan, 1.8)
        poses = list(zip(map(tuple, path.position), map(tuple, path.rotation), strict=True))
        shots = [star.cloud(number, *held(*pose)).points for number, pose in enumerate(poses)]
        found[seed] = DepthScene.of(
            [DepthCloud("/cloud", "camera", i + 1, i + 1, points) for i, points in enumerate(shots)]
        )
    return found

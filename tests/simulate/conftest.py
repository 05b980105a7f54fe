"""The scene that the STAR tests measure: made once for each module."""

from __future__ import annotations

import pytest

from igtl_gateway.simulate.star_camera import CloudFrame
from igtl_gateway.simulate.star_scene import Scene
from tests.simulate.star_truth import SECONDS


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def frames(scene: Scene) -> list[CloudFrame]:
    return [scene.cloud(number, 0.1 + number) for number in range(SECONDS)]

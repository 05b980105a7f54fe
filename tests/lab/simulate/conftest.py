"""What the STAR tests measure: the scene, its clouds, and the session as it was recorded."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway_lab.simulate.star_arm import held
from igtl_gateway_lab.simulate.star_camera import CloudFrame
from igtl_gateway_lab.simulate.star_scene import StarScene
from tests.lab.simulate.star_truth import BEGIN_S, SECONDS
from tests.places import ROOT

STAR = ROOT / "fixtures" / "star.mcap"


@pytest.fixture(scope="session")
def scene() -> StarScene:
    return StarScene()


@pytest.fixture(scope="session")
def frames(scene: StarScene) -> list[CloudFrame]:
    path = scene.tool(np.arange(SECONDS) + np.float64(0.1), scene.measured_plan, BEGIN_S)
    poses = zip(map(tuple, path.position), map(tuple, path.rotation), strict=True)
    return [scene.cloud(number, *held(*pose)) for number, pose in enumerate(poses)]


@pytest.fixture(scope="session")
def star_session() -> list[Entry]:
    """What ``simulate star`` makes; that it does is tested in ``test_star``."""
    with SessionFile.open(STAR) as file:
        return list(file.entries())

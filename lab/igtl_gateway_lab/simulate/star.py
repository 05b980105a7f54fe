"""The synthetic suturing session: who plays in it.

Sensors and robot are ROS programs, the planner is one of OpenIGTLink; between them is nothing but the gateway and the
ROS graph.  ``docs/how-to/scenario-star.md`` describes the story, and ``star_scene`` has the place of each part.
**Synthetic data**: no robot, no patient, no camera.
"""

from __future__ import annotations

import math

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway_lab.simulate.actor import Actor
from igtl_gateway_lab.simulate.star_planner import SuturePlanner
from igtl_gateway_lab.simulate.star_robot import SutureRobot
from igtl_gateway_lab.simulate.star_sensors import Sensors

DURATION_S = 12.0
TITLE = "STAR-like suturing session, synthetic: coloured clouds, camera, tool, markers; a planner moves a stitch"


def actors(duration_s: float | None = None) -> tuple[Actor, ...]:
    """The actors of a session of the given number of seconds.

    Raises ConfigError if the duration is not a positive number of seconds.
    """
    seconds = DURATION_S if duration_s is None else duration_s
    if not 0 < seconds < math.inf:
        raise ConfigError(f"duration of the STAR session: found {seconds} s, expected more than 0")
    duration_ns = round(seconds * NS_PER_S)
    return Sensors(duration_ns), SutureRobot(duration_ns), SuturePlanner(duration_ns)

"""The LEGO scenario: image-guided drawing with a toy, after section 4.1 of the ROS-IGTL-Bridge paper.

A head is shown in the navigation program, a slice of it lies printed in front of a small arm.  The arm touches crosses
on the sheet; with that the program registers image and robot, and sends a line that was planned on the image; the arm
draws it.  ``docs/how-to/scenario-lego.md`` describes it; the parts are ``lego_planner`` (OpenIGTLink) and
``lego_robot`` (ROS), which know each other by ``lego_terms`` alone.
"""

from __future__ import annotations

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.actor import Actor
from igtl_gateway_lab.simulate.lego_planner import LegoPlanner
from igtl_gateway_lab.simulate.lego_robot import LegoRobot
from igtl_gateway_lab.simulate.lego_terms import CONFIG
from igtl_gateway_lab.simulate.volume import MrVolume, head_volume

__all__ = ["CONFIG", "LENGTH_S", "actors"]

LENGTH_S = 37.0  #: of the story at its own pace
#: Faster, and the pen would not stand at a cross for as long as a stop takes; slower, and it would be tedious to watch.
_PACES = (0.75, 10.0)


def actors(duration_s: float | None = None, volume: MrVolume | None = None) -> tuple[Actor, ...]:
    """Fresh actors.

    Args:
        duration_s: how long the story shall take, nearly; None: its own length.
        volume: the planning volume; ``volume.head_volume()`` unless given.

    Raises ConfigError for a duration that the arm cannot keep, and as ``head_volume``.
    """
    pace = 1.0 if duration_s is None else duration_s / LENGTH_S
    low, high = _PACES
    if not low <= pace <= high:
        raise ConfigError(
            f"duration of lego: found {duration_s:g} s, expected {low * LENGTH_S:g} … {high * LENGTH_S:g} s"
        )
    return LegoPlanner(head_volume() if volume is None else volume), LegoRobot(pace)

"""The CRTK scenario: two dVRK-like arms, and who commands them.

The surgeon's console is a ROS program.  **Synthetic data**: no robot, no patient.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from igtl_gateway.config import Config, ToIgtlRow
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.robot_msgs import StringStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.errors import ConfigError
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, ActorReport, Publishes, Received, RosSent
from igtl_gateway_lab.simulate.agenda import Agenda, Task
from igtl_gateway_lab.simulate.crtk_arm import ARMS, WORLD, Arm
from igtl_gateway_lab.simulate.crtk_robot import HOME, CrtkRobot

TITLE = "two dVRK-like arms with CRTK topics and a URDF; a console homes and moves them, synthetic"
DURATION_S = 4.0
_SERVO_NS = 50 * NS_PER_MS
_WAIT_NS = 250 * NS_PER_MS

CONFIG = Config(
    to_igtl=tuple(
        ToIgtlRow(topic=f"/*/{name}", device="", type=kind, igtl_unit="m")
        for name, kind in (("measured_cp", "TRANSFORM"), ("measured_js", "SENSOR"))
    )
)


class Console:
    """The surgeon's console: enables and homes its arms, then moves the tip of each on a small circle."""

    name = "console"
    side = ActorProtocol.ROS

    def __init__(self, arms: tuple[Arm, ...], duration_ns: int) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes = {f"/{arm.name}/state_command": Publishes(StringStamped.TYPE) for arm in arms} | {
            f"/{arm.name}/servo_cp": Publishes(PoseStamped.TYPE) for arm in arms
        }
        self._arms = arms
        self._count = max((duration_ns - 4 * _WAIT_NS) // _SERVO_NS, 0)
        self._agenda = Agenda()
        self._sent = 0

    def begin(self, now_ns: int) -> None:
        for number, word in enumerate(("enable", "home"), 1):
            self._agenda.add(now_ns + number * _WAIT_NS, self._saying(word))
        self._agenda.add(now_ns + 4 * _WAIT_NS, self._servo)

    @property
    def due_ns(self) -> int | None:
        return self._agenda.due_ns

    @property
    def done(self) -> bool:
        return self._agenda.due_ns is None

    def act(self, now_ns: int) -> Iterable[RosSent]:
        return self._agenda.act(now_ns)  # type: ignore[return-value]  # its tasks send on ROS topics only

    def receive(self, now_ns: int, received: Received) -> Iterable[RosSent]:
        return ()

    def report(self) -> ActorReport:
        return ActorReport(self._sent > 0, (f"{self._sent} poses sent",), {"sent": self._sent})

    def _saying(self, word: str) -> Task:
        return lambda now_ns: [
            RosSent(f"/{arm.name}/state_command", StringStamped(Header(now_ns), word)) for arm in self._arms
        ]

    def _servo(self, now_ns: int) -> Iterable[RosSent]:
        for arm in self._arms:
            pose = arm.tip(circle(self._sent))
            yield RosSent(f"/{arm.name}/servo_cp", PoseStamped(Header(now_ns, WORLD), pose))
        self._sent += 1
        if self._sent < self._count:
            self._agenda.add(now_ns + _SERVO_NS, self._servo)


def circle(number: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """The joints of step ``number``: from home on a circle, with a turning wrist."""
    phase = 2 * math.pi * number / 60
    away = np.array([0.1 * math.sin(phase), 0.1 * (1 - math.cos(phase)), 0.02 * math.sin(phase)])
    return HOME + np.concatenate((away, [0.8 * math.sin(phase), 0.4 * math.sin(2 * phase), 0.3 * math.sin(phase)]))


def actors(duration_s: float | None = None) -> tuple[Actor, ...]:
    """The actors of a session of the given number of seconds.  Raises ConfigError below 2 s."""
    seconds = DURATION_S if duration_s is None else duration_s
    if not 2 <= seconds < math.inf:
        raise ConfigError(f"duration of the CRTK session: found {seconds} s, expected at least 2")
    duration_ns = round(seconds * NS_PER_S)
    return CrtkRobot(duration_ns), Console(ARMS, duration_ns)

"""The CRTK scenario: two dVRK-like arms, and who commands them.

The surgeon's console, a ROS program, moves PSM2.  A planner, a program of OpenIGTLink, moves PSM1 through the guard of
the gateway: it also sends commands that the guard must refuse.  ``docs/how-to/crtk.md`` describes the bridge.
**Synthetic data**: no robot, no patient.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import PoseStamped, StringStamped
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, ActorReport, Publishes, Received, RosSent, Sent
from igtl_gateway_lab.simulate.agenda import Agenda, Task
from igtl_gateway_lab.simulate.crtk_arm import ARMS, WORLD, Arm, Pose
from igtl_gateway_lab.simulate.crtk_robot import HOME, CrtkRobot

TITLE = "two dVRK-like arms with CRTK topics and a URDF; a console and a planner move them, synthetic"
DURATION_S = 4.0
_SERVO_NS = 50 * NS_PER_MS
_WAIT_NS = 250 * NS_PER_MS

CONFIG = Config(
    profile="crtk:/PSM*",
    crtk=(ArmsRow("/PSM1", workspace=(-0.1, -0.1, -0.05, 0.1, 0.1, 0.1)),),
    allow_in=("PSM1/servo_cp", "PSM1/move_cp", "PSM1/state_command"),
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


class Planner:
    """A program of OpenIGTLink: it enables and homes PSM1, moves its tip, and sends commands that must be refused."""

    name = "planner"
    side = ActorProtocol.IGTL

    def __init__(self, arm: Arm, duration_ns: int) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self._arm = arm
        self._count = max((duration_ns - 4 * _WAIT_NS) // _SERVO_NS, 0)
        self._agenda = Agenda()
        self._sent = 0
        self._received: dict[str, int] = {}

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

    def act(self, now_ns: int) -> Iterable[Sent]:
        return self._agenda.act(now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        if isinstance(received, Message):
            self._received[received.device_name] = self._received.get(received.device_name, 0) + 1
        return ()

    def report(self) -> ActorReport:
        states = sum(count for name, count in self._received.items() if name.endswith(("_cp", "_js")))
        facts = {"sent": self._sent, "poses_and_joints": states}
        return ActorReport(self._sent > 0 and states > 0, (f"{self._sent} poses sent, {states} received",), facts)

    def _saying(self, word: str) -> Task:
        device = f"{self._arm.name}/state_command"
        return lambda now_ns: [Message("STRING", device, String.of(word), ns_to_ticks(now_ns))]

    def _servo(self, now_ns: int) -> Iterable[Sent]:
        pose = self._arm.tip(circle(self._sent))
        yield self._command("servo_cp", pose, now_ns)
        yield from self._mistake(self._sent, pose, now_ns)
        self._sent += 1
        if self._sent < self._count:
            self._agenda.add(now_ns + _SERVO_NS, self._servo)

    def _mistake(self, number: int, pose: Pose, now_ns: int) -> Iterable[Sent]:
        """Now and then a command that the guard refuses."""
        later_ns = now_ns + NS_PER_MS
        if number == 10:  # millimetres in place of metres
            x, y, z = pose[:3]
            yield self._command("servo_cp", (1000 * x, 1000 * y, 1000 * z, *pose[3:]), later_ns)
        elif number == 20:  # of the minute before
            yield self._command("servo_cp", pose, now_ns - 60 * NS_PER_S)
        elif number == 30:  # below the table
            yield self._command("move_cp", (pose[0], pose[1], -0.2, *pose[3:]), later_ns)
        elif number == 40:  # of the other arm, for which it has no permission
            yield Message("TRANSFORM", "PSM2/servo_cp", matrix_of(pose), ns_to_ticks(later_ns))

    def _command(self, name: str, pose: Pose, stamp_ns: int) -> Message:
        return Message("TRANSFORM", f"{self._arm.name}/{name}", matrix_of(pose), ns_to_ticks(stamp_ns))


def matrix_of(pose: Pose) -> Transform:
    """The pose as TRANSFORM in metres."""
    (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(pose[3:])
    return Transform((a, d, g, b, e, h, c, f, i, *pose[:3]))


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
    first, second = ARMS
    return CrtkRobot(duration_ns), Console((second,), duration_ns), Planner(first, duration_ns)

"""The robot of the CRTK scenario: two dVRK-like arms as one ROS program, with the topics of CRTK.

An arm is DISABLED at first.  ``state_command`` enables and homes it; then it follows ``servo_cp`` at once and
``move_cp`` on a smooth path, and refuses what its joints cannot reach on ``error``.  All of it goes in steps of 50 ms,
counted and not measured.  **Synthetic data**: no robot, no patient.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.convert.common_msgs import JointState, OperatingState, PoseStamped, StringStamped, TwistStamped
from igtl_gateway.convert.rosmsg import Header, RosMessage, String
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, RosReceived, RosSent
from igtl_gateway_lab.simulate.crtk_arm import ARMS, STEP, WORLD, Arm, Pose, urdf
from igtl_gateway_lab.simulate.star_arm import minimum_jerk
from igtl_gateway_lab.simulate.star_numbers import Array, rounded

TICK_NS = 50 * NS_PER_MS
_TICK_S = 0.05
DESCRIPTION = "/robot_description"
HOME = np.array([0.0, 0.0, 0.14, 0.0, 0.0, 0.0])
_HOMING_TICKS, _MOVE_TICKS = 4, 16
_FOLLOWS = 0.6  #: part of the way to the setpoint that the joints go in a tick

_STATES = {"enable": "ENABLED", "disable": "DISABLED", "pause": "PAUSED", "resume": "ENABLED"}
#: Topics of an arm → class and whether the last message is latched.
_PUBLISHED: dict[str, tuple[type[RosMessage], bool]] = {
    "measured_js": (JointState, False),
    "setpoint_js": (JointState, False),
    "measured_cp": (PoseStamped, False),
    "local/measured_cp": (PoseStamped, False),
    "setpoint_cp": (PoseStamped, False),
    "measured_cv": (TwistStamped, False),
    "jaw/measured_js": (JointState, False),
    "operating_state": (OperatingState, True),
    "status": (String, False),
    "error": (String, False),
}
_COMMANDS: dict[str, type[RosMessage]] = {
    "servo_cp": PoseStamped,
    "move_cp": PoseStamped,
    "state_command": StringStamped,
}


class _Moving:
    """One arm that moves: its joints, its setpoint, and its operating state."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.state, self.homed = "DISABLED", False
        self.joints, self.velocity = HOME.copy(), np.zeros(len(HOME))
        self.setpoint = HOME.copy()
        self.followed = 0  # number of commands
        self.refused = 0
        self._path: list[Array] = []
        self._tip = arm.tip(self.joints)
        self._words: list[RosSent] = []
        self._changed = True

    def command(self, name: str, message: RosMessage) -> None:
        """Follow a message on ``<arm>/<name>``, or refuse it on ``error``."""
        if isinstance(message, StringStamped):
            self._state_command(message.string)
        elif isinstance(message, PoseStamped):
            self._pose_command(name, message.pose)

    def _state_command(self, word: str) -> None:
        if word == "home" and self.state == "ENABLED":
            self.homed = False
            self._path = _path(self.setpoint, HOME, _HOMING_TICKS)
        elif word == "unhome":
            self.homed = False
        elif word in _STATES:
            self.state = _STATES[word]
            self._path = []
        else:
            self._say("error", f"state_command: found {word!r} in state {self.state}")
            return
        self.followed += 1
        self._changed = True

    def _pose_command(self, name: str, pose: Pose) -> None:
        if self.state != "ENABLED" or not self.homed:
            self.refused += 1
            self._say("error", f"{name}: the arm is {self.state}, homed: {self.homed}")
            return
        try:
            target = self.arm.joints_of(pose)
        except ValueError as error:
            self.refused += 1
            self._say("error", f"{name}: {error}")
            return
        self.followed += 1
        if name == "servo_cp":
            self.setpoint, self._path = target, []
        else:
            self._path, self._changed = _path(self.setpoint, target, _MOVE_TICKS), True

    def step(self, stamp_ns: int) -> Iterator[RosSent]:
        """One tick: move, and publish."""
        if self._path:
            self.setpoint = self._path.pop(0)
            self._changed |= not self._path
            if not self._path and not self.homed:
                self.homed = True
                self._say("status", f"{self.arm.name} is homed")
        before, tip_before = self.joints, self._tip
        self.joints = rounded(before + _FOLLOWS * (self.setpoint - before), STEP)
        self.velocity = rounded((self.joints - before) / _TICK_S, STEP)
        self._tip = self.arm.tip(self.joints)
        yield from self._measured(stamp_ns, tip_before)
        if self._changed:
            self._changed = False
            header = Header(stamp_ns)
            yield self._sent("operating_state", OperatingState(header, self.state, self.homed, bool(self._path)))
        words, self._words = self._words, []
        yield from words

    def _measured(self, stamp_ns: int, tip_before: Pose) -> Iterator[RosSent]:
        names, arm = self.arm.joint_names(), self.arm
        here, local = Header(stamp_ns, WORLD), Header(stamp_ns, f"{arm.name}_base")
        # a setpoint is not valid before the arm is homed: its stamp is then 0 in CRTK
        aimed_ns = stamp_ns if self.homed else 0
        effort = rounded(2.0 * (self.setpoint - self.joints), STEP)
        yield self._sent("measured_js", JointState(Header(stamp_ns), names, self.joints, self.velocity, effort))
        yield self._sent("setpoint_js", JointState(Header(aimed_ns), names, rounded(self.setpoint, STEP)))
        yield self._sent("measured_cp", PoseStamped(here, self._tip))
        yield self._sent("local/measured_cp", PoseStamped(local, arm.tip(self.joints, local=True)))
        yield self._sent("setpoint_cp", PoseStamped(Header(aimed_ns, WORLD), arm.tip(self.setpoint)))
        x, y, z = rounded((np.array(self._tip[:3]) - np.array(tip_before[:3])) / _TICK_S, STEP).tolist()
        yield self._sent("measured_cv", TwistStamped(here, (x, y, z, 0.0, 0.0, 0.0)))
        opened = rounded(np.array([0.35 + 0.5 * self.joints[3]]), STEP)
        yield self._sent("jaw/measured_js", JointState(Header(stamp_ns), (f"{arm.name}_jaw",), opened))

    def _say(self, name: str, text: str) -> None:
        self._words.append(self._sent(name, String(text)))

    def _sent(self, name: str, message: RosMessage) -> RosSent:
        return RosSent(f"/{self.arm.name}/{name}", message)


class CrtkRobot:
    """The actor; it is done after ``duration_ns``."""

    name = "dvrk"
    side = ActorProtocol.ROS

    def __init__(self, duration_ns: int) -> None:
        self.subscribes = {f"/{arm.name}/{name}": kind.TYPE for arm in ARMS for name, kind in _COMMANDS.items()}
        self.publishes = {DESCRIPTION: Publishes(String.TYPE, latched=True, recorded=True)} | {
            f"/{arm.name}/{name}": Publishes(kind.TYPE, latched)
            for arm in ARMS
            for name, (kind, latched) in _PUBLISHED.items()
        }
        self._arms = {arm.name: _Moving(arm) for arm in ARMS}
        self._ticks, self._last = 0, duration_ns // TICK_NS
        self._due_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        return None if self.done else self._due_ns

    @property
    def done(self) -> bool:
        return self._ticks > self._last

    def act(self, now_ns: int) -> Iterable[RosSent]:
        stamp_ns = now_ns if self._due_ns is None else self._due_ns
        self._due_ns = stamp_ns + TICK_NS
        if self._ticks == 0:
            yield RosSent(DESCRIPTION, String(urdf()))
        self._ticks += 1
        for arm in self._arms.values():
            yield from arm.step(stamp_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[RosSent]:
        if isinstance(received, RosReceived) and received.topic in self.subscribes:
            _, arm, name = received.topic.split("/")
            self._arms[arm].command(name, _COMMANDS[name].unpack(received.cdr))
        return ()

    def report(self) -> ActorReport:
        facts = {name: {"followed": arm.followed, "refused": arm.refused} for name, arm in self._arms.items()}
        lines = (
            f"{name}: {one['followed']} commands followed, {one['refused']} refused" for name, one in facts.items()
        )
        good = all(one["followed"] > 2 for one in facts.values())
        return ActorReport(good, tuple(lines), facts)


def _path(start: Array, end: Array, ticks: int) -> list[Array]:
    parts = minimum_jerk(np.arange(1, ticks + 1) / ticks)
    return [rounded(start + part * (end - start), STEP) for part in parts]

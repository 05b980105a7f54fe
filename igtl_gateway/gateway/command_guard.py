"""The guard in front of a robot: commands of peers to CRTK topics are checked, and a refused one is not published.

Strategy: a command passes if ``allow_in`` has its device, and if the command, the last accepted command of the device
and the last states of the arm on ROS give no reason against it.  All of it is a function
of the inputs of the session: stamps are arguments, so a verification gives the same result.  A refusal has a code,
which is the fate of the message, and its note has the value found and the value expected.

A stream with such a check is not compiled: neither the fast path nor the native passage has a command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from igtl_gateway.config import Config
from igtl_gateway.convert.arms import ArmsRow, arms_row
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.crtk import STATE_COMMANDS, CrtkName, Motion, namespaces, row_of
from igtl_gateway.convert.poses import determinant, distance_from_rotation, rotation_matrix, unit_quaternion
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.errors import ConversionError
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.session.entry import Entry
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

#: Codes of the notes about refused commands, and what they mean; also the fates of the messages.
CODES = {
    "command_not_allowed": "no allow_in has the device",
    "command_type": "the OpenIGTLink type is not that of the CRTK name",
    "command_unstamped": "the command has no stamp, so its age is not known",
    "command_old": "the stamp is older than max_age_s",
    "command_early": "the stamp is more than max_age_s in the future",
    "command_backwards": "the stamp is not after that of the last accepted command",
    "command_not_finite": "a number is NaN or infinite",
    "command_not_rigid": "the matrix is not a rotation",
    "command_frame": "the pose is in another frame",
    "command_unknown_state": "the state of the arm that a limit needs is not known",
    "command_workspace": "the pose is outside the workspace",
    "command_speed": "the tool or its rotation would be too fast",
    "command_joint_count": "the number of joints is not that of the arm",
    "command_joint_range": "a joint is outside its range",
    "command_joint_speed": "a joint would be too fast",
    "command_force": "force or torque is too large",
    "command_word": "the word is not one of state_command",
}

#: Largest deviation of RᵀR from the identity: ten times what float32 and a rounded text cause.
_NOT_RIGID = 1e-4
#: The time to which a speed limit applies: at most this, so that a pause does not allow a jump.
_LONGEST_NS = 100 * NS_PER_MS
#: From a measured state, whose stamp is not that of the last command: at least this.
_SHORTEST_NS = 20 * NS_PER_MS
#: After such a pause the measured state counts, not the last command.
_PAUSE_NS = 500 * NS_PER_MS
#: A measured state that is older than this is not known.
_STATE_NS = NS_PER_S

_CONTENT: dict[str, type[Body]] = {"TRANSFORM": Transform, "SENSOR": Sensor, "STRING": String}
_SIX = 6

Latest = Callable[[str], Entry | None]


class Refused(Exception):
    """A command is refused: ``code`` is one of ``CODES``."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(slots=True)
class _Accepted:
    """The last accepted command of a device: stamp (UTC ns), position (m) and rotation, or joints."""

    stamp_ns: int
    values: tuple[float, ...] = ()
    rotation: list[list[float]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Command:
    """A command under examination: ``base`` is its arm or sub-device, such as ``/PSM1``."""

    device: str
    name: CrtkName
    arms: ArmsRow
    base: str
    arrived_ns: int
    stamp_ns: int
    frame_id: str


class CommandGuard:
    """The checks of all CRTK commands of a session.

    Args:
        latest: returns the last message of a ROS topic, such as ``/PSM1/measured_cp``; None if there is none.
    """

    def __init__(self, config: Config, latest: Latest) -> None:
        self._config = config
        self._arms = config.all_arms
        self._latest = latest
        self._accepted: dict[str, _Accepted] = {}

    def is_command(self, device: str) -> bool:
        """Return whether a device is a command to an arm of the configuration."""
        if not self._arms:
            return False
        name = row_of(device)
        return name is not None and name.motion is not None and arms_row(self._arms, device) is not None

    def check(self, entry: Entry, content: Body, device: str, stamp_ns: int, frame_id: str, guard: Guard) -> str:
        """Check a command, and take it as the last accepted one; return the frame of its pose.

        Args:
            entry: the input.
            content: its content, or that of a child of a BIND.
            device: a device that is a command.
            stamp_ns: its own stamp, UTC ns; 0: none.
            frame_id: the frame that its metadata name; "" if none.
            guard: the guard of the session, for the time of the host's clock.

        Raises:
            Refused: with code and text.
        """
        name, arms = row_of(device), arms_row(self._arms, device)
        assert name and arms and name.motion  # it is a command
        if not self._config.allows_in(device):
            raise Refused(
                "command_not_allowed", f"{device}: found a command to a robot, expected --allow-in {device} for it"
            )
        kind = _CONTENT[name.igtl_type]
        if not isinstance(content, kind):
            raise Refused("command_type", f"{device}: found {type(content).__name__}, expected {name.igtl_type}")
        command = _Command(device, name, arms, namespaces(device)[0], entry.stamp_ns, stamp_ns, frame_id)
        accepted = _Accepted(stamp_ns or entry.stamp_ns)
        try:
            frame = self._examine(command, content, accepted, entry.stamp_ns - guard.ahead_ns)
        except Refused:
            if not guard.restoring:
                raise
            frame = frame_id
        if device in self._accepted or len(self._accepted) < self._config.max_streams:
            self._accepted[device] = accepted
        return frame

    def _examine(self, command: _Command, content: Body, accepted: _Accepted, now_ns: int) -> str:
        """Check all of a command, and set what it asks for; return its frame.  Raises Refused."""
        device, motion = command.device, command.name.motion
        if isinstance(content, Transform):
            return self._check_pose(command, content, accepted, now_ns)
        self._check_age(command, now_ns)
        if isinstance(content, Sensor):
            values = tuple(map(float, content.values))
            if not all(map(math.isfinite, values)):
                raise Refused("command_not_finite", f"{device}: found {list(values)}, expected finite numbers")
            if motion is Motion.WRENCH:
                _check_wrench(command, values)
            else:
                accepted.values = values
                self._check_joints(command, values, accepted)
        elif isinstance(content, String) and motion is Motion.STATE and content.text not in STATE_COMMANDS:
            words = ", ".join(STATE_COMMANDS)
            raise Refused("command_word", f"{device}: found {content.text[:40]!r}, expected one of {words}")
        return command.frame_id

    # -- time ---------------------------------------------------------------------------------------------------

    def _check_age(self, command: _Command, now_ns: int) -> None:
        device, most_ns = command.device, round(command.arms.max_age_s * NS_PER_S)
        if command.stamp_ns <= 0:
            if most_ns:
                raise Refused("command_unstamped", f"{device}: found no stamp, expected one (max_age_s)")
        elif most_ns:
            age_ns = now_ns - command.stamp_ns
            text = f"{device}: found a command of {age_ns / NS_PER_S:.3f} s ago, expected"
            if age_ns > most_ns:
                raise Refused("command_old", f"{text} at most {command.arms.max_age_s:g} s (max_age_s)")
            if age_ns < -most_ns:
                raise Refused("command_early", f"{text} at least -{command.arms.max_age_s:g} s (max_age_s)")
        last = self._accepted.get(device)
        if last and command.stamp_ns > 0 and command.stamp_ns <= last.stamp_ns:
            late_ms = (last.stamp_ns - command.stamp_ns) / NS_PER_MS
            raise Refused(
                "command_backwards",
                f"{device}: found a stamp {late_ms:.3f} ms before the last one, expected a later one",
            )

    def _span_s(self, since_ns: int, command: _Command, shortest_ns: int = 0) -> float:
        """Return the time that a motion since ``since_ns`` may take into account, s."""
        passed_ns = (command.stamp_ns or command.arrived_ns) - since_ns
        return min(max(passed_ns, shortest_ns), _LONGEST_NS) / NS_PER_S

    def _last(self, command: _Command) -> _Accepted | None:
        """Return the last accepted command, unless a pause followed it."""
        last = self._accepted.get(command.device)
        now_ns = command.stamp_ns or command.arrived_ns
        return last if last and now_ns - last.stamp_ns <= _PAUSE_NS else None

    # -- poses --------------------------------------------------------------------------------------------------

    def _check_pose(self, command: _Command, content: Transform, accepted: _Accepted, now_ns: int) -> str:
        """Check a pose; return its frame."""
        device, arms, m = command.device, command.arms, content.wire_matrix
        if not all(map(math.isfinite, m)):
            raise Refused("command_not_finite", f"{device}: found {list(m)}, expected finite numbers")
        rotation = [[m[row], m[row + 3], m[row + 6]] for row in range(3)]
        to_ros = LengthUnits(igtl=arms.igtl_unit).to_ros
        place = to_ros(m[9]), to_ros(m[10]), to_ros(m[11])
        accepted.values, accepted.rotation = place, rotation
        self._check_age(command, now_ns)
        off = distance_from_rotation(rotation)
        if off > _NOT_RIGID or determinant(rotation) < 0:
            found = f"a deviation of {off:.3g}" if off > _NOT_RIGID else "a reflection"
            raise Refused("command_not_rigid", f"{device}: found {found}, expected an orthonormal rotation matrix")
        measured = self._measured_pose(command)
        frame = arms.frame_id or (measured.header.frame_id if measured else "")
        if command.frame_id and frame and command.frame_id != frame:
            raise Refused("command_frame", f"{device}: found frame {command.frame_id[:80]!r}, expected {frame!r}")
        _check_workspace(device, arms.workspace, place)
        if command.name.streamed and (arms.max_speed or arms.max_turn_speed):
            self._check_speed(command, place, rotation, measured)
        return frame or command.frame_id

    def _measured_pose(self, command: _Command) -> PoseStamped | None:
        """Return the last measured pose of the arm, unless it is invalid or too old."""
        entry = self._latest(f"{command.base}/measured_cp")
        if entry is None or entry.type != PoseStamped.TYPE:
            return None
        try:
            pose = PoseStamped.unpack(entry.payload[0])
        except ConversionError:
            return None
        finite = all(map(math.isfinite, pose.pose)) and any(pose.pose[3:])
        recent = command.arrived_ns - entry.stamp_ns <= _STATE_NS
        return pose if finite and recent and pose.header.stamp_ns > 0 else None

    def _check_speed(
        self,
        command: _Command,
        place: tuple[float, float, float],
        rotation: list[list[float]],
        measured: PoseStamped | None,
    ) -> None:
        """Check the way from the last accepted command or, after a pause, from the measured pose."""
        device, arms = command.device, command.arms
        if last := self._last(command):
            before, turned, span_s = last.values, last.rotation, self._span_s(last.stamp_ns, command)
        elif measured:
            before = measured.pose[:3]
            turned = rotation_matrix(unit_quaternion(measured.pose[3:]))
            span_s = self._span_s(measured.header.stamp_ns, command, _SHORTEST_NS)
        else:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_cp of the last second, expected one for max_speed",
            )
        way = math.dist(before, place)
        if arms.max_speed and not way <= arms.max_speed * span_s:
            text = (
                f"{device}: found {way / span_s:.3g} m/s ({1000 * way:.3g} mm), expected at most {arms.max_speed:g} m/s"
            )
            raise Refused("command_speed", f"{text} (max_speed)")
        angle = _angle(turned, rotation)
        if arms.max_turn_speed and not angle <= arms.max_turn_speed * span_s + _NOT_RIGID:
            text = f"{device}: found {angle / span_s:.3g} rad/s, expected at most {arms.max_turn_speed:g} rad/s"
            raise Refused("command_speed", f"{text} (max_turn_speed)")

    # -- joints -------------------------------------------------------------------------------------------------

    def _check_joints(self, command: _Command, values: tuple[float, ...], accepted: _Accepted) -> None:
        device, arms = command.device, command.arms
        measured = self._measured_joints(command)
        if measured is None and not arms.joint_min:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_js of the last second, expected one for the joints",
            )
        count = len(arms.joint_min) if measured is None else len(measured.position)
        if len(values) != count or count == 0:
            raise Refused("command_joint_count", f"{device}: found {len(values)} joints, expected {count}")
        if arms.joint_min and len(arms.joint_min) != count:
            raise Refused(
                "command_joint_count", f"{device}: found {count} joints, expected {len(arms.joint_min)} (joint_min)"
            )
        relative = command.name.motion is Motion.JOINT_STEPS
        if relative and measured is None:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_js of the last second, expected one for a change",
            )
        now = tuple(np.asarray(measured.position, float).tolist()) if measured else ()
        goal = tuple(at + by for at, by in zip(now, values, strict=True)) if relative else values
        for number, (value, least, most) in enumerate(zip(goal, arms.joint_min, arms.joint_max, strict=False), 1):
            if not least <= value <= most:
                raise Refused(
                    "command_joint_range",
                    f"{device}: found {value:.6g} of joint {number}, expected {least:g} to {most:g}",
                )
        if command.name.streamed and arms.joint_speed:
            self._check_joint_speed(command, goal, values if relative else None, measured)
        accepted.values = goal

    def _check_joint_speed(
        self,
        command: _Command,
        goal: Sequence[float],
        steps: Sequence[float] | None,
        measured: JointState | None,
    ) -> None:
        device, speeds = command.device, command.arms.joint_speed
        last = self._last(command)
        if last:
            span_s = self._span_s(last.stamp_ns, command)
        elif measured:
            span_s = self._span_s(measured.header.stamp_ns, command, _SHORTEST_NS)
        else:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_js of the last second, expected one for joint_speed",
            )
        if steps is None:
            before = last.values if last else np.asarray(measured.position, float).tolist()  # type: ignore[union-attr]
            if len(before) != len(goal):
                raise Refused("command_joint_count", f"{device}: found {len(goal)} joints, expected {len(before)}")
            steps = [value - at for value, at in zip(goal, before, strict=True)]
        if len(speeds) not in (1, len(steps)):
            raise Refused(
                "command_joint_count", f"{device}: found {len(steps)} joints, expected {len(speeds)} (joint_speed)"
            )
        limits = speeds * len(steps) if len(speeds) == 1 else speeds
        for number, (step, most) in enumerate(zip(steps, limits, strict=True), 1):
            if not abs(step) <= most * span_s:
                raise Refused(
                    "command_joint_speed",
                    f"{device}: found {abs(step) / span_s:.3g} per second of joint {number}, expected at most {most:g}",
                )

    def _measured_joints(self, command: _Command) -> JointState | None:
        entry = self._latest(f"{command.base}/measured_js")
        if entry is None or entry.type != JointState.TYPE or command.arrived_ns - entry.stamp_ns > _STATE_NS:
            return None
        try:
            joints = JointState.unpack(entry.payload[0])
        except ConversionError:
            return None
        valid = len(joints.position) and np.isfinite(joints.position).all() and joints.header.stamp_ns > 0
        return joints if valid else None


def _check_workspace(device: str, workspace: tuple[float, ...], place: tuple[float, float, float]) -> None:
    if not workspace:
        return
    found = ", ".join(f"{value:.6g}" for value in place)
    if len(workspace) == _SIX:
        if not all(low <= at <= high for low, at, high in zip(workspace[:3], place, workspace[3:], strict=True)):
            box = f"{list(workspace[:3])} to {list(workspace[3:])}"
            raise Refused("command_workspace", f"{device}: found ({found}) m, expected within {box}")
    elif not math.dist(workspace[:3], place) <= workspace[3]:
        raise Refused(
            "command_workspace",
            f"{device}: found ({found}) m, expected within {workspace[3]:g} m of {list(workspace[:3])}",
        )


def _check_wrench(command: _Command, values: tuple[float, ...]) -> None:
    device, arms = command.device, command.arms
    if len(values) != _SIX:
        raise Refused("command_joint_count", f"{device}: found {len(values)} values, expected {_SIX}")
    for found, most, unit in (
        (math.hypot(*values[:3]), arms.max_force, "N (max_force)"),
        (math.hypot(*values[3:]), arms.max_torque, "N m (max_torque)"),
    ):
        if most and not found <= most:
            raise Refused("command_force", f"{device}: found {found:.3g}, expected at most {most:g} {unit}")


def _angle(a: list[list[float]], b: list[list[float]]) -> float:
    """Return the angle between two rotations, rad; exact for small ones too."""
    chord = math.sqrt(
        sum((x - y) ** 2 for row, other in zip(a, b, strict=True) for x, y in zip(row, other, strict=True))
    )
    return 2.0 * math.asin(min(1.0, chord / math.sqrt(8.0)))

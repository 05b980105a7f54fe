"""The guard in front of a robot: commands of peers to CRTK topics are checked, and a refused one is not published.

Strategy: a command passes if ``allow_in`` has its device, and if the command, the last published commands to the arm
and the last states of the arm on ROS give no reason against it.  All of it is a function
of the inputs of the session: times are arguments, so a verification gives the same result.  A refusal has a code,
which is the fate of the message, and its note has the value found and the value expected.  What passed is an
`Order`, which the edge writes at once or refuses: that is an input, too (``orders``).

A stream with such a check is not compiled: neither the fast path nor the native passage has a command.
``command_motion`` limits the speed.  Joints are compared by name (``joint_order``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import arms_row
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.crtk import STATE_COMMANDS, Motion, namespaces, row_of
from igtl_gateway.convert.poses import determinant, distance_from_rotation, nearest_quaternion, unit_quaternion
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.command_motion import (
    LONGEST_NS,
    SHOWN_NS,
    Motions,
    check_joint_speed,
    check_joints_behind,
    check_pose_behind,
    check_pose_speed,
    needed_ns,
)
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.joint_order import JointOrders, places
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.orders import BEGIN_AGAIN, Order, Unwritten, note_of, orders_of
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.robot_command import Refused, RobotCommand, SetPoint
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

__all__ = ["Checked", "CommandGuard", "Refused"]

#: Largest deviation of RᵀR from the identity: ten times what float32 and a rounded text cause.
_NOT_RIGID = 1e-4
#: A measured state that is older than this is not known.
_STATE_NS = NS_PER_S

_CONTENT: dict[str, type[Body]] = {"TRANSFORM": Transform, "SENSOR": Sensor, "STRING": String}
_SIX = 6
_OF_JOINTS = frozenset({Motion.JOINTS, Motion.JOINT_STEPS})
_JOINT_STATE = "measured_js"
#: Joints that a refusal names.
_MOST_NAMED = 12

Latest = Callable[[str], Entry | None]


@dataclass(frozen=True, slots=True)
class Checked:
    """A command that passed: where it puts the arm, the frame of its pose, and its joints in the order of the arm.

    Attributes:
        joints: names of the joints, if the sender has named them; (): it has not.
    """

    command: RobotCommand
    point: SetPoint
    frame_id: str
    joints: tuple[str, ...] = ()


#: Writes an order at once; returns why it did not.
Write = Callable[[Order], Unwritten | None]


class CommandGuard:
    """The checks of all CRTK commands of a session.

    Args:
        latest: returns the last message of a ROS topic, such as ``/PSM1/measured_cp``; None if there is none.

    Attributes:
        write: writes an order; None: what was not written is known from the inputs.
    """

    def __init__(self, config: Config, latest: Latest) -> None:
        self._config = config
        self._arms = config.all_arms
        self._latest = latest
        self._motions = Motions()
        self._joints = JointOrders()
        self.write: Write | None = None
        self._unwritten: dict[int, Unwritten] = {}  # orders of the message, by their number in it
        self._noted: tuple[tuple[int, ...], str] = (), ""  # links and stream of the message that a note is about
        self._orders = 0

    def see(self, entry: Entry) -> None:
        """Take notice of a message of ROS: the first that names the joints of an arm fixes their order."""
        if self._arms and self._config.allow_in:
            self._joints.see(entry)

    # -- what is written ----------------------------------------------------------------------------------------

    def recall(self, links: tuple[int, ...], note: Note) -> None:
        """Take the note about the orders of the next message that were not written."""
        self._unwritten, self._noted = orders_of(note), (links, note.stream)

    def begin_message(self, entry: Entry) -> None:
        """A message begins: its orders are numbered from 0."""
        self._orders = 0
        if self._unwritten and self._noted != (entry.links, entry.channel):
            self._unwritten = {}

    def end_message(self, entry: Entry) -> Note | None:
        """Return the note about the orders of a message that were not written; None if all were."""
        unwritten, self._unwritten = self._unwritten, {}
        return note_of(entry.channel, unwritten) if unwritten and self.write else None

    def order(self, checked: Checked, outputs: Sequence[Output], qos: Qos) -> None:
        """Have a command that passed written: ``outputs`` is what it became, of which one is for its own topic.

        Raises:
            Refused: it was not written.
        """
        command, topic = checked.command, f"/{checked.command.device}"
        number, self._orders = self._orders, self._orders + 1
        output = next((each for each in outputs if each.channel == topic), None)
        if self.write and output:
            last = self._motions.last(command.device)
            refused = self.write(
                Order(
                    command.device,
                    topic,
                    output.type,
                    bytes(output.payload[0]),
                    qos,
                    max(command.stamp_ns, 0),
                    round(command.arms.max_age_s * NS_PER_S),
                    needed_ns(command, checked.point, last),
                    "command_speed" if command.name.motion is Motion.POSE else "command_joint_speed",
                    not (self._limits_speed(command) and self._motions.goes_on(command)),
                )
            )
            if refused:
                self._unwritten[number] = refused
        if found := self._unwritten.get(number):
            raise Refused(found.code, found.text)

    def refused(self, device: str, code: str) -> None:
        """Take the refusal of a command: after some of them its stream begins again where the arm is."""
        if code in BEGIN_AGAIN:
            self._motions.begin_again(device)

    def published(self, checked: Checked) -> None:
        """Take a command that was published: it is where the arm will be."""
        self._motions.published(checked.command, checked.point)

    @staticmethod
    def _limits_speed(command: RobotCommand) -> bool:
        """Return whether a command is a set point whose way is limited."""
        arms, motion = command.arms, command.name.motion
        if motion is Motion.POSE:
            return command.name.streamed and bool(arms.max_speed or arms.max_turn_speed)
        return command.name.streamed and motion in _OF_JOINTS and bool(arms.joint_speed)

    # -- the checks ---------------------------------------------------------------------------------------------

    def is_command(self, device: str) -> bool:
        """Return whether a device is a command to an arm of the configuration."""
        if not self._arms:
            return False
        name = row_of(device)
        return name is not None and name.motion is not None and arms_row(self._arms, device) is not None

    def check(
        self,
        entry: Entry,
        content: Body,
        device: str,
        stamp_ns: int,
        frame_id: str,
        guard: Guard,
        unit: str = "",
        names: tuple[str, ...] = (),
    ) -> Checked:
        """Check a command.

        Args:
            entry: the input.
            content: its content, or that of a child of a BIND.
            device: a device that is a command.
            stamp_ns: its own stamp, UTC ns; 0: none.
            frame_id: the frame that its metadata name; "" if none.
            guard: the guard of the session, for the time of the host's clock, and for verdicts.
            unit: length unit of its sender; "": that of the arm.
            names: of its joints, in its order; () if it has none.

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
        arms = replace(arms, igtl_unit=unit or arms.igtl_unit)
        names = names if name.motion in _OF_JOINTS else ()
        command = RobotCommand(device, name, arms, namespaces(device)[0], entry.stamp_ns, stamp_ns, frame_id, names)
        point = SetPoint(entry.stamp_ns, max(stamp_ns, 0))
        published = guard.verdicts.next(device) if guard.verdicts else None
        try:
            frame = self._examine(command, content, point, entry.stamp_ns - guard.ahead_ns)
        except Refused:
            if not guard.verdicts:
                raise
            frame = frame_id
        if published and published.type == PoseStamped.TYPE:
            frame = point.frame = PoseStamped.unpack(published.payload[0]).header.frame_id
        return Checked(command, point, frame, self._joints.of(f"{command.base}/{_JOINT_STATE}") if names else ())

    def _examine(self, command: RobotCommand, content: Body, point: SetPoint, now_ns: int) -> str:
        """Check all of a command, and set what it asks for; return its frame.  Raises Refused."""
        device, motion = command.device, command.name.motion
        if isinstance(content, Transform):
            return self._check_pose(command, content, point, now_ns)
        if isinstance(content, Sensor):
            values = tuple(map(float, content.values))
            if not all(map(math.isfinite, values)):
                raise Refused("command_not_finite", f"{device}: found {list(values)}, expected finite numbers")
            point.values = values
            self._check_age(command, now_ns)
            if command.joints:
                point.values = values = self._in_order(command, values)
            if motion is Motion.WRENCH:
                _check_wrench(command, values)
            else:
                self._check_joints(command, values)
            return command.frame_id
        self._check_age(command, now_ns)
        if isinstance(content, String) and motion is Motion.STATE and content.text not in STATE_COMMANDS:
            words = ", ".join(STATE_COMMANDS)
            raise Refused("command_word", f"{device}: found {content.text[:40]!r}, expected one of {words}")
        return command.frame_id

    # -- time ---------------------------------------------------------------------------------------------------

    def _check_age(self, command: RobotCommand, now_ns: int) -> None:
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
        last = self._motions.last(device)
        if last and 0 < command.stamp_ns <= last.stamp_ns:
            late_ms = (last.stamp_ns - command.stamp_ns) / NS_PER_MS
            raise Refused(
                "command_backwards",
                f"{device}: found a stamp {late_ms:.3f} ms before the last one, expected a later one",
            )

    # -- poses --------------------------------------------------------------------------------------------------

    def _check_pose(self, command: RobotCommand, content: Transform, point: SetPoint, now_ns: int) -> str:
        """Check a pose; return its frame."""
        device, arms, m = command.device, command.arms, content.wire_matrix
        if not all(map(math.isfinite, m)):
            raise Refused("command_not_finite", f"{device}: found {list(m)}, expected finite numbers")
        matrix = [[m[row], m[row + 3], m[row + 6]] for row in range(3)]
        off = distance_from_rotation(matrix)
        rigid = off <= _NOT_RIGID and determinant(matrix) > 0
        to_ros = LengthUnits(igtl=arms.igtl_unit).to_ros
        place = point.values = to_ros(m[9]), to_ros(m[10]), to_ros(m[11])
        if rigid:
            point.rotation = nearest_quaternion(matrix, device)
        self._check_age(command, now_ns)
        if point.rotation is None:
            found = f"a deviation of {off:.3g}" if off > _NOT_RIGID else "a reflection"
            raise Refused("command_not_rigid", f"{device}: found {found}, expected an orthonormal rotation matrix")
        measured = self._measured_pose(command)
        frame = self._frame(command, measured)
        if frame is None and command.frame_id:
            raise Refused(
                "command_unknown_state",
                f"{device}: found frame {command.frame_id[:80]!r} and no {command.base}/measured_cp of the last "
                "second, expected one for the frame",
            )
        if frame is None:
            frame = self._motions.frame_of_stream(command)
        point.frame = frame
        if command.frame_id and command.frame_id != frame:
            raise Refused("command_frame", f"{device}: found frame {command.frame_id[:80]!r}, expected {frame!r}")
        _check_workspace(device, arms.workspace, place)
        if command.name.streamed and (arms.max_speed or arms.max_turn_speed):
            reaches = self._motions.reaches(command, measured, "measured_cp", frame)
            check_pose_speed(command, place, point.rotation, reaches)
            if near := self._to_follow(command, measured, "measured_cp"):
                check_pose_behind(command, place, point.rotation, near, self._behind_s(command))
        return frame or ""

    def _behind_s(self, command: RobotCommand) -> float:
        """Return how far a stream may be from its arm, s at the speed limit; 0: no limit."""
        own_s = command.arms.max_behind_s
        return (self._config.max_behind_s or 0.0) if own_s is None else own_s

    def _to_follow(self, command: RobotCommand, measured: SetPoint | None, state: str) -> SetPoint | None:
        """Return the state that a set point has to be near; None if there is no such limit.

        One that begins a stream is nearer to it already.  Raises Refused.
        """
        if not (self._behind_s(command) and self._motions.goes_on(command)):
            return None
        if measured is None:
            raise Refused(
                "command_unknown_state",
                f"{command.device}: found no {command.base}/{state} of the last second, expected one for max_behind_s",
            )
        return measured

    def _frame(self, command: RobotCommand, measured: SetPoint | None) -> str | None:
        """Return the frame of the poses of an arm; None if nothing shows it.

        An arm that names no frame has that of the configuration.  Raises Refused if it names another one.
        """
        configured, shown = command.arms.frame_id, measured.frame if measured else None
        if configured and shown and shown != configured:
            raise Refused(
                "command_frame",
                f"{command.device}: found {command.base}/measured_cp in frame {shown[:80]!r}, expected "
                f"{configured!r} (frame_id)",
            )
        return configured or shown

    def _measured_pose(self, command: RobotCommand) -> SetPoint | None:
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
        if not (finite and recent and pose.header.stamp_ns > 0):
            return None
        rotation = unit_quaternion(pose.pose[3:])
        return SetPoint(entry.stamp_ns, pose.header.stamp_ns, pose.pose[:3], rotation, pose.header.frame_id)

    # -- joints -------------------------------------------------------------------------------------------------

    def _check_joints(self, command: RobotCommand, values: Sequence[float]) -> None:
        device, arms = command.device, command.arms
        measured = self._measured_joints(command)
        if measured is None and not arms.joint_min:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_js of the last second, expected one for the joints",
            )
        count = len(arms.joint_min) if measured is None else len(measured.values)
        if len(values) != count or count == 0:
            raise Refused("command_joint_count", f"{device}: found {counted(len(values), 'joint')}, expected {count}")
        if arms.joint_min and len(arms.joint_min) != count:
            raise Refused(
                "command_joint_count",
                f"{device}: found {counted(count, 'joint')}, expected {len(arms.joint_min)} (joint_min)",
            )
        relative = command.name.motion is Motion.JOINT_STEPS
        if relative and measured is None:
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/measured_js of the last second, expected one for a change",
            )
        goal = self._goal_of_steps(command, values, measured) if relative and measured else values
        for number, (value, least, most) in enumerate(zip(goal, arms.joint_min, arms.joint_max, strict=False), 1):
            if not least <= value <= most:
                raise Refused(
                    "command_joint_range",
                    f"{device}: found {value:.6g} of joint {number}, expected {least:g} to {most:g}",
                )
        if command.name.streamed and arms.joint_speed:
            reaches = self._motions.reaches(command, measured, "measured_js")
            check_joint_speed(command, goal, values if relative else None, reaches)
            if not relative and (near := self._to_follow(command, measured, "measured_js")):
                check_joints_behind(command, goal, near, self._behind_s(command))

    def _goal_of_steps(self, command: RobotCommand, steps: Sequence[float], measured: SetPoint) -> list[float]:
        """Return where the steps of a relative command end at the farthest: the state might not show earlier steps.

        The speed limit bounds the earlier steps of a stream: those since ``SHOWN_NS`` before the state, of which the
        first may have made use of ``LONGEST_NS``.  Steps without it have no bound, so that they need a later state.
        Raises Refused.
        """
        if not self._motions.moved_since(command, measured):
            return [at + step for at, step in zip(measured.values, steps, strict=True)]
        speeds = command.arms.joint_speed if command.name.streamed else ()
        if not speeds:
            if command.arms.joint_min:
                raise Refused(
                    "command_unknown_state",
                    f"{command.device}: found no {command.base}/measured_js {SHOWN_NS // NS_PER_MS} ms after the last "
                    f"command to {command.arm}, expected one for the range",
                )
            return [at + step for at, step in zip(measured.values, steps, strict=True)]
        unseen_s = (command.arrived_ns - measured.arrived_ns + SHOWN_NS + LONGEST_NS) / NS_PER_S
        limits = speeds * len(steps) if len(speeds) == 1 else speeds
        if len(limits) != len(steps):
            limits = (max(speeds),) * len(steps)
        return [
            at + step + math.copysign(speed * unseen_s, step) if step else at
            for at, step, speed in zip(measured.values, steps, limits, strict=True)
        ]

    def _in_order(self, command: RobotCommand, values: tuple[float, ...]) -> tuple[float, ...]:
        """Return the values of a command that names its joints in the order of the arm.  Raises Refused."""
        order = self._joints.of(f"{command.base}/{_JOINT_STATE}")
        if len(command.joints) != len(values):
            found = f"{counted(len(values), 'value')} for the joints {_listed(command.joints)}"
            raise Refused("command_joint_count", f"{command.device}: found {found}, expected one for each")
        at = places(command.joints, order)
        if at is None:
            expected = f"those of {command.base}/{_JOINT_STATE}: {_listed(order) or 'none has a name'}"
            raise Refused(
                "command_unknown_state",
                f"{command.device}: found the joints {_listed(command.joints)}, expected {expected}",
            )
        return tuple(values[index] for index in at)

    def _measured_joints(self, command: RobotCommand) -> SetPoint | None:
        """Return the last measured joints of the arm in its order, unless they are invalid or too old.

        Raises Refused if they have other names than before: then it is not known which joint a number is for.
        """
        entry = self._latest(f"{command.base}/{_JOINT_STATE}")
        if entry is None or entry.type != JointState.TYPE or command.arrived_ns - entry.stamp_ns > _STATE_NS:
            return None
        try:
            joints = JointState.unpack(entry.payload[0])
        except ConversionError:
            return None
        values = np.asarray(joints.position, float)
        named = len(joints.name) in (0, len(values))
        if not (named and len(values) and np.isfinite(values).all() and joints.header.stamp_ns > 0):
            return None
        order = self._joints.of(entry.channel)
        if order and joints.name != order:
            at = places(joints.name, order)
            if at is None:
                found = f"the joints {_listed(joints.name)}" if joints.name else "no names of joints"
                raise Refused(
                    "command_unknown_state",
                    f"{command.device}: found {found} in {entry.channel}, expected {_listed(order)}, which it had at "
                    "first: one publisher of it, and the bridge started again after a change of the tool",
                )
            values = values[at]
        return SetPoint(entry.stamp_ns, joints.header.stamp_ns, values.tolist())


def _listed(names: Sequence[str]) -> str:
    """Return names of joints as they are shown in a refusal."""
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(repr(name[:40]) for name in names[:_MOST_NAMED]) + more


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


def _check_wrench(command: RobotCommand, values: tuple[float, ...]) -> None:
    device, arms = command.device, command.arms
    if len(values) != _SIX:
        raise Refused("command_joint_count", f"{device}: found {counted(len(values), 'value')}, expected {_SIX}")
    for found, most, unit in (
        (math.hypot(*values[:3]), arms.max_force, "N (max_force)"),
        (math.hypot(*values[3:]), arms.max_torque, "N m (max_torque)"),
    ):
        if most and not found <= most:
            raise Refused("command_force", f"{device}: found {found:.3g}, expected at most {most:g} {unit}")

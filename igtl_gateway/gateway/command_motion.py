"""How far a streamed command may move an arm: by the time that has passed, whatever the stamps of the sender are.

Strategy: a set point is compared with the last one that was published.  The way between them may be as long as the
arm can move in the time between them, by the clock of the gateway or by that of the sender, whichever shows less.  So
no window of time, between any two published set points, has a faster motion: there is no credit to save up in a stall,
and no tolerance that a burst adds up.  A pause counts as 0.1 s at most, and after 0.5 s the arm must be where the
command begins: ``docs/how-to/guard.md`` has the policy and its reasons.

While a stream goes on, its set point stays near the measured state, too: how near, the configuration has as a time at
the speed limit (``max_behind_s``).

The state is the last published command of each device, and after it a refusal after which the stream begins again.  So
the prologue of a part of a recording restores it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.crtk import Motion
from igtl_gateway.convert.poses import Quaternion
from igtl_gateway.gateway.robot_command import Refused, RobotCommand, SetPoint

#: The time that one command may make use of: at most this, so that a pause does not allow a jump.
LONGEST_NS = 100 * NS_PER_MS
#: A command may begin as far from the measured state as the arm moves in this time: what noise and lag need.
BEGIN_NS = 20 * NS_PER_MS
#: A measured state shows the commands that arrived this long before it: what a robot and its network take.
SHOWN_NS = 50 * NS_PER_MS
#: After this time without a command, the measured state counts, and another command may move the arm.
PAUSE_NS = 500 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Reach:
    """From where a command may go, how long it may move, and in words what was there before."""

    start: SetPoint
    span_ns: int
    origin: str


class Motions:
    """The last published command of each device, and the last one of each arm."""

    def __init__(self) -> None:
        self._of_device: dict[str, SetPoint] = {}
        self._of_arm: dict[str, tuple[str, SetPoint]] = {}
        self._beginning: set[str] = set()  # devices whose next set point has to be where the arm is

    def begin_again(self, device: str) -> None:
        """The next set point of a stream has to be where the arm is: a robot has not got what was before."""
        self._beginning.add(device)

    def goes_on(self, command: RobotCommand) -> bool:
        """Return whether a command goes on with the stream of its device, so that it is compared with its last one."""
        last = self._of_device.get(command.device)
        if last is None or command.device in self._beginning:
            return False
        return command.arrived_ns - last.arrived_ns < PAUSE_NS

    def published(self, command: RobotCommand, point: SetPoint) -> None:
        """Take a command that was published."""
        self._beginning.discard(command.device)
        self._of_device[command.device] = point
        self._of_arm[command.arm] = command.device, point

    def last(self, device: str) -> SetPoint | None:
        """Return the last published command of a device."""
        return self._of_device.get(device)

    def frame_of_stream(self, command: RobotCommand) -> str | None:
        """Return the frame of the stream that a command goes on with, "" if it has none; None for a first command."""
        last = self._of_device.get(command.device)
        if last is None or not command.name.streamed or command.arrived_ns - last.arrived_ns >= PAUSE_NS:
            return None
        return last.frame

    def moved_since(self, command: RobotCommand, measured: SetPoint) -> bool:
        """Return whether the arm has had a command that a state does not show."""
        _, point = self._of_arm.get(command.arm, ("", None))
        return point is not None and point.arrived_ns + SHOWN_NS > measured.arrived_ns

    def reaches(
        self, command: RobotCommand, measured: SetPoint | None, state: str, frame: str | None = None
    ) -> list[Reach]:
        """Return what limits the motion to a set point in ``frame``; ``state`` is the topic of ``measured``.

        Poses of two frames have no distance: a stream does not go on in another one.  Raises Refused.
        """
        device = command.device
        mover, point = self._of_arm.get(command.arm, ("", None))
        last = self._of_device.get(device)
        pause_ns = command.arrived_ns - point.arrived_ns if point else PAUSE_NS
        if pause_ns < PAUSE_NS and mover != device:
            raise Refused(
                "command_unknown_state",
                f"{device}: found {mover} {_ms(pause_ns)} ms ago, expected no other command to {command.arm} "
                f"for {_ms(PAUSE_NS)} ms",
            )
        passed_ns = _passed_ns(last, command) if last else 0
        other_frame = last is not None and None not in (last.frame, frame) and last.frame != frame
        if last and pause_ns < PAUSE_NS and device not in self._beginning:
            if other_frame:
                raise Refused(
                    "command_frame",
                    f"{device}: found frame {_frame(frame)}, expected {_frame(last.frame)}, that of the last one "
                    f"{_ms(pause_ns)} ms ago",
                )
            return [Reach(last, min(passed_ns, LONGEST_NS), "from the last one")]
        if measured is None or self.moved_since(command, measured):
            raise Refused(
                "command_unknown_state",
                f"{device}: found no {command.base}/{state} of the last second and {_ms(SHOWN_NS)} ms after the last "
                "command, expected one for the speed limit",
            )
        begin = [Reach(measured, BEGIN_NS, f"from {command.base}/{state}")]
        return [*begin, Reach(last, passed_ns, "from the last one")] if last and not other_frame else begin


def _passed_ns(last: SetPoint, command: RobotCommand) -> int:
    """Return the time since a set point: of the two clocks, the one that shows less."""
    arrived_ns = command.arrived_ns - last.arrived_ns
    if command.stamp_ns <= 0 or last.stamp_ns <= 0:
        return arrived_ns
    return min(arrived_ns, command.stamp_ns - last.stamp_ns)


def check_pose_speed(
    command: RobotCommand, place: Sequence[float], rotation: Quaternion, reaches: Sequence[Reach]
) -> None:
    """Check the way and the turn to a pose.  Raises Refused."""
    device, arms = command.device, command.arms
    for reach in reaches:
        assert reach.start.rotation is not None  # a pose is compared with poses
        way, most = math.dist(reach.start.values, place), _most(arms.max_speed, reach)
        if arms.max_speed and not way <= most:
            limit = f"at most {1000 * most:.3g} mm ({arms.max_speed:g} m/s, max_speed)"
            raise Refused("command_speed", _too_fast(device, f"{1000 * way:.3g} mm", reach, limit))
        turn, most = angle(reach.start.rotation, rotation), _most(arms.max_turn_speed, reach)
        if arms.max_turn_speed and not turn <= most:
            limit = f"at most {most:.3g} rad ({arms.max_turn_speed:g} rad/s, max_turn_speed)"
            raise Refused("command_speed", _too_fast(device, f"{turn:.3g} rad", reach, limit))


def check_joint_speed(
    command: RobotCommand, goal: Sequence[float], steps: Sequence[float] | None, reaches: Sequence[Reach]
) -> None:
    """Check the ways of all joints to ``goal``, or ``steps`` of a relative command.  Raises Refused."""
    device, speeds = command.device, command.arms.joint_speed
    limits = speeds * len(goal) if len(speeds) == 1 else speeds
    if len(limits) != len(goal):
        raise Refused(
            "command_joint_count",
            f"{device}: found {counted(len(goal), 'joint')}, expected {len(speeds)} (joint_speed)",
        )
    for reach in reaches:
        ways = steps
        if ways is None:
            before = reach.start.values
            if len(before) != len(goal):
                raise Refused(
                    "command_joint_count", f"{device}: found {counted(len(goal), 'joint')}, expected {len(before)}"
                )
            ways = [value - at for value, at in zip(goal, before, strict=True)]
        for number, (way, speed) in enumerate(zip(ways, limits, strict=True), 1):
            if not abs(way) <= _most(speed, reach):
                limit = f"at most {_most(speed, reach):.3g} ({speed:g} per second, joint_speed)"
                raise Refused(
                    "command_joint_speed", _too_fast(device, f"{abs(way):.3g} of joint {number}", reach, limit)
                )


def check_pose_behind(
    command: RobotCommand, place: Sequence[float], rotation: Quaternion, measured: SetPoint, behind_s: float
) -> None:
    """Check the distance of a pose from the measured one, while its stream goes on.  Raises Refused."""
    arms = command.arms
    assert measured.rotation is not None  # a measured pose
    way, most = math.dist(measured.values, place), arms.max_speed * behind_s
    if arms.max_speed and not way <= most:
        raise Refused("command_behind", _behind(command, "cp", f"{1000 * way:.3g}", f"{1000 * most:.3g} mm"))
    turn, most = angle(measured.rotation, rotation), arms.max_turn_speed * behind_s
    if arms.max_turn_speed and not turn <= most:
        raise Refused("command_behind", _behind(command, "cp", f"{turn:.3g}", f"{most:.3g} rad"))


def check_joints_behind(command: RobotCommand, goal: Sequence[float], measured: SetPoint, behind_s: float) -> None:
    """Check the distance of all joints from the measured ones, while a stream goes on.  Raises Refused."""
    for number, (value, at, speed) in enumerate(
        zip(goal, measured.values, _speeds(command, len(goal)), strict=True), 1
    ):
        way, most = abs(value - at), speed * behind_s
        if not way <= most:
            found = f"{way:.3g} of joint {number}"
            raise Refused("command_behind", _behind(command, "js", found, f"{most:.3g}"))


def needed_ns(command: RobotCommand, point: SetPoint, last: SetPoint | None) -> int:
    """Return the time that the way from the last set point takes at the limits, ns; 0 if nothing limits it."""
    arms, times = command.arms, [0.0]
    if last is None or not command.name.streamed:
        return 0
    if point.rotation is not None and last.rotation is not None:
        if None not in (last.frame, point.frame) and last.frame != point.frame:
            return 0  # poses of two frames have no distance
        if arms.max_speed:
            times.append(math.dist(last.values, point.values) / arms.max_speed)
        if arms.max_turn_speed:
            times.append(angle(last.rotation, point.rotation) / arms.max_turn_speed)
    elif arms.joint_speed and len(point.values) == len(last.values):
        steps = command.name.motion is Motion.JOINT_STEPS
        before = [0.0] * len(point.values) if steps else last.values
        speeds = _speeds(command, len(point.values))
        times += [abs(to - at) / speed for to, at, speed in zip(point.values, before, speeds, strict=False)]
    return math.ceil(max(times) * NS_PER_S)


def _speeds(command: RobotCommand, count: int) -> tuple[float, ...]:
    speeds = command.arms.joint_speed
    return speeds * count if len(speeds) == 1 else speeds


def angle(a: Quaternion, b: Quaternion) -> float:
    """Return the angle between two rotations, rad; exact for small ones too."""
    minus = [x - y for x, y in zip(a, b, strict=True)]
    plus = [x + y for x, y in zip(a, b, strict=True)]
    chord = math.sqrt(min(sum(x * x for x in minus), sum(x * x for x in plus)))
    return 4.0 * math.asin(min(1.0, chord / 2.0))


def _most(speed: float, reach: Reach) -> float:
    return speed * reach.span_ns / NS_PER_S


def _too_fast(device: str, found: str, reach: Reach, limit: str) -> str:
    return f"{device}: found {found} {reach.origin} in {_ms(reach.span_ns)} ms, expected {limit}"


def _behind(command: RobotCommand, state: str, found: str, most: str) -> str:
    where = f"from {command.base}/measured_{state}"
    return f"{command.device}: found {found} {where}, expected at most {most} (max_behind_s): the arm does not follow"


def _frame(name: str | None) -> str:
    return repr((name or "")[:80])


def _ms(ns: int) -> str:
    return f"{ns / NS_PER_MS:.4g}"

"""A judge of what reached robots, by the promises of docs/how-to/guard.md and crtk.md; it calls nothing of the guard.

It sees the states that the robots published, the commands that peers sent, and what the gateway published of them.
Each rule is stated for what was published only: what was refused is not its matter.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState, PoseStamped, StringStamped, WrenchStamped
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

Vector = npt.NDArray[np.float64]
#: Device of a command → its kind, and the arm that it moves: a jaw is an arm of its own, local is not.
DEVICES = {
    "PSM1/servo_cp": ("cp", "PSM1"),
    "PSM1/local/servo_cp": ("cp", "PSM1"),
    "PSM1/servo_jp": ("jp", "PSM1"),
    "PSM1/servo_jr": ("jr", "PSM1"),
    "PSM1/jaw/servo_jp": ("jp", "PSM1/jaw"),
    "PSM1/jaw/servo_jr": ("jr", "PSM1/jaw"),
    "PSM2/servo_cp": ("cp", "PSM2"),
    "PSM2/servo_jr": ("jr", "PSM2"),
    "PSM1/move_cp": ("cp", "PSM1"),
    "PSM2/move_jp": ("jp", "PSM2"),
    "PSM1/move_jr": ("jr", "PSM1"),
    "PSM2/move_jr": ("jr", "PSM2"),
    "PSM1/servo_cf": ("cf", "PSM1"),
    "PSM2/hold": ("hold", "PSM2"),
    "PSM2/state_command": ("word", "PSM2"),
}
TYPES = {"cp": "TRANSFORM", "jp": "SENSOR", "jr": "SENSOR", "cf": "SENSOR", "hold": "STRING", "word": "STRING"}
_CONTENT: dict[str, type[Body]] = {"TRANSFORM": Transform, "SENSOR": Sensor, "STRING": String}
_WORDS = {"enable", "disable", "pause", "resume", "home", "unhome"}
#: A motion may begin this far from the arm, in time at its limit; a pause allows no more than the second.
_BEGIN_S, _LONGEST_S = 0.02, 0.1
_PAUSE_NS = 500 * NS_PER_MS
#: A state shows what came this long before it.
_SHOWN_NS = 50 * NS_PER_MS
#: Rounding of the judge's own sums, relative and absolute: no allowance of the guard.
_ROUNDING, _NOTHING = 1 + 1e-9, 1e-12


@dataclass(frozen=True)
class Command:
    """What a peer sent: a message, or a child of a BIND with the stamp and the frame of the BIND."""

    device: str
    igtl_type: str
    content: Body
    stamp_ns: int = 0
    frame: str = ""


@dataclass(frozen=True)
class State:
    """A state of an arm as it arrived."""

    at_ns: int
    values: Vector
    frame: str = ""


@dataclass(frozen=True)
class Move:
    """A command that was published, at the gateway time of its message."""

    at_ns: int
    device: str
    values: Vector
    frame: str
    stamp_ns: int


class Judge:
    """Sees one session; ``broken`` then has the promises that were not kept.

    Args:
        limits: arm → its limits.
        allowed: devices that peers may send.
        max_age_s: of states; an older one is withheld, and shows nothing. 0: none is.

    Attributes:
        broken: one text for each, beginning with its rule.
        seen: how often each rule had something to judge.
    """

    def __init__(self, limits: Mapping[str, ArmsRow], allowed: Sequence[str], max_age_s: float) -> None:
        self._limits = limits
        self._allowed = frozenset(allowed)
        self._max_age_s = max_age_s
        self._states: dict[str, State] = {}
        self._moves: list[Move] = []
        self._broken: list[str] = []
        self.seen: Counter[str] = Counter()

    def state(self, topic: str, at_ns: int, host_ns: int, message: RosMessage) -> None:
        """Take a state that a robot published; ``host_ns``: the host's clock at its arrival."""
        stamp_ns = getattr(message, "header", Header()).stamp_ns
        if stamp_ns <= 0 or (self._max_age_s and host_ns - stamp_ns > self._max_age_s * NS_PER_S):
            return
        if not isinstance(message, PoseStamped | JointState):  # a type without a state of the arm
            self._states.pop(topic, None)
            return
        values = np.array(message.pose if isinstance(message, PoseStamped) else message.position, float)
        if not (len(values) and np.isfinite(values).all()):
            return
        if isinstance(message, JointState) and len(message.name) not in (0, len(values)):  # whose are they?
            self._states.pop(topic, None)
            return
        if isinstance(message, PoseStamped):
            length = np.linalg.norm(values[3:])
            if not length:
                return
            values[3:] /= length
        self._states[topic] = State(at_ns, values, message.header.frame_id)

    def published(
        self, at_ns: int, host_ns: int, sent: Sequence[Command], outputs: Sequence[tuple[str, bytes]]
    ) -> None:
        """Take what one message caused: the commands that it has, and the messages on topics of commands."""
        left = list(sent)
        for topic, data in outputs:
            device = topic.removeprefix("/")
            values, frame = _read(device, data)
            fits = (at for at, one in enumerate(left) if one.device == device and self._is_same(one, values, data))
            number = next(fits, None)
            if number is None:
                self._break("content", f"{device}: {values} was not sent")
                continue
            command, left = left[number], left[number + 1 :]
            move = Move(at_ns, device, values, frame, command.stamp_ns)
            for rule, text in self._faults(move, command, host_ns):
                self._break(rule, f"{device} at {_clock(at_ns)}: {text}")
            self._moves.append(move)

    def stands(self, device: str, joints: Vector) -> None:
        """Take where the joints of a robot stand that follows at once, and whose states are late by 50 ms at most."""
        limits = self._limits[DEVICES[device][1].partition("/")[0]]
        if limits.joint_min and len(joints) == len(limits.joint_min):
            self.seen["robot"] += 1
            over = np.maximum(limits.joint_min - joints, joints - limits.joint_max)
            if over.max() > _NOTHING:
                self._break("robot", f"{device}: stands {over.max():.6f} outside its range")

    @property
    def broken(self) -> list[str]:
        """The promises that were not kept."""
        return self._broken + [text for device in DEVICES for text in self._windows(device)]

    @property
    def moves(self) -> int:
        """How many commands were published."""
        return len(self._moves)

    def _break(self, rule: str, text: str) -> None:
        self._broken.append(f"{rule}: {text}")

    # -- one command --------------------------------------------------------------------------------------------------

    def _faults(self, move: Move, command: Command, host_ns: int) -> Iterator[tuple[str, str]]:
        """Yield rule and text of what is wrong with a published command."""
        device = move.device
        kind, arm = DEVICES[device]
        limits = self._limits[arm.partition("/")[0]]
        if device not in self._allowed:
            yield "allowed", "no allow_in has it"
        if command.igtl_type != TYPES[kind]:
            yield "type", command.igtl_type
        if not np.isfinite(move.values).all():
            yield "finite", str(move.values)
        yield from self._age(move, limits, host_ns)
        if kind == "cp":
            yield from self._pose(move, command, limits)
        elif kind in ("jp", "jr"):
            yield from self._joints(move, limits)
        elif kind == "cf":
            self.seen["force"] += 1
            if len(move.values) != 6:
                yield "count", f"{len(move.values)} values of a wrench"
            for length, most in (
                (np.linalg.norm(move.values[:3]), limits.max_force),
                (np.linalg.norm(move.values[3:]), limits.max_torque),
            ):
                if most and length > most:
                    yield "force", f"{length}"
        elif kind == "word" and isinstance(command.content, String) and command.content.text not in _WORDS:
            yield "word", command.content.text
        if "servo" in device and kind != "cf" and _limited(kind, limits):
            yield from self._motion(move, limits)

    def _age(self, move: Move, limits: ArmsRow, host_ns: int) -> Iterator[tuple[str, str]]:
        if limits.max_age_s:
            age_s = (host_ns - move.stamp_ns) / NS_PER_S
            if move.stamp_ns == 0 or abs(age_s) > limits.max_age_s:
                yield "age", f"{age_s:.6f} s"
        last = self._last(move.device)
        if last and last.stamp_ns and move.stamp_ns and move.stamp_ns <= last.stamp_ns:
            yield "order", f"{last.stamp_ns - move.stamp_ns} ns back"

    def _pose(self, move: Move, command: Command, limits: ArmsRow) -> Iterator[tuple[str, str]]:
        state = self._state(move)
        shown = state.frame if state else None
        expected = limits.frame_id or shown
        if command.frame:
            self.seen["named frame"] += 1
            if command.frame != expected:
                yield "frame", f"found {command.frame!r}, where the arm has {expected!r}"
        if expected is not None and move.frame != expected:
            yield "frame", f"published in {move.frame!r}, where the arm has {expected!r}"
        if limits.frame_id and shown and shown != limits.frame_id:
            yield "frame", f"measured_cp is in {shown!r}, the poses in {limits.frame_id!r}"
        place, box = move.values[:3], np.array(limits.workspace)
        if len(box):
            self.seen["workspace"] += 1
            if len(box) == 6:
                inside = bool((box[:3] <= place).all() and (place <= box[3:]).all())
            else:
                inside = float(np.linalg.norm(place - box[:3])) <= box[3] * _ROUNDING
            if not inside:
                yield "workspace", str(place)

    def _joints(self, move: Move, limits: ArmsRow) -> Iterator[tuple[str, str]]:
        state = self._state(move)
        kind, arm = DEVICES[move.device]
        counts = {len(limits.joint_min) or None, len(state.values) if state else None} - {None}
        if counts != {len(move.values)}:
            yield "count", f"{len(move.values)} joints, expected {counts or 'a state or a range'}"
            return
        goal = move.values
        if kind == "jr":
            if state is None:
                yield "state", "steps from nowhere"
                return
            goal = state.values + move.values
            if limits.joint_min:
                unseen_ns = state.at_ns - _SHOWN_NS
                since = [one for one in self._moves if DEVICES[one.device][1] == arm and one.at_ns > unseen_ns]
                if strange := [one.device for one in since if DEVICES[one.device][0] != "jr"]:
                    yield "range", f"steps after {strange[-1]}, which the state does not show"
                goal = goal + sum(one.values for one in since if DEVICES[one.device][0] == "jr")
        if limits.joint_min:
            self.seen[f"range {kind}"] += 1
            low, high = goal < np.array(limits.joint_min), goal > np.array(limits.joint_max)
            if kind == "jr":  # what the state shows of the steps before is not known: a way back is not one out
                low &= (move.values < 0) & (limits.joint_min - goal > _NOTHING)
                high &= (move.values > 0) & (goal - limits.joint_max > _NOTHING)
            if low.any() or high.any():
                yield "range", f"ends at {goal}, range {limits.joint_min} to {limits.joint_max}"

    # -- the motion of a stream ---------------------------------------------------------------------------------------

    def _motion(self, move: Move, limits: ArmsRow) -> Iterator[tuple[str, str]]:
        kind, arm = DEVICES[move.device]
        of_arm = next((one for one in reversed(self._moves) if DEVICES[one.device][1] == arm), None)
        last = self._last(move.device)
        if last and move.stamp_ns and last.stamp_ns and (kind != "cp" or last.frame == move.frame):
            passed_s = (move.stamp_ns - last.stamp_ns) / NS_PER_S
            if (times := _times(kind, last, move, limits, passed_s)) > 1:
                yield "stamps", f"{times:.4f} times the limit in {1000 * passed_s:.4f} ms of its stamps"
        if of_arm and move.at_ns - of_arm.at_ns < _PAUSE_NS:
            if of_arm.device != move.device:
                yield "takeover", f"{(move.at_ns - of_arm.at_ns) / NS_PER_MS:.3f} ms after {of_arm.device}"
                return
            self.seen["goes on"] += 1
            if move.frame != of_arm.frame:
                yield "frame", f"goes on in {move.frame!r} after {of_arm.frame!r}"
            elif (times := _times(kind, of_arm, move, limits, _LONGEST_S)) > 1:
                yield "pause", f"{times:.4f} times what 0.1 s allows"
            return
        self.seen["begins"] += 1
        state = self._state(move)
        if state is None:
            yield "begin", "without a state of the last second"
        elif of_arm and state.at_ns < of_arm.at_ns + _SHOWN_NS:
            yield "begin", f"the state came {(state.at_ns - of_arm.at_ns) / NS_PER_MS:.3f} ms after the last command"
        elif kind == "cp" and move.frame != (state.frame or limits.frame_id):
            yield "begin", f"in {move.frame!r} beside a state in {state.frame!r}"
        else:
            at = Move(state.at_ns, move.device, state.values, move.frame, 0)
            if (times := _times(kind, at, move, limits, _BEGIN_S)) > 1:
                yield "begin", f"{20 * times:.4f} ms from the arm at the limit"

    def _windows(self, device: str) -> Iterator[str]:
        """Yield the windows of time between any two set points in which the device was too fast."""
        kind, arm = DEVICES[device]
        limits = self._limits[arm.partition("/")[0]]
        moves = [one for one in self._moves if one.device == device]
        if "servo" not in device or kind == "cf" or not _limited(kind, limits):
            return
        breaks = [number for number, (a, b) in enumerate(pairwise(moves), 1) if a.frame != b.frame]
        for begin, end in pairwise([0, *breaks, len(moves)]):
            part = moves[begin:end]
            if len(part) < 2 or len({len(one.values) for one in part}) > 1:
                continue
            self.seen["window"] += 1
            one, other = np.triu_indices(len(part), 1)
            # differences of integers: a float64 of UTC ns has steps of 256 ns
            at_ns = np.array([move.at_ns for move in part], np.int64)
            values = np.array([move.values for move in part])
            if kind == "jr":
                values = values.cumsum(axis=0)
            times = _ratio(kind, values[one], values[other], limits, (at_ns[other] - at_ns[one]) / NS_PER_S)
            if (worst := int(times.argmax())) >= 0 and times[worst] > 1:
                a, b = part[one[worst]], part[other[worst]]
                moment = f"{_clock(a.at_ns)} and {_clock(b.at_ns)}"
                yield f"speed: {device}: {times[worst]:.4f} times the limit between {moment}"

    # -- what is known ------------------------------------------------------------------------------------------------

    def _last(self, device: str) -> Move | None:
        return next((one for one in reversed(self._moves) if one.device == device), None)

    def _state(self, move: Move) -> State | None:
        """Return the state that a command is about, if it is of the last second."""
        state = self._states.get(state_of(move.device))
        return state if state and move.at_ns - state.at_ns <= NS_PER_S else None

    def _is_same(self, command: Command, values: Vector, data: bytes) -> bool:
        """Return whether a published message is what a command asks for."""
        kind, arm = DEVICES[command.device]
        if not isinstance(command.content, _CONTENT[TYPES[kind]]):
            return False
        if isinstance(command.content, Sensor):
            return np.array_equal(values, np.asarray(command.content.values, float))
        if isinstance(command.content, Transform):
            m = np.array(command.content.wire_matrix).reshape(4, 3).T
            unit = 0.001 if self._limits[arm.partition("/")[0]].igtl_unit == "mm" else 1.0
            close = np.allclose(values[:3], unit * m[:, 3], rtol=1e-6, atol=1e-12)  # float32 on the wire
            return close and np.allclose(matrix_of(values[3:]), m[:, :3], atol=2e-4)
        return kind == "hold" or StringStamped.unpack(data).string == getattr(command.content, "text", None)


def state_of(device: str) -> str:
    """Return the topic of the state that a command is about."""
    kind, _ = DEVICES[device]
    return f"/{device.rpartition('/')[0]}/measured_{'cp' if kind == 'cp' else 'js'}"


def matrix_of(q: Vector) -> Vector:
    """Return the rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _read(device: str, data: bytes) -> tuple[Vector, str]:
    """Return values and frame of a published command."""
    kind, _ = DEVICES[device]
    if kind == "cp":
        pose = PoseStamped.unpack(data)
        return np.array(pose.pose), pose.header.frame_id
    if kind in ("jp", "jr"):
        return np.asarray(JointState.unpack(data).position, float), ""
    if kind == "cf":
        return np.array(WrenchStamped.unpack(data).wrench), ""
    return np.zeros(0), ""


def _clock(at_ns: int) -> str:
    """Return a time of a world: its seconds within a thousand."""
    return f"{(at_ns % (1000 * NS_PER_S)) / NS_PER_S:.6f} s"


def _limited(kind: str, limits: ArmsRow) -> bool:
    return bool(limits.max_speed or limits.max_turn_speed) if kind == "cp" else bool(limits.joint_speed)


def _times(kind: str, before: Move, move: Move, limits: ArmsRow, passed_s: float) -> float:
    """Return how many times the way between two set points is what its limits allow in a time."""
    if len(before.values) != len(move.values):
        return 0.0  # the counts of joints are judged by themselves
    start = np.zeros(len(move.values)) if kind == "jr" else before.values
    return float(_ratio(kind, start[None], move.values[None], limits, np.array([passed_s]))[0])


def _ratio(kind: str, before: Vector, after: Vector, limits: ArmsRow, passed_s: Vector) -> Vector:
    if kind != "cp":
        most = passed_s[:, None] * np.resize(limits.joint_speed, before.shape[1])
        return _over(np.abs(after - before), most).max(axis=1)
    ratio = np.zeros(len(before))
    if limits.max_speed:
        ratio = _over(np.linalg.norm(after[:, :3] - before[:, :3], axis=1), passed_s * limits.max_speed)
    if limits.max_turn_speed:
        q, p = before[:, 3:], after[:, 3:]
        chord = np.minimum(np.linalg.norm(q - p, axis=1), np.linalg.norm(q + p, axis=1))
        turn = 4 * np.arcsin(np.minimum(chord / 2, 1))
        # the quaternions of a state are rounded on their own, and the angle is that of their difference
        ratio = np.maximum(ratio, _over(np.where(turn < 1e-9, 0.0, turn), passed_s * limits.max_turn_speed))
    return ratio


def _over(way: Vector, most: Vector) -> Vector:
    """Return how many times a way is what it may be, without what rounding makes of it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        times: Vector = np.where(way <= _NOTHING, 0.0, way / most)
    times[(times < 0) | ((most <= 0) & (way > _NOTHING))] = math.inf
    return np.where(times <= _ROUNDING, np.minimum(times, 1.0), times)

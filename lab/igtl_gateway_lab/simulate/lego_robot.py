"""The robot of the LEGO scenario: the arm, and the brick that drives it.

An actor of ROS.  It touches the crosses of the sheet when it receives landmarks, and follows the points that it is
sent, by the last registration that it has received.  The world that it stands in is ``lego_world``: the operator who
touches the crosses and the camera that sees the ink look at that, the brick does not.

All of it goes in steps of 50 ms, counted and not measured: the arm moves on the same path however late it is called.
Lengths are millimetres until they leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.igtl_msgs import PointList
from igtl_gateway.convert.igtl_msgs import Volume as VolumeMessage
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import Header, Marker, RosMessage, String, TransformStamped
from igtl_gateway_lab.simulate import lego_terms as terms
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, RosReceived, RosSent
from igtl_gateway_lab.simulate.lego_arm import JOINTS, Drives, Point, angles_of, skeleton_of, tip_of
from igtl_gateway_lab.simulate.lego_world import World
from igtl_gateway_lab.simulate.registration import Rigid, distances
from igtl_gateway_lab.simulate.star_numbers import SEED, Array, rounded

TICK_NS = 50 * NS_PER_MS
_TICK_S = 0.05
_ARM_EVERY, _INK_EVERY = 4, 10  # ticks

_HOME = (200.0, -20.0, 60.0)
_HOVER_MM = 18.0
_TRAVEL_MM_S, _LOWER_MM_S, _DRAW_MM_S = 130.0, 45.0, 15.0
_SHORTEST_MOVE_S, _TOUCH_S = 0.35, 0.8
_PRESS_MM = 1.5  #: the pen sits on a spring: so far below the paper it is sent, so that it draws where the paper dips

_METRE = 1000.0
_STEP_M, _TURN_STEP = 1e-6, 1e-9


@dataclass(frozen=True, slots=True)
class _Step:
    """What the brick does in one tick: the tip to ``target`` (base, mm)."""

    target: Array
    by_eye: bool = False  #: the operator looks, and turns the motors so that the pen itself gets there
    pressing: bool = False  #: the pen is down: it should draw


class LegoRobot:
    """The actor; ``pace`` above 1 makes everything slower."""

    name = "lego_robot"
    side = ActorProtocol.ROS

    def __init__(self, pace: float = 1.0, seed: int = SEED) -> None:
        self.subscribes = {topic: message.TYPE for topic, (message, _) in self._handlers().items()}
        self.publishes = {
            terms.JOINTS_TOPIC: Publishes(JointState.TYPE),
            terms.PEN_TOPIC: Publishes(TransformStamped.TYPE),
            terms.ARM_TOPIC: Publishes(Marker.TYPE, latched=True),
            terms.INK_TOPIC: Publishes(Marker.TYPE, latched=True),
            terms.STATUS_TOPIC: Publishes(String.TYPE, latched=True),
        }
        self._pace = pace
        self._world = World(seed)
        self._drives = Drives(angles_of(_metres(np.array(_HOME))))
        self._at = np.array(_HOME)  # where the tip was sent last
        self._program: Iterator[_Step] | None = None
        self._then = ""  # the message at the end of the program
        self._due_ns: int | None = None
        self._ticks = 0
        self._words: list[str] = []
        self._voxels: tuple[int, ...] = ()
        self._registration: Rigid | None = None
        self._registrations = 0
        self._touched = 0
        self._fault = ""
        self._done = False

    # -- Actor --------------------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns
        self._words.append(f"{terms.READY}: SYNTHETIC arm of {len(JOINTS)} joints, no robot and no patient")

    @property
    def due_ns(self) -> int | None:
        return None if self._done else self._due_ns

    @property
    def done(self) -> bool:
        return self._done

    def act(self, now_ns: int) -> Iterable[RosSent]:
        stamp_ns = now_ns if self._due_ns is None else self._due_ns
        self._due_ns = stamp_ns + TICK_NS
        yield from self._spoken()
        finished = self._program is not None and not self._moved(self._program)
        yield from self._state(stamp_ns)
        if self._ticks % _ARM_EVERY == 0:
            yield RosSent(terms.ARM_TOPIC, self._skeleton(stamp_ns))
        if self._world.ink and (finished or (self._world.drawing and self._ticks % _INK_EVERY == 0)):
            yield RosSent(terms.INK_TOPIC, self._drawn(stamp_ns))
        if finished:
            self._program = None
            self._words.append(self._then.format(segments=len(self._world.ink)))
        self._ticks += 1

    def receive(self, now_ns: int, received: Received) -> Iterable[RosSent]:
        if isinstance(received, RosReceived) and received.topic in self.subscribes:
            message, answer = self._handlers()[received.topic]
            answer(message.unpack(received.cdr))
        yield from self._spoken()

    def report(self) -> ActorReport:
        segments, gaps = len(self._world.ink), self._world.skipped
        facts = {"volume": list(self._voxels), "touched": self._touched, "segments": segments, "gaps": gaps}
        lines = [
            f"planning volume of {' × '.join(map(str, self._voxels)) or 'no'} voxels received",
            f"{self._touched} crosses touched, {segments} segments drawn, {gaps} left out",
        ]
        if self._registration:
            error = self._world.error_of(self._registration)
            facts["error_of_registration_mm"] = round(error, 3)
            lines.append(f"registration against where the sheet really lies: {error:.2f} mm (rms)")
        if self._fault:
            lines.append(self._fault)
        return ActorReport(self._done and not self._fault and segments > 0 and gaps == 0, tuple(lines), facts)

    # -- Received messages --------------------------------------------------------------------------------------------

    def _handlers(self) -> dict[str, tuple[type[RosMessage], Callable[..., None]]]:
        """Topic → class of the message, and what is done with it."""
        return {
            terms.topic_of(terms.VOLUME, "volume"): (VolumeMessage, self._on_volume),
            terms.topic_of(terms.LANDMARKS, "landmarks"): (PointList, self._on_landmarks),
            terms.topic_of(terms.REGISTRATION, "transform"): (TransformStamped, self._on_registration),
            terms.topic_of(terms.POINTS, "landmarks"): (PointList, self._on_points),
            terms.topic_of(terms.SAYS, "string"): (String, self._on_text),
        }

    def _on_volume(self, message: VolumeMessage) -> None:
        self._voxels = message.size

    def _on_landmarks(self, message: PointList) -> None:
        """The operator finds the crosses on the sheet by their names."""
        if self._touched or self._program or not message.points:
            return
        try:
            seen = self._world.crosses([point.name for point in message.points])
        except KeyError as error:
            self._refuse(f"there is no cross {error} on the sheet")
            return
        self._touched = len(seen)
        self._program = self._touching(seen)
        self._then = f"{terms.TOUCHED_ALL} {len(seen)} crosses"

    def _on_registration(self, message: TransformStamped) -> None:
        """It comes again and again; a new one is acknowledged."""
        rotation: Array = np.array(rotation_matrix(message.rotation))
        found = Rigid(rotation, np.array(message.translation) * _METRE)
        if self._registration is None or found.rows != self._registration.rows:
            self._registration = found
            self._registrations += 1
            self._words.append(f"{terms.REGISTERED} {self._registrations}")

    def _on_points(self, message: PointList) -> None:
        """Groups of points are strokes: the pen goes up between them."""
        if self._world.ink or self._program or not message.points:
            return
        if self._registration is None:
            self._refuse("points came without a registration")
            return
        strokes: dict[str, list[Point]] = {}
        for point in message.points:
            strokes.setdefault(point.group, []).append(point.position)
        lines = [self._registration.apply(np.array(line) * _METRE) for line in strokes.values()]
        try:
            for point in np.concatenate(lines):
                angles_of(_metres(point - [0, 0, _PRESS_MM]))
        except ConfigError as error:
            self._refuse(str(error))
            return
        self._words.append(f"drawing {len(lines)} stroke{'s' * (len(lines) > 1)} through {len(message.points)} points")
        self._program = self._drawing(lines)
        self._then = terms.DRAWN + " {segments} segments"

    def _on_text(self, message: String) -> None:
        if message.data.startswith(terms.RESULT) and not self._done:
            self._words.append(terms.FINISHED)
            self._done = True

    def _refuse(self, why: str) -> None:
        self._fault = f"{terms.REFUSED}: {why}"
        self._words.append(self._fault)

    def _spoken(self) -> Iterator[RosSent]:
        words, self._words = self._words, []
        for text in words:
            yield RosSent(terms.STATUS_TOPIC, String(text))

    # -- What it does -------------------------------------------------------------------------------------------------

    def _touching(self, crosses: Array) -> Iterator[_Step]:
        above = np.array([0.0, 0.0, _HOVER_MM])
        for cross in crosses:
            yield from self._move(cross + above, _TRAVEL_MM_S)
            yield from self._move(cross, _LOWER_MM_S)
            for _ in range(self._count(_TOUCH_S)):
                yield _Step(cross, by_eye=True)
            yield from self._move(cross + above, _LOWER_MM_S)
        yield from self._rest()

    def _drawing(self, lines: list[Array]) -> Iterator[_Step]:
        above, press = np.array([0.0, 0.0, _HOVER_MM]), np.array([0.0, 0.0, _PRESS_MM])
        for line in lines:
            yield from self._move(line[0] + above, _TRAVEL_MM_S)
            yield from self._move(line[0] - press, _LOWER_MM_S)
            for target in _along(line, _DRAW_MM_S * _TICK_S / self._pace):
                yield _Step(target - press, pressing=True)
            yield from self._move(line[-1] + above, _LOWER_MM_S)
        yield from self._rest()

    def _rest(self) -> Iterator[_Step]:
        yield from self._move(np.array(_HOME), _TRAVEL_MM_S)
        for _ in range(self._count(_TOUCH_S)):
            yield _Step(np.array(_HOME))

    def _move(self, end: Array, speed_mm_s: float) -> Iterator[_Step]:
        """Straight, and gently at both ends."""
        start = self._at
        count = self._count(max(float(distances(end[None], start)[0]) / speed_mm_s, _SHORTEST_MOVE_S))
        for number in range(1, count + 1):
            part = number / count
            yield _Step(start + part * part * part * (10 + part * (6 * part - 15)) * (end - start))

    def _count(self, seconds: float) -> int:
        return max(round(seconds * self._pace / _TICK_S), 1)

    def _moved(self, program: Iterator[_Step]) -> bool:
        """One tick of it; false at its end."""
        step = next(program, None)
        if step is None:
            return False
        self._at = step.target
        go = self._drives.jog if step.by_eye else self._drives.go
        go(angles_of(_metres(step.target)))
        if step.pressing:
            self._world.draw(np.array(tip_of(self._drives.joints)) * _METRE)
        else:
            self._world.lift()
        return True

    # -- Sent messages -------------------------------------------------------------------------------------------------

    def _state(self, stamp_ns: int) -> Iterator[RosSent]:
        angles = self._drives.encoders
        header = Header(stamp_ns, terms.BASE)
        x, y, z = rounded(np.array(tip_of(angles)), _STEP_M).tolist()
        sin, cos = rounded(np.array([math.sin(angles[0] / 2), math.cos(angles[0] / 2)]), _TURN_STEP).tolist()
        names = tuple(joint.name for joint in JOINTS)
        yield RosSent(terms.JOINTS_TOPIC, JointState(header, names, rounded(np.array(angles), _TURN_STEP)))
        yield RosSent(terms.PEN_TOPIC, TransformStamped(header, terms.PEN, (x, y, z), (0.0, 0.0, sin, cos)))

    def _skeleton(self, stamp_ns: int) -> Marker:
        points = rounded(skeleton_of(self._drives.encoders), _STEP_M)
        return _lines(stamp_ns, terms.BASE, Marker.LINE_STRIP, points, (0.95, 0.75, 0.1, 1.0), 0.008)

    def _drawn(self, stamp_ns: int) -> Marker:
        points = np.array(self._world.ink).reshape(-1, 3) / _METRE
        return _lines(stamp_ns, terms.IMAGE, Marker.LINE_LIST, points, (0.1, 0.3, 0.95, 1.0), 0.001)


def _lines(
    stamp_ns: int, frame: str, kind: int, points: Array, colour: tuple[float, float, float, float], width_m: float
) -> Marker:
    colors = np.tile(np.array(colour, np.float32), (len(points), 1))
    header = Header(stamp_ns, frame)
    return Marker(header, "lego", 0, kind, scale=(width_m, 0.0, 0.0), color=colour, points=points, colors=colors)


def _along(line: Array, step: float) -> Iterator[Array]:
    """Points of a polyline, ``step`` apart along it, both ends included."""
    lengths = distances(line[1:], line[:-1]).tolist()
    passed, number = 0.0, 0
    for index in range(math.ceil(math.fsum(lengths) / step)):
        way = index * step
        while way > passed + lengths[number] and number + 1 < len(lengths):
            passed += lengths[number]
            number += 1
        part = min((way - passed) / lengths[number], 1.0) if lengths[number] else 0.0
        yield line[number] + part * (line[number + 1] - line[number])
    yield line[-1]


def _metres(point: Array) -> Point:
    x, y, z = (point / _METRE).tolist()
    return x, y, z

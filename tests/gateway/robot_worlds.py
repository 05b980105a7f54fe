"""Random worlds of robots, their commanders and bad networks, and an integrator of what reached the robots.

A world has commanders that send set points along a path, with stamps that may lie, over lines that stall, burst,
reorder and repeat, to arms whose states may lie, too.  All of it follows from a seed.  The integrator knows the guard's
promise only: it compares each published set point with every earlier one.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS

Vector = npt.NDArray[np.float64]
#: Device of a command → its kind, and the arm that it moves.
DEVICES = {
    "PSM1/servo_cp": ("cp", "PSM1"),
    "PSM1/local/servo_cp": ("cp", "PSM1"),
    "PSM1/servo_jp": ("jp", "PSM1"),
    "PSM1/servo_jr": ("jr", "PSM1"),
    "PSM1/jaw/servo_jp": ("jp", "PSM1/jaw"),
    "PSM2/servo_cp": ("cp", "PSM2"),
    "PSM2/servo_jr": ("jr", "PSM2"),
    "PSM1/move_cp": ("cp", "PSM1"),
    "PSM1/servo_cf": ("cf", "PSM1"),
    "PSM2/hold": ("hold", "PSM2"),
}
_OFTEN = ("PSM1/servo_cp", "PSM1/servo_cp", "PSM1/servo_cp", "PSM1/servo_jp", "PSM1/servo_jr", "PSM2/servo_cp")
JOINTS = 3
NAMES = ("yaw", "pitch", "insertion")
#: What a stamp shows, by the time of sending: UTC ns.
Lie = Callable[[int, int, random.Random], int]
LIES: dict[str, Lie] = {
    "honest": lambda now_ns, number, rng: now_ns,
    "behind": lambda now_ns, number, rng: now_ns - 80 * NS_PER_MS,
    "constant": lambda now_ns, number, rng: T0_NS,
    "unset": lambda now_ns, number, rng: 0,
    "backwards": lambda now_ns, number, rng: 2 * T0_NS - now_ns,
    "fast": lambda now_ns, number, rng: T0_NS + 5 * (now_ns - T0_NS),
    "slow": lambda now_ns, number, rng: now_ns - (now_ns - T0_NS) // 3,
    "far": lambda now_ns, number, rng: now_ns + number * NS_PER_S,
    "all ones": lambda now_ns, number, rng: (1 << 32) * NS_PER_S - 1,
    "random": lambda now_ns, number, rng: now_ns + rng.randint(-NS_PER_S, NS_PER_S),
    "sometimes": lambda now_ns, number, rng: rng.choice((0, now_ns, now_ns + 400 * NS_PER_MS)),
    "steps": lambda now_ns, number, rng: T0_NS + 90 * NS_PER_MS * number,
}


@dataclass(frozen=True)
class Event:
    """A command of a peer (``topic`` is its device), or the next state of an arm."""

    at_ns: int
    topic: str
    data: bytes = b""
    link: int = 0


@dataclass
class Published:
    """What reached a robot on one topic: times of arrival, and set points."""

    at_ns: list[int] = field(default_factory=list)
    values: list[Vector] = field(default_factory=list)
    states: list[tuple[int, Vector] | None] = field(default_factory=list)  # the last measured one at that time


class World:
    """One world of a seed: ``run`` feeds it to a gateway; ``topics`` then has what reached the robots."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = random.Random(seed)
        self.limits = ArmsRow(
            "/**",
            igtl_unit=rng.choice(("m", "m", "mm")),
            max_age_s=rng.choice((0.0, 0.1, 0.5, 0.5, 20.0)),
            max_speed=rng.choice((0.25, 0.25, 0.05, 1.0)),
            max_turn_speed=rng.choice((3.0, 0.5)),
            joint_speed=rng.choice(((1.0,), (0.5, 2.0, 1.0))),
        )
        self.topics: dict[str, Published] = {}
        self.sent = 0
        self._state: dict[str, Vector] = {}
        self._states: dict[str, tuple[int, Vector]] = {}
        self._target: dict[str, Vector] = {}
        self._follows = rng.choice(("exact", "exact", "late", "still", "elsewhere"))

    def run(self) -> None:
        """Play the world."""
        config = Config(profile="crtk", crtk=(self.limits,), allow_in=tuple(DEVICES))
        session = Session(Gateway(config))
        for link in (1, 2, 3):
            session.input(T0_NS, Kind.LINK, (Note(Level.INFO, LINK_UP, "up").pack(),), links=(link,))
        commands = list(self._commands())
        events = sorted((*self._states_of_arms(commands), *commands), key=lambda event: event.at_ns)
        for event in events:
            if event.link:
                self.sent += 1
                self._take(session.input(event.at_ns, Kind.IGTL_IN, (event.data,), links=(event.link,)))
            else:
                shown = self._shown(event)
                session.input(event.at_ns, Kind.ROS_IN, (shown.pack(),), channel=event.topic, type_name=shown.TYPE)

    # -- commanders ---------------------------------------------------------------------------------------------------

    def _commands(self) -> Iterator[Event]:
        rng = self.rng
        stalls = [
            (T0_NS + rng.randint(0, 2 * NS_PER_S), rng.randint(10, 900) * NS_PER_MS) for _ in range(rng.randint(0, 4))
        ]
        for _ in range(rng.choice((1, 1, 2, 3))):
            device = rng.choice(_OFTEN) if rng.random() < 0.7 else rng.choice(list(DEVICES))
            link = rng.randint(1, 3)
            yield from self._stream(device, link, stalls if rng.random() < 0.8 else [])

    def _stream(self, device: str, link: int, stalls: list[tuple[int, int]]) -> Iterator[Event]:
        rng = self.rng
        kind, _ = DEVICES[device]
        period_ns = rng.choice((1, 2, 5, 10, 20, 33, 100, 400)) * NS_PER_MS
        count = min(80, 2 * NS_PER_S // period_ns)
        lie = LIES[rng.choice(list(LIES)) if rng.random() < 0.5 else "honest"]
        jitter_ns = rng.choice((0, 0, 100_000, 5 * NS_PER_MS, 40 * NS_PER_MS))
        factor, jumps = rng.choice((0.1, 0.5, 0.9, 1.0, 1.1, 4.0)), rng.random() < 0.3
        path = self._path(kind, factor, jumps)
        start_ns = T0_NS + 50 * NS_PER_MS + rng.randint(0, 300) * NS_PER_MS
        held_ns = 0
        for number in range(count):
            sent_ns = start_ns + number * period_ns
            at_ns = sent_ns + NS_PER_MS + (rng.randint(0, jitter_ns) if jitter_ns else 0)
            for begin_ns, span_ns in stalls:
                if begin_ns <= at_ns < begin_ns + span_ns:
                    held_ns += rng.choice((0, 1, 10_000))
                    at_ns = begin_ns + span_ns + held_ns
            content = path(sent_ns - start_ns, period_ns)
            igtl_type = {"cp": "TRANSFORM", "hold": "STRING"}.get(kind, "SENSOR")
            ticks = ns_to_ticks(lie(sent_ns, number, rng))
            data = join(encode(Message(igtl_type, device, content, ticks)))
            yield Event(at_ns, device, data, link)
            if rng.random() < 0.03:  # again
                yield Event(at_ns + rng.choice((0, 1, 20 * NS_PER_MS)), device, data, link)

    def _path(self, kind: str, factor: float, jumps: bool) -> Callable[[int, int], Body]:
        """Return the content to be sent at a time since the start of a stream, ns, with the period of sending."""
        rng = self.rng
        way = np.array([rng.gauss(0, 1) for _ in range(3)])
        way /= np.linalg.norm(way)
        axis = np.array([rng.gauss(0, 1) for _ in range(3)])
        axis /= np.linalg.norm(axis)
        period_s = rng.choice((math.inf, 0.5, 2.0))

        def along(speed: float, at_ns: int) -> float:
            s = at_ns / NS_PER_S
            if jumps and rng.random() < 0.05:
                s += rng.choice((-0.3, 0.05, 0.5))
            return speed * (s if period_s == math.inf else period_s * math.sin(s / period_s))

        def pose(at_ns: int, _period_ns: int) -> Body:
            place = along(factor * self.limits.max_speed, at_ns) * way
            turn = along(rng.choice((0.0, factor)) * self.limits.max_turn_speed, at_ns)
            scale = 1000.0 if self.limits.igtl_unit == "mm" else 1.0
            return Transform((*_turned(axis, turn).T.ravel(), *(scale * place)))

        def joints(at_ns: int, _period_ns: int) -> Body:
            speeds = np.resize(self.limits.joint_speed, JOINTS)
            return _sensor(along(factor, at_ns) * speeds * np.sign(way))

        def steps(_at_ns: int, period_ns: int) -> Body:
            speeds = np.resize(self.limits.joint_speed, JOINTS)
            return _sensor(factor * speeds * np.sign(way) * period_ns / NS_PER_S * rng.choice((1, 1, 1, -1, 0)))

        def force(_at_ns: int, _period_ns: int) -> Body:
            return Sensor(np.array([1.0, 0, 0, 0, 0, 0], ">f8"))

        paths: dict[str, Callable[[int, int], Body]] = {"cp": pose, "jp": joints, "jr": steps, "cf": force}
        return paths.get(kind, lambda at_ns, period_ns: String(b""))

    # -- arms ---------------------------------------------------------------------------------------------------------

    def _states_of_arms(self, commands: list[Event]) -> Iterator[Event]:
        rng = self.rng
        last_ns = max(event.at_ns for event in commands)
        for topic in sorted({_state_of(event.topic) for event in commands}):
            period_ns = rng.choice((20, 50, 200)) * NS_PER_MS
            end_ns = rng.choice((last_ns, last_ns, last_ns, T0_NS + NS_PER_S))
            for at_ns in range(T0_NS + rng.randint(1, 20) * NS_PER_MS, end_ns, period_ns):
                yield Event(at_ns, topic)

    def _shown(self, event: Event) -> RosMessage:
        """Return the state of an arm at the time of an event."""
        topic = event.topic
        size = 7 if topic.endswith("_cp") else JOINTS
        rest = np.array([0.0] * 6 + [1.0]) if size == 7 else np.zeros(JOINTS)
        target = self._target.get(topic, rest)
        before = self._state.get(topic, rest)
        match self._follows:
            case "exact":
                now = target
            case "late":
                now = before + 0.3 * (target - before)
            case "still":
                now = rest
            case _:
                now = rest + np.array([self.rng.gauss(0, 0.05) for _ in range(size)])
        self._state[topic] = now
        self._states[topic] = event.at_ns, now
        stamp_ns = event.at_ns - self.rng.choice((0, NS_PER_MS, 40 * NS_PER_MS))
        if size == 7:
            return PoseStamped(Header(stamp_ns), tuple(now.tolist()))
        return JointState(Header(stamp_ns), NAMES, now)

    # -- what reached the robots --------------------------------------------------------------------------------------

    def _take(self, entries: list[Entry]) -> None:
        for entry in entries[1:]:
            device = entry.channel.removeprefix("/")
            if entry.kind is not Kind.ROS_OUT or device not in DEVICES:
                continue
            kind, _ = DEVICES[device]
            topic = _state_of(device)
            log = self.topics.setdefault(device, Published())
            point = np.zeros(0)
            if kind == "cp":
                point = np.array(PoseStamped.unpack(entry.data()).pose)
                self._target[topic] = point
            elif kind == "jp":
                point = np.asarray(JointState.unpack(entry.data()).position, float)
                self._target[topic] = point
            elif kind == "jr":  # the robot adds the steps up
                step = np.asarray(JointState.unpack(entry.data()).position, float)
                point = step + (log.values[-1] if log.values else 0.0)
                self._target[topic] = self._target.get(topic, np.zeros(JOINTS)) + step
            log.at_ns.append(entries[0].stamp_ns)
            log.values.append(point)
            log.states.append(self._states.get(topic))

    def fastest(self) -> float:
        """Return the fastest motion of any set point over any window, as a multiple of its limit."""
        return max((self._fastest(device, log) for device, log in self.topics.items()), default=0.0)

    def _fastest(self, device: str, log: Published) -> float:
        kind, _ = DEVICES[device]
        if "servo" not in device or kind == "cf" or len(log.at_ns) < 2:
            return 0.0
        one, other = np.triu_indices(len(log.at_ns), 1)
        # differences of integers: a float64 of UTC ns has steps of 256 ns
        at_ns = np.array(log.at_ns, np.int64)
        passed_s = (at_ns[other] - at_ns[one]) / NS_PER_S
        points = np.array(log.values)
        if kind != "cp":
            ways = np.abs(points[other] - points[one])
            return float((_over(ways, passed_s[:, None] * np.resize(self.limits.joint_speed, JOINTS))).max())
        way = np.linalg.norm(points[other, :3] - points[one, :3], axis=1)
        q, p = points[one, 3:], points[other, 3:]
        chord = np.minimum(np.linalg.norm(q - p, axis=1), np.linalg.norm(q + p, axis=1))
        turn = 4 * np.arcsin(np.minimum(chord / 2, 1))
        fastest = _over(way, passed_s * self.limits.max_speed), _over(turn, passed_s * self.limits.max_turn_speed)
        return float(max(fastest[0].max(), fastest[1].max()))

    def beginnings(self) -> Iterator[tuple[float, bool]]:
        """Yield for each set point after a pause the way from the state of the arm in units of 1 ms at the limit,
        and whether that state came after the last command."""
        for device, log in self.topics.items():
            kind, arm = DEVICES[device]
            if "servo" not in device or kind not in ("cp", "jp"):
                continue
            for number, at_ns in enumerate(log.at_ns):
                since = [one for one in self._times(arm) if one < at_ns]
                if since and at_ns - since[-1] < 500 * NS_PER_MS:
                    continue
                state = log.states[number]
                if state is None:
                    yield math.inf, False
                    continue
                seen_ns, place = state
                point = log.values[number]
                if kind == "cp":
                    ms = float(np.linalg.norm(point[:3] - place[:3])) / self.limits.max_speed * 1000
                else:
                    ms = float(np.max(np.abs(point - place) / np.resize(self.limits.joint_speed, JOINTS))) * 1000
                yield ms, not since or seen_ns > since[-1]

    def takeovers(self) -> Iterator[int]:
        """Yield the time between a command to an arm and a streamed set point of another device to it, ns."""
        for arm in {arm for _, arm in DEVICES.values()}:
            moves = sorted(
                (at_ns, device)
                for device, log in self.topics.items()
                if DEVICES[device][1] == arm
                for at_ns in log.at_ns
            )
            for (before_ns, before), (at_ns, device) in pairwise(moves):
                if device != before and "servo" in device and DEVICES[device][0] != "cf":
                    yield at_ns - before_ns

    def _times(self, arm: str) -> list[int]:
        return sorted(at_ns for device, log in self.topics.items() if DEVICES[device][1] == arm for at_ns in log.at_ns)


def _state_of(device: str) -> str:
    """Return the topic of the state that a command is about."""
    kind, _ = DEVICES[device]
    return f"/{device.rpartition('/')[0]}/measured_{'cp' if kind == 'cp' else 'js'}"


def _over(way: Vector, most: Vector) -> Vector:
    """Return how many times a way is what it may be; a way of rounding errors does not count."""
    return np.where(way <= 1e-12, 0.0, way / most)


def _turned(axis: Vector, angle: float) -> Vector:
    x, y, z = axis
    cross: Vector = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Vector = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned


def _sensor(values: Vector) -> Sensor:
    return Sensor(np.asarray(values, ">f8"))

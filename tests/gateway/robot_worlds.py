"""Random worlds of robots, their commanders and bad networks; ``robot_judge`` judges what reached the robots.

A world has commanders that send set points along a path, alone or several in a BIND, with stamps that may lie and
contents that may be wrong, over lines that stall, burst, reorder and repeat, to arms whose states may lie, stop, come
late, be invalid or change their frame, under a clock that may be set.  All of it follows from a seed.
"""

from __future__ import annotations

import heapq
import math
import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header, RosMessage, TransformStamped
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Item, Message, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.gateway.robot_judge import DEVICES, Command, Judge, Vector, matrix_of, state_of
from tests.script import T0_NS

#: Devices that the commanders of a world share: what interferes is not left to chance.
_THEMES = (
    ("PSM1/servo_cp", "PSM1/servo_cp", "PSM1/servo_cp", "PSM1/local/servo_cp", "PSM1/move_cp", "PSM2/servo_cp"),
    ("PSM1/servo_cp", "PSM2/servo_cp"),
    ("PSM1/servo_jp", "PSM1/servo_jp", "PSM1/jaw/servo_jp", "PSM2/move_jp"),
    ("PSM1/servo_jr", "PSM1/servo_jr", "PSM1/move_jr", "PSM2/servo_jr", "PSM2/move_jr"),
    tuple(DEVICES),
)
_REST = np.array([0.0] * 6 + [1.0])
#: Where the origin of a frame is, m: the same numbers in two frames are two places.
_ORIGINS = {"ECM": 0.0, "PSM1_base": 0.08, "": 0.0}
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
Path = Callable[[int, int], Body]


@dataclass
class Stream:
    """A commander of one device; ``origin`` is where its path begins, known when it begins."""

    device: str
    link: int
    lie: Lie
    path: Path
    looks: bool
    frame: str | None = ""  # that its metadata name; None: that of the arm
    begun_ns: int = 0
    origin: Vector | None = None


@dataclass
class Sent:
    """One set point of a stream: at most one message, or a child of a BIND."""

    stream: Stream
    number: int
    sent_ns: int
    at_ns: int
    period_ns: int
    begins: bool


class World:
    """One world of a seed: ``run`` feeds it to a gateway, and ``judge`` sees what it does.

    Args:
        recorded: as in a recorded session, all outputs are built, whether there is a subscriber or not.

    Attributes:
        sent: commands that arrived, also those inside a BIND.
        joints: how many each arm has; limits are for three.
        codes: code of each note → how often.
    """

    def __init__(self, seed: int, *, recorded: bool = False) -> None:
        self.rng = rng = random.Random(seed)
        self._recorded = recorded
        self.limits = {"PSM1": self._some_limits("/PSM1"), "PSM2": self._some_limits("/PSM2")}
        allowed = tuple(device for device in DEVICES if rng.random() < 0.97)
        max_age_s = rng.choice((0.0, 0.0, 0.0, 0.3))
        self.judge = Judge(self.limits, allowed, max_age_s)
        self.sent = 0
        self.joints = rng.choice((3, 3, 3, 3, 3, 4))
        self.codes: Counter[str] = Counter()
        rows = tuple(self.limits.values())
        self._gateway = Gateway(Config(profile="crtk", crtk=rows, allow_in=allowed, max_age_s=max_age_s))
        self._session = Session(self._gateway)
        self._ahead_ns = self._step_ns = 0
        self._queue: list[tuple[int, int, Callable[[], object]]] = []
        self._planned = 0
        self._arms: dict[str, Arm] = {}
        self._faults = rng.choice((0.0, 0.0, 0.02, 0.1))
        self._binds = rng.choice((0.0, 0.0, 0.2, 0.7))
        self._clock_is_set = rng.random() < 0.2
        self._same_host = rng.random() < 0.5  # the commanders have the clock of the gateway

    def run(self) -> None:
        """Play the world."""
        for link in (1, 2, 3):
            self._input(T0_NS, Kind.LINK, Note(Level.INFO, LINK_UP, "up").pack(), link=link)
        sent = self._streams()
        last_ns = max(one.at_ns for one in sent)
        for topic in sorted({state_of(one.stream.device) for one in sent}):
            self._arms[topic] = Arm(self, topic, last_ns)
        self._plan_mishaps(sent, last_ns)
        for packet in self._packets(sent):
            self.plan(packet[-1].at_ns, partial(self._arrives, packet))
        while self._queue:
            _, _, action = heapq.heappop(self._queue)
            action()

    def plan(self, at_ns: int, action: Callable[[], object]) -> None:
        """Let something happen at a time."""
        self._planned += 1
        heapq.heappush(self._queue, (at_ns, self._planned, action))

    def host_ns(self, at_ns: int) -> int:
        """Return what the clock of the gateway's host shows at a time."""
        return at_ns + self._step_ns

    def show(self, at_ns: int, topic: str, message: RosMessage) -> None:
        """A state of a robot arrives."""
        stamp_ns, _ = self._input(at_ns, Kind.ROS_IN, message.pack(), topic, message.TYPE)
        self.judge.state(topic, stamp_ns, stamp_ns - self._ahead_ns, message)

    def _input(
        self, at_ns: int, kind: Kind, data: bytes, topic: str = "", type_name: str = "", link: int = 0
    ) -> tuple[int, list[tuple[str, bytes]]]:
        """Feed an input; return its gateway time, and what the gateway published on topics of commands."""
        now_ns = self.host_ns(at_ns) + self._ahead_ns
        first, *caused = self._session.input(
            now_ns, kind, (data,), channel=topic, type_name=type_name, links=(link,) if link else ()
        )
        self.codes.update(Note.unpack(one.data()).code for one in caused if one.kind is Kind.NOTE)
        outputs = [(one.channel, bytes(one.data())) for one in caused if one.kind is Kind.ROS_OUT]
        return first.stamp_ns, [(topic, data) for topic, data in outputs if topic.removeprefix("/") in DEVICES]

    def _some_limits(self, arms: str) -> ArmsRow:
        rng = self.rng
        ranges = ((), ()), ((), ()), ((-0.1, -0.3, -0.02), (0.2, 0.1, 0.3)), ((-0.05,) * 3, (0.05,) * 3)
        low, high = rng.choice(ranges)
        speeds: tuple[tuple[float, ...], ...] = ((1.0,), (1.0,), (0.5, 2.0, 1.0), ())
        return ArmsRow(
            arms,
            igtl_unit=rng.choice(("m", "m", "mm")),
            frame_id=rng.choice(("", "", "ECM")),
            max_age_s=rng.choice((0.0, 0.1, 0.5, 0.5, 20.0)),
            workspace=rng.choice(((), (), (-0.03, -0.05, -0.05, 0.03, 0.05, 0.05), (0.0, 0.02, 0.0, 0.05))),
            max_speed=rng.choice((0.25, 0.25, 0.05, 1.0, 0.0)),
            max_turn_speed=rng.choice((3.0, 0.5, 0.5, 0.0)),
            joint_min=low,
            joint_max=high,
            joint_speed=rng.choice(speeds),
            max_force=rng.choice((5.0, 1.0, 0.0)),
            max_torque=rng.choice((0.5, 0.0)),
        )

    # -- commanders ---------------------------------------------------------------------------------------------------

    def _streams(self) -> list[Sent]:
        rng = self.rng
        stalls = [
            (T0_NS + rng.randint(0, 2 * NS_PER_S), rng.randint(10, 900) * NS_PER_MS) for _ in range(rng.randint(0, 4))
        ]
        sent: list[Sent] = []
        theme = rng.choice(_THEMES)
        for _ in range(rng.choice((1, 1, 2, 3))):
            device = rng.choice(theme)
            sent += self._set_points(device, rng.randint(1, 3), stalls if rng.random() < 0.7 else [])
        return sent

    def _set_points(self, device: str, link: int, stalls: list[tuple[int, int]]) -> Iterator[Sent]:
        rng = self.rng
        kind, arm = DEVICES[device]
        period_ns = rng.choice((1, 2, 5, 10, 20, 33, 100, 400)) * NS_PER_MS
        count = min(80, 2 * NS_PER_S // period_ns)
        lie = LIES[rng.choice(list(LIES)) if rng.random() < 0.4 else "honest"]
        jitter_ns = rng.choice((0, 0, 100_000, 5 * NS_PER_MS, 40 * NS_PER_MS))
        path = self._path(kind, self.limits[arm.partition("/")[0]])
        frame = rng.choice(("", "", None, None, "ECM", "camera"))
        stream = Stream(device, link, lie, path, rng.random() < 0.8, frame)
        now_ns = T0_NS + 50 * NS_PER_MS + rng.randint(0, 300) * NS_PER_MS
        held_ns = 0
        rests = rng.random() < 0.5
        for number in range(count):
            begins = number == 0
            if rests and rng.random() < 0.05:
                now_ns += rng.choice((410, 470, 520, 600, 900, 1300)) * NS_PER_MS
                begins = True
            now_ns += period_ns
            at_ns = now_ns + NS_PER_MS + (rng.randint(0, jitter_ns) if jitter_ns else 0)
            for begin_ns, span_ns in stalls:
                if begin_ns <= at_ns < begin_ns + span_ns:
                    held_ns += rng.choice((0, 1, 10_000))
                    at_ns = begin_ns + span_ns + held_ns
            yield Sent(stream, number, now_ns, at_ns, period_ns, begins)

    def _path(self, kind: str, limits: ArmsRow) -> Path:
        """Return the content to be sent at a time since the begin of a stream, ns, with the period of sending."""
        rng = self.rng
        factor, jumps = rng.choice((0.1, 0.5, 0.9, 1.0, 1.1, 4.0)), rng.random() < 0.3
        way = np.array([rng.gauss(0, 1) for _ in range(3)])
        way /= np.linalg.norm(way)
        axis = np.array([rng.gauss(0, 1) for _ in range(3)])
        axis /= np.linalg.norm(axis)
        period_s = rng.choice((math.inf, 0.5, 2.0))
        turns = rng.choice((0.0, factor))
        speeds = np.resize(limits.joint_speed or (1.0,), self.joints) * np.sign(np.resize(way, self.joints))

        def along(speed: float, at_ns: int) -> float:
            s = at_ns / NS_PER_S
            if jumps and rng.random() < 0.05:
                s += rng.choice((-0.3, 0.05, 0.5))
            return speed * (s if period_s == math.inf else period_s * math.sin(s / period_s))

        def pose(at_ns: int, _period_ns: int) -> Body:
            place = along(factor * (limits.max_speed or 0.25), at_ns) * way
            turn = along(turns * (limits.max_turn_speed or 3.0), at_ns)
            return Transform((*_turned(axis, turn).T.ravel(), *place))

        def joints(at_ns: int, _period_ns: int) -> Body:
            return _sensor(along(factor, at_ns) * speeds)

        def steps(_at_ns: int, period_ns: int) -> Body:
            return _sensor(factor * speeds * min(period_ns, 100 * NS_PER_MS) / NS_PER_S * rng.choice((1, 1, 1, -1, 0)))

        def force(_at_ns: int, _period_ns: int) -> Body:
            values = np.array([rng.gauss(0, 1) for _ in range(6)]) * rng.choice((0.1, 1.0, 4.0))
            return _sensor(values)

        def word(_at_ns: int, _period_ns: int) -> Body:
            return String.of(rng.choice(("enable", "home", "explode")))

        paths: dict[str, Path] = {"cp": pose, "jp": joints, "jr": steps, "cf": force, "word": word}
        return paths.get(kind, lambda at_ns, period_ns: String(b""))

    def _content(self, one: Sent) -> Body:
        """Return what a stream sends, from where the arm was seen when it began."""
        stream, rng = one.stream, self.rng
        kind, arm = DEVICES[stream.device]
        if one.begins or stream.origin is None:
            stream.begun_ns = one.sent_ns
            rest = _REST if kind == "cp" else np.zeros(self.joints)
            seen = self._arms[state_of(stream.device)].seen
            stream.origin = seen if stream.looks and seen is not None and len(seen) == len(rest) else rest
        content = stream.path(one.sent_ns - stream.begun_ns, one.period_ns)
        if isinstance(content, Transform):
            m = np.array(content.wire_matrix).reshape(4, 3).T
            place = stream.origin[:3] + m[:, 3]
            scale = 1000.0 if self.limits[arm].igtl_unit == "mm" else 1.0
            content = Transform((*(m[:, :3] @ matrix_of(stream.origin[3:])).T.ravel(), *(scale * place)))
        elif kind == "jp" and isinstance(content, Sensor):
            content = _sensor(stream.origin + np.asarray(content.values, float))
        return self._spoilt(content) if rng.random() < self._faults else content

    def _spoilt(self, content: Body) -> Body:
        """Return a content with a fault."""
        rng = self.rng
        if isinstance(content, Transform):
            m = list(content.wire_matrix)
            match rng.randint(0, 4):
                case 0:
                    m[rng.randint(0, 11)] = rng.choice((math.nan, math.inf))
                case 1:
                    m[rng.randint(0, 8)] += rng.choice((0.01, 0.3))
                case 2:
                    m[:3] = [-value for value in m[:3]]
                case 3:
                    m[9 + rng.randint(0, 2)] *= 1000
                case _:
                    return _sensor(np.zeros(self.joints))
            return Transform(tuple(m))
        if isinstance(content, Sensor):
            values = np.array(content.values, float)
            match rng.randint(0, 3):
                case 0:
                    values[0] = rng.choice((math.nan, -math.inf))
                case 1:
                    values = values[:-1]
                case 2:
                    values = np.append(values, 0.0)
                case _:
                    values[-1] += 1.0
            return _sensor(values)
        return String.of("?") if rng.random() < 0.5 else _sensor(np.zeros(self.joints))

    # -- the network --------------------------------------------------------------------------------------------------

    def _packets(self, sent: list[Sent]) -> Iterator[list[Sent]]:
        """Yield what arrives as one message: several of a link are a BIND."""
        rng = self.rng
        for link in (1, 2, 3):
            of_link = sorted((one for one in sent if one.stream.link == link), key=lambda one: one.at_ns)
            while of_link:
                count = rng.randint(2, 5) if rng.random() < self._binds else 1
                packet, of_link = of_link[:count], of_link[count:]
                yield packet

    def _arrives(self, packet: list[Sent]) -> None:
        rng, last = self.rng, packet[-1]
        contents = [(one.stream.device, _type_of(content := self._content(one)), content) for one in packet]
        stream = last.stream
        sent_ns = self.host_ns(last.sent_ns) if self._same_host else last.sent_ns
        stamp_ns = stream.lie(sent_ns, last.number, rng)
        frame = self._arms[state_of(stream.device)].frame if stream.frame is None else stream.frame
        if len(packet) == 1:
            (device, igtl_type, content), has_children = contents[0], False
        else:
            device = rng.choice(("all", "all", "all", stream.device))
            igtl_type, content, has_children = "BIND", _bind(contents, rng), True
        message = Message(igtl_type, device, content, ns_to_ticks(stamp_ns))
        if frame or rng.random() < 0.1:
            items = (Item.of("ros.frame_id", frame),) if frame else ()
            message = replace(message, header_version=2, metadata=items)
        data = join(encode(message))
        stamp_ns = max(stamp_ns, 0)
        children = [] if has_children and device == stream.device else contents  # that BIND is itself no pose
        sent = [Command(*one, stamp_ns, frame) for one in children]
        self._feed(last.at_ns, data, stream.link, sent)
        if rng.random() < 0.03:  # again
            again_ns = last.at_ns + rng.choice((0, 1, 20 * NS_PER_MS))
            self.plan(again_ns, partial(self._feed, again_ns, data, stream.link, sent))

    def _feed(self, at_ns: int, data: bytes, link: int, sent: list[Command]) -> None:
        self.sent += len(sent)
        stamp_ns, outputs = self._input(at_ns, Kind.IGTL_IN, data, link=link)
        self.judge.published(stamp_ns, stamp_ns - self._ahead_ns, sent, outputs)
        for topic, packed in outputs:
            device = topic.removeprefix("/")
            joints = self._arms[state_of(device)].obey(DEVICES[device][0], packed)
            if joints is not None and not self._clock_is_set:
                self.judge.stands(device, joints)

    def _plan_mishaps(self, sent: list[Sent], last_ns: int) -> None:
        """Let the clock be set, links go down, subscribers come and go."""
        rng = self.rng
        if self._clock_is_set:
            for _ in range(rng.randint(1, 2)):
                step_ns = round(rng.choice((0.03, 0.3, 0.6, 2.0, -0.05, -0.8, -3.0)) * NS_PER_S)
                at_ns = rng.randint(T0_NS, last_ns)
                self.plan(at_ns, partial(self._set_clock, at_ns, step_ns))
        if rng.random() < 0.1:
            at_ns, link = rng.randint(T0_NS, last_ns), rng.randint(1, 3)
            for code, after_ns in ((LINK_DOWN, 0), (LINK_UP, 100 * NS_PER_MS)):
                note = Note(Level.INFO, code, code).pack()
                self.plan(at_ns + after_ns, partial(self._input, at_ns + after_ns, Kind.LINK, note, link=link))
        if rng.random() < 0.15 and not self._recorded:
            heard: set[str] = set()
            self._gateway.has_subscriber = lambda topic, type_name: topic in heard
            for topic in sorted({f"/{one.stream.device}" for one in sent}):
                if rng.random() < 0.5:
                    heard.add(topic)
                for _ in range(2):
                    self.plan(rng.randint(T0_NS, last_ns), partial(heard.symmetric_difference_update, (topic,)))

    def _set_clock(self, at_ns: int, step_ns: int) -> None:
        step = ClockStep.after(step_ns, self._ahead_ns)
        self._step_ns += step_ns
        self._ahead_ns = step.ahead_ns
        self._input(at_ns, Kind.EDGE_NOTE, step.note().pack())


class Arm:
    """A robot, seen by one of its topics: where it is, and what it shows.

    Attributes:
        seen: the last valid state that it has shown; None: there was none.
        frame: the frame of its poses.
    """

    def __init__(self, world: World, topic: str, last_ns: int) -> None:
        self._world, self._topic = world, topic
        self._rng = rng = world.rng
        self.seen: Vector | None = None
        self.frame = rng.choice(("ECM", "ECM", "PSM1_base", ""))
        self._rest = _REST if topic.endswith("_cp") else np.zeros(world.joints)
        self._target = self._at = self._rest
        self._follows = rng.choice(("exact", "exact", "exact", "moved", "moved", "late", "still", "elsewhere"))
        self._delay_ns = rng.choice((0, 0, 0, 2, 45)) * NS_PER_MS
        self._faults = rng.choice((0.0, 0.0, 0.02, 0.2))
        self._plan(last_ns)

    def _plan(self, last_ns: int) -> None:
        rng, plan = self._rng, self._world.plan
        period_ns = rng.choice((20, 20, 50, 200)) * NS_PER_MS
        end_ns = rng.choice((last_ns, last_ns, last_ns, T0_NS + NS_PER_S))
        silent = [rng.randint(T0_NS, last_ns) for _ in range(rng.choice((0, 1)))]
        for at_ns in range(T0_NS + rng.randint(1, 20) * NS_PER_MS, end_ns, period_ns):
            if not any(begin_ns < at_ns < begin_ns + 1500 * NS_PER_MS for begin_ns in silent):
                plan(at_ns, partial(self._measure, at_ns))
        if self._follows == "moved":  # by another program
            for _ in range(3):
                plan(rng.randint(T0_NS, last_ns), self._move)
        if self._topic.endswith("_cp") and rng.random() < 0.3:
            for _ in range(rng.randint(1, 2)):
                plan(rng.randint(T0_NS, last_ns), self._change_frame)

    def _move(self) -> None:
        way = np.array([self._rng.gauss(0, 0.3) for _ in range(3)])
        self._target = np.append(way, self._target[3:])

    def _change_frame(self) -> None:
        frame = self._rng.choice(list(_ORIGINS))
        way = np.array([_ORIGINS[frame] - _ORIGINS[self.frame], *[0.0] * 6])
        self._target, self._at, self.frame = self._target + way, self._at + way, frame

    def _measure(self, at_ns: int) -> None:
        match self._follows:
            case "exact" | "moved":
                self._at = self._target
            case "late":
                self._at = self._at + 0.3 * (self._target - self._at)
            case "elsewhere":
                self._at = self._rest + np.array([self._rng.gauss(0, 0.05) for _ in self._rest])
        stamp_ns = self._world.host_ns(at_ns) - self._rng.choice((0, NS_PER_MS, 40 * NS_PER_MS))
        values, spoilt = self._at, self._rng.random() < self._faults
        shown = None if spoilt else values
        message: RosMessage
        if len(values) == len(_REST):
            message = PoseStamped(Header(stamp_ns, self.frame), tuple(values.tolist()))
        else:
            message = JointState(Header(stamp_ns), ("a", "b", "c", "d")[: len(values)], values)
        if spoilt:
            message = self._spoilt(message, stamp_ns)
        at_ns += self._delay_ns
        self._world.plan(at_ns, partial(self._show, at_ns, message, shown))

    def _show(self, at_ns: int, message: RosMessage, values: Vector | None) -> None:
        self._world.show(at_ns, self._topic, message)
        self.seen = self.seen if values is None else values

    def _spoilt(self, message: PoseStamped | JointState, stamp_ns: int) -> RosMessage:
        """Return a state with a fault."""
        rng = self._rng
        if rng.random() < 0.3:
            return replace(message, header=Header(0, self.frame))
        if isinstance(message, JointState):
            values = message.position
            return replace(
                message, position=rng.choice((values * math.nan, values[:0], values[:-1], np.append(values, 0.1)))
            )
        if rng.random() < 0.3:
            return TransformStamped(Header(stamp_ns, self.frame), "tool", (0.3, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        zero, nan, inf = 0.0, math.nan, math.inf
        no_pose = (nan, zero, zero, zero, zero, zero, 1.0)
        no_rotation, no_number = (zero,) * 7, (zero, zero, zero, zero, zero, zero, inf)
        return replace(message, pose=rng.choice((no_pose, no_rotation, no_number)))

    def obey(self, kind: str, data: bytes) -> Vector | None:
        """A command reaches the robot, which adds steps up; return where its joints stand, if its states show it."""
        if kind == "cp":
            self._target = np.array(PoseStamped.unpack(data).pose)
        elif kind in ("jp", "jr"):
            values = np.asarray(JointState.unpack(data).position, float)
            if len(values) == len(self._target):
                self._target = values + (self._target if kind == "jr" else 0.0)
                return self._target if self._follows == "exact" else None
        return None


def _bind(contents: list[tuple[str, str, Body]], rng: random.Random) -> Bind:
    """Return contents as children, some of them one level deeper."""
    children = [BindChild(igtl_type, device, join(content.pack())) for device, igtl_type, content in contents]
    if rng.random() < 0.2:
        inner = Bind(tuple(children[1:]))
        children[1:] = [BindChild("BIND", "inner", join(inner.pack()))]
    return Bind(tuple(children))


def _type_of(content: Body) -> str:
    return {Transform: "TRANSFORM", Sensor: "SENSOR", String: "STRING"}[type(content)]


def _turned(axis: Vector, angle: float) -> Vector:
    x, y, z = axis
    cross: Vector = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Vector = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned


def _sensor(values: Vector) -> Sensor:
    return Sensor(np.asarray(values, ">f8"))

"""The message exchange of the ROS-IGTL-Bridge paper's Figure 9, as two actors: a planner and a robot.

The planning program initialises the robot, commands it to a point, has it acquire an image there together with the
pose of the probe, and shuts it down; in six steps, each of which waits for the one before.  The robot's probe looks
at a phantom with one bright lesion, at the point that it is sent to: if every message arrived as it was meant, the
lesion is in the middle of the image.  **Synthetic data.**

===  ==================================  ==============================================================
step planner (OpenIGTLink)               robot (ROS 2)
===  ==================================  ==============================================================
1    STRING ``INITIALIZE``               STRING ``INITIALIZED``
2    POINT ``Target``                    STRING ``MOVING``
3                                        TRANSFORM stream of the probe, then STRING ``AT TARGET``
4    COMMAND ``Acquire``                 its reply
5                                        TRANSFORM of the probe and IMAGE, with one stamp
6    STRING ``SHUT DOWN``                STRING ``SHUT DOWN``
===  ==================================  ==============================================================
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply
from igtl_gateway.convert.rosmsg import Header, Image, PointStamped, RosMessage, String, TransformStamped
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.image import Image as WireImage
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.text import String as WireString
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.simulate.actor import (
    Actor,
    ActorProtocol,
    ActorReport,
    Publishes,
    Received,
    RosReceived,
    RosSent,
    Sent,
)
from igtl_gateway_lab.simulate.star_numbers import Noise, Rgb

#: Where the lesion is, and the robot is sent to: millimetres in the robot's base frame.
LESION_MM = (420.0, -60.0, 135.0)
HOME_MM = (300.0, 0.0, 300.0)
MOVE_S = 2.0  #: how long the robot moves, unless a session of another length is asked for

WIDTH, HEIGHT, PIXEL_MM = 160, 120, 0.5
LESION_RADIUS_MM = 8.0
BRIGHT = 220  #: of 255; the tissue around is below half of it

_SETTLE_NS = 200 * NS_PER_MS  # for the robot to switch itself on, and to take a picture
_POSE_NS = 50 * NS_PER_MS  # between two poses
_THINK_NS = 100 * NS_PER_MS  # for the planner's user to press the next button
_GIVE_UP_NS = 5 * NS_PER_S  # without an answer
_LATE_NS = NS_PER_S // 2  # on a ROS graph a message may overtake that of another topic by as much

_MAX_ERROR_MM = 0.01  # the target's coordinates are 32-bit floats of some hundred millimetres
_MAX_CENTRE_MM = PIXEL_MM

_BASE_FRAME = "base"
#: Points of planners are in the robot's own frame; nothing else differs from the usual.
CONFIG = Config(base_frame=_BASE_FRAME)

_TOPIC = {name: f"/igtl/out/{name}" for name in ("Robot/string", "ProbeToBase/transform", "Probe/image")}
_COMMAND_ID = 1


def actors(duration_s: float | None = None) -> tuple[Actor, ...]:
    """Planner and robot; the robot moves so long that the session takes about ``duration_s``."""
    move_s = MOVE_S if duration_s is None else max(0.2, duration_s - 1.0)
    return AcquisitionPlanner(), AcquisitionRobot(move_s)


def probe_image(position_mm: tuple[float, float, float]) -> Rgb:
    """What the probe sees at a position: speckled tissue, and the lesion where it lies; 8 bits grey."""
    speckle = (Noise(9, 1).uniform(HEIGHT, WIDTH) * 100).astype(np.uint8)
    x = (np.arange(WIDTH) - (WIDTH - 1) / 2) * PIXEL_MM + position_mm[0] - LESION_MM[0]
    y = (np.arange(HEIGHT) - (HEIGHT - 1) / 2) * PIXEL_MM + position_mm[1] - LESION_MM[1]
    out_mm = position_mm[2] - LESION_MM[2]
    inside = x[None, :] ** 2 + y[:, None] ** 2 + out_mm**2 < LESION_RADIUS_MM**2
    return np.where(inside, np.uint8(BRIGHT), speckle)


class AcquisitionRobot:
    """The ROS side: a robot that carries a probe."""

    name = "robot"
    side = ActorProtocol.ROS

    def __init__(self, move_s: float) -> None:
        self.subscribes = {
            "/igtl/in/Planner/string": String.TYPE,
            "/igtl/in/Target/point": PointStamped.TYPE,
            "/igtl/in/Probe/command": RosCommand.TYPE,
        }
        self.publishes = {
            _TOPIC["Robot/string"]: Publishes(String.TYPE),
            _TOPIC["ProbeToBase/transform"]: Publishes(TransformStamped.TYPE),
            "/igtl/out/Probe/command_reply": Publishes(CommandReply.TYPE),
            _TOPIC["Probe/image"]: Publishes(Image.TYPE),
        }
        self._move_ns = round(move_s * NS_PER_S)
        self._position = HOME_MM
        self._ready = False
        self._over = False
        self._steps: list[str] = []
        # what it will do: time, number, deed
        self._plans: list[tuple[int, int, Callable[[int], list[Sent]]]] = []
        self._number = 0

    def begin(self, now_ns: int) -> None:
        """It waits for its first order."""

    @property
    def due_ns(self) -> int | None:
        return self._plans[0][0] if self._plans else None

    @property
    def done(self) -> bool:
        return self._over and not self._plans

    def act(self, now_ns: int) -> Iterable[Sent]:
        messages: list[Sent] = []
        while self._plans and self._plans[0][0] <= now_ns:
            messages += heapq.heappop(self._plans)[2](now_ns)
        return messages

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, RosReceived)
        match received.type:
            case String.TYPE:
                return self._order(now_ns, String.unpack(received.cdr).data)
            case PointStamped.TYPE if self._ready:
                return self._move(now_ns, PointStamped.unpack(received.cdr))
            case RosCommand.TYPE if self._ready:
                return self._acquire(now_ns, RosCommand.unpack(received.cdr))
        self._steps.append(f"refused {received.topic}: not initialised")
        return ()

    def report(self) -> ActorReport:
        x, y, z = self._position
        lines = (*self._steps, f"probe at ({x:.2f}, {y:.2f}, {z:.2f}) mm")
        return ActorReport(self.done, lines, {"position_mm": list(self._position), "initialised": self._ready})

    def _later(self, time_ns: int, deed: Callable[[int], list[Sent]]) -> None:
        self._number += 1
        heapq.heappush(self._plans, (time_ns, self._number, deed))

    def _order(self, now_ns: int, order: str) -> list[Sent]:
        if order == "INITIALIZE":
            self._later(now_ns + _SETTLE_NS, self._initialised)
            return []
        if order == "SHUT DOWN":
            self._ready, self._over = False, True
            return [self._status("SHUT DOWN")]
        return [self._status(f"UNKNOWN ORDER {order}")]

    def _initialised(self, _now_ns: int) -> list[Sent]:
        self._ready = True
        return [self._status("INITIALIZED")]

    def _move(self, now_ns: int, target: PointStamped) -> list[Sent]:
        start = self._position
        x, y, z = (round(value * 1000, 4) for value in target.point)
        steps = max(1, self._move_ns // _POSE_NS)
        for step in range(1, steps + 1):
            self._later(now_ns + step * _POSE_NS, self._step(start, (x, y, z), step / steps))
        return [self._status("MOVING")]

    def _step(
        self, start: tuple[float, float, float], end: tuple[float, float, float], part: float
    ) -> Callable[[int], list[Sent]]:
        def step(now_ns: int) -> list[Sent]:
            smooth = part * part * (3 - 2 * part)
            x, y, z = (round(a + (b - a) * smooth, 4) for a, b in zip(start, end, strict=True))
            self._position = (x, y, z)
            pose = self._publish("ProbeToBase/transform", self._pose(now_ns))
            return [pose, self._status("AT TARGET")] if part >= 1 else [pose]

        return step

    def _acquire(self, now_ns: int, order: RosCommand) -> list[Sent]:
        known = order.name == "Acquire"
        status = CommandReply.SUCCESS if known else CommandReply.FAIL
        error = "" if known else f"unknown command {order.name}"
        if known:
            self._later(now_ns + _SETTLE_NS, self._image)
        reply = CommandReply(Header(now_ns), "Probe", order.id, order.name, status, error, link=order.link)
        self._steps.append(f"command {order.name}: {error or 'done'}")
        return [RosSent("/igtl/out/Probe/command_reply", reply)]

    def _image(self, now_ns: int) -> list[Sent]:
        pixels = probe_image(self._position)
        image = Image(Header(now_ns, "probe"), HEIGHT, WIDTH, "mono8", 0, WIDTH, pixels.tobytes())
        return [self._publish("ProbeToBase/transform", self._pose(now_ns)), self._publish("Probe/image", image)]

    def _pose(self, now_ns: int) -> TransformStamped:
        x, y, z = (value / 1000 for value in self._position)
        return TransformStamped(Header(now_ns, _BASE_FRAME), "probe", (x, y, z), (0.0, 0.0, 0.0, 1.0))

    def _status(self, text: str) -> Sent:
        self._steps.append(text.lower())
        return self._publish("Robot/string", String(text))

    def _publish(self, stream: str, message: RosMessage) -> Sent:
        return RosSent(_TOPIC[stream], message)


class AcquisitionPlanner:
    """The OpenIGTLink side: a planning program, as 3D Slicer is."""

    name = "planner"
    side = ActorProtocol.IGTL

    def __init__(self) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self._step = 0
        self._due_ns: int | None = None
        self._give_up_ns = 0
        self._poses = 0
        self._pose: tuple[int, tuple[float, ...]] = (0, ())
        self._image: tuple[int, WireImage] | None = None
        self._late_ns: int | None = None  # when a pose that belongs to what has come is given up
        self._faults: list[str] = []
        self._lines: list[str] = []
        self._facts: dict[str, float | None] = {}

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns + _THINK_NS

    @property
    def due_ns(self) -> int | None:
        if self._late_ns is not None:
            return self._late_ns
        if self._due_ns is not None or self.done:
            return self._due_ns
        return self._give_up_ns

    @property
    def done(self) -> bool:
        return self._step == _LAST_STEP or bool(self._faults)

    def act(self, now_ns: int) -> Iterable[Sent]:
        if self._late_ns is not None:
            self._judge(now_ns)
            return []
        if self._due_ns is None:
            self._faults.append(f"step {self._step}: no {_AWAITED[self._step]} within {_GIVE_UP_NS / NS_PER_S:g} s")
            return [self._text(now_ns, "SHUT DOWN")]  # whatever happened, the robot must not be left switched on
        self._due_ns = None
        self._next(now_ns)
        match self._step:
            case 1:
                return [self._text(now_ns, "INITIALIZE")]
            case 2:
                target = Points.of(np.array([LESION_MM]), None, 2 * LESION_RADIUS_MM)
                return [Message("POINT", "Target", target, ns_to_ticks(now_ns))]
            case 4:
                return [Message("COMMAND", "Probe", Command.of(_COMMAND_ID, "Acquire", ""), ns_to_ticks(now_ns))]
            case _:
                return [self._text(now_ns, "SHUT DOWN")]

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, Message)
        content = received.content
        match self._step, received.type:
            case _, "TRANSFORM" if isinstance(content, Transform):
                self._poses += 1
                self._pose = (received.ticks, content.wire_matrix[9:])
                self._give_up_ns = now_ns + _GIVE_UP_NS
                self._judge(now_ns)
            case 1, "STRING" if _has_text(received, "INITIALIZED"):
                self._line(1, "robot initialised")
                self._due_ns = now_ns + _THINK_NS
            case 2, "STRING" if _has_text(received, "MOVING"):
                self._line(2, f"target ({', '.join(f'{value:.2f}' for value in LESION_MM)}) mm taken, robot moves")
                self._next(now_ns)
            case 3, "STRING" if _has_text(received, "AT TARGET"):
                self._late_ns = now_ns + _LATE_NS
                self._judge(now_ns)
            case 4, "RTS_COMMAND" if isinstance(content, Command) and content.command_id == _COMMAND_ID:
                self._line(4, "command Acquire taken")
                self._next(now_ns)
            case 5, "IMAGE" if isinstance(content, WireImage):
                self._image = (received.ticks, content)
                self._late_ns = now_ns + _LATE_NS
                self._judge(now_ns)
            case 6, "STRING" if _has_text(received, "SHUT DOWN"):
                self._line(6, "robot shut down")
                self._step = _LAST_STEP
        return ()

    def report(self) -> ActorReport:
        steps = min(self._step, _LAST_STEP - 1) if self._step == _LAST_STEP else max(0, self._step - 1)
        good = self._step == _LAST_STEP and not self._faults
        lines = (*self._lines, *self._faults)
        return ActorReport(good, lines, {"steps": steps, "poses": self._poses, "faults": self._faults, **self._facts})

    def _judge(self, now_ns: int) -> None:
        """Look at what has come, once the pose that belongs to it has come, too, or is too late."""
        if self._late_ns is None:
            return
        error_mm = math.dist(self._pose[1], LESION_MM) if self._pose[1] else math.inf
        complete = self._pose[0] == self._image[0] if self._image else error_mm <= _MAX_ERROR_MM
        if not complete and now_ns < self._late_ns:
            return
        self._late_ns, self._due_ns = None, now_ns + _THINK_NS
        if self._image:
            self._acquired(self._image[1])
            if not complete:
                self._faults.append("step 5: found no pose with the stamp of the image, expected one")
            return
        self._facts["target_error_mm"] = round(error_mm, 4) if self._pose[1] else None
        self._line(3, f"at the target after {self._poses} poses, {error_mm:.3f} mm off")
        if not complete:
            self._faults.append(f"step 3: found the probe {error_mm:.3f} mm off, expected at most {_MAX_ERROR_MM:g} mm")

    def _acquired(self, image: WireImage) -> None:
        columns, rows, slices = image.dimensions
        if (columns, rows, slices) != (WIDTH, HEIGHT, 1):
            self._faults.append(f"step 5: found an image of {image.dimensions}, expected {(WIDTH, HEIGHT, 1)}")
            return
        bright = np.frombuffer(bytes(image.pixels), np.uint8).reshape(HEIGHT, WIDTH) > BRIGHT // 2
        row, column = np.nonzero(bright)
        off = math.inf
        if len(row):
            off = PIXEL_MM * math.hypot(column.mean() - (WIDTH - 1) / 2, row.mean() - (HEIGHT - 1) / 2)
        self._facts |= {"lesion_off_centre_mm": round(off, 4) if len(row) else None, "lesion_pixels": len(row)}
        self._line(5, f"image {WIDTH} x {HEIGHT} and its pose, lesion {off:.2f} mm off the centre")
        if not off <= _MAX_CENTRE_MM:
            self._faults.append(f"step 5: found the lesion {off:.2f} mm off, expected at most {_MAX_CENTRE_MM:g} mm")

    def _next(self, now_ns: int) -> None:
        self._step += 1
        self._give_up_ns = now_ns + _GIVE_UP_NS

    def _line(self, step: int, text: str) -> None:
        self._lines.append(f"{step}. {text}")

    @staticmethod
    def _text(now_ns: int, text: str) -> Message:
        return Message("STRING", "Planner", WireString.of(text), ns_to_ticks(now_ns))


_LAST_STEP = 7
_AWAITED = {
    1: "STRING INITIALIZED",
    2: "STRING MOVING",
    3: "STRING AT TARGET",
    4: "reply to the COMMAND",
    5: "IMAGE",
    6: "STRING SHUT DOWN",
}


def _has_text(received: Message, text: str) -> bool:
    return isinstance(received.content, WireString) and received.content.text == text

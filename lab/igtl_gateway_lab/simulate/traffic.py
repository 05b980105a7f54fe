"""Two test programs that send each other messages of one type and size at a rate, and measure what arrives.

The ROS Test Node and the IGTL Test Server of the ROS-IGTL-Bridge paper: either is a sender, a receiver, or both.
Every message contains its number and its creation time, so the receiver knows of each that is missing, out of order or
changed, and how long it was on its way (by one clock: on one host, or on hosts whose clocks agree).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.rosmsg import Header, Image, PointCloud2, PointField, RosMessage, String, TransformStamped
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image as WireImage
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
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
from igtl_gateway_lab.simulate.load import Load
from igtl_gateway_lab.simulate.scenario import Scenario
from igtl_gateway_lab.simulate.star_numbers import Array, Noise, rounded

ROS_NAME, IGTL_NAME = "RosTest", "IgtlTest"  #: devices: who sends

_SILENCE_NS = 3 * NS_PER_S  # after this time without a message a receiver counts the rest as lost
_SEED = 23
_TOLERANCE_MM = 0.01
_TAIL = 16  # bytes at the end of an image that are compared
_XYZ = tuple(PointField(name, 4 * axis, 7) for axis, name in enumerate("xyz"))
_STAMP = slice(10, 29)  # of a string: the time in it
_HEAD = 30  # bytes of a string before its filling


def scenario(load: Load) -> Scenario:
    """The two programs with a load."""
    form = _FORMS[load.type]
    config = Config(
        to_igtl=(ToIgtlRow(topic=form.sends, device=ROS_NAME, type=load.type),),
        to_ros=(ToRosRow(device=IGTL_NAME, kinds=(form.kind,)),),
    )
    return Scenario(
        "messages of one type, size and rate between a ROS node and an OpenIGTLink program, measured, synthetic",
        config,
        actors=lambda duration_s: actors(load, duration_s),
        limit_s=120.0 + load.count / load.rate_hz,
        loaded=scenario,
    )


def actors(load: Load, duration_s: float | None = None) -> tuple[Actor, ...]:
    """The node and the server."""
    count = load.lasting(duration_s)
    node_sends, server_sends = load.sender in ("ros", "both"), load.sender in ("igtl", "both")
    return (
        TestServer(load, count if server_sends else 0, count if node_sends else 0),
        TestNode(load, count if node_sends else 0, count if server_sends else 0),
    )


@dataclass(frozen=True, slots=True)
class _TestMessage:
    """The metadata of a message."""

    number: int
    sent_ns: int
    intact: bool


@dataclass(frozen=True, slots=True)
class _Form:
    """How a type is made and read: number, length and time in, and out again."""

    kind: str
    ros_type: str
    ros: Callable[[int, int, int], RosMessage]
    igtl: Callable[[int, int, int], Body]
    of_ros: Callable[[bytes, int], _TestMessage]
    of_igtl: Callable[[Message, int], _TestMessage]

    @property
    def sends(self) -> str:
        """The topic of the ROS node."""
        return f"/igtl/out/{ROS_NAME}/{self.kind}"

    @property
    def to_ros_topic(self) -> str:
        """The topic of what the server sends."""
        return f"/igtl/in/{IGTL_NAME}/{self.kind}"


class _Tester:
    """What both programs have in common: the schedule of sent messages, the account of received messages."""

    def __init__(self, load: Load, to_send: int, to_hear: int) -> None:
        self._load = load
        self._form = _FORMS[load.type]
        self._to_send, self._to_hear = to_send, to_hear
        self._period_ns = round(NS_PER_S / load.rate_hz)
        self._begun_ns = self._last_ns = self._sent_ns = 0
        self._sent = 0
        self._gave_up = False
        self._latencies: list[int] = []
        self._heard: list[int] = []
        self._changed = 0
        self._first_ns = 0

    def begin(self, now_ns: int) -> None:
        self._begun_ns = self._last_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        if self._sent < self._to_send:
            return self._begun_ns + self._sent * self._period_ns
        return None if self.done else self._last_ns + _SILENCE_NS + self._period_ns

    @property
    def done(self) -> bool:
        return self._sent == self._to_send and (self._gave_up or len(self._heard) >= self._to_hear)

    def act(self, now_ns: int) -> Iterable[Sent]:
        if self._sent == self._to_send:
            self._gave_up = True
            return []
        sent = self._message(self._sent, now_ns)
        self._sent, self._sent_ns = self._sent + 1, now_ns
        return [sent]

    def _message(self, number: int, now_ns: int) -> Sent:
        raise NotImplementedError

    def _take(self, now_ns: int, seen: _TestMessage) -> None:
        self._first_ns = self._first_ns or now_ns
        self._last_ns = now_ns
        self._heard.append(seen.number)
        self._latencies.append(now_ns - seen.sent_ns)
        self._changed += not seen.intact

    def report(self) -> ActorReport:
        lines: list[str] = []
        facts: dict[str, Any] = {}
        if self._to_send:
            rate = _rate(self._sent, self._sent_ns - self._begun_ns)
            lines.append(f"sent {self._sent:,} {self._load.type} of {self._size()}{_at(rate)}")
            facts = {"sent": self._sent, "sent_hz": rate}
        lost = self._to_hear - len(set(self._heard))
        swapped = sum(after <= before for before, after in zip(self._heard, self._heard[1:], strict=False))
        if self._to_hear:
            rate = _rate(len(self._heard), self._last_ns - self._first_ns)
            lines.append(
                f"received {len(self._heard):,} of {self._to_hear:,}{_at(rate)}: "
                f"{lost:,} lost, {swapped:,} out of order, {self._changed:,} changed"
            )
            facts |= {"received": len(self._heard), "lost": lost, "out_of_order": swapped, "changed": self._changed}
            facts["received_hz"] = rate
        if self._latencies:
            ordered = sorted(self._latencies)
            middle, late = ordered[len(ordered) // 2], ordered[(99 * (len(ordered) - 1)) // 100]
            ms = {"median": middle / NS_PER_MS, "p99": late / NS_PER_MS, "max": ordered[-1] / NS_PER_MS}
            lines.append(
                f"on its way {ms['median']:.2f} ms (median), {ms['p99']:.2f} (99 %), {ms['max']:.2f} (longest)"
            )
            facts["latency_ms"] = {name: round(value, 4) for name, value in ms.items()}
        return ActorReport(self.done and not (lost or swapped or self._changed), tuple(lines), facts)

    def _size(self) -> str:
        length = self._load.length
        if self._load.type == "IMAGE":
            return f"{length} x {length * 3 // 4} pixels"
        return {"TRANSFORM": "one pose", "STRING": f"{length:,} bytes"}.get(self._load.type, f"{length:,} points")


class TestServer(_Tester):
    """The OpenIGTLink side: the paper's IGTL Test Server; it listens or connects as its driver wants."""

    __test__ = False  # for pytest: this is no test
    name = "test_server"
    side = ActorProtocol.IGTL
    subscribes: dict[str, str] = {}  # noqa: RUF012  # as an actor's attributes are
    publishes: dict[str, Publishes] = {}  # noqa: RUF012

    def _message(self, number: int, now_ns: int) -> Sent:
        content = self._form.igtl(number, self._load.length, now_ns)
        return Message(self._load.type, IGTL_NAME, content, ns_to_ticks(now_ns))

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        if isinstance(received, Message) and (received.type, received.device_name) == (self._load.type, ROS_NAME):
            self._take(now_ns, self._form.of_igtl(received, self._load.length))
        return ()


class TestNode(_Tester):
    """The ROS side: the paper's ROS Test Node."""

    __test__ = False
    name = "test_node"
    side = ActorProtocol.ROS

    def __init__(self, load: Load, to_send: int, to_hear: int) -> None:
        super().__init__(load, to_send, to_hear)
        self.subscribes = {self._form.to_ros_topic: self._form.ros_type} if to_hear else {}
        self.publishes = {self._form.sends: Publishes(self._form.ros_type)} if to_send else {}

    def _message(self, number: int, now_ns: int) -> Sent:
        return RosSent(self._form.sends, self._form.ros(number, self._load.length, now_ns))

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        if isinstance(received, RosReceived) and received.topic == self._form.to_ros_topic:
            self._take(now_ns, self._form.of_ros(received.cdr, self._load.length))
        return ()


def _rate(count: int, span_ns: int) -> float:
    """Messages per second; 0 if unknown."""
    return round((count - 1) * NS_PER_S / span_ns, 3) if count > 1 and span_ns > 0 else 0.0


def _at(rate: float) -> str:
    return f" at {rate:.1f}/s" if rate else ""


# -- the forms ------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def _cloud(length: int) -> Array:
    """Points in millimetres; the first one is replaced by the number."""
    return rounded(Noise(_SEED, 1).uniform(length, 3) * 200 - 100, 0.125)


@lru_cache(maxsize=2)
def _pixels(width: int) -> bytes:
    return (Noise(_SEED, 2).uniform(width * (width * 3 // 4) * 3) * 256).astype(np.uint8).tobytes()


def _numbered(length: int, number: int) -> Array:
    points = _cloud(length).copy()
    points[0] = (number, 0.0, 0.0)
    return points


def _header(now_ns: int) -> Header:
    return Header(now_ns, "test")


def _text(number: int, length: int, now_ns: int) -> str:
    return f"{number:09d} {now_ns:019d} " + "x" * (length - _HEAD)


def _of_text(text: str, length: int) -> _TestMessage:
    if len(text) != length or not (text[:9] + text[_STAMP]).isdigit():
        return _TestMessage(-1, 0, False)
    number, sent_ns = int(text[:9]), int(text[_STAMP])
    return _TestMessage(number, sent_ns, text == _text(number, length, sent_ns))


def _ros_pose(number: int, _length: int, now_ns: int) -> TransformStamped:
    return TransformStamped(_header(now_ns), ROS_NAME, (number / 1000, 0.25, -0.5), (0.0, 0.0, 0.6, 0.8))


def _of_ros_pose(cdr: bytes, _length: int) -> _TestMessage:
    pose = TransformStamped.unpack(cdr)
    x, y, z = (1000 * value for value in pose.translation)
    return _TestMessage(round(x), pose.header.stamp_ns, max(abs(y - 250), abs(z + 500)) < _TOLERANCE_MM)


def _igtl_pose(number: int, _length: int, _now_ns: int) -> Transform:
    return Transform((0.28, 0.96, 0.0, -0.96, 0.28, 0.0, 0.0, 0.0, 1.0, float(number), 250.0, -500.0))


def _of_igtl_pose(message: Message, _length: int) -> _TestMessage:
    content = message.content
    assert isinstance(content, Transform)
    x, y, z = content.wire_matrix[9:]
    return _TestMessage(round(x), ticks_to_ns(message.ticks), max(abs(y - 250), abs(z + 500)) < _TOLERANCE_MM)


def _ros_cloud(number: int, length: int, now_ns: int) -> PointCloud2:
    data = (_numbered(length, number) / 1000).astype("<f4").tobytes()
    return PointCloud2(_header(now_ns), 1, length, _XYZ, False, 12, 12 * length, data, True)


def _of_points(points: Array, sent_ns: int, length: int) -> _TestMessage:
    if len(points) != length:
        return _TestMessage(-1, sent_ns, False)
    intact = np.abs(points[1:] - _cloud(length)[1:]).max(initial=0.0) < _TOLERANCE_MM
    return _TestMessage(round(float(points[0, 0])), sent_ns, bool(intact))


def _of_ros_cloud(cdr: bytes, length: int) -> _TestMessage:
    cloud = PointCloud2.unpack(cdr)
    at = {one.name: one.offset for one in cloud.fields}
    rows = np.dtype({"names": list("xyz"), "formats": ["<f4"] * 3, "offsets": [at[axis] for axis in "xyz"],
                     "itemsize": cloud.point_step})  # fmt: skip
    found = np.frombuffer(cloud.data, rows)
    points = np.stack([found[axis].astype(np.float64) for axis in "xyz"], axis=1) * 1000
    return _of_points(points, cloud.header.stamp_ns, length)


def _igtl_polydata(number: int, length: int, _now_ns: int) -> PolyData:
    points = _numbered(length, number).astype(">f4")
    return PolyData(points, Cells.of(np.arange(length).reshape(-1, 1)))


def _of_igtl_polydata(message: Message, length: int) -> _TestMessage:
    content = message.content
    assert isinstance(content, PolyData)
    points = np.asarray(content.points, np.float64).reshape(-1, 3)
    return _of_points(points, ticks_to_ns(message.ticks), length)


def _of_igtl_points(message: Message, length: int) -> _TestMessage:
    content = message.content
    assert isinstance(content, Points)
    points = np.asarray(content.elements["position"], np.float64).reshape(-1, 3)
    return _of_points(points, ticks_to_ns(message.ticks), length)


def _picture(number: int, width: int) -> bytes:
    return number.to_bytes(4, "little") + _pixels(width)[4:]


def _ros_image(number: int, width: int, now_ns: int) -> Image:
    return Image(_header(now_ns), width * 3 // 4, width, "rgb8", 0, 3 * width, _picture(number, width))


def _of_pixels(data: bytes, sent_ns: int, width: int) -> _TestMessage:
    wanted = _pixels(width)
    intact = len(data) == len(wanted) and data[-_TAIL:] == wanted[-_TAIL:]
    return _TestMessage(int.from_bytes(data[:4], "little"), sent_ns, intact)


def _of_ros_image(cdr: bytes, width: int) -> _TestMessage:
    image = Image.unpack(cdr)
    return _of_pixels(bytes(image.data), image.header.stamp_ns, width)


def _igtl_image(number: int, width: int, _now_ns: int) -> WireImage:
    return WireImage((width, width * 3 // 4, 1), 3, _picture(number, width), 3)


def _of_igtl_image(message: Message, width: int) -> _TestMessage:
    content = message.content
    assert isinstance(content, WireImage)
    return _of_pixels(bytes(content.pixels), ticks_to_ns(message.ticks), width)


def _of_igtl_text(message: Message, length: int) -> _TestMessage:
    content = message.content
    assert isinstance(content, WireString)
    return _of_text(content.text, length)


_FORMS = {
    "TRANSFORM": _Form("transform", TransformStamped.TYPE, _ros_pose, _igtl_pose, _of_ros_pose, _of_igtl_pose),
    "STRING": _Form(
        "string",
        String.TYPE,
        lambda number, length, now_ns: String(_text(number, length, now_ns)),
        lambda number, length, now_ns: WireString.of(_text(number, length, now_ns)),
        lambda cdr, length: _of_text(String.unpack(cdr).data, length),
        _of_igtl_text,
    ),
    "POINT": _Form(
        "points",
        PointCloud2.TYPE,
        _ros_cloud,
        lambda number, length, _now_ns: Points.of(_numbered(length, number), None, 1.0),
        _of_ros_cloud,
        _of_igtl_points,
    ),
    "POLYDATA": _Form("points", PointCloud2.TYPE, _ros_cloud, _igtl_polydata, _of_ros_cloud, _of_igtl_polydata),
    "IMAGE": _Form("image", Image.TYPE, _ros_image, _igtl_image, _of_ros_image, _of_igtl_image),
}

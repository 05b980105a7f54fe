"""Who sends what and when: the plan of a world, and its messages with their times.

True time is that of the world.  Each sender has a clock of its own, which its stamps show; each recorder has one, which
the times of receipt show.  ``Sent.true_ns`` is the moment at which a value was true.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from tools.truth import wire, world
from tools.truth.world import BEGIN_NS

MS = 10**6
_STORE = get_typestore(Stores.ROS2_JAZZY)
_T: Any = _STORE.types
_JOINTS = 3


@dataclass
class Sender:
    """A program that sends.

    Attributes:
        name: of it.
        link: of a peer; 0: a node of ROS.
        recorder: that receives it, 0 or 1 in a world of two.
        offset_ns, drift_ppm: its clock minus true time.
        stamped: whether its messages have stamps.
        stamp_jitter_ns: most that a stamp is away from the moment of the value.
        delay_ns, jitter_ns: from the moment to the receipt.
        version, crc: of the header of OpenIGTLink.
    """

    name: str
    link: int = 0
    recorder: int = 0
    offset_ns: int = 0
    drift_ppm: float = 0.0
    stamped: bool = True
    stamp_jitter_ns: int = 0
    delay_ns: int = 2 * MS
    jitter_ns: int = 0
    version: int = 1
    crc: bool = True

    def shows(self, true_ns: int) -> int:
        """What its clock shows, UTC ns."""
        return BEGIN_NS + true_ns + self.offset_ns + round(self.drift_ppm * 1e-6 * true_ns)


@dataclass
class Stream:
    """What a sender repeats.

    Attributes:
        key: as the product names it: TYPE/device or topic.
        kind: a row of ``_BODIES``.
        sender: who sends it.
        things: of the values; several in TDATA, tf and joints.
        names: of the things in the message, or of the frames.
        rate: per second.
        start, end: first and last moment, s.
        gaps: moments without message, s.
        extra_ns: delay beside that of the sender.
        rank: order within a frame.
        permuted: whether the names come in another order in each message.
    """

    key: str
    kind: str
    sender: Sender
    things: tuple[int, ...] = (0,)
    names: tuple[str, ...] = ()
    rate: float = 50.0
    start: float = 0.0
    end: float = 1e9
    gaps: list[tuple[float, float]] = field(default_factory=list)
    extra_ns: int = 0
    rank: int = 0
    permuted: bool = False

    @property
    def is_ros(self) -> bool:
        return self.key.startswith("/")

    def moments(self, seconds: float) -> Iterator[float]:
        """When its values are true, s."""
        for number in range(1 if self.rate == 0 else int(seconds * self.rate)):
            at = self.start if self.rate == 0 else number / self.rate
            if self.start <= at <= self.end and not any(low <= at < high for low, high in self.gaps):
                yield at


@dataclass(frozen=True)
class Sent:
    """One message: the moment of its value, its stamp (UTC ns, 0 = unset) and its receipt (true ns)."""

    stream: Stream
    true_ns: int
    stamp_ns: int
    receipt_ns: int
    data: bytes


@dataclass
class Plan:
    """All that a world is.

    Attributes:
        seed: of its chances.
        seconds: duration.
        senders, streams: who sends what.
        recorder_offset_ns: clock of the second recorder minus true time; the first one has true time.
        files: verbs that change the file, in their order.
        config: settings of the session.
    """

    seed: int
    seconds: float
    senders: list[Sender]
    streams: list[Stream]
    recorder_offset_ns: int = 0
    files: list[str] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    conditions: tuple[str, ...] = ()

    def stream(self, key: str) -> Stream | None:
        return next((one for one in self.streams if one.key == key), None)

    def messages(self) -> list[Sent]:
        """All messages in the order of their receipt."""
        found = []
        for number, stream in enumerate(self.streams):
            chance = random.Random(f"{self.seed} {number} {stream.kind}")
            sender, last_ns = stream.sender, 0
            for at in stream.moments(self.seconds):
                true_ns = round(at * 1e9)
                stamp_ns = 0
                if sender.stamped:
                    stamp_ns = sender.shows(true_ns) + chance.randint(-sender.stamp_jitter_ns, sender.stamp_jitter_ns)
                delay_ns = sender.delay_ns + stream.extra_ns + stream.rank * 20_000
                receipt_ns = true_ns + delay_ns + chance.randint(0, sender.jitter_ns)
                last_ns = receipt_ns = max(receipt_ns, last_ns + 1000)  # one connection keeps the order
                data = _BODIES[stream.kind](stream, true_ns, stamp_ns, chance)
                found.append(Sent(stream, true_ns, stamp_ns, receipt_ns, data))
        return sorted(found, key=lambda one: one.receipt_ns)


def _peer(kind: str, stream: Stream, stamp_ns: int, body: bytes) -> bytes:
    sender = stream.sender
    return wire.message(kind, stream.key.partition("/")[2], body, stamp_ns, sender.version, crc=sender.crc)


def _ros(message: Any) -> bytes:
    return bytes(_STORE.serialize_cdr(message, message.__msgtype__))


def _header(stamp_ns: int, frame: str) -> Any:
    stamp = _T["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return _T["std_msgs/msg/Header"](stamp, frame)


def _order(stream: Stream, chance: random.Random) -> list[int]:
    order = list(range(len(stream.things)))
    if stream.permuted:
        chance.shuffle(order)
    return order


def _transform(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    return _peer("TRANSFORM", stream, stamp_ns, wire.transform(world.pose(stream.things[0], true_ns / 1e9)))


def _image(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    return _peer("IMAGE", stream, stamp_ns, wire.image(world.picture(stream.things[0], true_ns)))


def _tracking(stream: Stream, true_ns: int, stamp_ns: int, chance: random.Random) -> bytes:
    order = _order(stream, chance)
    tools = {stream.names[one]: world.pose(stream.things[one], true_ns / 1e9) for one in order}
    return _peer("TDATA", stream, stamp_ns, wire.tracking(tools))


def _text(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    return _peer("STRING", stream, stamp_ns, wire.text(f"at {true_ns // MS} ms"))


def _plan(stream: Stream, true_ns: int, stamp_ns: int, chance: random.Random) -> bytes:
    names = list(world.PLAN)
    if stream.permuted:
        chance.shuffle(names)
    return _peer("POINT", stream, stamp_ns, wire.points({name: world.PLAN[name] for name in names}))


def _surface(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    return _peer("POLYDATA", stream, stamp_ns, wire.surface(world.cloud(stream.things[0], true_ns / 1e9)))


def _geometry(thing: int, at: float) -> tuple[Any, Any]:
    place, turn = world.position(thing, at) / 1000, world.quaternion(thing, at)
    return place.tolist(), _T["geometry_msgs/msg/Quaternion"](*map(float, turn))


def _posed(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    place, turn = _geometry(stream.things[0], true_ns / 1e9)
    found = _T["geometry_msgs/msg/Pose"](_T["geometry_msgs/msg/Point"](*place), turn)
    return _ros(_T["geometry_msgs/msg/PoseStamped"](_header(stamp_ns, "base"), found))


def _edge(parent: str, child: str, place: Any, turn: Any, stamp_ns: int) -> Any:
    found = _T["geometry_msgs/msg/Transform"](_T["geometry_msgs/msg/Vector3"](*place), turn)
    return _T["geometry_msgs/msg/TransformStamped"](_header(stamp_ns, parent), child, found)


def _tf(stream: Stream, true_ns: int, stamp_ns: int, chance: random.Random) -> bytes:
    edges = [
        _edge("base", stream.names[one], *_geometry(stream.things[one], true_ns / 1e9), stamp_ns)
        for one in _order(stream, chance)
    ]
    return _ros(_T["tf2_msgs/msg/TFMessage"](edges))


def _tf_static(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    place = [each / 1000 for each in world.CAMERA_IN_BASE]
    turn = _T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    return _ros(_T["tf2_msgs/msg/TFMessage"]([_edge("base", "camera", place, turn, stamp_ns)]))


def _joints(stream: Stream, true_ns: int, stamp_ns: int, chance: random.Random) -> bytes:
    arm = stream.things[0]
    order = list(range(_JOINTS))
    if stream.permuted:
        chance.shuffle(order)
    angles = world.joints(arm, _JOINTS, true_ns / 1e9)
    none = np.zeros(0)
    names = [f"arm{arm}_joint{one}" for one in order]
    return _ros(_T["sensor_msgs/msg/JointState"](_header(stamp_ns, ""), names, angles[order], none, none))


def _ros_image(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    pixels = world.picture(stream.things[0], true_ns)
    rows, columns = pixels.shape
    header = _header(stamp_ns, "camera")
    return _ros(_T["sensor_msgs/msg/Image"](header, rows, columns, "mono8", 0, columns, pixels.ravel()))


def _depth(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
    pixels = world.depth(true_ns / 1e9)
    rows, columns = pixels.shape
    data = pixels.astype("<u2").view(np.uint8).ravel()
    return _ros(_T["sensor_msgs/msg/Image"](_header(stamp_ns, "camera"), rows, columns, "16UC1", 0, 2 * columns, data))


def _cloud(stream: Stream, true_ns: int, stamp_ns: int, chance: random.Random) -> bytes:
    names = ["x", "y", "z", "number"]
    if stream.permuted:
        chance.shuffle(names)
    values = np.zeros(world.POINTS, [(name, "<f4") for name in names])
    found = world.cloud(stream.things[0], true_ns / 1e9) / 1000
    for axis, name in enumerate("xyz"):
        values[name] = found[:, axis]
    values["number"] = np.arange(world.POINTS)
    fields = [_T["sensor_msgs/msg/PointField"](name, 4 * at, 7, 1) for at, name in enumerate(names)]
    data = values.view(np.uint8).ravel()
    size = len(values)
    message = _T["sensor_msgs/msg/PointCloud2"]
    return _ros(message(_header(stamp_ns, "camera"), 1, size, fields, False, 16, 16 * size, data, True))


#: Kind of a stream → its message at a moment.
_BODIES = {
    "transform": _transform,
    "image": _image,
    "tdata": _tracking,
    "string": _text,
    "point": _plan,
    "polydata": _surface,
    "pose": _posed,
    "tf": _tf,
    "tf_static": _tf_static,
    "joints": _joints,
    "ros_image": _ros_image,
    "depth": _depth,
    "cloud": _cloud,
}

#: Kind → ROS type.
ROS_TYPES = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "tf": "tf2_msgs/msg/TFMessage",
    "tf_static": "tf2_msgs/msg/TFMessage",
    "joints": "sensor_msgs/msg/JointState",
    "ros_image": "sensor_msgs/msg/Image",
    "depth": "sensor_msgs/msg/Image",
    "cloud": "sensor_msgs/msg/PointCloud2",
}


@cache
def kinds() -> tuple[str, ...]:
    """All kinds of streams."""
    return tuple(_BODIES)

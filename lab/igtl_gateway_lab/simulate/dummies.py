"""The ROS-IGTL-Test node of the paper, and a server that is its mirror image.

In every round each of the two sends a random transform, a point, a cloud of 20 points, a string and a poly data
model, and each shows what it receives.  The random numbers follow from the round; so each knows what the other one
must have sent, and how far off it arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert.rosmsg import Header, Mesh, PointCloud2, PointField, PointStamped, String, TransformStamped
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
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
from igtl_gateway_lab.simulate.star_numbers import Array, Noise, rounded

ROUNDS = 4
CLOUD_POINTS = 20
_ROUND_NS = NS_PER_S // 2
_SILENCE_NS = 3 * NS_PER_S
_TOLERANCE_MM = 0.001  # 32-bit floats of some hundred millimetres
_AXIS_MM = 100.0  # a turn counts by what it moves so far from the origin
_STEP_MM = 0.01  # what is sent is rounded to it
_XYZ = tuple(PointField(name, 4 * axis, 7) for axis, name in enumerate("xyz"))

#: What is sent in each round, in this order.
KINDS = ("Transform", "Point", "Cloud", "String", "Model")
_ROS_KINDS = {
    "Transform": ("transform", TransformStamped.TYPE),
    "Point": ("point", PointStamped.TYPE),
    "Cloud": ("points", PointCloud2.TYPE),
    "String": ("string", String.TYPE),
    "Model": ("mesh", Mesh.TYPE),
}
_WIRE_TYPES = {"Transform": "TRANSFORM", "Point": "POINT", "Cloud": "POINT", "String": "STRING", "Model": "POLYDATA"}
_NODE, _SERVER = "Node", "Server"

#: The cloud goes out as POINT, as the paper's does.
CONFIG = Config(to_igtl=(ToIgtlRow(topic=f"/igtl/out/{_NODE}Cloud/points", device=f"{_NODE}Cloud", type="POINT"),))


def actors(duration_s: float | None = None) -> tuple[Actor, ...]:
    """The server and the node; as many rounds as fit into the time."""
    rounds = ROUNDS if duration_s is None else max(1, math.ceil(duration_s * NS_PER_S / _ROUND_NS))
    return DummyServer(rounds), DummyNode(rounds)


@dataclass(frozen=True, slots=True)
class Dummies:
    """What one of the two sends in a round.

    Attributes:
        place: of the transform, in millimetres.
        quaternion: x, y, z, w of the same.
        point: millimetres.
        cloud: (20, 3) millimetres.
        text: for people.
        model: corners (n, 3) in millimetres; the triangles are always the same.
    """

    place: Array
    quaternion: Array
    point: Array
    cloud: Array
    text: str
    model: Array

    @classmethod
    def of(cls, sender: str, number: int) -> Dummies:
        """The same for the same sender and round, everywhere."""
        noise = Noise(41, len(sender), number)
        place = rounded(noise.uniform(2, 3) * 600 - 300, _STEP_MM)
        turn = noise.uniform(4) - 0.5
        turn[3] += 1.0  # never zero
        length = math.sqrt(sum(float(value) * float(value) for value in turn))
        cloud = rounded(noise.uniform(CLOUD_POINTS, 3) * 100 - 50, _STEP_MM)
        radius = 20.0 + rounded(noise.uniform(1), _STEP_MM)[0] * 20
        text = f"round {number + 1} of the {sender.lower()}: Grüße"
        return cls(place[0], turn / length, place[1], cloud, text, rounded(_SPHERE * radius, _STEP_MM))

    @property
    def columns(self) -> tuple[float, ...]:
        """The transform's rotation, column by column."""
        return _columns(*(float(value) for value in self.quaternion))

    def off_mm(self, kind: str, found: Array | str) -> float:
        """How far what arrived is from what was sent, in millimetres; infinite where it is something else."""
        wanted: Array | str
        match kind:
            case "Transform":
                wanted = _frame(self.place, self.columns)
            case "String":
                wanted = self.text
            case _:
                wanted = getattr(self, kind.lower())
        if isinstance(wanted, str) or isinstance(found, str):
            return 0.0 if isinstance(found, str) and found == wanted else math.inf
        if np.shape(found) != np.shape(wanted):
            return math.inf
        return float(np.abs(found - wanted).max())


def _sphere() -> tuple[Array, np.ndarray[tuple[int, int], np.dtype[np.uint32]]]:
    """Corners of a sphere of radius 1 and its triangles: an octahedron, each of whose faces is cut into four."""
    corners = [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    middles: dict[tuple[int, int], int] = {}

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in middles:
            middles[key] = len(corners)
            x, y, z = (p + q for p, q in zip(corners[a], corners[b], strict=True))
            length = math.sqrt(x * x + y * y + z * z)
            corners.append((x / length, y / length, z / length))
        return middles[key]

    for _ in range(2):
        cut = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            cut += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = cut
    return np.array(corners), np.array(faces, np.uint32)


_SPHERE, TRIANGLES = _sphere()


class _Dummy:
    """What both have in common: rounds of sending, and the account of what came."""

    side: ActorProtocol
    sends = receives = ""  #: how its own devices begin, and the other's

    def __init__(self, rounds: int) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self._rounds = rounds
        self._begun_ns = self._last_ns = 0
        self._number = 0
        self._gave_up = False
        self._counts = dict.fromkeys(KINDS, 0)
        self._worst = dict.fromkeys(KINDS, 0.0)
        self._shown = dict.fromkeys(KINDS, "")

    def begin(self, now_ns: int) -> None:
        self._begun_ns = self._last_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        if self._number < self._rounds:
            return self._begun_ns + self._number * _ROUND_NS
        return None if self.done else self._last_ns + _SILENCE_NS

    @property
    def done(self) -> bool:
        complete = all(count >= self._rounds for count in self._counts.values())
        return self._number == self._rounds and (complete or self._gave_up)

    def act(self, now_ns: int) -> Iterable[Sent]:
        if self._number == self._rounds:
            self._gave_up = True
            return []
        dummies = Dummies.of(self.sends, self._number)
        self._number += 1
        self._last_ns = now_ns
        return [self._message(kind, dummies, now_ns) for kind in KINDS]

    def _message(self, kind: str, dummies: Dummies, now_ns: int) -> Sent:
        raise NotImplementedError

    def _take(self, now_ns: int, kind: str, found: Array | str) -> None:
        number = self._counts[kind]
        off_mm = Dummies.of(self.receives, number).off_mm(kind, found)
        self._last_ns = now_ns
        self._counts[kind] += 1
        self._worst[kind] = max(self._worst[kind], off_mm)
        self._shown[kind] = _shown(kind, found)

    def report(self) -> ActorReport:
        lines = [f"sent {self._number} rounds of {', '.join(_WIRE_TYPES[kind] for kind in KINDS)}"]
        for kind in KINDS:
            lines.append(
                f"{_WIRE_TYPES[kind]:<10} {self.receives + kind:<16} {self._counts[kind]:>3}  {self._summary(kind)}"
            )
        complete = all(count == self._rounds for count in self._counts.values())
        worst = max(self._worst.values())
        facts = {
            "rounds": self._number,
            "received": {self.receives + kind: count for kind, count in self._counts.items()},
            "worst_mm": round(worst, 6) if math.isfinite(worst) else None,
        }
        return ActorReport(complete and worst <= _TOLERANCE_MM, tuple(lines), facts)

    def _summary(self, kind: str) -> str:
        if not self._counts[kind]:
            return "nothing came"
        off_mm = self._worst[kind]
        if math.isinf(off_mm):
            return f"{self._shown[kind]}, not what was expected"
        return self._shown[kind] if kind == "String" else f"{self._shown[kind]}, at most {off_mm:.5f} mm off"


def _shown(kind: str, found: Array | str) -> str:
    if isinstance(found, str):
        return f"{found!r}"
    if kind in ("Transform", "Point"):
        place = found.reshape(-1, 3)[0]
        return f"at ({', '.join(f'{value:.2f}' for value in place)}) mm"
    low, high = found.min(axis=0), found.max(axis=0)
    return f"{len(found)} points in {' x '.join(f'{side:.1f}' for side in high - low)} mm"


class DummyNode(_Dummy):
    """The ROS side."""

    name = "test_node"
    side = ActorProtocol.ROS
    sends, receives = _NODE, _SERVER

    def __init__(self, rounds: int) -> None:
        super().__init__(rounds)
        for kind, (last, ros_type) in _ROS_KINDS.items():
            self.subscribes[f"/igtl/in/{_SERVER}{kind}/{last}"] = ros_type
            self.publishes[f"/igtl/out/{_NODE}{kind}/{last}"] = Publishes(ros_type)
        self._kinds = dict(zip(self.subscribes, _ROS_KINDS, strict=True))

    def _message(self, kind: str, dummies: Dummies, now_ns: int) -> Sent:
        topic = f"/igtl/out/{_NODE}{kind}/{_ROS_KINDS[kind][0]}"
        header = Header(now_ns, "test")
        match kind:
            case "Transform":
                x, y, z, w = (float(value) for value in dummies.quaternion)
                return RosSent(topic, TransformStamped(header, "dummy", _metres(dummies.place), (x, y, z, w)))
            case "Point":
                return RosSent(topic, PointStamped(header, _metres(dummies.point)))
            case "Cloud":
                count, data = len(dummies.cloud), (dummies.cloud / 1000).astype("<f4").tobytes()
                return RosSent(topic, PointCloud2(header, 1, count, _XYZ, False, 12, 12 * count, data, True))
            case "String":
                return RosSent(topic, String(dummies.text))
            case _:
                return RosSent(topic, Mesh(TRIANGLES, dummies.model / 1000))

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, RosReceived)
        kind = self._kinds[received.topic]
        self._take(now_ns, kind, _OF_ROS[kind](received.cdr))
        return ()


class DummyServer(_Dummy):
    """The OpenIGTLink side."""

    name = "test_server"
    side = ActorProtocol.IGTL
    sends, receives = _SERVER, _NODE

    def _message(self, kind: str, dummies: Dummies, now_ns: int) -> Sent:
        content = _WIRE[kind](dummies)
        return Message(_WIRE_TYPES[kind], _SERVER + kind, content, ns_to_ticks(now_ns))

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, Message)
        kind = received.device_name.removeprefix(_NODE)
        if kind in KINDS and received.type == _WIRE_TYPES[kind]:
            self._take(now_ns, kind, _of_wire(kind, received.content))
        return ()


def _metres(place: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) / 1000 for value in place)
    return x, y, z


def _millimetres(place: Iterable[float]) -> Array:
    return np.array([value * 1000 for value in place])


def _columns(x: float, y: float, z: float, w: float) -> tuple[float, ...]:
    """A rotation, column by column."""
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)),
        *(2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)),
        *(2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)),
    )


def _frame(place: Array, columns: Sequence[float]) -> Array:
    """A pose as points: its origin and the ends of its axes."""
    return np.vstack([place, place + _AXIS_MM * np.array(columns).reshape(3, 3)])


def _of_pose(cdr: bytes) -> Array:
    pose = TransformStamped.unpack(cdr)
    return _frame(_millimetres(pose.translation), _columns(*pose.rotation))


def _of_cloud(cdr: bytes) -> Array:
    cloud = PointCloud2.unpack(cdr)
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step)
    # x, y and z lead, whatever follows
    return np.ascontiguousarray(rows[:, :12]).view("<f4").astype(np.float64) * 1000


_OF_ROS: dict[str, Callable[[bytes], Array | str]] = {
    "Transform": _of_pose,
    "Point": lambda cdr: _millimetres(PointStamped.unpack(cdr).point),
    "Cloud": _of_cloud,
    "String": lambda cdr: String.unpack(cdr).data,
    "Model": lambda cdr: np.asarray(Mesh.unpack(cdr).vertices, np.float64) * 1000,
}


_WIRE: dict[str, Callable[[Dummies], Body]] = {
    "Transform": lambda dummies: Transform((*dummies.columns, *(float(value) for value in dummies.place))),
    "Point": lambda dummies: Points.of(dummies.point[None, :], None, 2.0),
    "Cloud": lambda dummies: Points.of(dummies.cloud, None, 1.0),
    "String": lambda dummies: WireString.of(dummies.text),
    "Model": lambda dummies: PolyData(dummies.model.astype(">f4"), polygons=Cells.of(TRIANGLES.astype(np.int64))),
}


def _of_wire(kind: str, content: object) -> Array | str:
    match content:
        case Transform():
            return _frame(np.array(content.wire_matrix[9:]), content.wire_matrix[:9])
        case Points():
            places = np.asarray(content.elements["position"], np.float64).reshape(-1, 3)
            return places[0] if kind == "Point" and len(places) == 1 else places
        case WireString():
            return content.text
        case PolyData():
            return np.asarray(content.points, np.float64).reshape(-1, 3)
    return ""

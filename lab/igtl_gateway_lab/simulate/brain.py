"""The scenario ``brain``: a large surface goes to ROS and comes back, and each side checks what arrived.

A planner on the OpenIGTLink side sends the surface of a brain as POLYDATA.  A node on the ROS side gets it as
shape_msgs/Mesh, compares it with the planner's description, and publishes its own copy, which the planner gets as
POLYDATA and compares with what it had sent.  Points are counted and summed (CRC-32) as the float32 millimetres that
they are on the wire, so *equal* means to the last bit.

The surface is that of the MR brain of Colin27 (Debian's ``mricron-data``) where this machine has it, else of a brain
made of formulae.  It is sent as an STL file has it, three points for each face, which gives the sizes of the
ROS-IGTL-Bridge paper: more than 600,000 points and 230,000 faces, three times there and back.  A session of less
than ``SMALL_BELOW_S`` seconds sends a small synthetic brain once: that is what recordings to keep are made of, the
same on every machine.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.base.versions import Self
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.rosmsg import Mesh
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.wire import Message
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.text import String
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
from igtl_gateway_lab.simulate.brain_surface import TriangleMesh, extract_surface, procedural_brain, resampled, smoothed
from igtl_gateway_lab.simulate.volume import BRAIN, find_volume, read_nifti_volume

SMALL_BELOW_S = 5.0  #: a session shorter than this is the small one
ROUNDS = 3

#: Grey value of ch2bet between brain and what surrounds it, and voxels from a point of its grid to the next: finer
#: ones give more faces than the paper's model has.
LEVEL, STEP = 40, 1.2
FINE_MM, SMALL_MM = 1.2, 3.5  #: voxels of the synthetic brain

_SURFACE, _CAPTION = "/igtl/in/BrainSurface/mesh", "/igtl/in/BrainCaption/string"
_MODEL, _VERDICT, _READY = "/brain/model", "/brain/verdict", "/brain/ready"
_AGAIN_NS = 500 * NS_PER_MS
_PAUSE_NS = 2 * NS_PER_S  # between rounds: 67 MB each, which a disk has to take that may be slow

CONFIG = Config(
    base_frame="RAS",
    # the marker that a surface also becomes would be as large again
    to_ros=(ToRosRow(device="BrainSurface", kinds=("mesh",)),),
    to_igtl=(
        ToIgtlRow(topic=_MODEL, device="BrainModel", type="POLYDATA"),
        ToIgtlRow(topic=_VERDICT, device="Verdict", type="STRING"),
        ToIgtlRow(topic=_READY, device="Ready", type="STRING"),
    ),
)


def actors(duration_s: float | None) -> tuple[Actor, ...]:
    """The planner and the node; see the module for what the duration decides."""
    if duration_s is not None and duration_s < SMALL_BELOW_S:
        return BrainPlanner(small_brain, 1), Model(1)
    return BrainPlanner(large_brain, ROUNDS), Model(ROUNDS)


def small_brain() -> tuple[TriangleMesh, str]:
    """The surface, in millimetres RAS, and where it comes from."""
    return procedural_brain(SMALL_MM).unwelded(), f"synthetic brain, {SMALL_MM:g} mm"


def large_brain() -> tuple[TriangleMesh, str]:
    """As ``small_brain``: of the MR volume where there is one.  Raises ConfigError where it cannot be read."""
    path = find_volume(BRAIN)
    if path is None:
        return procedural_brain(FINE_MM).unwelded(), f"synthetic brain, {FINE_MM:g} mm"
    volume = read_nifti_volume(path)
    field = resampled(smoothed(np.clip(volume.voxels, 0, 255).astype(np.uint8)), STEP)
    columns = STEP * volume.affine[:, [2, 1, 0]]  # the array's axes are k, j, i
    surface = extract_surface(field, 64.0 * LEVEL).placed(columns, volume.affine[:, 3])
    return surface.unwelded(), volume.source


@dataclass(frozen=True, slots=True)
class Sum:
    """What both sides compare: counts, and a sum of all points and faces as they are on the wire."""

    points: int
    faces: int
    crc32: int

    @classmethod
    def of(cls, points_mm: np.typing.NDArray[Any], faces: np.typing.NDArray[Any]) -> Self:
        crc = zlib.crc32(np.ascontiguousarray(points_mm, ">f4").data)
        return cls(len(points_mm), len(faces), zlib.crc32(np.ascontiguousarray(faces, ">u4").data, crc))

    def __str__(self) -> str:
        return f"{self.points:,} points, {self.faces:,} faces, CRC {self.crc32:08x}"


@dataclass(frozen=True, slots=True)
class Caption:
    """Metadata of a surface, as JSON in a string: its origin, its number, and when it was sent (UTC ns)."""

    sum: Sum
    round: int
    sent_ns: int
    equal: bool = True

    def pack(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def unpack(cls, text: str) -> Self:
        values = json.loads(text)
        return cls(**values | {"sum": Sum(**values["sum"])})


@dataclass(frozen=True, slots=True, eq=False)
class _Cargo:
    """What is sent, its sum, and where it comes from."""

    content: PolyData
    sum: Sum
    source: str


class BrainPlanner:
    """Sends a surface, and compares what comes back.

    Args:
        make: gives the surface (mm) and its source; called once, before the planner begins.
        rounds: how often it is sent.
    """

    name = "planner"
    side = ActorProtocol.IGTL
    subscribes: dict[str, str] = {}  # noqa: RUF012 - read only, as the protocol has it
    publishes: dict[str, Publishes] = {}  # noqa: RUF012

    def __init__(self, make: Callable[[], tuple[TriangleMesh, str]], rounds: int) -> None:
        self._make = make
        self._rounds = rounds
        self._due_ns: int | None = None
        self._sent_ns = 0
        self._round = 0
        self._verdict: Caption | None = None
        self._model: tuple[int, Sum] | None = None  # arrival, what it was
        self._equal = 0
        self._at_ros = 0
        self._to_igtl_s: list[float] = []
        self._both_s: list[float] = []

    @cached_property
    def _cargo(self) -> _Cargo:
        surface, source = self._make()
        content = PolyData(surface.points.astype(">f4"), polygons=Cells.of(surface.faces))
        return _Cargo(content, Sum.of(content.points, surface.faces), source)

    def prepare(self) -> None:
        """The surface takes a second or two."""
        _ = self._cargo

    def begin(self, now_ns: int) -> None:
        self.prepare()  # before anything is timed

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        """The next round."""
        return self._send(now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        match received:
            case Message(type="STRING", device_name="Ready") if self._round == 0:
                self._due_ns = now_ns
            case Message(type="STRING", device_name="Verdict", content=String() as text):
                self._verdict = Caption.unpack(text.text)
            case Message(type="POLYDATA", device_name="BrainModel", content=PolyData() as model):
                self._model = now_ns, Sum.of(model.points, model.polygons.data.reshape(-1, 4)[:, 1:])
        self._compare(now_ns)
        return ()

    def _send(self, now_ns: int) -> Iterable[Sent]:
        self._due_ns = None
        self._round += 1
        self._sent_ns = now_ns
        caption = String.of(Caption(self._cargo.sum, self._round, now_ns).pack())
        ticks = ns_to_ticks(now_ns)
        return (
            Message("STRING", "BrainCaption", caption, ticks),
            Message("POLYDATA", "BrainSurface", self._cargo.content, ticks),
        )

    def _compare(self, now_ns: int) -> None:
        """Once both have come: take them, and send the next one in a while."""
        if self._verdict is None or self._model is None:
            return
        arrived_ns, found = self._model
        self._equal += found == self._cargo.sum == self._verdict.sum
        self._at_ros += self._verdict.equal
        self._to_igtl_s.append((arrived_ns - self._verdict.sent_ns) / NS_PER_S)
        self._both_s.append((arrived_ns - self._sent_ns) / NS_PER_S)
        self._verdict = self._model = None
        if self._round < self._rounds:
            self._due_ns = now_ns + _PAUSE_NS

    @property
    def done(self) -> bool:
        return len(self._both_s) == self._rounds

    def report(self) -> ActorReport:
        if not self._round:
            return ActorReport(False, ("no node of ROS was ready",), {"sent": 0})
        cargo = self._cargo
        size = sum(memoryview(part).nbytes for part in cargo.content.pack())
        good = self._equal == self._at_ros == self._rounds
        return ActorReport(
            good,
            (
                f"{cargo.source}: {cargo.sum}, {size / 1e6:.1f} MB as POLYDATA",
                f"{self._round} sent, {self._at_ros} arrived at ROS and {self._equal} came back equal, bit by bit",
                f"ROS → OpenIGTLink {_seconds(self._to_igtl_s)}, there and back {_seconds(self._both_s)}",
            ),
            {
                "source": cargo.source,
                "points": cargo.sum.points,
                "faces": cargo.sum.faces,
                "polydata_bytes": size,
                "sent": self._round,
                "equal_at_ros": self._at_ros,
                "equal_back": self._equal,
                "to_igtl_s": self._to_igtl_s,
                "there_and_back_s": self._both_s,
            },
        )


class Model:
    """The node that has the surface on the ROS side, and gives it back ``rounds`` times."""

    name = "brain_model"
    side = ActorProtocol.ROS

    def __init__(self, rounds: int) -> None:
        self.subscribes = {_SURFACE: Mesh.TYPE, _CAPTION: RosString.TYPE}
        self.publishes = {
            _MODEL: Publishes(Mesh.TYPE, latched=True),
            _VERDICT: Publishes(RosString.TYPE),
            _READY: Publishes(RosString.TYPE),
        }
        self._rounds = rounds
        self._due_ns: int | None = None
        self._caption: Caption | None = None
        self._mesh: tuple[int, Mesh, int] | None = None  # arrival, what came, its bytes
        self._equal = 0
        self._size = 0
        self._last = ""
        self._to_ros_s: list[float] = []

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        """Report ready until the planner begins: a late joiner has not received the first report."""
        self._due_ns = now_ns + _AGAIN_NS
        return (RosSent(_READY, RosString("ready")),)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, RosReceived)
        self._due_ns = None
        if received.topic == _CAPTION:
            self._caption = Caption.unpack(RosString.unpack(received.cdr).data)
        else:
            self._mesh = now_ns, Mesh.unpack(received.cdr), len(received.cdr)
        if self._caption is None or self._mesh is None:
            return ()
        caption, (arrived_ns, mesh, self._size) = self._caption, self._mesh
        self._caption = self._mesh = None
        found = Sum.of(mesh.vertices * 1000, mesh.triangles)
        self._equal += found == caption.sum
        self._last = str(found)
        self._to_ros_s.append((arrived_ns - caption.sent_ns) / NS_PER_S)
        verdict = Caption(found, caption.round, now_ns, found == caption.sum)
        return RosSent(_VERDICT, RosString(verdict.pack())), RosSent(_MODEL, mesh)

    @property
    def done(self) -> bool:
        return len(self._to_ros_s) == self._rounds

    def report(self) -> ActorReport:
        if not self._to_ros_s:
            return ActorReport(False, ("no surface arrived",), {"received": 0})
        return ActorReport(
            self._equal == self._rounds,
            (
                f"{len(self._to_ros_s)} received, {self._equal} equal to the last bit: {self._last}, "
                f"{self._size / 1e6:.1f} MB as Mesh",
                f"OpenIGTLink → ROS {_seconds(self._to_ros_s)}",
            ),
            {
                "received": len(self._to_ros_s),
                "equal": self._equal,
                "mesh_bytes": self._size,
                "to_ros_s": self._to_ros_s,
            },
        )


def _seconds(times: list[float]) -> str:
    return " ".join(f"{seconds:.3f}" for seconds in times) + " s"

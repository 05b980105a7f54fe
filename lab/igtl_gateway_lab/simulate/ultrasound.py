"""The scenario ``ultrasound``: a tracked freehand sweep over a phantom of a forearm, and the structures found in it.

A scanner with a tracker, as PLUS is one, sends for each picture ``ProbeToTracker`` and ``ReferenceToTracker``
(TRANSFORM) and ``Image_Probe`` (IMAGE, whose matrix is the calibration), all with the stamp of the moment in which
the picture was taken.  For a while the reference is out of sight; then its transform is left out, as PLUS does.

A navigator on the ROS side asks for the sweep, pairs pictures and poses by their stamps, finds vessel and bone in the
pictures, and puts them together in the frame of the reference: it answers with the surfaces of both, which grow as
the sweep goes on, the place for a needle, and its status.  The scanner compares them with the phantom, whose truth
is known: only where calibration, poses, units, directions and pairing are all right do the slices stack up to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.base.versions import Self
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header, PointCloud2, PointField, TransformStamped
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.wire import Message
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import Status, String
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
from igtl_gateway_lab.simulate.registration import Rigid, rms
from igtl_gateway_lab.simulate.star_numbers import Array, dot, rounded
from igtl_gateway_lab.simulate.ultrasound_finder import bone, dark, middle, walls
from igtl_gateway_lab.simulate.ultrasound_phantom import HEIGHT, PIXEL_MM, WIDTH, bone_depth, phantom, vessels
from igtl_gateway_lab.simulate.ultrasound_probe import IMAGE_TO_PROBE, Hand, compose_rigid

DURATION_S = 12.0
FRAME_NS = 50 * NS_PER_MS
_DELAY_NS = 30 * NS_PER_MS  # from the moment that a picture shows to the moment that it is sent
_AGAIN_NS = 500 * NS_PER_MS
_PATIENCE_NS = NS_PER_S
_FEWEST = 10  # pictures of the shortest sweep
_IVORY, _RED = 0xF0E2BE, 0xD64242  # of bone and vessel
_FLOAT32 = 7  # sensor_msgs/PointField
_SHOWN_PICTURES = 20  # after this number of new images the navigator publishes its volume

#: While the sweep is in this part of its length, something is between tracker and reference.
_HIDDEN = (0.58, 0.63)
#: The needle is to meet the vessel at this part of the sweep; images that far away show its place, too.
_NEEDLE_PART, _NEEDLE_MM = 0.35, 1.5
#: What the answers may be off by.
GOOD_MM = 0.5
_GOOD_PAIRS = 0.9
_OK = 1  # code of STATUS
#: Key of a fact → the surface that comes back, and what it is of.
_SHAPES = {"bone": ("BoneSurface", "bone"), "wall": ("VesselWall", "wall of the vessel")}

_PICTURE = "/igtl/in/Image_Probe/volume"
_PROBE, _REFERENCE = "/igtl/in/ProbeToTracker/transform", "/igtl/in/ReferenceToTracker/transform"
_SWEEP = "/igtl/in/Sweep/string"
_REQUEST, _STATUS = "/ultrasound/request", "/ultrasound/status"
_NEEDLE, _BONE, _VESSEL = "/ultrasound/needle", "/ultrasound/bone", "/ultrasound/vessel"

CONFIG = Config(
    base_frame="Tracker",
    to_ros=(
        # a program that reads slowly gets three seconds of pictures all the same
        ToRosRow(device="Image_Probe", type="IMAGE", frame_id="Probe", qos=Qos(depth=60)),
    ),
    to_igtl=(
        ToIgtlRow(topic=_REQUEST, device="Request", type="STRING"),
        ToIgtlRow(topic=_NEEDLE, device="NeedleToReference", type="TRANSFORM"),
        ToIgtlRow(topic=_BONE, device="BoneSurface", type="POLYDATA"),
        ToIgtlRow(topic=_VESSEL, device="VesselWall", type="POLYDATA"),
        ToIgtlRow(topic=_STATUS, device="Navigator", type="STATUS"),
    ),
)


def actors(duration_s: float | None) -> tuple[Actor, ...]:
    """Scanner and navigator; the sweep is always as long in space, so a slow one has its pictures closer together."""
    seconds = DURATION_S if duration_s is None else duration_s
    return Scanner(max(round(seconds * NS_PER_S / FRAME_NS), _FEWEST)), Navigator()


class Scanner:
    """Sends a sweep of the given number of images on request, and judges the result."""

    name = "scanner"
    side = ActorProtocol.IGTL
    subscribes: dict[str, str] = {}  # noqa: RUF012 - read only, as the protocol has it
    publishes: dict[str, Publishes] = {}  # noqa: RUF012

    def __init__(self, pictures: int) -> None:
        self._count = pictures
        self._hidden = range(round(_HIDDEN[0] * pictures), round(_HIDDEN[1] * pictures))
        self._hand = Hand(pictures)
        self._start_ns = 0
        self._sent = 0
        self._due_ns: int | None = None
        self._needle_off: float | None = None
        self._needle_ticks = 0
        self._shapes: dict[str, _Shape] = {}
        self._status: Status | None = None

    def prepare(self) -> None:
        """The phantom takes a moment."""
        phantom()

    def begin(self, now_ns: int) -> None:
        pass  # it waits to be asked

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        """The next image; after the last one it repeats a final message until it gets an answer."""
        if self._sent == self._count:
            self._due_ns = now_ns + _AGAIN_NS
            return (Message("STRING", "Sweep", String.of(f"finished: {self._count} pictures"), ns_to_ticks(now_ns)),)
        shots = self._shot(self._sent)
        self._sent += 1
        self._due_ns = self._start_ns + self._sent * FRAME_NS + _DELAY_NS
        return shots

    def _shot(self, number: int) -> Iterable[Sent]:
        ticks = ns_to_ticks(self._start_ns + number * FRAME_NS)
        look = self._hand.moment(number)
        if number not in self._hidden:
            yield Message("TRANSFORM", "ReferenceToTracker", Transform.from_rows(look.reference_to_tracker.rows), ticks)
        yield Message("TRANSFORM", "ProbeToTracker", Transform.from_rows(look.probe_to_tracker.rows), ticks)
        place = look.image_to_reference
        across, down, beside = IMAGE_TO_PROBE.rotation.T * PIXEL_MM
        middle = IMAGE_TO_PROBE.apply(PIXEL_MM / 2 * np.array([WIDTH - 1.0, HEIGHT - 1.0, 0.0]))
        pixels = phantom().image(place.translation, PIXEL_MM * place.rotation[:, 0], PIXEL_MM * place.rotation[:, 1])
        matrix = tuple(float(value) for axis in (across, down, beside, middle) for value in axis)
        yield Message("IMAGE", "Image_Probe", Image((WIDTH, HEIGHT, 1), 3, pixels.data, wire_matrix=matrix), ticks)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        match received:
            case Message(type="STRING", device_name="Request") if self._due_ns is None and not self._sent:
                self._start_ns = now_ns
                self._due_ns = now_ns + _DELAY_NS
            case Message(type="TRANSFORM", device_name="NeedleToReference", content=Transform() as needle):
                self._needle_ticks = received.ticks
                place = np.array([needle.wire_matrix[9:]])
                self._needle_off = float(off_middle(place)[0])
            case Message(
                type="POLYDATA", device_name="BoneSurface" | "VesselWall" as name, content=PolyData() as shape
            ):
                off = (off_bone if name == "BoneSurface" else off_wall)(shape.points.astype(np.float64))
                self._shapes[name] = _Shape(received.ticks, len(off), rms(off) if len(off) else math.inf)
            case Message(type="STATUS", device_name="Navigator", content=Status() as status):
                self._status = status
        if self.done:
            self._due_ns = None
        return ()

    @property
    def done(self) -> bool:
        """Whether there is an answer, and its parts, which have one stamp, are here."""
        if self._status is None:
            return False
        last = {shape.ticks for shape in self._shapes.values()}
        return self._status.code != _OK or (len(self._shapes) == len(_SHAPES) and last == {self._needle_ticks})

    def report(self) -> ActorReport:
        lines = [
            f"sent {self._sent} pictures of {WIDTH} × {HEIGHT} in {self._sent * FRAME_NS / NS_PER_S:.1f} s, "
            f"{len(self._hidden)} while the reference was out of sight"
        ]
        facts: dict[str, Any] = {"pictures": self._sent, "hidden": len(self._hidden)}
        for key, (device, name) in _SHAPES.items():
            if shape := self._shapes.get(device):
                lines.append(f"{name}: {shape.points:,} points came back, {shape.rms_mm:.2f} mm rms off the phantom's")
                facts |= {f"{key}_points": shape.points, f"{key}_rms_mm": shape.rms_mm}
        if self._needle_off is not None:
            lines.append(f"needle: {self._needle_off:.2f} mm beside the middle of the vessel")
            facts["needle_off_mm"] = self._needle_off
        if self._status is not None:
            lines.append(f"status of the navigator: {self._status.message}")
        offs = [*(shape.rms_mm for shape in self._shapes.values()), self._needle_off]
        good = len(offs) > len(_SHAPES) and all(off is not None and off < GOOD_MM for off in offs)
        return ActorReport(good and self._sent == self._count, tuple(lines), facts)


@dataclass(frozen=True, slots=True)
class _Shape:
    """What came back of a surface: when (ticks), how many points, and how far off."""

    ticks: int
    points: int
    rms_mm: float


def off_bone(points: Array) -> Array:
    """Distances (mm) of points of the reference's frame from the bone's true surface, nearly."""
    u, v, w = points.T
    step = 0.01
    here = bone_depth(u, v)
    slope_u = (bone_depth(u + step, v) - here) / step
    slope_v = (bone_depth(u, v + step) - here) / step
    return np.asarray(np.abs(w - here) / np.sqrt(1 + slope_u * slope_u + slope_v * slope_v))


def off_wall(points: Array) -> Array:
    """The same for the wall of the vessel, or of its branch where that is nearer."""
    u, v, w = points.T
    off = [np.abs(np.sqrt((u - a) ** 2 + (w - b) ** 2) - radius) for a, b, radius in vessels(v)]
    return np.asarray(np.minimum(*off))


def off_middle(points: Array) -> Array:
    """The same for the middle line of the vessel before its branch."""
    u, v, w = points.T
    (a, b, _), _ = vessels(v)
    return np.asarray(np.sqrt((u - a) ** 2 + (w - b) ** 2))


@dataclass(frozen=True, slots=True)
class _PictureFindings:
    """What a picture shows, as (n, 3) places in millimetres: its middle, that of the vessel (or none), and surfaces."""

    middle: Array
    vessel: Array
    wall: Array
    bone: Array

    def placed(self, place: Rigid) -> Self:
        """The same in another frame."""
        return type(self)(*(place.apply(points) for points in (self.middle, self.vessel, self.wall, self.bone)))


class Navigator:
    """Asks for a sweep and finds its way in it."""

    name = "navigator"
    side = ActorProtocol.ROS

    def __init__(self) -> None:
        self.subscribes = {
            _PICTURE: Volume.TYPE,
            _PROBE: TransformStamped.TYPE,
            _REFERENCE: TransformStamped.TYPE,
            _SWEEP: RosString.TYPE,
        }
        self.publishes = {
            _REQUEST: Publishes(RosString.TYPE),
            _NEEDLE: Publishes(TransformStamped.TYPE, latched=True),
            _BONE: Publishes(PointCloud2.TYPE, latched=True),
            _VESSEL: Publishes(PointCloud2.TYPE, latched=True),
            _STATUS: Publishes(DiagnosticStatus.TYPE),
        }
        self._due_ns: int | None = None
        self._announced: int | None = None
        # all by stamp
        self._found: dict[int, _PictureFindings] = {}
        self._probe: dict[int, Rigid] = {}
        self._reference: dict[int, Rigid] = {}
        self._placed: dict[int, _PictureFindings] = {}  # in the frame of the reference
        self._answer: tuple[Sent, ...] = ()
        self._swept_mm = self._path_mm = 0.0
        self._bone_points = 0

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        """Asks until the sweep begins; once it is over, what has not come by now will not come."""
        if self._announced is not None:
            return self._answered(now_ns)
        self._due_ns = now_ns + _AGAIN_NS
        return (RosSent(_REQUEST, RosString("StartSweep")),)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        assert isinstance(received, RosReceived)
        if self._announced is None:
            self._due_ns = None  # the sweep is under way
        if received.topic == _SWEEP:
            return self._finished(now_ns, RosString.unpack(received.cdr).data)
        if received.topic == _PICTURE:
            picture = Volume.unpack(received.cdr)
            self._found[picture.header.stamp_ns] = _found_in(picture)
        else:
            pose = TransformStamped.unpack(received.cdr)
            poses = self._probe if received.topic == _PROBE else self._reference
            poses[pose.header.stamp_ns] = _rigid(pose)
        if self._complete and not self._answer:
            return self._answered(now_ns)
        return self._grown(now_ns) if self._pair() and len(self._placed) % _SHOWN_PICTURES == 0 else ()

    def _pair(self) -> bool:
        """Put the pictures in their places whose poses have come by now; whether there were any."""
        stamps = self._found.keys() & self._probe.keys() & self._reference.keys() - self._placed.keys()
        for stamp in sorted(stamps):
            place = compose_rigid(self._reference[stamp].inverse(), self._probe[stamp])
            self._placed[stamp] = self._found[stamp].placed(place)
        return bool(stamps)

    def _finished(self, now_ns: int, text: str) -> Iterable[Sent]:
        """The scanner reports the number of images, and repeats the report until it gets an answer."""
        word, _, rest = text.partition(":")
        if word != "finished":
            return ()
        if self._announced is None:
            self._announced = int(rest.split()[0])
            self._due_ns = now_ns + _PATIENCE_NS
        return self._answered(now_ns) if self._complete or self._answer else ()

    @property
    def _complete(self) -> bool:
        return self._announced is not None and len(self._found) >= self._announced

    def _answered(self, now_ns: int) -> tuple[Sent, ...]:
        self._due_ns = None
        self._answer = self._answer or tuple(self._stacked(now_ns))
        return self._answer

    def _stack(self) -> list[_PictureFindings]:
        """The slices in the order in which they were taken."""
        return [self._placed[stamp] for stamp in sorted(self._placed)]

    def _grown(self, now_ns: int) -> Iterable[Sent]:
        """The surfaces as far as they are known."""
        stack, header = self._stack(), Header(now_ns, "Reference")
        yield RosSent(_BONE, _cloud(header, np.concatenate([one.bone for one in stack]), _IVORY))
        yield RosSent(_VESSEL, _cloud(header, np.concatenate([one.wall for one in stack]), _RED))

    def _stacked(self, now_ns: int) -> Iterable[Sent]:
        """The slices in the frame of the reference, and what follows from them."""
        self._pair()
        stack = self._stack()
        target = _target(stack)
        self._bone_points = sum(len(one.bone) for one in stack)
        if target is None or not self._bone_points:
            yield RosSent(_STATUS, DiagnosticStatus(2, "Navigator", f"nothing found in {len(stack)} pictures"))
            return
        middles = np.concatenate([one.middle for one in stack])
        way = np.diff(middles, axis=0)
        self._path_mm = float(np.sqrt(dot(way, way)).sum())
        whole = middles[-1] - middles[0]
        self._swept_mm = math.sqrt(float(dot(whole, whole)))
        yield from self._grown(now_ns)
        x, y, z = (float(value) for value in rounded(target / 1000, 1e-6))
        # down into the arm, leaning by 40° along it
        header = Header(now_ns, "Reference")
        yield RosSent(_NEEDLE, TransformStamped(header, "Needle", (x, y, z), (0.342, 0.0, 0.0, 0.94)))
        summary = f"{len(stack)} of {len(self._found)} pictures have a pose; swept {self._swept_mm:.1f} mm"
        yield RosSent(_STATUS, DiagnosticStatus(0, "Navigator", summary))

    @property
    def done(self) -> bool:
        return bool(self._answer)

    def report(self) -> ActorReport:
        came, announced = len(self._found), self._announced
        lost = (announced or came) - came
        return ActorReport(
            bool(announced and self._bone_points and len(self._placed) >= _GOOD_PAIRS * announced),
            (
                f"received {came} pictures" + (f" of {announced}" if lost else ""),
                f"{len(self._placed)} paired with a pose by stamp, {came - len(self._placed)} without",
                f"swept {self._swept_mm:.1f} mm ({self._path_mm:.1f} mm along the hand's path), "
                f"{self._bone_points:,} points of bone",
            ),
            {
                "pictures": came,
                "announced": announced,
                "paired": len(self._placed),
                "swept_mm": round(self._swept_mm, 3),
                "path_mm": round(self._path_mm, 3),
                "bone_points": self._bone_points,
            },
        )


def _rigid(pose: TransformStamped) -> Rigid:
    """In millimetres."""
    return Rigid(np.array(rotation_matrix(pose.rotation)), np.array(pose.translation) * 1000)


def _found_in(picture: Volume) -> _PictureFindings:
    width, height, _ = picture.size
    grey = np.frombuffer(picture.data, np.uint8).reshape(height, width)
    across, down = np.array(picture.direction[:3]), np.array(picture.direction[3:6])
    step_x, step_y, _ = (1000 * step for step in picture.spacing)
    first = np.array(picture.origin) * 1000

    def placed(pixels: Array) -> Array:
        rows, columns = pixels[:, :1], pixels[:, 1:]
        return np.asarray(first + columns * (step_x * across) + rows * (step_y * down))

    blood = dark(grey)
    vessel_at = middle(blood)
    shown = ([((height - 1) / 2, (width - 1) / 2)], [vessel_at] if vessel_at else [], walls(blood), bone(grey))
    return _PictureFindings(*(placed(np.asarray(pixels, float).reshape(-1, 2)) for pixels in shown))


def _cloud(header: Header, points_mm: Array, colour: int) -> PointCloud2:
    data = np.empty((len(points_mm), 4), "<u4")
    data[:, :3] = rounded(points_mm / 1000, 1e-6).astype("<f4").view("<u4")
    data[:, 3] = colour
    fields = tuple(PointField(name, 4 * index, _FLOAT32) for index, name in enumerate(("x", "y", "z", "rgb")))
    return PointCloud2(header, 1, len(data), fields, False, 16, 16 * len(data), data.tobytes(), True)


def _target(stack: list[_PictureFindings]) -> Array | None:
    """Where the vessel is at a part of the sweep: the mean of the pictures there."""
    if not stack:
        return None
    here = stack[round(_NEEDLE_PART * (len(stack) - 1))].middle
    near = [one.vessel for one in stack if float(dot(one.middle - here, one.middle - here)[0]) <= _NEEDLE_MM**2]
    found = np.concatenate(near)
    return np.asarray(found.sum(axis=0) / len(found)) if len(found) else None

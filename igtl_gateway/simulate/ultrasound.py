"""The scenario ``ultrasound``: a tracked freehand sweep over a forearm that is none, and what is found in it.

A scanner with a tracker, as PLUS is one, sends for each picture ``ProbeToTracker`` and ``ReferenceToTracker``
(TRANSFORM) and ``Image_Probe`` (IMAGE, whose matrix is the calibration), all with the stamp of the moment in which
the picture was taken.  For a while the reference is out of sight; then its transform is left out, as PLUS does.

A navigator on the ROS side asks for the sweep, pairs pictures and poses by their stamps, finds vessel and bone in the
pictures, and puts them together in the frame of the reference: it answers with the surface of the bone, the place for
a needle, and its status.  The scanner holds both against the phantom, whose truth is known: only where calibration,
poses, units, directions and pairing are all right do the slices stack up to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from igtl_gateway.config import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.poses import matrix_of
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header, PointCloud2, PointField, TransformStamped
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.qos import Qos
from igtl_gateway.simulate.actor import Actor, Heard, Report, RosHeard, RosSaid, Said, Says, Side
from igtl_gateway.simulate.registration import Rigid, rms
from igtl_gateway.simulate.star_numbers import Array, dot, rounded
from igtl_gateway.simulate.ultrasound_finder import bone, lumen
from igtl_gateway.simulate.ultrasound_phantom import HEIGHT, PIXEL_MM, WIDTH, bone_depth, phantom, vessel
from igtl_gateway.simulate.ultrasound_probe import IMAGE_TO_PROBE, Hand, composed
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.wire import Message
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform

DURATION_S = 12.0
FRAME_NS = 50 * NS_PER_MS
_DELAY_NS = 30 * NS_PER_MS  # from the moment that a picture shows to the moment that it is sent
_AGAIN_NS = 500 * NS_PER_MS
_PATIENCE_NS = NS_PER_S
_FEWEST = 10  # pictures of the shortest sweep

#: While the sweep is in this part of its length, something is between tracker and reference.
_HIDDEN = (0.58, 0.63)
#: The needle is to meet the vessel at this part of the sweep; so far away pictures tell where that is, too.
_NEEDLE_PART, _NEEDLE_MM = 0.35, 1.5
#: What the answers may be off by.
GOOD_MM = 0.5
_GOOD_PAIRS = 0.9

_PICTURE = "/igtl/in/Image_Probe/volume"
_PROBE, _REFERENCE = "/igtl/in/ProbeToTracker/transform", "/igtl/in/ReferenceToTracker/transform"
_SWEEP = "/igtl/in/Sweep/string"
_REQUEST, _STATUS = "/ultrasound/request", "/ultrasound/status"
_NEEDLE, _BONE = "/ultrasound/needle", "/ultrasound/bone"

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
        ToIgtlRow(topic=_STATUS, device="Navigator", type="STATUS"),
    ),
)


def actors(duration_s: float | None) -> tuple[Actor, ...]:
    """Scanner and navigator; the sweep is always as long in space, so a slow one has its pictures closer together."""
    seconds = DURATION_S if duration_s is None else duration_s
    return Scanner(max(round(seconds * NS_PER_S / FRAME_NS), _FEWEST)), Navigator()


class Scanner:
    """Sends a sweep of so many pictures when it is asked to, and judges what is found in it."""

    name = "scanner"
    side = Side.IGTL
    hears: dict[str, str] = {}  # noqa: RUF012 - read only, as the protocol has it
    says: dict[str, Says] = {}  # noqa: RUF012

    def __init__(self, pictures: int) -> None:
        self._count = pictures
        self._hidden = range(round(_HIDDEN[0] * pictures), round(_HIDDEN[1] * pictures))
        self._hand = Hand(pictures)
        self._start_ns = 0
        self._sent = 0
        self._due_ns: int | None = None
        self._needle_off: float | None = None
        self._bone_off: float | None = None
        self._bone_points = 0
        self._status: Status | None = None

    def begin(self, now_ns: int) -> None:
        self._phantom = phantom()

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Said]:
        """The next picture; after the last one it says so until there is an answer."""
        if self._sent == self._count:
            self._due_ns = now_ns + _AGAIN_NS
            return (Message("STRING", "Sweep", String.of(f"finished: {self._count} pictures"), ns_to_ticks(now_ns)),)
        said = self._shot(self._sent)
        self._sent += 1
        self._due_ns = self._start_ns + self._sent * FRAME_NS + _DELAY_NS
        return said

    def _shot(self, number: int) -> Iterable[Said]:
        ticks = ns_to_ticks(self._start_ns + number * FRAME_NS)
        look = self._hand.look(number)
        if number not in self._hidden:
            yield Message("TRANSFORM", "ReferenceToTracker", Transform.from_rows(look.reference_to_tracker.rows), ticks)
        yield Message("TRANSFORM", "ProbeToTracker", Transform.from_rows(look.probe_to_tracker.rows), ticks)
        place = look.image_to_reference
        across, down, beside = IMAGE_TO_PROBE.rotation.T * PIXEL_MM
        middle = IMAGE_TO_PROBE.apply(PIXEL_MM / 2 * np.array([WIDTH - 1.0, HEIGHT - 1.0, 0.0]))
        pixels = self._phantom.image(
            place.translation, PIXEL_MM * place.rotation[:, 0], PIXEL_MM * place.rotation[:, 1]
        )
        matrix = tuple(float(value) for axis in (across, down, beside, middle) for value in axis)
        yield Message("IMAGE", "Image_Probe", Image((WIDTH, HEIGHT, 1), 3, pixels.data, wire_matrix=matrix), ticks)

    def hear(self, now_ns: int, heard: Heard) -> Iterable[Said]:
        match heard:
            case Message(type="STRING", device_name="Request") if self._due_ns is None and not self._sent:
                self._start_ns = now_ns
                self._due_ns = now_ns + _DELAY_NS
            case Message(type="TRANSFORM", device_name="NeedleToReference", content=Transform() as needle):
                u, v, w = needle.wire_matrix[9:]
                middle_u, middle_w, _ = vessel(np.array(v))
                self._needle_off = math.sqrt((u - float(middle_u)) ** 2 + (w - float(middle_w)) ** 2)
            case Message(type="POLYDATA", device_name="BoneSurface", content=PolyData() as surface):
                self._bone_points = len(surface.points)
                if self._bone_points:
                    self._bone_off = rms(_off_bone(surface.points.astype(np.float64)))
            case Message(type="STATUS", device_name="Navigator", content=Status() as status):
                self._status = status
        if self.done:
            self._due_ns = None
        return ()

    @property
    def done(self) -> bool:
        return self._status is not None and (
            self._status.code != 1 or (self._needle_off is not None and self._bone_off is not None)
        )

    def report(self) -> Report:
        lines = [
            f"sent {self._sent} pictures of {WIDTH} × {HEIGHT} in {self._sent * FRAME_NS / NS_PER_S:.1f} s, "
            f"{len(self._hidden)} while the reference was out of sight"
        ]
        if self._bone_off is not None:
            lines.append(f"bone: {self._bone_points:,} points came back, {self._bone_off:.2f} mm rms off the phantom's")
        if self._needle_off is not None:
            lines.append(f"needle: {self._needle_off:.2f} mm beside the middle of the vessel")
        if self._status is not None:
            lines.append(f"the navigator says: {self._status.message}")
        good = all(off is not None and off < GOOD_MM for off in (self._bone_off, self._needle_off))
        return Report(
            good and self._sent == self._count,
            tuple(lines),
            {
                "pictures": self._sent,
                "hidden": len(self._hidden),
                "bone_points": self._bone_points,
                "bone_rms_mm": self._bone_off,
                "needle_off_mm": self._needle_off,
            },
        )


def _off_bone(points: Array) -> Array:
    """Distances (mm) of points of the reference's frame from the true surface, nearly."""
    u, v, w = points.T
    step = 0.01
    here = bone_depth(u, v)
    slope_u = (bone_depth(u + step, v) - here) / step
    slope_v = (bone_depth(u, v + step) - here) / step
    return np.asarray(np.abs(w - here) / np.sqrt(1 + slope_u * slope_u + slope_v * slope_v))


@dataclass(frozen=True, slots=True)
class _Found:
    """What a picture shows, in the frame of the probe (mm): its middle, vessel (or None) and bone."""

    middle: Array
    vessel: Array | None
    bone: Array


class Navigator:
    """Asks for a sweep and finds its way in it."""

    name = "navigator"
    side = Side.ROS

    def __init__(self) -> None:
        self.hears = {
            _PICTURE: Volume.TYPE,
            _PROBE: TransformStamped.TYPE,
            _REFERENCE: TransformStamped.TYPE,
            _SWEEP: RosString.TYPE,
        }
        self.says = {
            _REQUEST: Says(RosString.TYPE),
            _NEEDLE: Says(TransformStamped.TYPE, latched=True),
            _BONE: Says(PointCloud2.TYPE, latched=True),
            _STATUS: Says(DiagnosticStatus.TYPE),
        }
        self._due_ns: int | None = None
        self._announced: int | None = None
        # all by stamp
        self._found: dict[int, _Found] = {}
        self._probe: dict[int, Rigid] = {}
        self._reference: dict[int, Rigid] = {}
        self._answer: tuple[Said, ...] = ()
        self._paired = 0
        self._swept_mm = self._path_mm = 0.0
        self._bone_points = 0

    def begin(self, now_ns: int) -> None:
        self._due_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        return self._due_ns

    def act(self, now_ns: int) -> Iterable[Said]:
        """Asks until the sweep begins; once it is over, what has not come by now will not come."""
        if self._announced is not None:
            return self._answered(now_ns)
        self._due_ns = now_ns + _AGAIN_NS
        return (RosSaid(_REQUEST, RosString("StartSweep")),)

    def hear(self, now_ns: int, heard: Heard) -> Iterable[Said]:
        assert isinstance(heard, RosHeard)
        if self._announced is None:
            self._due_ns = None  # the sweep is under way
        if heard.topic == _SWEEP:
            return self._finished(now_ns, RosString.unpack(heard.cdr).data)
        if heard.topic == _PICTURE:
            picture = Volume.unpack(heard.cdr)
            self._found[picture.header.stamp_ns] = _found_in(picture)
        else:
            pose = TransformStamped.unpack(heard.cdr)
            poses = self._probe if heard.topic == _PROBE else self._reference
            poses[pose.header.stamp_ns] = _rigid(pose)
        return self._answered(now_ns) if self._complete and not self._answer else ()

    def _finished(self, now_ns: int, text: str) -> Iterable[Said]:
        """The scanner says how many pictures there were, and says it again where it has no answer."""
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

    def _answered(self, now_ns: int) -> tuple[Said, ...]:
        self._due_ns = None
        self._answer = self._answer or tuple(self._stacked(now_ns))
        return self._answer

    def _stacked(self, now_ns: int) -> Iterable[Said]:
        """The slices in the frame of the reference, and what follows from them."""
        stamps = sorted(self._found.keys() & self._probe.keys() & self._reference.keys())
        places = [composed(self._reference[stamp].inverse(), self._probe[stamp]) for stamp in stamps]
        self._paired = len(stamps)
        seen = [self._found[stamp] for stamp in stamps]
        middles = np.array([place.apply(one.middle) for place, one in zip(places, seen, strict=True)]).reshape(-1, 3)
        way = np.diff(middles, axis=0)
        self._path_mm = float(np.sqrt(dot(way, way)).sum())
        whole = middles[-1] - middles[0] if len(middles) else np.zeros(3)
        self._swept_mm = math.sqrt(float(dot(whole, whole)))
        surface = [place.apply(one.bone) for place, one in zip(places, seen, strict=True) if len(one.bone)]
        target = _target(middles, places, seen)
        if not surface or target is None:
            yield RosSaid(_STATUS, DiagnosticStatus(2, "Navigator", f"nothing found in {self._paired} pictures"))
            return
        header = Header(now_ns, "Reference")
        points = rounded(np.concatenate(surface) / 1000, 1e-6).astype("<f4")
        self._bone_points = len(points)
        fields = tuple(PointField(axis, 4 * index, 7) for index, axis in enumerate("xyz"))
        cloud = PointCloud2(header, 1, len(points), fields, False, 12, 12 * len(points), points.tobytes(), True)
        yield RosSaid(_BONE, cloud)
        x, y, z = (float(value) for value in rounded(target / 1000, 1e-6))
        # down into the arm, leaning by 40° along it
        yield RosSaid(_NEEDLE, TransformStamped(header, "Needle", (x, y, z), (0.342, 0.0, 0.0, 0.94)))
        told = f"{self._paired} of {len(self._found)} pictures have a pose; swept {self._swept_mm:.1f} mm"
        yield RosSaid(_STATUS, DiagnosticStatus(0, "Navigator", told))

    @property
    def done(self) -> bool:
        return bool(self._answer)

    def report(self) -> Report:
        came, announced = len(self._found), self._announced
        lost = (announced or came) - came
        return Report(
            bool(announced and self._bone_points and self._paired >= _GOOD_PAIRS * announced),
            (
                f"received {came} pictures" + (f" of {announced}" if lost else ""),
                f"{self._paired} paired with a pose by stamp, {came - self._paired} without",
                f"swept {self._swept_mm:.1f} mm ({self._path_mm:.1f} mm along the hand's path), "
                f"{self._bone_points:,} points of bone",
            ),
            {
                "pictures": came,
                "announced": announced,
                "paired": self._paired,
                "swept_mm": round(self._swept_mm, 3),
                "path_mm": round(self._path_mm, 3),
                "bone_points": self._bone_points,
            },
        )


def _rigid(pose: TransformStamped) -> Rigid:
    """In millimetres."""
    return Rigid(np.array(matrix_of(pose.rotation)), np.array(pose.translation) * 1000)


def _found_in(picture: Volume) -> _Found:
    width, height, _ = picture.size
    grey = np.frombuffer(picture.data, np.uint8).reshape(height, width)
    across, down = np.array(picture.direction[:3]), np.array(picture.direction[3:6])
    step_x, step_y, _ = (1000 * step for step in picture.spacing)
    first = np.array(picture.origin) * 1000

    def placed(rows: Array, columns: Array) -> Array:
        return np.asarray(first + columns[:, None] * (step_x * across) + rows[:, None] * (step_y * down))

    def one(row: float, column: float) -> Array:
        return np.asarray(placed(np.array([row]), np.array([column]))[0])

    middle, edge = lumen(grey), bone(grey)
    return _Found(
        one((height - 1) / 2, (width - 1) / 2), one(*middle) if middle else None, placed(edge[:, 0], edge[:, 1])
    )


def _target(middles: Array, places: list[Rigid], seen: list[_Found]) -> Array | None:
    """Where the vessel is at a part of the sweep: the mean of the pictures there."""
    if not len(middles):
        return None
    away = middles - middles[round(_NEEDLE_PART * (len(middles) - 1))]
    near = np.flatnonzero(dot(away, away) <= _NEEDLE_MM * _NEEDLE_MM).tolist()
    found = [places[index].apply(vessel) for index in near if (vessel := seen[index].vessel) is not None]
    return np.asarray(sum(found, np.zeros(3)) / len(found)) if found else None

"""Tracked sequences as PLUS writes them, by its versions: header, fields of the frames, packed pixels.

The layout of the header and of the fields is that of the sequences in PlusLibData; poses and pixels are made here.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

WATER_TANK = Path(__file__).parent / "data" / "water-tank" / "signals.json"

#: Where the wire phantom of the water tank stands, and how the probe moves in it: any fixed pose and axis.
_AXIS = np.array([0.48, -0.64, 0.6])


@dataclass(frozen=True)
class Frame:
    """A frame of a sequence.

    Attributes:
        seconds: time stamp on the clock of PLUS.
        poses: name of a transform, like ``ProbeToTracker``, → pose (4, 4) in mm.
        invalid: names of the transforms whose status is not OK.
        before, after: further fields, before and after the time stamp.
    """

    seconds: float
    poses: dict[str, Array]
    invalid: frozenset[str] = frozenset()
    before: dict[str, str] = field(default_factory=dict)
    after: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Style:
    """What the versions of PLUS write differently.

    Attributes:
        orientation: of the pictures; ``XX`` without pictures in newer versions.
        element: type of a pixel; newer versions state another one where there are no pixels.
        channels, kind: whether ``ElementNumberOfChannels`` and ``UltrasoundImageType`` are there.
        digits: of the numbers of a pose.
        windows: exponents with three digits, as the runtime of Windows wrote them.
        blank: a blank after the last number of a pose.
    """

    orientation: str = "MF"
    element: str = "MET_UCHAR"
    channels: bool = True
    kind: str = "BRIGHTNESS"
    digits: int = 6
    windows: bool = False
    blank: bool = False


def write_sequence(
    path: Path, frames: Sequence[Frame], pixels: npt.NDArray[np.uint8] | None = None, style: Style = Style()
) -> Path:
    """Write a sequence; ``pixels`` (frames, rows, columns) are packed with zlib.  Return ``path``."""
    packed = b"" if pixels is None else zlib.compress(pixels.tobytes())
    rows, columns = (0, 0) if pixels is None else pixels.shape[1:]
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CenterOfRotation = 0 0 0",
        f"CompressedData = {pixels is not None}",
        *([f"CompressedDataSize = {len(packed):<20}"] if packed else []),
        f"DimSize = {f'{columns} {rows} {len(frames)}':<25}",
        "Kinds = domain domain list",
        *(["ElementNumberOfChannels = 1"] if style.channels else []),
        "ElementSpacing = 1 1 1",
        f"ElementType = {style.element}",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"UltrasoundImageOrientation = {style.orientation}",
        *([f"UltrasoundImageType = {style.kind}"] if style.kind else []),
    ]
    for number, frame in enumerate(frames):
        lines += [f"Seq_Frame{number:04}_{key} = {value}" for key, value in _fields(frame, style)]
        lines.append(f"Seq_Frame{number:04}_ImageStatus = {'OK' if pixels is not None else 'INVALID'}")
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + packed)
    return path


def _fields(frame: Frame, style: Style) -> list[tuple[str, str]]:
    told = list(frame.before.items())
    for name, pose in sorted(frame.poses.items()):
        text = " ".join(f"{number:.{style.digits}g}" for number in pose.ravel().tolist())
        if style.windows:
            text = text.replace("e-", "e-0")
        told.append((f"{name}Transform", text + " " * style.blank))
        told.append((f"{name}TransformStatus", "INVALID" if name in frame.invalid else "OK"))
    return [*told, ("Timestamp", f"{frame.seconds:.6f}"), *frame.after.items()]


def pose(chance: np.random.Generator, place: Array | None = None) -> Array:
    """Any pose (4, 4), at ``place`` in mm or at any place."""
    turned, _ = np.linalg.qr(chance.normal(size=(3, 3)))
    made = np.eye(4)
    made[:3, :3] = turned * np.sign(np.linalg.det(turned))
    made[:3, 3] = chance.uniform(-300, 300, 3) if place is None else place
    return made


def speckle(chance: np.random.Generator, count: int, rows: int, columns: int) -> npt.NDArray[np.uint8]:
    """Pictures (count, rows, columns) with a bright line that moves in noise."""
    pixels = chance.integers(0, 60, (count, rows, columns), np.uint8)
    pixels[np.arange(count), np.arange(count) % rows] = 230
    return pixels


# -- one sequence of each kind ----------------------------------------------------------------------------------------


def _probe(chance: np.random.Generator, count: int, tools: Sequence[str]) -> list[Frame]:
    return [
        Frame(232.542071 + number * 0.0862, {f"{tool}ToTracker": pose(chance) for tool in tools})
        for number in range(count)
    ]


def ultrasound(path: Path) -> Path:
    """Tracked pictures as PLUS 2.9 writes them: 21 frames with three tools."""
    chance = np.random.default_rng(1)
    frames = _probe(chance, 21, ["Probe", "Reference", "Stylus"])
    return write_sequence(path, frames, speckle(chance, 21, 77, 102))


def ultrasound_of_old(path: Path, count: int = 21) -> Path:
    """Tracked pictures as PLUS 2.2 writes them: the orientation has three letters, there is no type of picture."""
    chance = np.random.default_rng(2)
    style = Style("MFA", channels=False, kind="", windows=True)
    frames = _probe(chance, count, ["Probe", "Reference", "Stylus"])
    return write_sequence(path, frames, speckle(chance, count, 77, 102), style)


def cropped(path: Path) -> Path:
    """20 cropped pictures, with the transform of the cropping; the stylus is never seen."""
    chance = np.random.default_rng(3)
    crop = np.eye(4)
    crop[:3, 3] = -335, -285, 0
    unseen = np.eye(4) + np.array([[0, -8.43482e-5, 1.9e-4, 0.37]] + [[0] * 4] * 3)
    frames = [
        Frame(
            345.627957 + number * 0.09,
            {
                "ImageToCroppedImage": crop,
                "ProbeToTracker": pose(chance),
                "ReferenceToTracker": pose(chance),
                "StylusToTracker": unseen,
            },
            frozenset({"StylusToTracker"}),
        )
        for number in range(20)
    ]
    return write_sequence(path, frames, speckle(chance, 20, 150, 200), Style("MFA", windows=True))


def tracked(path: Path) -> Path:
    """93 poses of two tools with all digits, without pictures."""
    frames = _probe(np.random.default_rng(4), 93, ["Reference", "Stylus"])
    return write_sequence(path, frames, style=Style("XX", kind="XX", digits=17))


def numbered(path: Path) -> Path:
    """100 poses of three tools with the number of the frame and the unfiltered stamp, without pictures."""
    frames = [
        Frame(
            frame.seconds,
            frame.poses,
            before={"FrameNumber": str(332203 + number)},
            after={"UnfilteredTimestamp": f"{frame.seconds:.3f}000"},
        )
        for number, frame in enumerate(_probe(np.random.default_rng(5), 100, ["Probe", "Reference", "Stylus"]))
    ]
    return write_sequence(path, frames, style=Style("XX", "MET_OTHER", kind="XX"))


# -- the water tank of PLUS -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WaterTank:
    """What PLUS's two sequences of a moving probe in a water tank show; see ``data/README.md``.

    Attributes:
        video_s, line_px: times of the pictures, and rows of the bright line of the bottom in them.
        tracker_s, place_mm: times of the poses, and place of the probe on the axis of its movement.
    """

    video_s: Array
    line_px: Array
    tracker_s: Array
    place_mm: Array


def water_tank() -> WaterTank:
    """The measured signals."""
    told = json.loads(WATER_TANK.read_text("utf-8"))
    return WaterTank(*(np.array(told[key]) for key in ("fixed_t", "fixed_px", "moving_t", "moving_mm")))


def water_tank_pictures() -> npt.NDArray[np.uint8]:
    """Pictures (frames, rows, columns) with a bright line in noise, at the measured rows and slightly inclined."""
    chance = np.random.default_rng(6)
    rows, columns = np.arange(450, dtype=np.float32)[:, np.newaxis], np.arange(40)
    line = water_tank().line_px.astype(np.float32)[:, np.newaxis, np.newaxis] + 0.04 * (columns - 20)
    bright = 220 * np.exp(-(((rows - line) / 3) ** 2))
    return np.asarray(bright + chance.integers(0, 30, bright.shape, np.uint8), np.uint8)


def water_tank_video(path: Path) -> Path:
    """The pictures, without poses."""
    tank = water_tank()
    frames = [
        Frame(stamp, {}, before={"FrameNumber": str(1449 + number)}, after={"UnfilteredTimestamp": f"{stamp:.2f}0000"})
        for number, stamp in enumerate(tank.video_s.tolist())
    ]
    return write_sequence(path, frames, water_tank_pictures(), Style("MFA", channels=False))


def water_tank_tracker(path: Path) -> Path:
    """The poses: the probe at the measured places relative to a reference, both tracked; two seconds of rest first."""
    tank, chance = water_tank(), np.random.default_rng(7)
    reference, turned = pose(chance), pose(chance, np.zeros(3))
    rest = tank.tracker_s[0] - 4 + np.arange(40) / 20
    seconds = np.concatenate([rest, tank.tracker_s])
    places = np.concatenate([np.full(len(rest), tank.place_mm[0]), tank.place_mm])
    frames = []
    for number, (stamp, place) in enumerate(zip(seconds.tolist(), places.tolist(), strict=True)):
        probe = turned.copy()
        probe[:3, 3] = 70 + place * _AXIS
        poses = {"ProbeToTracker": reference @ probe, "ReferenceToTracker": reference}
        frames.append(Frame(stamp, poses, before={"FrameNumber": str(329640 + number)}))
    return write_sequence(path, frames, style=Style("MFA", channels=False, kind="", digits=9, blank=True))


# -- landmarks of a phantom -------------------------------------------------------------------------------------------

#: Landmarks of a block of bricks, mm.
LANDMARKS = np.array(
    [(104.3, 5, 20), (104.3, 45, 20), (104.3, 45, 0), (104.3, -5, 0), (-34.3, 45, 15), (-34.3, -5, 20), (-34.3, -5, 0),
     (-34.3, 45, 0)]
)  # fmt: skip
TIP_MM = np.array([108.565, 7.774, 2.539])


def phantom() -> Array:
    """Where the phantom is in the frame of the reference: pose (4, 4) in mm."""
    made = np.array([(0.0, 0, -1, 22.71), (0, 1, 0, -39.75), (1, 0, 0, 25.65), (0, 0, 0, 1)])
    tilt, (sine, cosine) = np.eye(4), (np.sin(0.0128), np.cos(0.0128))
    tilt[1:3, 1:3] = (cosine, -sine), (sine, cosine)
    return np.asarray(made @ tilt)


def touches(path: Path) -> Path:
    """A stylus that touches the landmarks one after the other: 1000 poses at 15 Hz.

    It waits before the first and after the last one, and pivots about its tip while it touches: the tip is still within
    a tenth of a millimetre, and each landmark is missed by about 0.2 mm.
    """
    chance = np.random.default_rng(8)
    reference = pose(chance)
    stations = (phantom() @ np.c_[LANDMARKS, np.ones(8)].T).T[:, :3]
    stations = stations + chance.normal(0, 0.12, stations.shape)
    idle = np.array([[180.0, 60, 120], [-150.0, -90, 90]])
    tips: list[Array] = []
    way = [idle[0], *stations, idle[1]]
    for number, station in enumerate(way):
        tips += [station] * 60
        if number + 1 < len(way):
            share = np.linspace(0, 1, 44)[:, np.newaxis]
            tips += list(station + share * (way[number + 1] - station) + 40 * np.sin(np.pi * share) * (0, 0, 1))
    frames = []
    start = pose(chance, np.zeros(3))
    for number in range(1000):
        at = tips[min(number, len(tips) - 1)] + chance.normal(0, 0.05, 3)
        angle = 0.3 * np.sin(number / 9)
        lean = np.eye(4)
        lean[:2, :2] = (np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))
        stylus = start @ lean
        stylus[:3, 3] = at - stylus[:3, :3] @ TIP_MM
        poses = {"ReferenceToTracker": reference, "StylusToTracker": reference @ stylus}
        frames.append(Frame(280.461143 + number / 15, poses))
    return write_sequence(path, frames, style=Style("XX", "MET_OTHER", kind="XX", digits=16))

"""The streams of a session as tracks of a scene: poses, pictures, items (surfaces, points, strings) and numbers.

A track collects what a stream has while the session is read once.  Its times become indexes when all streams are known,
because they have one clock (``log.one_clock``).  3D Slicer takes indexes that differ by less than a millisecond for
one, and its reader of poses rounds times to milliseconds, so every index is an integer of them: of messages in
the same millisecond the last one counts.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_MS, NS_PER_S
from igtl_gateway.addon.igtl import BIG_ENDIAN, SCALARS, Image
from igtl_gateway.addon.reading import Buffer, Entry
from igtl_gateway.addon.streams import ImagePlacement, StreamTimes
from igtl_gateway.addons.exchange.account import ExportedStream
from igtl_gateway.addons.exchange.scene_nodes import Scene
from igtl_gateway.addons.exchange.scene_store import entry_info

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

_SELECTION = "vtkMRMLSelectionNodeSingleton"
SAME_MS = "another one has its millisecond"
#: Items of a track, by default: what a reader of 3D Slicer loads in a minute; it is quadratic in their number.
MOST_SAMPLES, MOST_ITEMS = 20_000, 2_000


@dataclass(slots=True)
class Pace:
    """The rule by which a stream is thinned: the first message of each period.

    Args:
        period_ns: 0: every message.
    """

    period_ns: int = 0
    _last: int = -1

    @classmethod
    def of(cls, rate: float, count: int, most: int, span_ns: int) -> Pace:
        """Return the pace of a stream of ``count`` messages in ``span_ns``: ``rate`` in Hz, or 0: ``most`` at most."""
        if rate:
            return cls(max(1, round(NS_PER_S / rate)))
        return cls(-(-span_ns // most)) if count > most else cls()

    @property
    def why(self) -> str:
        """Why a message is left out."""
        return f"thinned to {NS_PER_S / self.period_ns:.4g} Hz, the first of each {self.period_ns / NS_PER_MS:.4g} ms"

    def passes(self, time_ns: int) -> bool:
        """Return whether a message of this time is the first of its period."""
        if not self.period_ns:
            return True
        period = time_ns // self.period_ns
        is_first, self._last = period != self._last, period
        return is_first


@dataclass(slots=True)
class Track:
    """One stream.

    Attributes:
        source: kind and name of the stream, for people: ``in:TRANSFORM/ToolToBase``.
        type: of its messages.
        wanted: name of its node, if that is free.
        sender: streams of one sender have one clock; see ``StreamTimes``.
        frame: frame that its content lies in; ``""``: none is known.
        times, stamps, sources: gateway times, stamps in the messages, and source stamps, UTC ns.
        row: of the account.
        name, order, ms: set by ``arrange``: name of the node, indices of the messages in order of time, their indexes.
    """

    source: str
    type: str
    wanted: str
    sender: str = ""
    frame: str = ""
    times: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    sources: list[int] = field(default_factory=list)
    row: ExportedStream | None = None
    name: str = ""
    order: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    ms: Times = field(default_factory=lambda: np.zeros(0, np.int64))

    def add_time(self, entry: Entry, stamp_ns: int) -> None:
        """Add the times of a message."""
        self.times.append(entry.stamp_ns)
        self.stamps.append(stamp_ns)
        self.sources.append(entry.source_ns)

    def stream_times(self) -> StreamTimes:
        """Return its times, for ``one_clock``."""
        stamps = np.array(self.stamps, np.int64)
        stamps = stamps if np.any(stamps) else np.array(self.sources, np.int64)
        return StreamTimes(self.source, np.array(self.times, np.int64), stamps, self.sender)

    def carried(self, since_ns: int) -> Array:
        """Return which messages are from before a part that begins at this gateway time."""
        return np.array(self.times, np.int64) < since_ns

    def arrange(self, times: Times, begin_ns: int, since_ns: int = 0) -> int:
        """Give each message its index; return the number of those whose millisecond another one has.

        Args:
            times: of the messages, UTC ns.
            begin_ns: index 0.
            since_ns: gateway time at which the part begins: what is from before is at index 0, and not counted.
        """
        ms = (times - begin_ns + NS_PER_MS // 2) // NS_PER_MS
        carried = self.carried(since_ns)
        ms[carried] = 0
        order = np.lexsort((~carried, ms))
        ms = ms[order]
        last = np.append(ms[1:] != ms[:-1], True)[: len(ms)]
        self.order, self.ms = order[last], ms[last]
        return int(np.count_nonzero(~last & ~carried[order]))


def index_text(ms: int) -> str:
    """Return an index: seconds with three decimals."""
    return f"{ms // 1000}.{ms % 1000:03}"


@dataclass(slots=True)
class PoseTrack(Track):
    """Poses of ``child`` in ``frame``; ``parts``: (N, 4, 4) each, mm; ``static``: one pose of all times."""

    child: str = ""
    static: bool = False
    rank: int = 0
    parts: list[Array] = field(default_factory=list)

    def matrices(self) -> Array:
        """Return the poses (N, 4, 4) in the order of the messages."""
        return np.concatenate([np.zeros((0, 4, 4)), *self.parts])


@dataclass(slots=True)
class NumberTrack(Track):
    """Numbers by name.

    Attributes:
        columns: name → place in a row.
        rows: the numbers of each message, by place.
        joints: names and positions of each message of joint states, rad or m.
    """

    columns: dict[str, int] = field(default_factory=dict)
    rows: list[dict[int, float]] = field(default_factory=list)
    joints: list[tuple[tuple[str, ...], Sequence[float]]] = field(default_factory=list)


@dataclass(slots=True)
class PictureTrack(Track):
    """Pictures of one size and pixel type; their pixels are in ``stream`` one after the other.

    Attributes:
        file: name of the file with the pixels, below the root of the scene.
        stream: open for writing.
        first: the picture that all others are like.
        matrices: of each picture from voxels to RAS, mm; None: it has none.
    """

    file: str = ""
    stream: IO[bytes] | None = None
    first: Image | None = None
    matrices: list[tuple[float, ...]] = field(default_factory=list)

    def mismatch(self, image: Image) -> str:
        """Return why a picture cannot be one of this track; ``""`` if it can."""
        first = self.first
        if first is None:
            return ""
        mine, its = (
            (one.dimensions, one.scalar_type, one.num_components, one.endian, one.is_lps) for one in (first, image)
        )
        return "" if mine == its else f"size or pixel type differs from the first one of {first.dimensions}"

    def add(self, image: Image) -> None:
        """Add a picture that fits."""
        if self.first is None:
            self.first = image
        self.matrices.append(image.wire_matrix)
        assert self.stream is not None
        self.stream.write(image.pixels)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one picture."""
        return self.first.expected_bytes if self.first else 0

    def moves(self) -> bool:
        """Return whether the pictures have several positions."""
        return len(set(self.matrices)) > 1

    def placed(self) -> Array:
        """Return the matrices from voxels to RAS (N, 4, 4), mm; of a picture without a valid one that before it."""
        assert self.first is not None
        known: dict[tuple[float, ...], Array] = {}
        found = np.zeros((len(self.matrices), 4, 4))
        here = np.eye(4)
        for number, matrix in enumerate(self.matrices):
            if matrix not in known:
                known[matrix] = _placed(self.first, matrix)
            here = known[matrix] if known[matrix][3, 3] else here
            found[number] = here
        return found


def _placed(image: Image, matrix: tuple[float, ...]) -> Array:
    """Return the matrix of a picture as (4, 4); zeros if it is invalid."""
    place = ImagePlacement.of_image(replace(image, wire_matrix=matrix))
    found = np.zeros((4, 4))
    if place is not None:
        found[:3, :3], found[:3, 3], found[3, 3] = np.array(place.axes).T, place.origin, 1
    return found


def picture_header(track: PictureTrack, place: Array, indexes: Iterable[str], count: int, data_file: str = "") -> bytes:
    """Return the NRRD header of a sequence of pictures; ``data_file``: where their pixels are, else they follow.

    Args:
        track: the pictures.
        place: matrix (4, 4) from voxels to RAS, mm.
        indexes: of the frames.
        count: number of frames.
        data_file: a name in the same folder.
    """
    first = track.first
    assert first is not None
    dtype = np.dtype(SCALARS[first.number_type])
    kind = {"i": "int", "u": "uint", "f": "float"}[dtype.kind] + f"{dtype.itemsize * 8}"
    kind = {"float32": "float", "float64": "double"}.get(kind, kind)
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ place + 0.0
    many = first.num_components > 1
    lead = f"{first.num_components} " if many else ""
    pixel = {3: "RGB-color ", 4: "RGBA-color "}.get(first.num_components, "vector ") if many else ""
    blanks = " ".join(['""'] * (4 if many else 3))
    vectors = " ".join(_vector(lps[:3, axis]) for axis in range(3))
    lines = [
        "NRRD0005",
        f"type: {kind}",
        f"dimension: {5 if many else 4}",
        "space: left-posterior-superior",
        f"sizes: {lead}{' '.join(map(str, first.dimensions))} {count}",
        f"space directions: {'none ' if many else ''}{vectors} none",
        f"kinds: {pixel}domain domain domain list",
        f'labels: {blanks} "time"',
        f'units: {blanks} "s"',
        f"endian: {'big' if first.endian == BIG_ENDIAN and dtype.itemsize > 1 else 'little'}",
        "encoding: raw",
        f"space origin: {_vector(lps[:3, 3])}",
        *([f"data file: {data_file}"] if data_file else []),
        f"DataNodeClassName:={'vtkMRMLVectorVolumeNode' if many else 'vtkMRMLScalarVolumeNode'}",
        "axis 3 index type:=numeric",
        f"axis 3 index values:={' '.join(indexes)}",
    ]
    return "\n".join(lines).encode() + (b"\n" if data_file else b"\n\n")


def _vector(values: Array) -> str:
    return f"({','.join(f'{value:.17g}' for value in values)})"


@dataclass(slots=True)
class ItemTrack(Track):
    """Items with a file each: surfaces, points; or none: strings.  They are a scene in a bundle (``.seq.mrb``).

    Attributes:
        tag: element of an item.
        storage: element of its storage; ``""``: it has no file.
        file: name of the bundle below the root of the scene.
        stream: the bundle.
        values: attributes of each item.
        empty: attributes of an empty item, and the content of its file.
    """

    tag: str = ""
    storage: str = ""
    suffix: str = ""
    file: str = ""
    stream: zipfile.ZipFile | None = None
    values: list[dict[str, object]] = field(default_factory=list)
    empty: tuple[dict[str, object], bytes] = ({}, b"")
    colour: tuple[float, float, float] | None = None
    scalars: str = ""
    has_faces: bool = False
    low: Array = field(default_factory=lambda: np.full(3, np.inf))
    high: Array = field(default_factory=lambda: np.full(3, -np.inf))

    @property
    def _root(self) -> str:
        return self.file.rpartition("/")[2].removesuffix(".seq.mrb")

    def add(self, values: dict[str, object], parts: Iterable[Buffer] = ()) -> None:
        """Add an item with its attributes and the content of its file."""
        self.write(len(self.values), parts)
        self.values.append(values)

    def see(self, points: Array) -> None:
        """Take notice of the extent of points (N, 3), mm."""
        if len(points):
            self.low = np.minimum(self.low, points.min(axis=0))
            self.high = np.maximum(self.high, points.max(axis=0))

    def write(self, number: int, parts: Iterable[Buffer]) -> None:
        """Write the file of an item."""
        if self.storage:
            assert self.stream is not None
            info = entry_info(f"{self._root}/Data/{self._root}_{number}.{self.suffix}")
            with self.stream.open(info, "w") as out:
                for part in parts:
                    out.write(part)

    def close(self, begin_empty: bool) -> str:
        """Write the scene of the kept items, close the bundle, and return the index values of the sequence."""
        assert self.stream is not None
        scene, words = Scene(), []
        if self.tag == "MarkupsLine":  # 3D Slicer measures a line while it reads it, and logs where it finds no units
            scene.add("Selection", "Selection", {"singletonTag": "Singleton"}, node=_SELECTION, hidden=True)
        items = [(int(number), index_text(ms)) for number, ms in zip(self.order, self.ms.tolist(), strict=True)]
        if begin_empty:
            number = len(self.values)
            self.values.append(self.empty[0])
            self.write(number, (self.empty[1],))
            items.insert(0, (number, index_text(0)))
        for number, index in items:
            kept = scene.new_id(self.storage) if self.storage else ""
            node = scene.add(self.tag, self.name, self.values[number], [("storage", kept)])
            if kept:
                values = {"fileName": f"Data/{self._root}_{number}.{self.suffix}", "coordinateSystem": "RAS"}
                scene.add(self.storage, self.storage, values, node=kept, hidden=True)
            words.append(f"{node}:{index}")
        with self.stream.open(entry_info(f"{self._root}/{self._root}.mrml"), "w") as out:
            out.write(scene.document())
        self.stream.close()
        return ";".join(words)

"""Export to a scene of 3D Slicer: a bundle (``.mrb``), a folder with a ``.mrml``, or one sequence of pictures.

The scene plays: a sequence browser has all streams, each of which moves a node.  Poses are transforms below each other,
as their frames are; pictures, surfaces and points lie in the frame of their messages.  It is written without 3D Slicer,
and the session is read once.

What the formats of 3D Slicer need:

* Indexes are seconds with three decimals: finer ones are merged or rounded (``scene_tracks``).
* Before its first item a sequence shows that one, so a stream that begins later has an empty item at 0.
* A sequence of pictures has one position.  Pictures that move have that of the first one, below a transform that moves.
* A reader of transforms drops those with ``Status`` in their name.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_MS, NS_PER_S, ConfigError, UnsupportedRecording, __version__, distinct_names
from igtl_gateway.addon.reading import Kind, RecordedStamps, SessionFile, marks_of
from igtl_gateway.addon.ros import Image as RosImage
from igtl_gateway.addon.streams import OneClock, StreamTimes, one_clock
from igtl_gateway.addon.terminal import utc_text
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addon.writing import make_folder, open_new, written, written_folder
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.scene_files import axes_file, pose_file, table_files
from igtl_gateway.addons.exchange.scene_nodes import Scene, facts
from igtl_gateway.addons.exchange.scene_reading import SURFACES, NeedsParts, SceneReading
from igtl_gateway.addons.exchange.scene_robot import Robots
from igtl_gateway.addons.exchange.scene_store import DATA, FolderStore, Store, bundle
from igtl_gateway.addons.exchange.scene_tracks import (
    SAME_MS,
    ItemTrack,
    NumberTrack,
    PictureTrack,
    PoseTrack,
    Track,
    index_text,
    picture_header,
)
from igtl_gateway.addons.exchange.selection import Recording
from igtl_gateway.addons.exchange.volume_out import PICTURES

Array = npt.NDArray[Any]

#: Colours of surfaces without colours of their own, and of points.
_COLOURS = ((0.85, 0.75, 0.6), (0.55, 0.75, 0.9), (0.75, 0.85, 0.55), (0.9, 0.6, 0.55), (0.75, 0.6, 0.85))
#: Series of one plot.
_MOST_SERIES = 16
_READ = 4 << 20
_VOLUME, _VECTOR = "Volume", "VectorVolume"
_FOUR_UP, _ONE_UP_3D = 3, 4
#: Share of the session in which a stream that begins is there at first sight.
_SOON = 0.2


class _Again(Exception):
    """Pictures have to be left out of a file that is written already."""


def export_mrb(recording: Recording, out: Path, globs: Sequence[str], rate: float = 0.0) -> ExportAccount:
    """Write the bundle ``out``, which must not exist, and further ones if the pictures are more than one scene holds.

    ``rate``: most messages of a stream in a second; 0: as many as 3D Slicer reads in reasonable time.
    Raises ConfigError, GatewayError, OSError.
    """
    file = _session(recording)

    @contextmanager
    def opened(ends: ExitStack, place: Path) -> Iterator[tuple[Store, Path]]:
        new = ends.enter_context(written(place))
        with bundle(new, _stem(place)) as store:
            yield store, new

    direct = _most_pictures(file)
    if direct is not None:
        with suppress(_Again, NeedsParts):
            return _scenes(file, globs, rate, out, opened, direct)
    return _scenes(file, globs, rate, out, opened)


def export_mrml(recording: Recording, out: Path, globs: Sequence[str], rate: float = 0.0) -> ExportAccount:
    """Write the folder ``out`` with a scene and its files, and further ones as ``export_mrb``.

    Raises as that, and for a folder with files.
    """

    @contextmanager
    def opened(ends: ExitStack, place: Path) -> Iterator[tuple[Store, Path]]:
        new = ends.enter_context(written_folder(place))
        yield FolderStore(new), new

    return _scenes(_session(recording), globs, rate, out, opened)


def _scenes(
    file: SessionFile,
    globs: Sequence[str],
    rate: float,
    out: Path,
    opened: Callable[[ExitStack, Path], AbstractContextManager[tuple[Store, Path]]],
    direct: tuple[Kind, str, str] | None = None,
) -> ExportAccount:
    """Write the scenes of a session: one with ``direct``, else as many as its pictures need; all of them, or none.

    Raises _Again, NeedsParts.
    """
    reading: SceneReading | None = None
    places, notes = list[Path](), list[str]()
    with ExitStack() as ends, _digest(file) as digest:
        ends.push(partial(_remove_after_error, places))
        while True:
            place = _part_place(out, len(places) + 1)
            with opened(ends, place) as (store, new):
                if reading is None:
                    reading = SceneReading(file, globs, rate, store, direct, in_parts=direct is None)
                else:
                    reading.begin_part(store)
                try:
                    has_more = reading.read()
                    part = f"part {len(places) + 1}, {place.name}" if places or has_more else ""
                    writer = _SceneWriter(file, reading, store, part)
                    if reading.tracks:
                        writer.arrange([*reading.tracks.values()])
                        writer.write(digest)
                        store.write(f"{_stem(place)}.mrml", writer.scene.document())
                finally:
                    reading.close()
            if not reading.tracks:
                _remove(new)
                break
            places.append(place)
            notes += writer.notes
            if not has_more:
                break
    reading.account.files = len(places)
    reading.account.notes = list(dict.fromkeys(notes)) + reading.account.notes
    if not places:  # a robot has nothing to stand on
        for row in reading.account.rows:
            row.leave_out("nothing in the session moves it", row.taken)
            row.taken = 0
    return reading.account


def _part_place(out: Path, number: int) -> Path:
    """Return where a part of a scene is: the first at ``out``, the others with their number behind its name."""
    stem, suffix = (out.name[:-4], out.name[-4:]) if out.name.lower().endswith(".mrb") else (out.name, "")
    return out if number == 1 else out.with_name(f"{stem}-{number}{suffix}")


def _remove_after_error(places: list[Path], kind: type[BaseException] | None, *_: object) -> None:
    """Remove the parts that have moved to their places before another one could not."""
    if kind is not None:
        for place in places:
            with suppress(OSError):
                _remove(place)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def export_picture_sequence(recording: Recording, out: Path, globs: Sequence[str], rate: float = 0.0) -> ExportAccount:
    """Write the pictures of one stream, which do not move, as ``.seq.nrrd``.  Raises as ``export_mrb``."""
    file = _session(recording)
    with written(out) as new:
        beside = new.parent / "waiting"
        make_folder(beside)
        store = FolderStore(beside)
        reading = SceneReading(file, globs, rate, store, only_pictures=True)
        try:
            reading.read()
        finally:
            reading.close()
        tracks = [track for track in reading.tracks.values() if isinstance(track, PictureTrack)]
        if len(tracks) > 1:
            names = ", ".join(track.source for track in tracks)
            raise ConfigError(f"--streams: found {names}, expected one stream of pictures")
        if tracks:
            (track,) = tracks
            if track.moves():
                raise UnsupportedRecording(
                    f"{track.source}: found pictures with several positions, expected one for a .seq.nrrd; "
                    "--to mrb and --to igs.mha have the position of each picture"
                )
            clock = _clock(file, [track])
            times = clock.times(track.stream_times(), 0)
            begin_ns = int(times.min())
            _left_out(track, track.arrange(times, begin_ns))
            header = picture_header(track, track.placed()[0], map(index_text, track.ms.tolist()), len(track.ms))
            with open_new(new) as whole:
                whole.write(header)
                for part in _chosen_frames(beside / track.file, track):
                    whole.write(part)
            reading.account.files = 1
            reading.account.notes += [*clock.notes, f"index 0 is {utc_text(begin_ns)} ({clock.name})"]
        shutil.rmtree(beside)
    return reading.account


def _session(recording: Recording) -> SessionFile:
    assert isinstance(recording, SessionFile)
    return recording


def _stem(out: Path) -> str:
    """Return the name of the folder in a bundle: letters, digits and signs that every system has."""
    name = out.name.removesuffix(".mrb").removesuffix(".mrml")
    return "".join(sign if sign.isascii() and (sign.isalnum() or sign in "-_.") else "_" for sign in name) or "scene"


@contextmanager
def _digest(file: SessionFile) -> Iterator[Future[str]]:
    """Context manager: the SHA-256 of the recording, which another thread calculates."""
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(_sha256, Path(file.path))


def _sha256(path: Path) -> str:
    found = hashlib.sha256()
    try:
        for each in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
            with each.open("rb") as stream:
                while part := stream.read(_READ):
                    found.update(part)
    except OSError as error:
        return f"not known: {error.strerror}"
    return found.hexdigest()


def _left_out(track: Track, same: int) -> None:
    if same and track.row is not None:
        track.row.taken -= same
        track.row.leave_out(SAME_MS, same)


def _chosen_frames(path: Path, track: PictureTrack) -> Iterator[bytes]:
    """Yield the frames of a file of pixels that have an index, in order of time."""
    with path.open("rb") as stream:
        for number in track.order.tolist():
            stream.seek(number * track.frame_bytes)
            yield stream.read(track.frame_bytes)


def _clock(file: SessionFile, tracks: Sequence[Track]) -> OneClock:
    """Return the clock on which streams are joined; a lag that was measured counts as that of its stream."""
    stamps = RecordedStamps(file)
    own = [track.stream_times() for track in tracks]
    by_name = {track.source: each for track, each in zip(tracks, own, strict=True)}
    found: list[StreamTimes] = []
    for track, times in zip(tracks, own, strict=True):
        side, _, channel = track.source.partition(":")
        lag = stamps.of(channel, track.type) if side == "in" else None
        behind = by_name.get(f"in:{lag.behind_channel}") if lag else None
        found.append(replace(times, behind=behind) if behind is not None else times)
    return one_clock(found)


def _most_pictures(file: SessionFile) -> tuple[Kind, str, str] | None:
    """Return the received stream with most pictures."""
    pictures = [each for each in file.channels if each.entry_type in PICTURES and each.count]
    best = max(pictures, key=lambda each: (each.kind.is_input, each.count), default=None)
    return (best.kind, best.stream or best.topic, best.entry_type) if best else None


class _SceneWriter:
    """Writes the nodes and files of arranged tracks."""

    def __init__(self, file: SessionFile, reading: SceneReading, store: Store, part: str) -> None:
        """``part``: names the part that it is, ``""`` of a whole session."""
        self._file, self._reading, self._store, self._part = file, reading, store, part
        self.scene = Scene()
        self.notes: list[str] = []
        self._played: list[tuple[str, str, Track]] = []
        self._taken: list[str] = []
        #: frame → transform node whose children lie in it; its first pose
        self._nodes: dict[str, str] = {}
        #: transform node → its first pose, and the node above it
        self._places: dict[str, tuple[Array, str]] = {}
        self._shown: tuple[str, PictureTrack, Array, str] | None = None
        self._origins: list[tuple[Array, str]] = []
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    # -- times

    def arrange(self, tracks: Sequence[Track]) -> None:
        """Give each message its index, and each track its name.  Raises _Again."""
        self._tracks = [*tracks]
        moving = [track for track in tracks if not (isinstance(track, PoseTrack) and track.static)]
        clock = self._clock = _clock(self._file, moving)
        times = [clock.times(track.stream_times(), number) for number, track in enumerate(moving)]
        since_ns = self._reading.since_ns
        own = [each[~track.carried(since_ns)] for track, each in zip(moving, times, strict=True)]
        self.begin_ns = min((int(each.min()) for each in own if len(each)), default=0)
        self.end_ns = max((int(each.max()) for each in own if len(each)), default=0)
        for track, each in zip(moving, times, strict=True):
            same = track.arrange(each, self.begin_ns, since_ns)
            if isinstance(track, PictureTrack) and track.stream is not None:
                if track.ms[0] > 0 and not same:
                    track.stream.write(bytes(track.frame_bytes))
                track.stream.close()
                if same and self._reading.direct is not None and self._is_direct(track):
                    raise _Again
            _left_out(track, same)
        self.notes += clock.notes
        what = "stamps of the senders" if clock.name == "source" else "times of receipt"
        at = utc_text(self.begin_ns)
        seconds = (self.end_ns - self.begin_ns) / NS_PER_S
        self.notes.append(
            f"{self._part}: index 0 is {at}, the last one {seconds:.3f} s later ({what})"
            if self._part
            else f"index 0 of all sequences is {at}; the indexes are {what}, in s, to 1 ms"
        )
        wanted = {id(track): printable(track.wanted) or track.type for track in self._tracks}
        names = distinct_names(wanted, lambda name: name, other=lambda name, number: f"{name} {number}")
        for track in self._tracks:
            track.name = names[id(track)]

    def _is_direct(self, track: Track) -> bool:
        return any(each is track and key == self._reading.direct for key, each in self._reading.tracks.items())

    # -- nodes

    def write(self, digest: Future[str]) -> None:
        """Write all files, and fill ``scene``."""
        poses = [track for track in self._tracks if isinstance(track, PoseTrack)]
        robots = Robots.of(self._reading.robots, self._reading.tracks, {track.child for track in poses})
        poses += robots.tracks()
        self._poses = _tree(poses)
        for each in poses:
            self._write_poses(each)
        numbers = 0
        for track in self._tracks:
            match track:
                case PictureTrack():
                    self._write_pictures(track)
                case ItemTrack():
                    self._write_items(track, numbers)
                    numbers += 1
                case NumberTrack():
                    self._write_numbers(track)
        for body in robots.bodies:
            node = self._nodes.get(body.frame, "")
            name = f"{DATA}/{body.name}.vtk"
            self._store.write(name, body.data)
            self._see(body.box, node)
            self._model(body.name, name, node, {"color": _numbers(body.colour), "scalarVisibility": "false"})
        self.notes += robots.notes
        if not np.isfinite(self._low).all():  # frames alone: a goal far away does not count beside things
            for points, above in self._origins:
                self._see(points, above)
        self._write_axes(poses, robots.frames)
        self._write_marks()
        self._write_views()
        self._write_browser()
        self._write_about(digest)

    def _sequence(
        self, track: Track, tag: str, file: str, suffix: str, values: str = "", name: str = "", source: str = ""
    ) -> str:
        """Add a sequence with its storage; return its identity."""
        kept = self.scene.new_id(tag)
        head = {
            "indexName": "time",
            "indexUnit": "s",
            "indexType": "numeric",
            "numericIndexValueTolerance": "1e-06",
            "indexValues": values,
            "attributes": facts(
                {
                    "IgtlGateway.Stream": source or track.source,
                    "IgtlGateway.Type": track.type,
                    "IgtlGateway.Frame": track.frame,
                }
            ),
        }
        node = self.scene.add("Sequence", name or track.name, head, [("storage", kept)])
        found = {"fileName": file, "useCompression": 0, "defaultWriteFileExtension": suffix}
        self.scene.add(tag, tag, found, node=kept, hidden=True)
        return node

    def _write_poses(self, track: PoseTrack) -> None:
        known, matrices = self._poses[id(track)], track.matrices()
        kept = matrices[-1:] if track.static else matrices[track.order]
        known.node = self.scene.new_id("LinearTransform")
        above = self._poses[id(known.parent)].node if known.parent is not None else ""
        if not track.static:
            self._pose_sequence(track, track.name, kept, known.node)
        self._transform(track.name, kept[0], above, known.node)
        if known.leads:
            self._nodes[track.child.lstrip("/")] = known.node
        self._origins.append((kept[:: max(1, len(kept) // 500), :3, 3], above))

    def _pose_sequence(self, track: Track, name: str, matrices: Array, node: str, source: str = "") -> None:
        token = self._token(name)
        file = f"{DATA}/{token}.seq.mha"
        self._store.write(file, pose_file(token, track.ms, matrices))
        sequence = self._sequence(track, "LinearTransformSequenceStorage", file, "seq.mha", name=token, source=source)
        self._played.append((sequence, node, track))

    def _token(self, name: str) -> str:
        """Return a new name of a file."""
        token = distinct_names({0: name}, _file_token, self._taken, lambda one, number: f"{one}-{number}")[0]
        self._taken.append(token)
        return token

    def _frame_node(self, frame: str) -> str:
        """Return the transform of a frame; ``""`` if no stream has its poses."""
        return self._nodes.get(frame.lstrip("/"), "") if frame else ""

    def _above(self, track: Track) -> str:
        if track.type == RosImage.TYPE:
            return ""  # it has no position: it is shown flat
        found = self._frame_node(track.frame)
        if not found and not track.frame:
            # PLUS and others name a picture Image_Probe if it lies in the frame Probe
            found = self._frame_node(track.wanted.rpartition("_")[2])
        return found

    def _write_pictures(self, track: PictureTrack) -> None:
        first = track.first
        assert first is not None
        matrices = track.placed()[track.order]
        above, begin = self._above(track), matrices[0]
        token = self._token(track.name)
        if not self._is_direct(track):
            self._settle(track)
        indexes = list(map(index_text, _file_order(track)))
        header = picture_header(track, begin, indexes, len(indexes), Path(track.file).name)
        self._store.write(f"{DATA}/{token}.seq.nhdr", header)
        if track.moves():
            poses = matrices @ np.linalg.inv(begin)
            node, name = self.scene.new_id("LinearTransform"), f"{track.name} moves"
            self._transform(name, poses[0], above, node)
            self._pose_sequence(track, name, poses, node, source=f"{track.source} position")
            above = node
        many = first.num_components > 1
        tag = _VECTOR if many else _VOLUME
        is_bytes = first.expected_bytes == math.prod(first.dimensions) * first.num_components
        levels = {"window": 255, "level": 127.5, "autoWindowLevel": 0} if is_bytes else {"autoWindowLevel": 1}
        # A reference of the role "color" is ignored; without a table the slices draw nothing and log errors.
        colours = {} if many else {"colorNodeID": "vtkMRMLColorTableNodeGrey"}
        display = self.scene.add(f"{tag}Display", f"{track.name} display", {**levels, **colours}, hidden=True)
        node = self.scene.add(tag, track.name, _volume_values(begin), [("display", display), ("transform", above)])
        sequence = self._sequence(track, "VolumeSequenceStorage", f"{DATA}/{token}.seq.nhdr", "seq.nrrd", name=token)
        self._played.append((sequence, node, track))
        self._shown = self._shown or (node, track, begin, above)
        corners = np.array(list(itertools.product(*((0, size - 1) for size in first.dimensions))))
        if track.type != RosImage.TYPE:
            self._see((np.c_[corners, np.ones(8)] @ begin.T)[:, :3], above)

    def _settle(self, track: PictureTrack) -> None:
        """Leave only the pictures in the file that have an index, and add it to the scene."""
        path = self._store.waiting(track.file)
        if len(track.order) != len(track.times):
            kept = path.with_suffix(".kept")
            with open_new(kept) as new:
                new.writelines(_chosen_frames(path, track))
                if track.ms[0] > 0:
                    new.write(bytes(track.frame_bytes))
            kept.replace(path)
        self._store.add(track.file)

    def _transform(self, name: str, place: Array, above: str, node: str = "") -> str:
        values = {"matrixTransformToParent": _numbers(place.ravel())}
        found = self.scene.add("LinearTransform", name, values, [("transform", above)], node=node)
        self._places[found] = (place, above)
        return found

    def _write_items(self, track: ItemTrack, number: int) -> None:
        values = track.close(bool(track.ms[0] > 0))
        self._store.add(track.file)
        token = self._token(track.name)
        above = self._above(track)
        sequence = self._sequence(track, "SequenceStorage", track.file, "seq.mrb", values, name=token)
        colour = _numbers(track.colour or _COLOURS[number % len(_COLOURS)])
        if np.isfinite(track.low).all():
            corners = list(itertools.product(*zip(track.low.tolist(), track.high.tolist(), strict=True)))
            self._see(np.array(corners), above)
        if track.type in SURFACES:
            display = {"color": colour, "pointSize": 4, "lineWidth": 3, "representation": 2 if track.has_faces else 0}
            if track.scalars:
                display |= {
                    "scalarVisibility": "true",
                    "activeScalarName": track.scalars,
                    "scalarRangeFlag": "UseDirectMapping",
                }
            node = self._model(track.name, "", above, display)
        elif track.tag == "Text":
            node = self.scene.add("Text", track.name, {"text": "", "encoding": 1})
        else:
            display = {
                "color": colour,
                "selectedColor": colour,
                "glyphType": "Sphere3D",
                "useGlyphScale": "true",
                "glyphScale": 1.5,
                "textScale": 2.5,
                "pointLabelsVisibility": "true",
                "propertiesLabelVisibility": "false",
            }
            kind = "MarkupsFiducialDisplay" if track.tag == "MarkupsFiducial" else "MarkupsDisplay"
            shown = self.scene.add(kind, f"{track.name} display", display, hidden=True)
            values_of = {"locked": "true", "controlPointLabelFormat": "%d"}
            node = self.scene.add(track.tag, track.name, values_of, [("display", shown), ("transform", above)])
        self._played.append((sequence, node, track))

    def _model(self, name: str, file: str, above: str, display: dict[str, object]) -> str:
        """Add a model; ``file``: ``""`` if a sequence has its content."""
        values = {"visibility": "true", "frontfaceCulling": "false", "backfaceCulling": "false", **display}
        shown = self.scene.add("ModelDisplay", f"{name} display", values, hidden=True)
        kept = self.scene.new_id("ModelStorage") if file else ""
        node = self.scene.add("Model", name, {}, [("display", shown), ("storage", kept), ("transform", above)])
        if kept:
            self.scene.add(
                "ModelStorage", f"{name} file", {"fileName": file, "coordinateSystem": "RAS"}, node=kept, hidden=True
            )
        return node

    def _write_numbers(self, track: NumberTrack) -> None:
        columns = {"time [s]": [ms / 1000 for ms in track.ms.tolist()]}
        for name, place in track.columns.items():
            columns[name] = [track.rows[row].get(place, math.nan) for row in track.order.tolist()]
        node = self._table(track.name, columns)
        series = []
        names = [name for name in track.columns if name.endswith(" position")] or list(track.columns)
        for number, name in enumerate(names[:_MOST_SERIES]):
            colour = _COLOURS[number % len(_COLOURS)]
            values = {
                "plotType": "Scatter",
                "xColumnName": "time [s]",
                "yColumnName": name,
                "markerStyle": "none",
                "color": _numbers(colour),
            }
            label = f"{track.name}: {name}"
            series.append(("plotSeries", self.scene.add("PlotSeries", label, values, [("table", node)])))
        values = {"title": track.name, "xAxisTitle": "time [s]", "titleVisibility": "true", "legendVisibility": "true"}
        self.scene.add("PlotChart", f"{track.name} plot", values, series)

    def _table(self, name: str, columns: dict[str, list[Any]]) -> str:
        token = self._token(name)
        data, schema = table_files(columns)
        self._store.write(f"{DATA}/{token}.tsv", data)
        self._store.write(f"{DATA}/{token}.schema.tsv", schema)
        kept = self.scene.new_id("TableStorage")
        node = self.scene.add(
            "Table", name, {"locked": "true", "useColumnTitleAsColumnHeader": "true"}, [("storage", kept)]
        )
        found = {"fileName": f"{DATA}/{token}.tsv", "schemaFileName": f"{DATA}/{token}.schema.tsv"}
        self.scene.add("TableStorage", f"{name} file", found, node=kept, hidden=True)
        return node

    def _write_axes(self, poses: Sequence[PoseTrack], linked: set[str]) -> None:
        """Show where frames are that nothing else shows: a small cross of axes, red, green and blue."""
        used = {track.frame.lstrip("/") for track in self._tracks} | linked
        moving = [track for track in poses if not track.static and track.child.lstrip("/") not in used]
        if not moving:
            return
        size = min(max(self._extent() / 12, 2.0), 100.0)
        self._store.write(f"{DATA}/axes.vtk", axes_file(size))
        for track in moving:
            display: dict[str, object] = {
                "lineWidth": 4,
                "scalarVisibility": "true",
                "activeScalarName": "colours",
                "scalarRangeFlag": "UseDirectMapping",
            }
            self._model(f"{track.name} axes", f"{DATA}/axes.vtk", self._poses[id(track)].node, display)

    def _write_marks(self) -> None:
        since_ns, until_ns = self._reading.since_ns, self._reading.until_ns
        marks = [
            mark
            for mark in marks_of(self._file)
            if mark.time_ns < until_ns and (mark.time_ns if mark.end_ns is None else mark.end_ns) >= since_ns
        ]
        if not marks:
            return

        def at(time_ns: int | None) -> float:
            return math.nan if time_ns is None else round((time_ns - self.begin_ns) / NS_PER_MS) / 1000

        columns: dict[str, list[Any]] = {
            "time [s]": [at(mark.time_ns) for mark in marks],
            "end [s]": [at(mark.end_ns) for mark in marks],
            "label": [mark.label for mark in marks],
            "text": [mark.text for mark in marks],
            "who": [mark.who for mark in marks],
        }
        self._table("Marks", columns)

    # -- what a user sees first

    def _see(self, points: Array, above: str) -> None:
        """Take notice of points (N, 3) below a transform, as they are at first."""
        while above:
            place, above = self._places.get(above, (np.eye(4), ""))
            points = points @ place[:3, :3].T + place[:3, 3]
        if len(points) and np.isfinite(points).all():
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))

    def _extent(self) -> float:
        """Return the length of the diagonal of all that is seen, mm."""
        return float(np.linalg.norm(self._high - self._low)) if np.isfinite(self._low).all() else 100.0

    def _write_views(self) -> None:
        centre = (self._low + self._high) / 2 if np.isfinite(self._low).all() else np.zeros(3)
        away = max(self._extent(), 20.0) * 1.9
        eye = centre + away * np.array([0.55, 0.7, 0.45]) / np.linalg.norm([0.55, 0.7, 0.45])
        camera = {"position": _numbers(eye), "focalPoint": _numbers(centre), "viewUp": "0 0 1", "layoutName": "1"}
        view = {
            "layoutName": "1",
            "layoutLabel": "1",
            "singletonTag": "1",
            "boxVisible": "false",
            "axisLabelsVisible": "false",
        }
        self.scene.add("View", "View1", {**view, "fieldOfView": f"{max(self._extent(), 20.0):.6g}"})
        self.scene.add("Camera", "Camera", {**camera, "singletonTag": "1"})
        arrangement = _FOUR_UP if self._shown else _ONE_UP_3D
        self.scene.add(
            "Layout",
            "Layout",
            {"currentViewArrangement": arrangement, "singletonTag": "vtkMRMLLayoutNode"},
            hidden=True,
        )
        if not self._shown:
            return
        volume, track, place, above = self._shown
        for name in ("Red", "Green", "Yellow"):
            values = {"singletonTag": name, "layoutName": name}
            self.scene.add("SliceComposite", f"{name} composite", values, [("backgroundVolume", volume)], hidden=True)
        first = track.first
        assert first is not None
        if first.dimensions[2] != 1:
            return
        # the red view shows the plane of the picture, as it is at first; the volume moves, the view does not
        world = place
        while above:
            moved, above = self._places.get(above, (np.eye(4), ""))
            world = moved @ world
        columns = world[:3, :3] / np.maximum(np.linalg.norm(world[:3, :3], axis=0), 1e-12)
        plane = np.eye(4)
        # rows of a picture go down
        plane[:3, :3] = np.c_[columns[:, 0], -columns[:, 1], np.cross(columns[:, 0], -columns[:, 1])]
        middle = np.array([(size - 1) / 2 for size in first.dimensions])
        plane[:3, 3] = world[:3, :3] @ middle + world[:3, 3]
        steps = np.linalg.norm(world[:3, :3], axis=0)
        width, height = (float(step * size) * 1.05 for step, size in zip(steps[:2], first.dimensions[:2], strict=True))
        side = max(width, height)
        values = {
            "layoutName": "Red",
            "singletonTag": "Red",
            "layoutLabel": "R",
            "sliceToRAS": _numbers(plane.ravel()),
            "fieldOfView": _numbers((side, side, 1.0)),
            "dimensions": "512 512 1",
            "sliceVisibility": "true",
        }
        self.scene.add("Slice", "Red", values)

    def _write_browser(self) -> None:
        """Add the browser that plays all; the stream with most of the pictures or poses of the whole time leads."""
        span = max(1, self.end_ns - self.begin_ns) / NS_PER_MS

        def worth(one: tuple[str, str, Track]) -> tuple[bool, bool, int]:
            track = one[2]
            return bool(track.ms[-1] - track.ms[0] >= 0.9 * span), isinstance(track, PictureTrack), len(track.ms)

        played = sorted(self._played, key=worth, reverse=True)
        if not played:
            return
        leader = played[0][2]
        count = len(leader.ms) + (leader.ms[0] > 0)
        soon = [int(track.ms[0]) for *_, track in played if track.ms[0] <= _SOON * span]
        first = int(np.searchsorted(leader.ms, max(soon, default=0), side="left")) + int(leader.ms[0] > 0)
        seconds = max(1, int(leader.ms[-1])) / 1000
        refers = [(f"sequenceNodeRef{n}", sequence) for n, (sequence, _, _) in enumerate(played)]
        refers += [(f"dataNodeRef{n}", node) for n, (_, node, _) in enumerate(played)]
        rule = (
            "playback true recording false overwriteProxyName false saveChanges false "
            "missingItemMode createFromPrevious "
        )
        values: dict[str, object] = {
            "playbackActive": "false",
            "playbackRateFps": f"{min(max(count / seconds, 0.1), 1000):.6g}",
            "playbackItemSkippingEnabled": "true",
            "playbackLooped": "true",
            "selectedItemNumber": min(first, count - 1),
            "recordingActive": "false",
            "indexDisplayFormat": "%.3f",
            "virtualNodePostfixes": " ".join(str(n) for n in range(len(played))),
            **{f"SynchronizationPropertiesMap{n}": rule for n in range(len(played))},
            "attributes": facts({"IgtlGateway.BeginNs": str(self.begin_ns), "IgtlGateway.Clock": self._clock.name}),
        }
        self.scene.add("SequenceBrowser", "Session", values, refers)

    def _write_about(self, digest: Future[str]) -> None:
        account, session = self._reading.account, self._file.session
        seconds = (self.end_ns - self.begin_ns) / NS_PER_S
        lines = [
            f"recording: {Path(self._file.path).name}",
            f"SHA-256: {digest.result()}",
            f"made by: igtl-gateway {session.get('igtl_gateway_version', '')}; exported by igtl-gateway {__version__}",
            f"time: {utc_text(self.begin_ns)} to {utc_text(self.end_ns)}, {seconds:.3f} s",
            "lengths: mm; coordinates as recorded, read as RAS",
            *([f"{self._part}: at index 0 is what was there before, too; others have the rest"] if self._part else []),
            "",
            "in the scene:",
            *(f"  {row.stream} ({row.type}): {row.taken:,} of {row.declared:,}" for row in account.rows if row.taken),
            "left out:",
            *(f"  {row.stream} ({row.type}): {row.left_out:,}: {row.why}" for row in account.rows if row.left_out),
            *([f"  no node shows these types: {', '.join(sorted(account.others))}"] if account.others else []),
            "notes:",
            *(f"  {note}" for note in self.notes),
        ]
        self.scene.add("Text", "About this scene", {"text": "\n".join(lines), "encoding": 1})


class _Node:
    """A transform in the tree: its parent, whether other nodes of its frame lie below it, its identity."""

    def __init__(self) -> None:
        self.parent: PoseTrack | None = None
        self.leads, self.node = False, ""


def _tree(poses: list[PoseTrack]) -> dict[int, _Node]:
    """Sort the poses so that a parent comes before what is below it; return the place of each one."""
    found = {id(track): _Node() for track in poses}
    leaders: dict[str, PoseTrack] = {}
    for track in sorted(poses, key=lambda track: track.rank):
        if track.child and track.child.lstrip("/") not in leaders:
            leaders[track.child.lstrip("/")] = track
    for track in leaders.values():
        found[id(track)].leads = True
    for track in poses:
        above = leaders.get(track.frame.lstrip("/"))
        way = above
        while way is not None and way is not track:
            way = found[id(way)].parent
        if way is None:  # no circle
            found[id(track)].parent = above
    depth: dict[int, int] = {}
    for track in poses:
        way, count = found[id(track)].parent, 0
        while way is not None:
            way, count = found[id(way)].parent, count + 1
        depth[id(track)] = count
    poses.sort(key=lambda track: depth[id(track)])
    return found


def _file_order(track: PictureTrack) -> list[int]:
    """Return the indexes of the frames as they are in the file, ms; an empty one is the last."""
    ms = track.ms
    if len(track.order) == len(track.times):
        ms = np.empty_like(track.ms)
        ms[track.order] = track.ms
    return [*ms.tolist(), *([0] if track.ms[0] > 0 else [])]


def _file_token(name: str) -> str:
    """Return a name as that of a file and of a transform in it: ``Status`` and ``Transform`` have a meaning there."""
    token = "".join(sign if sign.isascii() and sign.isalnum() else "_" for sign in name).strip("_")[:60] or "unnamed"
    return token.replace("Status", "State").replace("Transform", "Pose")


def _volume_values(place: Array) -> dict[str, object]:
    """Return spacing, origin and directions of a volume, as MRML has them: in RAS."""
    steps = np.linalg.norm(place[:3, :3], axis=0)
    turns = place[:3, :3] / np.where(steps > 0, steps, 1)
    return {
        "ijkToRASDirections": _numbers(turns.ravel()),
        "spacing": _numbers(steps),
        "origin": _numbers(place[:3, 3]),
    }


def _numbers(values: Iterable[float] | Array) -> str:
    return " ".join(f"{float(value):.17g}" for value in values)

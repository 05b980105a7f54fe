"""Reads a session once, into the tracks of a scene; pixels and surfaces are written while it is read.

An input is in the scene once: what the gateway made of it is a copy, which shows the frames that it belongs to.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, FreeNames, UnsupportedRecording, distinct_names, failure_text
from igtl_gateway.addon.igtl import (
    ENTRY_ONLY,
    TARGET_ONLY,
    Cells,
    Image,
    NdArray,
    PolyData,
    Sensor,
    Status,
    String,
    Trajectories,
    decode_text,
    describe_content,
)
from igtl_gateway.addon.messages import (
    LengthUnits,
    ToIgtlContext,
    colour_field,
    into_ros,
    millimetres,
    trajectories_to_igtl,
)
from igtl_gateway.addon.notes import LINK_UP
from igtl_gateway.addon.reading import (
    Entry,
    Kind,
    Note,
    SessionFile,
    Stream,
    block_of,
    of_session,
    recorded_acceptance,
    recorded_units,
)
from igtl_gateway.addon.ros import FrameTransform, JointState, LinkStatusList, TFMessage, TrajectoryList
from igtl_gateway.addon.ros import String as RosString
from igtl_gateway.addon.streams import POSE_TYPES, Cloud, Interleaving, name_ros_fields, tools_of, transforms_of
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addon.writing import open_new
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.scene_store import DATA, Store
from igtl_gateway.addons.exchange.scene_tracks import (
    MOST_ITEMS,
    MOST_SAMPLES,
    ItemTrack,
    NumberTrack,
    Pace,
    PictureTrack,
    PoseTrack,
    Track,
)
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, chosen_entries
from igtl_gateway.addons.exchange.surface_out import export_surface_of, vtk
from igtl_gateway.addons.exchange.volume_out import PICTURES, export_picture_of

Array = npt.NDArray[Any]

SURFACES = frozenset(
    {
        "POLYDATA",
        "sensor_msgs/msg/PointCloud2",
        "shape_msgs/msg/Mesh",
        "igtl_msgs/msg/Mesh",
        "visualization_msgs/msg/Marker",
        "igtl_msgs/msg/PolyData",
    }
)
POINTS = frozenset({"POINT", "igtl_msgs/msg/PointList", "geometry_msgs/msg/PointStamped"})
PLANS = frozenset({"TRAJ", TrajectoryList.TYPE})
_TEXTS = frozenset({"STRING", "STATUS", RosString.TYPE})
_NUMBERS = frozenset({"SENSOR", "NDARRAY"})
#: Poses that wait to be decoded together.
_BATCH = 5_000
_HEAD_BYTES = 4_096  # a stamp is in the first ones of a message
_MOST_NUMBERS, _MOST_COLUMNS = 32, 512
_MOST_CHARS = 100_000
#: Bytes of the pictures of one scene: 3D Slicer holds all of them in memory, twice while it reads them.
MOST_PIXELS = 4 << 30
#: Paths of different names in one stream of plans: each is a line of its own.
_MOST_PATHS = 200
_MARKUPS = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
_END_NS = 1 << 63
_ROBOT = re.compile(r"\s*<(\?xml|!--|robot\b)")
_STATUS = b"TransformStatus"


class TooLarge(UnsupportedRecording):
    """A session has more pictures than one sequence holds."""


class NeedsParts(Exception):
    """A session has more pictures than one scene holds."""


class _Full(Exception):
    """The next picture belongs to the next part."""


#: Takes a message; returns the track that has it.
_Taker = Callable[[Entry, ExportedStream], Track | None]


@dataclass(slots=True)
class _Several:
    """What the messages of a stream have in common.

    Attributes:
        take: takes one.
        pace: its thinning.
    """

    take: _Taker | None
    pace: Pace


@dataclass
class SceneReading:
    """The tracks of a session.

    Args:
        file: the session.
        globs: select streams.
        rate: most messages of a stream in a second; 0: as many as 3D Slicer reads in reasonable time.
        store: where files go.
        direct: the stream of pictures that goes straight into the store: its channel; ``""``: none.
        only_pictures: read pictures, and no other messages.
        in_parts: ``read`` stops where a scene is full; else it raises NeedsParts.

    Attributes:
        tracks: all tracks that have a message.
        robots: topic and text of each description of a robot.
        account: of the export.
        since_ns, until_ns: gateway time of the part, UTC ns: from the first on, before the second.
    """

    file: SessionFile
    globs: Sequence[str]
    rate: float
    store: Store
    direct: tuple[Kind, str, str] | None = None
    only_pictures: bool = False
    in_parts: bool = False
    account: ExportAccount = field(default_factory=ExportAccount)
    since_ns: int = 0
    until_ns: int = _END_NS
    tracks: dict[tuple[object, ...], Track] = field(default_factory=dict)
    robots: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._streams: dict[tuple[str, str, str], Stream] = {
            (stream.direction, stream.name, stream.type): stream for stream in of_session(self.file).streams.values()
        }
        self._units, self._accepted = recorded_units(self.file), recorded_acceptance(self.file)
        self._decoder = MessageDecoder(lambda ros_type: self.file.definitions.get(ros_type, ""))
        self._kinds: dict[tuple[Kind, str, str], _Several] = {}
        self._waiting: dict[tuple[object, ...], list[Entry]] = {}
        self._links: dict[tuple[Kind, str, str], Interleaving] = {}
        self._files = FreeNames()
        #: Stream of plans → the names of the paths in its last message.
        self._shown: dict[tuple[object, ...], set[str]] = {}
        #: Stream of plans, name of a path → its track.
        self._path_tracks: dict[tuple[tuple[object, ...], str], ItemTrack] = {}
        counts = {(each.kind, each.stream or each.topic, each.entry_type): each.count for each in self.file.channels}
        self._counts = counts
        self._declared, self._pixels, self._has_new = 0, 0, False
        #: The last message of each stream: the next part begins with them.
        self._carried: dict[tuple[object, ...], tuple[Entry, _Several]] = {}
        self._pending: tuple[Entry, ExportedStream, _Several] | None = None
        #: The track of the last input, and the name of its stream.
        self._last: Track | None = None
        self._written = ""
        kinds = (*IGTL_KINDS, *ROS_KINDS)
        self._entries = chosen_entries(self.file, kinds, self.globs, self.account, on_input=self._see_input)
        #: Links that are down.
        self._gone: set[int] = set()
        #: Stream → link → the end of the key of its tracks.
        self._lanes: dict[tuple[Kind, str, str], dict[int, str]] = {}
        self._span_ns = max(1, self.file.end_ns - self.file.start_ns)

    # -- the pass

    def read(self) -> bool:
        """Read the session, or its next part; return whether there is another part.

        Raises NeedsParts, GatewayError, OSError.
        """
        is_full = False
        try:
            self._read()
        except _Full:
            is_full = True
        for key_of_poses in list(self._waiting):
            self._decode(key_of_poses)
        self._join_links()
        self._join_frames()
        self._name_lanes()
        for name, track in list(self.tracks.items()):
            if not track.times:
                self._drop(name, track)
        return is_full

    def _see_input(self, entry: Entry) -> None:
        self._last, self._written = None, ""
        if entry.kind is Kind.LINK:
            self._see_link(entry)

    def _read(self) -> None:
        """Take the messages up to the end, or to a picture that is too many.  Raises _Full, NeedsParts."""
        if self._pending is not None:
            pending, self._pending = self._pending, None
            self._take(*pending)
        for entry in self._entries:
            key = (entry.kind, entry.channel, entry.type)
            if self._written and not entry.kind.is_input:
                self.account.row(entry).leave_out(f"copies of {self._written}; --streams selects them alone")
                if self._last is not None and not self._last.frame:
                    _learn(self._last, entry)
                continue
            several = self._kinds.get(key)
            if several is None:
                several = self._kinds[key] = self._several_of(entry)
            if several.take is None:
                self.account.others[entry.type] = self.account.others.get(entry.type, 0) + 1
                continue
            row = self.account.row(entry)
            if entry.kind is Kind.IGTL_IN:
                self._links.setdefault(key, Interleaving()).add(entry.links)
            if several.pace.passes(entry.source_ns or entry.stamp_ns):
                self._take(entry, row, several)
            else:
                row.leave_out(several.pace.why)
                if entry.kind.is_input:
                    self._written = entry.channel

    def _take(self, entry: Entry, row: ExportedStream, several: _Several) -> None:
        """Take a message of a stream of the scene.  Raises _Full, NeedsParts."""
        assert several.take is not None
        taken = row.taken
        try:
            self._last = several.take(entry, row)
        except (NeedsParts, TooLarge):
            raise
        except _Full:
            self._pending, self.until_ns = (entry, row, several), entry.stamp_ns
            raise
        except Exception as error:  # decoding raises many types of errors; only this message is left out
            row.fail(failure_text(error))
            return
        if entry.kind.is_input:
            self._written = entry.channel
        # poses are counted when they are decoded
        if self.in_parts and (row.taken > taken or (several.take == self._pose and not _is_invalid(entry))):
            self._carried[entry.kind, entry.channel, entry.type, entry.links, _frames(entry)] = (entry, several)

    def begin_part(self, store: Store) -> None:
        """Begin the next part: with the last message of each stream, which 3D Slicer would go on to show."""
        self.store, self.since_ns, self.until_ns = store, self.until_ns, _END_NS
        before, account = self.tracks, self.account
        self.tracks, self.account = {}, ExportAccount()
        self._files, self._pixels, self._has_new = FreeNames(), 0, False
        self.robots.clear()
        self._shown.clear()
        self._path_tracks.clear()
        for entry, several in self._carried.values():
            early = replace(entry, stamp_ns=min(entry.stamp_ns, self.since_ns - 1))
            assert several.take is not None
            several.take(early, self.account.row(early))
        for key in list(self._waiting):
            self._decode(key)
        for name, track in self.tracks.items():
            if (known := before.get(name)) is not None:
                track.frame = track.frame or known.frame
            if isinstance(track, PoseTrack) and isinstance(known, PoseTrack):
                track.child = track.child or known.child
            if isinstance(track, ItemTrack) and isinstance(known, ItemTrack):
                track.colour = track.colour or known.colour
        self.account = account

    def _drop(self, key: tuple[object, ...], track: Track) -> None:
        """Forget a track without a message."""
        if isinstance(track, PictureTrack | ItemTrack) and track.stream is not None:
            track.stream.close()
            if not isinstance(track, PictureTrack) or key != self.direct:
                self.store.waiting(track.file).unlink(missing_ok=True)
        del self.tracks[key]

    def close(self) -> None:
        """Close what an error has left open: all of it, also on a full disk.  Raises OSError."""
        failure: OSError | ValueError | None = None
        for track in self.tracks.values():
            if isinstance(track, PictureTrack | ItemTrack) and track.stream is not None:
                try:
                    track.stream.close()
                except (OSError, ValueError) as error:
                    failure = failure or error
        if failure is not None:
            raise failure

    def _several_of(self, entry: Entry) -> _Several:
        """Return how the messages of a stream are taken, by its first one."""
        take = self._taker_of(entry)
        key = (entry.kind, entry.channel, entry.type)
        most = MOST_ITEMS if entry.type in SURFACES | POINTS | PLANS | _TEXTS else MOST_SAMPLES
        return _Several(take, Pace.of(self.rate, self._counts.get(key, 0), most, self._span_ns))

    def _taker_of(self, entry: Entry) -> _Taker | None:
        kind = entry.type
        if kind in PICTURES:
            return self._picture
        if self.only_pictures:
            return None
        if kind in SURFACES:
            return self._surface
        if kind in POINTS:
            return self._points
        if kind in PLANS:
            return self._plan
        if kind in ("TDATA", "QTDATA", TFMessage.TYPE):
            return self._poses_of_frames
        if kind in POSE_TYPES:
            return self._pose
        if kind in _TEXTS:
            return self._text
        if kind == JointState.TYPE:
            return self._joint_state
        if kind in _NUMBERS:
            return self._wire_numbers
        if entry.kind in IGTL_KINDS or kind == LinkStatusList.TYPE:
            return None
        try:
            self._stream(entry).poses_of([block_of([entry])])
        except ConfigError:
            return self._any_of_ros if self._fits_any(entry) else None
        except Exception:  # a damaged first message is no reason to leave out the others
            return self._any_of_ros
        return self._pose

    def _stream(self, entry: Entry) -> Stream:
        return self._streams[entry.kind.value, entry.channel, entry.type]

    def _unit(self, entry: Entry) -> str:
        return str(self._units.of(entry.kind, entry.channel, entry.type, entry.links))

    def _stamp(self, entry: Entry) -> int:
        """Return the stamp in a message, UTC ns; 0 = unset."""
        if entry.kind in IGTL_KINDS:
            return entry.source_ns
        head = replace(entry, payload=(bytes(memoryview(entry.data())[:_HEAD_BYTES]),))
        return int(self._stream(entry).stamps_of(block_of([head]))[0])

    def _new(self, entry: Entry, kind: type[Track], key: tuple[object, ...], **more: Any) -> Any:
        """Return the track of a key, a new one if it is not known."""
        track = self.tracks.get(key)
        if track is None:
            igtl = entry.kind in IGTL_KINDS
            side = "in" if entry.kind.is_input else "out"
            name = entry.channel.partition("/")[2] if igtl else entry.channel.strip("/")
            sender = f"link {entry.links}" if entry.kind is Kind.IGTL_IN else ""
            given = {"wanted": name or entry.type, "sender": sender, **more}
            track = self.tracks[key] = kind(source=f"{side}:{entry.channel}", type=entry.type, **given)
        return track

    # -- peers

    def _see_link(self, entry: Entry) -> None:
        """Take notice of a peer that came or went."""
        if Note.of(entry.data()).code == LINK_UP:
            self._gone.difference_update(entry.links)
        else:
            self._gone.update(entry.links)

    def _key(self, entry: Entry, *more: str) -> tuple[object, ...]:
        """Return the key of a track: a peer beside another one has its own, one that came again goes on with its."""
        stream = (entry.kind, entry.channel, entry.type)
        if entry.kind is not Kind.IGTL_IN or not entry.links:
            return (*stream, *more)
        lanes, link = self._lanes.setdefault(stream, {}), entry.links[0]
        if link not in lanes:
            free = (lane for lane in lanes.values() if {at for at, its in lanes.items() if its == lane} <= self._gone)
            lanes[link] = next(free, f"@{link}" if lanes else "")
        return (*stream, *more, lanes[link]) if lanes[link] else (*stream, *more)

    def _name_lanes(self) -> None:
        """Name the peers of streams that came from several at the same time."""
        for stream, lanes in self._lanes.items():
            if len(set(lanes.values())) < 2:
                continue
            first = next(iter(lanes))
            for key, track in self.tracks.items():
                if key[:3] == stream and not isinstance(track, PoseTrack):
                    lane = str(key[-1]) if key[-1] in lanes.values() and len(key) > 3 else f"@{first}"
                    track.wanted, track.source = f"{track.wanted}{lane}", f"{track.source}{lane}"

    # -- poses

    def _pose(self, entry: Entry, row: ExportedStream) -> Track:
        """Take a message with one pose: it is decoded with others."""
        link = entry.links[0] if entry.kind is Kind.IGTL_IN and entry.links else 0
        key = (entry.kind, entry.channel, entry.type, "", link)
        track: PoseTrack = self._new(entry, PoseTrack, key, rank=1 if entry.kind in ROS_KINDS else 2)
        track.row = row
        waiting = self._waiting.setdefault(key, [])
        waiting.append(entry)
        if len(waiting) >= _BATCH:
            self._decode(key)
        return track

    def _decode(self, key: tuple[object, ...]) -> None:
        entries, track = self._waiting.pop(key), self.tracks[key]
        assert isinstance(track, PoseTrack)
        assert track.row is not None
        try:
            poses = self._stream(entries[0]).poses_of([block_of(entries)]).in_unit("mm")
        except ConfigError as error:  # not one of them has a pose
            track.row.leave_out(failure_text(error), len(entries))
            track.row.failed += len(entries)
            return
        good = np.isfinite(poses.matrices).all(axis=(1, 2))
        invalid = np.array([_is_invalid(entries[row]) for row in poses.rows.tolist()], np.bool_)
        kept = good & ~invalid
        for number, why, is_fault in (
            (len(entries) - len(poses), "no pose that can be read", True),
            (int(np.count_nonzero(~good)), "not finite", False),
            (int(np.count_nonzero(good & invalid)), "its TransformStatus is not OK", False),
        ):
            if number:
                track.row.leave_out(why, number)
                track.row.failed += number * is_fault
        poses = poses[kept]
        track.row.taken += len(poses)
        track.times += poses.times.tolist()
        track.stamps += poses.stamps.tolist()
        track.sources += poses.source_times.tolist()
        track.parts.append(poses.matrices)
        track.child, track.frame = track.child or poses.child, track.frame or poses.parent

    def _poses_of_frames(self, entry: Entry, row: ExportedStream) -> Track | None:
        """Take a message with the poses of several frames, each of which is a track."""
        ros = entry.kind in ROS_KINDS
        data = entry.data()
        found = list(transforms_of(memoryview(data)) if ros else tools_of(self._accepted.message(data).content))
        lengths = millimetres(self._unit(entry))
        static = ros and entry.channel.rpartition("/")[2] == "tf_static"
        track: PoseTrack | None = None
        for parent, child, stamp_ns, matrix in found:
            key = self._key(entry, parent, child)
            track = self._new(
                entry, PoseTrack, key, rank=0 if ros else 2, frame=parent, child=child, static=static,
                wanted=f"{child} to {parent}" if parent else child,
            )  # fmt: skip
            if not np.isfinite(matrix).all():
                continue
            place = matrix.copy()
            place[:3, 3] = [lengths.to_ros(float(value)) for value in matrix[:3, 3]]
            track.add_time(entry, stamp_ns or (0 if ros else entry.source_ns))
            track.parts.append(place[None])
        row.taken += 1
        return track if len(found) == 1 else None

    def _join_links(self) -> None:
        """Join the poses that came over several links if the peer connected again: they are one movement."""
        for key, one in self._links.items():
            mine = [each for each in self.tracks if each[:3] == key and len(each) == 5 and isinstance(each[4], int)]
            tracks = [self.tracks[each] for each in mine]
            if len(mine) < 2:
                continue
            for track, (*_, link) in zip(tracks, mine, strict=True):
                if one.is_mixed:
                    track.wanted, track.source = f"{track.wanted}@{link}", f"{track.source}@{link}"
            if not one.is_mixed:
                first = tracks[0]
                assert isinstance(first, PoseTrack)
                for other, name in zip(tracks[1:], mine[1:], strict=True):
                    assert isinstance(other, PoseTrack)
                    first.times += other.times
                    first.stamps += other.stamps
                    first.sources += other.sources
                    first.parts += other.parts
                    del self.tracks[name]

    def _join_frames(self) -> None:
        """Give the paths of a plan the frame that a copy has shown of one of them."""
        plans = {key: track for key, track in self.tracks.items() if key[2] in PLANS}
        frames = {key[:3]: track.frame for key, track in plans.items() if track.frame}
        for key, track in plans.items():
            track.frame = track.frame or frames.get(key[:3], "")

    # -- pictures

    def _picture(self, entry: Entry, row: ExportedStream) -> Track | None:
        image = export_picture_of(entry, self._unit(entry), self._accepted)
        key = self._key(entry)
        track: PictureTrack = self._new(entry, PictureTrack, key)
        if track.stream is None:
            if len(key) == 3 and not self.in_parts:  # with all peers
                self._check_size(entry, image)
            name = self._files.take(_token(track.wanted))
            track.file = f"{DATA}/{name}.raw"
            if self.store.direct or key == self.direct:
                track.stream = self.store.opened(track.file)
            else:
                track.stream = open_new(self.store.waiting(track.file))
        if why := track.mismatch(image):
            row.fail(why)
            return None
        self._check_room(entry, image)
        if entry.kind in ROS_KINDS and not track.frame:
            track.frame = frame_id_of(entry)
        track.add_time(entry, self._stamp(entry))
        track.add(image)
        track.row = row
        row.taken += 1
        return track

    def _check_size(self, entry: Entry, image: Image) -> None:
        """Count the pixels of a stream, by its first picture.  Raises NeedsParts; for one sequence ConfigError."""
        key = (entry.kind, entry.channel, entry.type)
        count, pace = self._counts.get(key, 1), self._kinds[key].pace
        if pace.period_ns:
            count = min(count, self._span_ns // pace.period_ns + 1)
        self._declared += count * image.expected_bytes
        if self._declared <= MOST_PIXELS:
            return
        if self.only_pictures:
            raise TooLarge(
                f"{self.file.path}: found {count_text(self._declared, 'byte')} of pictures up to {entry.channel}, "
                "expected at most "
                f"{MOST_PIXELS:,} in one sequence: --to mrb makes several scenes of them; --rate leaves pictures out"
            )
        raise NeedsParts

    def _check_room(self, entry: Entry, image: Image) -> None:
        """Count the pixels of a picture.  Raises _Full, NeedsParts where the scene has others already."""
        self._pixels += image.expected_bytes
        if self._pixels > MOST_PIXELS and self._has_new and not self.only_pictures:
            raise _Full if self.in_parts else NeedsParts
        self._has_new = entry.stamp_ns >= self.since_ns  # what is carried is earlier

    # -- items

    def _items(
        self,
        entry: Entry,
        tag: str,
        storage: str,
        suffix: str,
        empty: tuple[dict[str, object], bytes],
        more: tuple[str, ...] = (),
    ) -> ItemTrack:
        """Return the track of a stream; ``more``: the name of a part of it, which is a track of its own."""
        key = self._key(entry, *more)
        is_new = key not in self.tracks
        track: ItemTrack = self._new(entry, ItemTrack, key, tag=tag, storage=storage, suffix=suffix, empty=empty)
        if is_new and more:
            track.wanted, track.source = (f"{each} {' '.join(more)}" for each in (track.wanted, track.source))
        if track.stream is None:
            track.file = f"{DATA}/{self._files.take(_token(track.wanted))}.seq.mrb"
            path = self.store.waiting(track.file)
            open_new(path).close()  # with the mode of new files, which zipfile does not know
            track.stream = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED)
        return track

    def _surface(self, entry: Entry, row: ExportedStream) -> Track:
        surface = export_surface_of(entry, self._unit(entry), self._accepted)
        content = surface.content
        track = self._items(entry, "Model", "ModelStorage", "vtk", ({}, _EMPTY_SURFACE))
        written = vtk(_with_cells(content))
        if not track.times:
            colours = next((each for each in content.attributes if colour_field(each)), None)
            track.scalars = "colours" if colours else ""
        track.has_faces = track.has_faces or bool(content.polygons.count or content.cells[3].count)
        track.see(content.points[np.isfinite(content.points).all(axis=1)])
        track.add({}, (written.data,))
        track.add_time(entry, self._stamp(entry))
        track.row = row
        for unit, number, why in (("points", surface.holes, "no finite coordinates"), *written.parts):
            if number and why:
                part = self.account.part(entry, unit)
                part.declared += number
                part.leave_out(why, number)
        if entry.kind in ROS_KINDS and not track.frame:
            track.frame = frame_id_of(entry)
        row.taken += 1
        return track

    def _points(self, entry: Entry, row: ExportedStream) -> Track:
        (cloud,) = self._stream(entry).points_of([block_of([entry])])
        lengths = millimetres(cloud.unit)
        points = np.array([[lengths.to_ros(float(value)) for value in point] for point in cloud.xyz]).reshape(-1, 3)
        good = np.isfinite(points).all(axis=1)
        data, colour = _markups(points, good, cloud)
        track = self._items(entry, "MarkupsFiducial", "MarkupsJsonStorage", "mrk.json", ({}, _NO_MARKUPS))
        if track.colour is None and colour is not None:
            track.colour = colour
        track.see(points[good])
        track.add({}, (data,))
        track.add_time(entry, self._stamp(entry))
        if entry.kind in ROS_KINDS and not track.frame:
            track.frame = cloud.frame
        if count := int(np.count_nonzero(~good)):
            part = self.account.part(entry, "points")
            part.declared += count
            part.leave_out("no finite coordinates", count)
        row.taken += 1
        track.row = row
        return track

    def _plan(self, entry: Entry, row: ExportedStream) -> Track | None:
        """Take a plan: each of its paths is a line, which is empty while the plan does not have it."""
        elements = self._paths(entry)
        ends = np.stack([elements["entry"], elements["target"]], axis=1).astype(float)
        meant = np.array([_ENDS.get(int(kind), (True, True)) for kind in elements["type"]]).reshape(-1, 2)
        good = (np.isfinite(ends).all(axis=2) | ~meant).all(axis=1)
        labels = [decode_text(bytes(name)) or "path" for name in elements["name"]]
        names = distinct_names(dict(enumerate(labels)), lambda name: name, other=lambda name, n: f"{name} {n}")
        begin = self._key(entry)
        known = {name: track for (stream, name), track in self._path_tracks.items() if stream == begin}
        before, shown, beyond = self._shown.get(begin, set()), set[str](), 0
        for number, name in names.items():
            if not good[number]:
                continue
            if name not in known and len(known) >= _MOST_PATHS:
                beyond += 1
                continue
            path, points = elements[number], ends[number][meant[number]]
            track = known[name] = self._path_track(entry, name)
            if any(path["rgba"]) and track.colour is None:
                red, green, blue = (float(value) / 255 for value in path["rgba"][:3])
                track.colour = red, green, blue
            track.see(points)
            track.add({}, (_line(path, points, meant[number]),))
            track.add_time(entry, self._stamp(entry))
            track.row = row
            shown.add(name)
        for name in before - shown:  # the plan does not have it any more
            track = self._path_track(entry, name)
            track.add({}, (_NO_LINE,))
            track.add_time(entry, self._stamp(entry))
        self._shown[begin] = shown
        for count, why in (
            (int(np.count_nonzero(~good)), "no finite coordinates"),
            (beyond, f"more than {_MOST_PATHS} different ones in a stream"),
        ):
            if count:
                part = self.account.part(entry, "paths")
                part.declared += count
                part.leave_out(why, count)
        row.taken += 1
        return next(iter(known.values()), None)

    def _path_track(self, entry: Entry, name: str) -> ItemTrack:
        track = self._items(entry, "MarkupsLine", "MarkupsJsonStorage", "mrk.json", ({}, _NO_LINE), (name,))
        self._path_tracks[self._key(entry), name] = track
        return track

    def _paths(self, entry: Entry) -> Array:
        """Return the paths of a plan (``TRAJECTORY_DTYPE``), mm."""
        unit = self._unit(entry)
        if entry.kind in ROS_KINDS:
            message = TrajectoryList.unpack(entry.data())
            content = trajectories_to_igtl(message, ToIgtlContext(LengthUnits(unit, "mm"))).content
        else:
            content = self._accepted.message(entry.data()).content
        if not isinstance(content, Trajectories):
            raise ConfigError("found no plan, expected one")
        if entry.kind in ROS_KINDS or unit == "mm":
            return content.elements
        elements, lengths = content.elements.copy(), millimetres(unit)
        for name in ("entry", "target", "diameter"):
            elements[name] = into_ros(lengths, elements[name], np.empty(elements[name].shape, np.float32))
        return elements

    def _text(self, entry: Entry, row: ExportedStream) -> Track | None:
        if entry.kind in ROS_KINDS:
            text = RosString.unpack(entry.data()).data
        else:
            content = self._accepted.message(entry.data()).content
            match content:
                case String():
                    text = content.text
                case Status():
                    words = describe_content(content)
                    text = " ".join(f"{name}: {value}" for name, value in words.items() if value not in ("", None))
                case _:
                    raise ConfigError("found no text, expected one")
        if _ROBOT.match(text) and "<robot" in text and "<link" in text:
            self.robots.append((entry.channel, text))
            row.taken += 1
            return None
        return self._take_text(entry, row, text)

    def _take_text(self, entry: Entry, row: ExportedStream, text: str) -> Track:
        track = self._items(entry, "Text", "", "", ({"text": "", "encoding": 1}, b""))
        if len(text) > _MOST_CHARS:
            raise ConfigError(
                f"found {count_text(len(text), 'character')}, expected at most {_MOST_CHARS:,} in a node of strings"
            )
        track.row = row
        if track.values and track.values[-1]["text"] == text:
            row.leave_out("the text before it, once more")
            return track
        track.add({"text": text, "encoding": 1})
        track.add_time(entry, self._stamp(entry))
        row.taken += 1
        return track

    # -- numbers

    def _joint_state(self, entry: Entry, row: ExportedStream) -> Track:
        message = JointState.unpack(entry.data())
        track: NumberTrack = self._new(entry, NumberTrack, (entry.kind, entry.channel, entry.type))
        names = message.name or tuple(f"joint{number + 1}" for number in range(len(message.position)))
        numbers = {
            f"{name} {what}": float(value)
            for what, values in (
                ("position", message.position),
                ("velocity", message.velocity),
                ("effort", message.effort),
            )
            for name, value in zip(names, values, strict=False)
        }
        self._take_numbers(track, entry, row, numbers)
        track.joints.append((message.name, message.position.tolist()))
        return track

    def _wire_numbers(self, entry: Entry, row: ExportedStream) -> Track:
        content = self._accepted.message(entry.data()).content
        match content:
            case Sensor():
                values = content.values
            case NdArray():
                values = content.array.ravel().real
            case _:
                raise ConfigError("found no numbers, expected some")
        if len(values) > 256:
            raise ConfigError(f"found {count_text(len(values), 'number')}, expected at most 256 in a table")
        track: NumberTrack = self._new(entry, NumberTrack, self._key(entry))
        self._take_numbers(track, entry, row, {str(number + 1): float(v) for number, v in enumerate(values.tolist())})
        return track

    def _take_numbers(
        self, track: NumberTrack, entry: Entry, row: ExportedStream, numbers: Mapping[str, float]
    ) -> None:
        if len(track.columns | dict.fromkeys(numbers)) > _MOST_COLUMNS:
            raise ConfigError(f"found more than {_MOST_COLUMNS} different names, expected at most that in a table")
        for name in numbers:
            track.columns.setdefault(name, len(track.columns))
        track.rows.append({track.columns[name]: value for name, value in numbers.items()})
        track.add_time(entry, self._stamp(entry))
        track.row = row
        row.taken += 1

    def _fits_any(self, entry: Entry) -> bool:
        """Return whether a message of any ROS type has a few numbers or strings."""
        try:
            numbers, texts = self._leaves(entry)
        except Exception:  # what cannot be decoded is not shown
            return False
        return 0 < len(numbers) + len(texts) and len(numbers) <= _MOST_NUMBERS

    def _leaves(self, entry: Entry) -> tuple[dict[str, float], dict[str, str]]:
        message = self._decoder.decode(entry.type, bytes(entry.data()))
        named = name_ros_fields(self._decoder.store(entry.type), message)
        numbers: dict[str, float] = {}
        texts: dict[str, str] = {}
        for name, value in _flat("", named):
            if name.split(".")[0] == "header":
                continue
            if isinstance(value, str):
                texts[name] = value
            else:
                numbers[name] = float(value)
        return numbers, texts

    def _any_of_ros(self, entry: Entry, row: ExportedStream) -> Track:
        numbers, texts = self._leaves(entry)
        known = self.tracks.get((entry.kind, entry.channel, entry.type))
        if isinstance(known, NumberTrack) or (known is None and not texts):
            if len(numbers) > _MOST_NUMBERS:
                raise ConfigError(f"found {count_text(len(numbers), 'number')}, expected at most {_MOST_NUMBERS}")
            track: NumberTrack = self._new(entry, NumberTrack, (entry.kind, entry.channel, entry.type))
            self._take_numbers(track, entry, row, numbers)
            return track
        words = [*texts.items(), *((name, f"{value:g}") for name, value in numbers.items())]
        return self._take_text(entry, row, "\n".join(f"{name}: {value}" for name, value in words))


def _learn(track: Track, copy: Entry) -> None:
    """Take the frames of a stream from what the gateway made of a message of it."""
    if copy.kind is not Kind.ROS_OUT:
        return
    if isinstance(track, PoseTrack):
        if copy.type == FrameTransform.TYPE:
            found = FrameTransform.unpack(copy.data())
            track.frame, track.child = found.header.frame_id, found.child_frame_id
    elif copy.type in PICTURES | SURFACES | POINTS | PLANS:
        track.frame = frame_id_of(copy)


def frame_id_of(entry: Entry) -> str:
    """Return the frame of a message that begins with a header."""
    data = memoryview(entry.data())
    if len(data) < 16:
        return ""
    length = int.from_bytes(data[12:16], "little" if data[1] & 1 else "big")
    if not 0 < length <= 256 or len(data) < 16 + length:
        return ""
    return bytes(data[16 : 15 + length]).decode("utf-8", "replace")


def _frames(entry: Entry) -> tuple[str, ...]:
    """Return the frames of a message with the poses of several: each of its senders has others."""
    if entry.type != TFMessage.TYPE:
        return ()
    return tuple(child for _, child, _, _ in transforms_of(memoryview(entry.data())))


def _is_invalid(entry: Entry) -> bool:
    """Return whether the metadata of a TRANSFORM state that it is not valid."""
    if entry.kind not in IGTL_KINDS or entry.type != "TRANSFORM":
        return False
    data = bytes(entry.data())
    at = data.find(_STATUS)
    return at >= 0 and b"OK" not in data[at + len(_STATUS) :]


def _token(name: str) -> str:
    """Return a name as that of a file: letters and digits of ASCII."""
    return re.sub(r"[^A-Za-z0-9-]+", "_", name).strip("_-")[:60] or "unnamed"


def _flat(place: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _flat(f"{place}.{name}" if place else str(name), inner)
    elif isinstance(value, np.ndarray | list | tuple):
        for number, inner in enumerate(value):
            if number > _MOST_COLUMNS:
                return
            yield from _flat(f"{place}.{number}", inner)
    elif isinstance(value, bool | int | float | str | np.number):
        yield place, value


def _markups(
    points: Array, good: npt.NDArray[np.bool_], cloud: Cloud
) -> tuple[bytes, tuple[float, float, float] | None]:
    """Return points as markups of 3D Slicer, and the colour of the first one."""
    controls = []
    for number, point in enumerate(points.tolist()):
        if not good[number]:
            continue
        label = cloud.names[number] if number < len(cloud.names) else str(number + 1)
        controls.append(
            {
                "id": str(number + 1),
                "label": label,
                "position": point,
                "selected": True,
                "locked": True,
                "visibility": True,
                "positionStatus": "defined",
            }
        )
    rgba = cloud.fields.get("rgba")
    colour = None
    if rgba is not None and len(rgba) and not (rgba[0][:3] == 255).all():
        red, green, blue = (float(value) / 255 for value in rgba[0][:3])
        colour = red, green, blue
    return _markups_file(controls), colour


def _line(path: Any, points: Array, meant: Array) -> bytes:
    """Return a path as a line of 3D Slicer: the ends that its type means; what a line does not have is described."""
    words = {"group": decode_text(bytes(path["group"])), "owner": decode_text(bytes(path["owner"]))}
    if path["diameter"]:
        words["diameter"] = f"{float(path['diameter']):g} mm"
    controls: list[dict[str, object]] = [
        {
            "id": str(number + 1),
            "label": label,
            "description": "; ".join(f"{name}: {word}" for name, word in words.items() if word),
            "position": point,
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, (label, point) in enumerate(zip(np.array(["entry", "target"])[meant], points.tolist(), strict=True))
    ]
    return _markups_file(controls, "Line")


def _markups_file(controls: list[dict[str, object]], kind: str = "Fiducial") -> bytes:
    one = {
        "type": kind,
        # 3D Slicer logs three warnings for each line in a sequence that measures its length
        **({"measurements": [{"name": "length", "enabled": False}]} if kind == "Line" else {}),
        "coordinateSystem": "RAS",
        "coordinateUnits": "mm",
        "locked": True,
        "labelFormat": "%d",
        "controlPoints": controls,
    }
    return json.dumps({"@schema": _MARKUPS, "markups": [one]}).encode()


def _with_cells(content: PolyData) -> PolyData:
    """Return a surface, with a vertex for each point if it has no cells: a program shows cells, not points."""
    if any(cells.count for cells in content.cells) or not len(content.points):
        return content
    count = len(content.points)
    data = np.empty((count, 2), np.uint32)
    data[:, 0], data[:, 1] = 1, np.arange(count)
    return replace(content, vertices=Cells(count, data.ravel()))


_NO_MARKUPS, _NO_LINE = _markups_file([]), _markups_file([], "Line")
#: Type of a path → whether its entry, and its target, are meant.
_ENDS = {ENTRY_ONLY: (True, False), TARGET_ONLY: (False, True)}
_EMPTY_SURFACE = b"# vtk DataFile Version 3.0\nempty, SPACE=RAS\nBINARY\nDATASET POLYDATA\nPOINTS 0 float\n\n"

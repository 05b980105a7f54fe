"""Import of videos with tables of kinematics, as a recipe describes them, as a session of ROS messages.

Poses become PoseStamped, joints JointState, frames of videos CompressedVideo as they are encoded, or Image where a
frame needs a later one.  Units become m and rad.  The stamps are those of the tables; a frame has its time in the file
after that of the first frame, or that of its row of a table.

Memory: the tables, and one frame of each video.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording
from igtl_gateway.addon.reading import Buffer, Kind
from igtl_gateway.addon.ros import CompressedVideo, Header, Image, JointState, PoseStamped
from igtl_gateway.addon.streams import quaternions_of
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, NonRosSource, note_item
from igtl_gateway.addons.lerobot.clips import decoded_frames, encoded_frames, format_of_frames
from igtl_gateway.addons.lerobot.kinematics_hdf5 import open_hdf5
from igtl_gateway.addons.lerobot.kinematics_recipe import (
    JOINTS,
    LENGTHS,
    UTC,
    JointsRow,
    KinematicsRecipe,
    PoseRow,
    TableRow,
    VideoRow,
    is_hdf5,
    read_kinematics_recipe,
)
from igtl_gateway.addons.lerobot.kinematics_table import LATEST_NS, KinematicsTable, open_csv
from igtl_gateway.addons.lerobot.set_streams import are_poses, joint_messages, pose_messages

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]
Stamped = tuple[int, Buffer]

#: Time from a stamp to its entry: an entry at its stamp would have none.
_AGE_NS = 1
#: Largest difference of the products of a rotation's columns from those of axes: rounding to two decimals.
_OFF = 2e-2


@dataclass(slots=True)
class _Stream:
    topic: str
    type: str
    row: ImportedStream
    messages: Iterator[Stamped]


@dataclass(frozen=True, slots=True)
class _Frames:
    """The times of the frames of a video: those of a table, UTC ns, or the first one."""

    start_ns: int
    times: Times | None
    of: str


def open_kinematics(path: Path, epoch_ns: int | None, default_ns: int) -> KinematicsSource:
    """Open a recipe.

    Args:
        path: of the recipe.
        epoch_ns: the begin, UTC ns; None: the first UTC time of a table, or else ``default_ns``.
        default_ns: see there.

    Raises ConfigError for what the recipe has, other GatewayErrors for what the files have.
    """
    return KinematicsSource(path, epoch_ns, default_ns)


class KinematicsSource(NonRosSource):
    """An open recipe with its files.  Raises GatewayError."""

    def __init__(self, path: Path, epoch_ns: int | None, default_ns: int) -> None:
        recipe = read_kinematics_recipe(path)
        super().__init__(f"kinematics {path.name}", {"imported_format": "kinematics"})
        self._path = path
        self._streams: list[_Stream] = []
        try:
            self._open(recipe, epoch_ns, default_ns)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
        self.rows = [each.row for each in self._streams]

    def _open(self, recipe: KinematicsRecipe, epoch_ns: int | None, default_ns: int) -> None:
        opened = [(row, _opened(recipe, row, f"table[{number}]")) for number, row in enumerate(recipe.table)]
        own = [self._own_times(row, table, f"table[{number}]") for number, (row, table) in enumerate(opened)]
        firsts = [int(times[0]) for (row, _), times in zip(opened, own, strict=True) if row.zero == UTC]
        begin_ns = min(firsts) if firsts and epoch_ns is None else default_ns if epoch_ns is None else epoch_ns
        self._begin_ns = begin_ns
        for number, ((row, table), times) in enumerate(zip(opened, own, strict=True)):
            at = times if row.zero == UTC else times + begin_ns
            _check_times(at, table.path)
            for index, pose in enumerate(row.pose):
                self._add_poses(pose, table, at, f"table[{number}].pose[{index}]")
            for index, joints in enumerate(row.joints):
                self._add_joints(joints, table, at, f"table[{number}].joints[{index}]")
        is_utc = any(row.zero == UTC for row in recipe.table)
        for number, video in enumerate(recipe.video):
            self._add_video(recipe, video, is_utc, f"video[{number}]")
        begin = np.datetime_as_string(np.datetime64(begin_ns, "ns"), unit="ms")
        what = "the first UTC time" if firsts and epoch_ns is None else "the tables have no date"
        self.notes.append(f"the begin is {begin}Z" + ("" if epoch_ns is not None else f": {what}"))

    def _own_times(self, row: TableRow, table: KinematicsTable, place: str) -> Times:
        if row.time:
            return table.times(row.time, row.unit, f"{place}.time")
        numbers = np.arange(table.rows, dtype=np.int64)
        return np.round(numbers * (NS_PER_S / row.rate)).astype(np.int64) + round(row.start * NS_PER_S)

    def _add_poses(self, row: PoseRow, table: KinematicsTable, times: Times, place: str) -> None:
        position = table.numbers(row.position, f"{place}.position") * LENGTHS[row.unit]
        if row.rotation:
            matrices = np.zeros((table.rows, 4, 4))
            matrices[:, :3, :3] = table.numbers(row.rotation, f"{place}.rotation").reshape(-1, 3, 3)
            matrices[:, 3, 3] = 1
            quaternions, good = quaternions_of(matrices)
            # columns that are not a matrix have a nearest rotation too
            with np.errstate(invalid="ignore", over="ignore"):
                off = np.abs(matrices.transpose(0, 2, 1) @ matrices - np.eye(4)).max(axis=(1, 2))
            quaternions = np.where((good & (off <= _OFF))[:, np.newaxis], quaternions, np.nan)
        else:
            quaternions = table.numbers(row.quaternion, f"{place}.quaternion")
            if row.order == "wxyz":
                quaternions = quaternions[:, [1, 2, 3, 0]]
        stream = self._add(row.name, PoseStamped.TYPE, table.rows)
        values = np.concatenate([position, quaternions], axis=1)
        why = "without a position and a rotation of length 1"
        _check_any(are_poses(values), why, table, place)
        packed = pose_messages(values, times, row.frame)
        stream.messages = self._good(stream, times, packed, why)

    def _add_joints(self, row: JointsRow, table: KinematicsTable, times: Times, place: str) -> None:
        position = table.numbers(row.position, f"{place}.position")
        names = row.names or tuple(map(str, row.position))
        values = [position * JOINTS[row.unit]]
        for name in ("velocity", "effort"):
            columns = getattr(row, name)
            values.append(table.numbers(columns, f"{place}.{name}") if columns else np.empty((table.rows, 0)))
        values[1] = values[1] * JOINTS[row.unit]
        stream = self._add(row.name, JointState.TYPE, table.rows)
        good = np.asarray(np.isfinite(np.concatenate(values, axis=1)).all(axis=1))
        why = "with a number that is missing or not finite"
        _check_any(good, why, table, place)
        packed = joint_messages(names, values[0], times, values[1], values[2])
        chosen = (each if is_good else None for each, is_good in zip(packed, good.tolist(), strict=True))
        stream.messages = self._good(stream, times, chosen, why)

    def _good(self, stream: _Stream, times: Times, packed: Iterator[Buffer | None], why: str) -> Iterator[Stamped]:
        """The messages of rows that have one; the others are counted."""
        for time_ns, payload in zip(times.tolist(), packed, strict=True):
            if payload is None:
                stream.row.left_out += 1
                stream.row.why = why
            else:
                yield time_ns, payload

    def _add(self, topic: str, kind: str, count: int) -> _Stream:
        stream = _Stream(topic, kind, ImportedStream(topic, count, kind), iter(()))
        self._streams.append(stream)
        return stream

    def _add_video(self, recipe: KinematicsRecipe, row: VideoRow, is_utc: bool, place: str) -> None:
        path = recipe.path(row.file)
        if row.times:
            form_of = next((each for each in recipe.table if each.file == row.times), TableRow(row.times))
            table = _opened(recipe, replace(form_of, time=row.time, pose=(), joints=()), place)
            times = table.times(row.time, row.unit, f"{place}.time")
            times = times if is_utc else times + self._begin_ns
            _check_times(times, table.path)
            frames = _Frames(int(times[0]), times, row.times)
        else:
            frames = _Frames(self._begin_ns + round(row.start * NS_PER_S), None, "")
        form = format_of_frames(path)
        stream = self._add(row.name, CompressedVideo.TYPE if form else Image.TYPE, 0)
        stream.messages = self._frames(stream, path, form, row.frame or row.name.strip("/"), frames)

    def _frames(self, stream: _Stream, path: Path, form: str, frame_id: str, frames: _Frames) -> Iterator[Stamped]:
        count = 0
        first_ns = 0
        for found in encoded_frames(path) if form else decoded_frames(path):
            if not count:
                first_ns = found.time_ns
            if frames.times is not None and count >= len(frames.times):
                raise DamagedRecording(f"{path}: found more frames, expected {len(frames.times):,} as {frames.of} has")
            time_ns = frames.start_ns + found.time_ns - first_ns if frames.times is None else int(frames.times[count])
            count += 1
            stream.row.declared += 1
            yield time_ns, _frame_message(found, form, frame_id, time_ns)
        if frames.times is not None and count < len(frames.times):
            raise DamagedRecording(
                f"{path}: found {counted(count, 'frame')}, expected {len(frames.times):,} as {frames.of} has"
            )
        if not count:
            raise DamagedRecording(f"{path}: found no frame, expected one or more")

    def items(self) -> Iterator[ImportedItem]:
        tagged = [self._tagged(order, each) for order, each in enumerate(self._streams)]
        text = f"imported from {self._path.name}; no gateway received these messages"
        is_first, ends = True, dict[str, int]()
        for time_ns, _, stream, payload in heapq.merge(*tagged, key=lambda each: each[:2]):
            if is_first:
                yield note_item(time_ns - NS_PER_S, "imported", text)
                is_first = False
            stream.row.taken += 1
            ends[stream.topic] = time_ns
            yield ImportedItem(time_ns + _AGE_NS, Kind.ROS_IN, payload, stream.topic, stream.type, source_ns=time_ns)
        self._note_ends(ends)

    @staticmethod
    def _tagged(order: int, stream: _Stream) -> Iterator[tuple[int, int, _Stream, Buffer]]:
        return ((time_ns, order, stream, payload) for time_ns, payload in stream.messages)

    def _note_ends(self, ends: dict[str, int]) -> None:
        """Note streams that end long before the last one."""
        last_ns = max(ends.values(), default=0)
        for topic, end_ns in ends.items():
            if last_ns - end_ns >= NS_PER_S:
                self.notes.append(f"{topic} ends {(last_ns - end_ns) / NS_PER_S:.1f} s before the last stream")

    def close(self) -> None:
        """All files are closed."""


def _opened(recipe: KinematicsRecipe, row: TableRow, place: str) -> KinematicsTable:
    path = recipe.path(row.file)
    return open_hdf5(path, row.places(place)) if is_hdf5(row.file) else open_csv(path, row.separator, row.header)


def _check_any(good: Array, why: str, table: KinematicsTable, place: str) -> None:
    if not good.any():
        raise ConfigError(f"{place}: {table.path.name}: found only rows {why}")


def _check_times(times: Times, path: Path) -> None:
    if not 0 < int(times[0]) <= int(times[-1]) < LATEST_NS:
        raise DamagedRecording(f"{path}: found times outside of 1970 to 2038, expected UTC in the unit of the recipe")


def _frame_message(found: Any, form: str, frame_id: str, time_ns: int) -> Buffer:
    if form:
        return CompressedVideo(time_ns, frame_id, found.data, form).pack()
    rows, columns = found.pixels.shape[:2]
    header = Header(time_ns, frame_id)
    return Image(header, rows, columns, "rgb8", 0, 3 * columns, found.pixels.tobytes()).pack()

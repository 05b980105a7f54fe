"""Import of a LeRobot data set (v2.1 or v3.0) as a session of ROS messages with the stamps of its frames.

Each feature is a topic, whose name has slashes for the dots:

* state and action with named numbers become JointState, all other numbers an array of std_msgs; both are exact.  A pose
  with all of its names is also a PoseStamped, of metres;
* videos become CompressedVideo with the encoded frames as they are, or Image where a frame needs a later one; encoded
  pictures of a table become CompressedImage;
* strings become String, and so does the task, at the first frame of an episode and where it changes.

An episode is a phase ``episode-N``, whose text is the task.  The order is that of time: ``set_times``.

Memory: one data file, and one frame of each video.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording
from igtl_gateway.addon.messages import MULTI_ARRAYS, topic_token
from igtl_gateway.addon.reading import Buffer, Kind, MarkNote
from igtl_gateway.addon.ros import CompressedImage, CompressedVideo, Header, Image, JointState, PoseStamped, String
from igtl_gateway.addon.terminal import count_text, counted, few_text
from igtl_gateway.addon.untrusted import printable, whole_number
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, NonRosSource, note_item
from igtl_gateway.addons.lerobot.clips import decoded_frames, encoded_frames, format_of_frames
from igtl_gateway.addons.lerobot.columns import Tables
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, VideoPart, read_data_set
from igtl_gateway.addons.lerobot.recipe import OWN_COLUMNS
from igtl_gateway.addons.lerobot.set_streams import (
    NUMBERS,
    array_messages,
    is_joints,
    joint_messages,
    names_of,
    pose_messages,
    poses_of,
    still_messages,
    values_of,
)
from igtl_gateway.addons.lerobot.set_times import SetTimes, times_of
from igtl_gateway.addons.lerobot.set_topics import SetTopics

Times = npt.NDArray[np.int64]
#: A message of a stream: its stamp (UTC ns) and its bytes; None for a frame without one.
Stamped = tuple[int, Buffer | None]

TASK = "/task"
LABEL = "episode-{}"
#: Names that a note lists.
_LISTED = 5
_MOST_TEXT = 1000
#: Time from a stamp to the first entry with it.
_AGE_NS = 1
#: Columns of each table that are used, beside those of features.
_NEEDED = ("timestamp", "episode_index", "task_index")
#: Files of the metadata that are read.
_READ = ("info.json", "tasks.", "episodes", "provenance")


@dataclass(frozen=True, slots=True)
class _Frames:
    """The frames of an episode: its rows, and their times, UTC ns."""

    episode: FoundEpisode
    table: pa.Table
    times: Times
    place: str


@dataclass(slots=True)
class _SetStream:
    """A topic, with the function that yields the messages of an episode."""

    topic: str
    type: str
    row: ImportedStream
    messages: Callable[[_Frames], Iterator[Stamped]]
    lead: int = field(default=0)


def open_set(root: Path, epoch_ns: int | None, default_ns: int, episodes: str = "") -> SetSource:
    """Open a data set; ``episodes``: a number, or a half-open range such as ``0:8``; "" for all.

    ``epoch_ns`` and ``default_ns`` are those of ``times_of``.  Raises GatewayError.
    """
    found = read_data_set(root)
    times = times_of(found, epoch_ns, default_ns)
    chosen = _chosen(found.episodes, episodes)
    _check_files(chosen, found)
    return SetSource(found, times, sorted(chosen, key=lambda each: (times.begins[each.index], each.index)))


class SetSource(NonRosSource):
    """Episodes of an open data set, in the order of time.  Raises GatewayError."""

    def __init__(self, found: FoundDataSet, times: SetTimes, episodes: Sequence[FoundEpisode]) -> None:
        super().__init__(f"LeRobot data set {found.root.resolve().name}, {found.version}")
        self._found, self._fps, self._times, self._episodes = found, int(found.info["fps"]), times, episodes
        self._count = sum(each.length for each in episodes)
        self._streams = [_SetStream(TASK, String.TYPE, ImportedStream("task", 0, String.TYPE), self._tasks)]
        self._columns: list[str] = []
        self._features: dict[str, tuple[str, tuple[str, ...]]] = {TASK: ("", ())}
        for name, feature in found.info["features"].items():
            if name not in OWN_COLUMNS:
                self._add(name, feature)
        self.rows = [each.row for each in self._streams] + self.rows
        self.facts = {
            "imported_format": "lerobot",
            **SetTopics(found.version, str(found.info.get("robot_type") or ""), self._features).facts(),
        }
        self._add_notes(sorted(episodes, key=lambda each: each.index))

    def each(self) -> Iterator[tuple[str, SetSource]]:
        """Yield name and source of each episode."""
        for episode in self._episodes:
            yield f"episode-{episode.index:06d}", SetSource(self._found, self._times, [episode])

    def _topic(self, name: str) -> str:
        """A topic of its own for a feature."""
        topic = "/" + "/".join(map(topic_token, name.split(".")))
        taken = {each.topic for each in self._streams}
        return next(each for each in _variants(topic) if each not in taken)

    def _add(self, name: str, feature: Mapping[str, Any]) -> None:
        """Add the streams of a feature, or a row with the reason that there is none."""
        dtype, topic = feature["dtype"], self._topic(name)
        if dtype == "video" and _is_depth(feature):
            self._leave_out(name, dtype, "depth in a video is not imported")
        elif dtype == "video":
            self._add_video(name, topic)
        elif dtype in NUMBERS:
            width = prod(feature["shape"])
            names = names_of(feature, width)
            joints = is_joints(name, feature)
            kind = JointState.TYPE if joints else MULTI_ARRAYS[NUMBERS[dtype]].TYPE
            self._add_stream(topic, kind, name, partial(self._numbers, name, feature, names, joints), names)
            for pose in poses_of(names):
                own = self._topic(f"{name}.{pose.name or 'pose'}")
                self._add_stream(own, PoseStamped.TYPE, name, partial(self._poses, name, width, pose.columns))
        elif dtype == "string":
            self._add_stream(topic, String.TYPE, name, partial(self._texts, name))
        elif dtype == "image":
            self._add_stream(topic, CompressedImage.TYPE, name, partial(self._stills, name))
        else:
            self._leave_out(name, dtype, f"no message has {printable(dtype)[:40]}")

    def _leave_out(self, name: str, dtype: str, why: str) -> None:
        self.rows.append(ImportedStream(printable(name), self._count, dtype, left_out=self._count, why=why))

    def _add_stream(
        self,
        topic: str,
        kind: str,
        name: str,
        messages: Callable[[_Frames], Iterator[Stamped]],
        names: tuple[str, ...] = (),
    ) -> _SetStream:
        what = f"{printable(name)}: pose" if kind == PoseStamped.TYPE else printable(name)
        stream = _SetStream(topic, kind, ImportedStream(what, self._count, kind), messages)
        self._streams.append(stream)
        is_pose = kind == PoseStamped.TYPE
        self._features[topic] = ("" if is_pose else name, names)
        if name not in self._found.videos:
            self._columns.append(name)
        return stream

    def _add_video(self, name: str, topic: str) -> None:
        paths = dict.fromkeys(each.videos[name].path for each in self._episodes)
        forms = {format_of_frames(path) for path in paths}
        [form] = forms if len(forms) == 1 else [""]
        if form:
            stream = self._add_stream(topic, CompressedVideo.TYPE, name, partial(self._decoded, name))
            stream.messages = partial(self._encoded, stream, name, form)
        else:
            self._add_stream(topic, Image.TYPE, name, partial(self._decoded, name))

    # --- messages of an episode -----------------------------------------------------------------------------------

    def _numbers(
        self, name: str, feature: Mapping[str, Any], names: tuple[str, ...], joints: bool, frames: _Frames
    ) -> Iterator[Stamped]:
        shape = feature["shape"]
        values = values_of(frames.table, name, prod(shape), frames.place)
        if joints:
            packed: Iterator[Buffer | None] = joint_messages(names, values, frames.times)
        else:
            axes = feature.get("names")
            labels = [", ".join(names)] if names and len(shape) == 1 else _labels(axes, len(shape))
            packed = array_messages(shape, labels, feature["dtype"], values)
        return zip(frames.times.tolist(), packed, strict=True)

    def _poses(self, name: str, width: int, columns: tuple[int, ...], frames: _Frames) -> Iterator[Stamped]:
        values = values_of(frames.table, name, width, frames.place)[:, list(columns)]
        return zip(frames.times.tolist(), pose_messages(values, frames.times, ""), strict=True)

    def _texts(self, name: str, frames: _Frames) -> Iterator[Stamped]:
        for time_ns, text in zip(frames.times.tolist(), _texts(frames, name), strict=True):
            yield time_ns, String(text).pack()

    def _stills(self, name: str, frames: _Frames) -> Iterator[Stamped]:
        frame = name.rpartition(".")[2]
        packed = still_messages(frames.table[name], frames.times, frame, f"{frames.place}: {name}")
        return zip(frames.times.tolist(), packed, strict=True)

    def _tasks(self, frames: _Frames) -> Iterator[Stamped]:
        """The task of the first frame, and each that follows another one."""
        numbers = values_of(frames.table, "task_index", 1, frames.place)[:, 0].tolist()
        last = None
        for row, (time_ns, number) in enumerate(zip(frames.times.tolist(), numbers, strict=True)):
            if number == last:
                continue
            if number not in self._found.tasks:
                raise DamagedRecording(
                    f"{frames.place}: row {row}: task_index: found {number}, expected one of "
                    f"{count_text(len(self._found.tasks), 'task')}"
                )
            last = number
            self._streams[0].row.declared += 1
            yield time_ns, String(self._found.tasks[number]).pack()

    def _encoded(self, stream: _SetStream, name: str, form: str, frames: _Frames) -> Iterator[Stamped]:
        """The encoded frames; those before it that the first one needs come shortly before it."""
        part, lead, frame_id = frames.episode.videos[name], list[bytes](), name.rpartition(".")[2]
        numbered = self._numbered(part, frames, encoded_frames(part.path, part.first_s))
        for number, found in numbered:
            if number < 0:
                if found.is_key:
                    lead.clear()
                if lead or found.is_key:
                    lead.append(found.data)
                continue
            if number == 0:
                if found.is_key:
                    lead.clear()
                elif not lead:
                    place = f"{part.path}: episode {frames.episode.index}"
                    raise DamagedRecording(f"{place}: found no key frame at or before its first frame, expected one")
                step_ns = max(min(1000, NS_PER_S // (4 * self._fps * (len(lead) + 1))), 1)
                for before, data in zip(range(len(lead), 0, -1), lead, strict=True):
                    time_ns = int(frames.times[0]) - before * step_ns
                    yield time_ns, CompressedVideo(time_ns, frame_id, data, form).pack()
                stream.lead += len(lead)
                stream.row.taken -= len(lead)
                if stream.lead:
                    stream.row.why = f"and {counted(stream.lead, 'frame')} before episodes, which a decoder needs"
            time_ns = int(frames.times[number])
            yield time_ns, CompressedVideo(time_ns, frame_id, found.data, form).pack()

    def _decoded(self, name: str, frames: _Frames) -> Iterator[Stamped]:
        part, frame_id = frames.episode.videos[name], name.rpartition(".")[2]
        for number, found in self._numbered(part, frames, decoded_frames(part.path, part.first_s)):
            if number >= 0:
                time_ns, (rows, columns) = int(frames.times[number]), found.pixels.shape[:2]
                data = found.pixels.tobytes()
                yield time_ns, Image(Header(time_ns, frame_id), rows, columns, "rgb8", 0, 3 * columns, data).pack()

    def _numbered(self, part: VideoPart, frames: _Frames, found: Iterator[Any]) -> Iterator[tuple[int, Any]]:
        """Yield frames with their number in the episode, negative before it.  Raises DamagedRecording for a gap."""
        place, wanted = f"{part.path}: episode {frames.episode.index}", 0
        for each in found:
            at_s = each.time_ns / NS_PER_S - part.first_s
            number = round(at_s * self._fps)
            if number >= 0:
                if number != wanted or abs(at_s - number / self._fps) > TOLERANCE_S:
                    raise DamagedRecording(
                        f"{place}: found a frame at {at_s:.4f} s, expected frame {wanted} at {wanted / self._fps:.4f} s"
                    )
                wanted += 1
            yield number, each
            if wanted == frames.episode.length:
                return
        raise DamagedRecording(
            f"{place}: found {counted(wanted, 'frame')}, expected {frames.episode.length:,} as the table has"
        )

    # --- the session ----------------------------------------------------------------------------------------------

    def items(self) -> Iterator[ImportedItem]:
        text = f"imported from {self.title}; no gateway received these messages"
        tables = Tables()
        for number, episode in enumerate(self._episodes):
            frames = self._frames(episode, tables)
            if not number:
                yield note_item(int(frames.times[0]) - NS_PER_S, "imported", text)
            yield from self._items_of(frames)

    def _frames(self, episode: FoundEpisode, tables: Tables) -> _Frames:
        table = tables.of(episode)
        place = f"{episode.data}: episode {episode.index}"
        if table.num_rows != episode.length:
            raise DamagedRecording(f"{place}: found {counted(table.num_rows, 'row')}, expected {episode.length:,}")
        for name in (*self._columns, *_NEEDED):
            if name not in table.schema.names:
                raise DamagedRecording(f"{place}: found no column {name}, expected one")
        _check_own(table, episode, self._fps, place)
        return _Frames(episode, table, self._times.of(episode, self._fps), place)

    def _items_of(self, frames: _Frames) -> Iterator[ImportedItem]:
        """The messages of an episode in the order of time, between the marks of its phase.

        An entry is 1 ns or more after its stamp: one at its stamp would have none.  At each frame another stream is
        first, so that each has messages of this least age: by it, an export knows where phases begin.
        """
        half_ns = NS_PER_S // (2 * self._fps)
        begin_ns, end_ns = int(frames.times[0]), int(frames.times[-1]) + half_ns
        label = LABEL.format(frames.episode.index)
        words = "".join(char if char.isprintable() else " " for char in _task_of(frames.episode))[:_MOST_TEXT]
        yield _mark(begin_ns + _AGE_NS, MarkNote(label, words, phase="begin"))
        tagged = [self._tagged(order, each, frames) for order, each in enumerate(self._streams)]
        for time_ns, _, stream, payload in heapq.merge(*tagged, key=lambda each: each[:2]):
            if payload is None:
                stream.row.left_out += 1
                is_pose = stream.type == PoseStamped.TYPE
                stream.row.why = "without a rotation of length 1" if is_pose else "an integer beyond 2^53"
            else:
                stream.row.taken += 1
                at_ns = time_ns + _AGE_NS
                yield ImportedItem(at_ns, Kind.ROS_IN, payload, stream.topic, stream.type, source_ns=time_ns)
        yield _mark(end_ns + _AGE_NS, MarkNote(label, words, phase="end"))

    def _tagged(
        self, order: int, stream: _SetStream, frames: _Frames
    ) -> Iterator[tuple[int, int, _SetStream, Buffer | None]]:
        streams = len(self._streams)
        return (
            (time_ns, (order - number) % streams, stream, payload)
            for number, (time_ns, payload) in enumerate(stream.messages(frames))
        )

    def close(self) -> None:
        """All files are closed."""

    def _add_notes(self, chosen: Sequence[FoundEpisode]) -> None:
        found = self._found
        there = (len(found.episodes), sum(each.length for each in found.episodes))
        stated = (found.info["total_episodes"], found.info["total_frames"])
        if there != stated:  # a list that lost a line: nothing else knows of its episode
            one, other = (f"{counted(each[0], 'episode')} and {counted(each[1], 'frame')}" for each in (stated, there))
            self.notes.append(f"meta/info.json has {one}, the list of episodes {other}")
        if len(chosen) < len(found.episodes):
            numbers = f"{len(chosen):,} of {count_text(len(found.episodes), 'episode')}"
            self.notes.append(f"{numbers}: {few_text([each.index for each in chosen], _LISTED)}")
        self.notes.append(self._times.note)
        if any(each.type == JointState.TYPE for each in self._streams):
            self.notes.append("numbers are as in the set, which states no units; JointState has them by name")
        if any(each.type == PoseStamped.TYPE for each in self._streams):
            self.notes.append("positions of poses are taken as metres")
        if any(len(_task_of(each)) > _MOST_TEXT for each in chosen):
            self.notes.append(f"marks have the first {_MOST_TEXT:,} characters of a task, {TASK} has all")
        if others := _other_files(found.root):
            self.notes.append(f"not imported: {few_text(others, _LISTED)}")


def _mark(time_ns: int, mark: MarkNote) -> ImportedItem:
    return ImportedItem(time_ns, Kind.EDGE_NOTE, mark.note().pack())


def _task_of(episode: FoundEpisode) -> str:
    return "; ".join(episode.tasks)


def _variants(topic: str) -> Iterator[str]:
    yield topic
    for number in count(2):
        yield f"{topic}_{number}"


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """Return whether the grey values of a video stand for distances."""
    facts = feature.get("info")
    return isinstance(facts, dict) and True in (facts.get("is_depth_map"), facts.get("video.is_depth_map"))


def _labels(axes: Any, sizes: int) -> list[str]:
    """Names of the axes of an array; "" where the set has none."""
    is_named = isinstance(axes, list) and len(axes) == sizes and all(isinstance(each, str) for each in axes)
    return list(axes) if is_named else [""] * sizes


def _texts(frames: _Frames, name: str) -> list[str]:
    column = frames.table[name]
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)) or column.null_count:
        raise DamagedRecording(
            f"{frames.place}: {name}: found {column.type} with {counted(column.null_count, 'missing value')}, expected "
            "strings"
        )
    found: list[str] = column.to_pylist()
    return found


def _check_own(table: pa.Table, episode: FoundEpisode, fps: int, place: str) -> None:
    """Raise DamagedRecording for rows of another episode, or whose times are not those of frames."""
    numbers = values_of(table, "episode_index", 1, place)[:, 0]
    if (numbers != episode.index).any():
        row = int(np.argmax(numbers != episode.index))
        raise DamagedRecording(f"{place}: row {row}: episode_index: found {numbers[row]}, expected {episode.index}")
    stamps = values_of(table, "timestamp", 1, place)[:, 0].astype(np.float64)
    wanted = np.arange(len(stamps)) / fps
    good = np.abs(stamps - wanted) <= TOLERANCE_S + np.spacing(wanted.astype(np.float32))
    if not good.all():
        row = int(np.argmin(good))
        raise DamagedRecording(
            f"{place}: row {row}: timestamp: found {stamps[row]:.6g} s, expected {wanted[row]:.6g} s, {row} / {fps}"
        )


def _check_files(episodes: Sequence[FoundEpisode], found: FoundDataSet) -> None:
    """Raise DamagedRecording if files of these episodes are missing, before hours of others are read."""
    paths = dict.fromkeys(
        path for each in episodes for path in (each.data, *(part.path for part in each.videos.values()))
    )
    missing = [path.relative_to(found.root) for path in paths if not path.is_file()]
    if missing:
        raise DamagedRecording(
            f"{found.root}: found no {few_text(missing, _LISTED)}, expected the {count_text(len(paths), 'file')} of "
            f"{count_text(len(episodes), 'episode')}"
        )


def _chosen(episodes: Sequence[FoundEpisode], text: str) -> list[FoundEpisode]:
    """The episodes of a number or a half-open range.  Raises ConfigError."""
    if not text:
        return list(episodes)
    first, colon, end = text.partition(":")
    begin, stop = whole_number(first), whole_number(end) if colon else None
    if begin is not None and (stop is not None or not colon):
        numbers = range(begin, begin + 1 if stop is None else stop)
        if found := [each for each in episodes if each.index in numbers]:
            return found
    raise ConfigError(
        f"--episodes: found {text}, expected a number or a half-open range such as 0:8 of "
        f"{count_text(len(episodes), 'episode')}"
    )


def _other_files(root: Path) -> list[str]:
    """Files of the root and of its metadata that are not read, and folders of neither data nor videos."""
    every = [each.name for each in root.iterdir() if each.name not in ("data", "videos", "meta")]
    every += [f"meta/{each.name}" for each in (root / "meta").iterdir() if not each.name.startswith(_READ)]
    return [printable(name) for name in sorted(every) if not name.startswith(".")]

"""Recordings as a data set, without a conversion: samples with LeRobot's keys, read when they are used.

Numbers are those that ``export`` writes, because it is the same plan.  Pictures are the recorded ones: ``export`` codes
them as video, with its loss.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import index as as_index
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload
from warnings import warn

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ClockWarning, ConfigError, Unavailable, one_of
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.lerobot.depth import depth_of, has_codes, no_stats
from igtl_gateway.addons.lerobot.frames import MAX_FRAMES
from igtl_gateway.addons.lerobot.pictures import Pixels
from igtl_gateway.addons.lerobot.recorded_open import OpenRecordings
from igtl_gateway.addons.lerobot.recorded_sessions import ReadSessions, read_sessions, recordings_in
from igtl_gateway.addons.lerobot.stats import PictureStats, number_stats, sampled

if TYPE_CHECKING:
    from igtl_gateway.addons.lerobot.torch_set import TorchSet

Array = npt.NDArray[Any]
AnyPath = str | PathLike[str]
Sample = dict[str, Any]

#: Distance (s) of an offset in time from a multiple of 1 / fps, as LeRobot has it.
_TOLERANCE_S = 1e-4
#: Characters of a wrong value that an error shows.
_SHOWN = 60


@dataclass(frozen=True, slots=True)
class SetEpisode:
    """An episode of a data set; the names are those of LeRobot.

    Attributes:
        episode_index: number in the data set.
        length: number of frames.
        tasks: what is done: one text.
        dataset_from_index, dataset_to_index: its first frame in the data set, and the one behind its last.
        session: name of the file of the recording, with the folders that ``splits.patient`` has.
        split: name of the split, such as ``"train"``.
    """

    episode_index: int
    length: int
    tasks: tuple[str, ...]
    dataset_from_index: int
    dataset_to_index: int
    session: str
    split: str


def dataset(
    source: AnyPath | Iterable[AnyPath],
    recipe: AnyPath,
    *,
    split: str | None = None,
    delta_timestamps: Mapping[str, Sequence[float]] | None = None,
) -> RecordedSet:
    """Open recordings as a data set.  All of them are read once, as ``export`` does before it writes.

    Args:
        source: a recording, a folder with recordings in and below it, or paths of recordings, in any order.
        recipe: path of the recipe, as for ``export --to lerobot``.
        split: name of a split of the recipe; None: all episodes.
        delta_timestamps: feature → offsets in s, multiples of 1 / fps: a sample has the values at its time and each
            offset, within its episode, as LeRobot's loader gives them.

    Returns:
        The data set; a ``ClockWarning`` has its ``notes``.  It may be pickled: another process, or another day, opens
        the recordings when it uses them.

    Raises:
        ConfigError: the recipe does not fit, recordings differ, or a name is unknown.
        GatewayError: a recording cannot be read, or has no frame.

    Examples:
        >>> from igtl_gateway.addons.lerobot import dataset
        >>> samples = dataset("sessions", recipe, split="train")
        >>> samples[0]["observation.state"].dtype
        dtype('float32')
    """
    paths = [Path(each) for each in ([source] if isinstance(source, str | PathLike) else source)]
    if len(paths) == 1 and paths[0].is_dir():
        paths = recordings_in(paths[0])
    if not paths:
        raise ConfigError("source: found no path, expected recordings")
    found = RecordedSet(read_sessions(paths, Path(recipe)), split, delta_timestamps)
    if found.notes:
        warn("; ".join(found.notes), ClockWarning, stacklevel=2)
    return found


class RecordedSet(Sequence[Sample]):
    """Samples of recordings in the order of a data set; ``dataset`` makes it.

    A sample has a key for each feature, with LeRobot's names:

    * ``observation.images.…``: (rows, columns, 3) uint8, the recorded pixels as RGB, with even rows and columns; of
      depth (rows, columns, 1) float32, mm in the steps of the recipe;
    * numbers: (K,) float32, or one float32; stamps are int64; strings;
    * ``timestamp``: float32, s from the start of the episode; ``frame_index``, ``episode_index``, ``index``,
      ``task_index``: int64; ``task``: a string.

    With ``delta_timestamps`` a feature has one more axis in front, or is a list of strings, and ``…_is_pad`` (offsets,)
    bool states which are outside of the episode: these repeat its first or last frame.  As in LeRobot, pictures with
    one offset have no further axis.

    The numbers of all frames are in memory.  A picture is read when its sample is used; at most 32 recordings are open,
    and 64 MiB of chunks are kept.  Processes share no file.

    Attributes:
        fps: frames per second.
        robot_type: of the recipe.
        clock: of the times: ``"source"``, the stamps of the senders, or ``"gateway"``, times of receipt.
        notes: what was corrected, or assumed to be one clock, as ``export`` prints it; of several recordings with their
            names.
        features: name → type, shape and names, as in info.json.
        camera_keys, depth_keys: features of pictures, and those of them that are depth.
        tasks: in the order of their numbers.
        splits: name → ranges of episodes, as in info.json.
        episodes: those of the split.

    Raises GatewayError for a sample of a recording whose content is another one now, or that cannot be read.
    """

    def __init__(
        self, found: ReadSessions, split: str | None, delta_timestamps: Mapping[str, Sequence[float]] | None
    ) -> None:
        recipe = found.recipe
        self.fps, self.robot_type, self.splits = recipe.fps, recipe.robot_type, dict(found.splits)
        self.clock = found.sessions[0].clock
        several = len(found.sessions) > 1
        self.notes = [
            f"{each.name}: {note}" if several else note
            for each, columns in zip(found.sessions, found.columns, strict=True)
            for note in columns.notes
        ]
        self.features: dict[str, Any] = dict(found.schema.features)
        self.tasks = list(dict.fromkeys(task for each in found.sessions for _, task in each.episodes))
        self._recordings = found.recordings
        self._sources = [each.sources for each in found.columns]
        self._ends = np.cumsum([each.frames for each in found.sessions], dtype=np.int64)
        self._all = _episodes(found)
        self.camera_keys = list(self._sources[0])
        self.depth_keys = [name for name in self.camera_keys if has_codes(self.features[name])]
        self._starts = np.array([each.dataset_from_index for each in self._all], np.int64)
        self._places = {
            name: np.concatenate([each.places[name] for each in found.columns]) for name in self._sources[0]
        }
        self._columns = {
            name: _flat(np.concatenate([each.columns[name] for each in found.columns]))
            for name in found.columns[0].columns
        }
        numbers = [(each.episode_index, self.tasks.index(each.tasks[0])) for each in self._all]
        of_frames = np.repeat(np.array(numbers, np.int64), [each.length for each in self._all], axis=0)
        self._columns |= {"episode_index": of_frames[:, 0], "task_index": of_frames[:, 1]}
        self._columns["index"] = np.arange(len(of_frames), dtype=np.int64)
        if split is not None and split not in self.splits:
            raise ConfigError(f"split: found {split!r}, expected {one_of(split, list(self.splits))}")
        self.episodes = [each for each in self._all if split in (None, each.split)]
        self._frames = np.concatenate(
            [np.arange(each.dataset_from_index, each.dataset_to_index) for each in self.episodes]
        )
        self._offsets = {
            name: self._offset(name, each) for name, each in (delta_timestamps or {}).items()
        }  # fmt: skip
        self._opened: OpenRecordings | None = None

    def _offset(self, name: str, seconds: Sequence[float]) -> Array:
        """The offsets of a feature in frames (N,).  Raises ConfigError."""
        if name not in self.features:
            raise ConfigError(f"delta_timestamps: found {name!r}, expected {one_of(name, list(self.features))}")
        try:
            found = np.asarray(seconds, np.float64) * self.fps
        except (TypeError, ValueError):
            found = np.zeros(0)
        if found.ndim != 1 or not len(found) or not (np.abs(found) < MAX_FRAMES).all():
            shown = repr(seconds)[:_SHOWN]
            raise ConfigError(f"delta_timestamps: {name}: found {shown}, expected a list of one or more seconds")
        wrong = np.abs(found - np.round(found)) > _TOLERANCE_S * self.fps
        if wrong.any():
            raise ConfigError(
                f"delta_timestamps: {name}: found {seconds[int(np.argmax(wrong))]} s, expected multiples of "
                f"1 / {self.fps} s"
            )
        return np.round(found).astype(np.int64)

    def __repr__(self) -> str:
        return (
            f"<RecordedSet: {count_text(len(self), 'frame')}, {count_text(len(self.episodes), 'episode')}, "
            f"{self.fps} Hz>"
        )

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        number, count = as_index(index), len(self)
        if not -count <= number < count:
            raise IndexError(f"found index {number}, expected one from {-count} to {count - 1}")
        return self._sample(int(self._frames[number]))

    def _sample(self, frame: int) -> Sample:
        number = int(np.searchsorted(self._ends, frame, side="right"))
        self._open.check(number)
        episode = self._all[int(np.searchsorted(self._starts, frame, side="right")) - 1]
        sample: Sample = {name: self._pictures(number, name, frame, episode) for name in self._places}
        padding: Sample = {}
        for name, column in self._columns.items():
            if name not in self._offsets:
                value = column[frame]
                sample[name] = value.copy() if isinstance(value, np.ndarray) else value
                continue
            values = column[self._around(name, frame, episode)]
            sample[name] = values.tolist() if values.dtype == object else values
        for name, offsets in self._offsets.items():
            at = frame + offsets
            padding[f"{name}_is_pad"] = (at < episode.dataset_from_index) | (at >= episode.dataset_to_index)
        return sample | padding | {"task": episode.tasks[0]}

    def _around(self, name: str, frame: int, episode: SetEpisode) -> Array:
        """The frames at the offsets of a feature; those outside of the episode are its first or last one."""
        found: Array = np.clip(frame + self._offsets[name], episode.dataset_from_index, episode.dataset_to_index - 1)
        return found

    def _pictures(self, number: int, name: str, frame: int, episode: SetEpisode) -> Array:
        frames = self._around(name, frame, episode).tolist() if name in self._offsets else [frame]
        found = [self._picture(number, name, each) for each in frames]
        if depth_mm := self._sources[number][name].depth_mm:
            found = [depth_of(each, depth_mm).astype(np.float32) for each in found]
        return found[0] if len(found) == 1 else np.stack(found)

    def _picture(self, number: int, name: str, frame: int) -> Pixels:
        begin_ns, time_ns, before = self._places[name][frame].tolist()
        return self._open.picture(number, self._sources[number][name], (begin_ns, time_ns, before))

    @property
    def _open(self) -> OpenRecordings:
        if self._opened is None or self._opened.pid != os.getpid():
            self._opened = OpenRecordings(self._recordings, self._opened)
        return self._opened

    @cached_property
    def stats(self) -> dict[str, dict[str, Array]]:
        """The statistics of the whole data set, with all splits: those that ``export`` writes to stats.json of v3.0.

        Feature → ``min``, ``max``, ``mean``, ``std``, quantiles, ``count``: of numbers (K,); of pictures (3, 1, 1) on
        a scale of 0 to 1, of depth (1, 1, 1) in mm, of up to 100 in each episode, which are read at the first use.
        """
        found = {
            name: number_stats(column.reshape(len(column), -1))
            for name, column in self._columns.items()
            if column.dtype != object
        }
        for name in self._places:
            pictures = no_stats(self.features[name]) or PictureStats()
            for episode in self._all:
                for frame in (episode.dataset_from_index + sampled(episode.length)).tolist():
                    number = int(np.searchsorted(self._ends, frame, side="right"))
                    pictures.add(self._picture(number, name, frame))
            found[name] = pictures.stats()
        return {name: {key: np.array(value) for key, value in each.items()} for name, each in found.items()}

    def to_torch(self, *, image_transforms: Any = None, return_uint8: bool = False) -> TorchSet:
        """Return it as a ``torch.utils.data.Dataset``, whose samples equal those of LeRobot's loader.

        Args:
            image_transforms: called with each tensor of pictures, but not of depth.
            return_uint8: colours stay uint8; otherwise they are float32 from 0 to 1.

        Raises:
            Unavailable: PyTorch is not installed.
        """
        try:
            from igtl_gateway.addons.lerobot.torch_set import TorchSet
        except ImportError as error:
            raise Unavailable(f"PyTorch: found {error}, expected it; run: pip install torch") from None
        return TorchSet(self, image_transforms, return_uint8)

    def close(self) -> None:
        """Close the recordings; a sample opens its one again."""
        if self._opened is not None and self._opened.pid == os.getpid():
            self._opened.close()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}


def _episodes(found: ReadSessions) -> list[SetEpisode]:
    splits: dict[int, str] = {}
    for name, text in found.splits.items():
        for each in text.split(","):
            start, end = map(int, each.split(":"))
            splits |= dict.fromkeys(range(start, end), name)
    episodes: list[SetEpisode] = []
    first = 0
    for session in found.sessions:
        for count, task in session.episodes:
            number = len(episodes)
            split = splits.get(number, "")
            episodes.append(SetEpisode(number, count, (task,), first, first + count, session.name, split))
            first += count
    return episodes


def _flat(column: Array) -> Array:
    """A feature of one number is a plain column."""
    return column[:, 0] if column.ndim == 2 and column.shape[1] == 1 else column

"""The files of the two formats: v2.1 has a file for each episode, v3.0 has files with many episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addon.writing import make_folder, open_new, write_text
from igtl_gateway.addons.lerobot.depth import CODEC as DEPTH_CODEC
from igtl_gateway.addons.lerobot.depth import has_codes
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S
from igtl_gateway.addons.lerobot.stats import QUANTILES, Stats
from igtl_gateway.addons.lerobot.video import VideoFile

CHUNK = 1000
DATA_MB, VIDEO_MB = 100, 200
_V21 = {
    "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
}
_V30 = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
PATHS = {"v2.1": _V21, "v3.0": _V30}


@dataclass(frozen=True, slots=True)
class Facts:
    """What both formats state about a data set.

    Attributes:
        fps: frames per second.
        codec: of the videos.
        sizes: feature → rows and columns of its video.
        features: name → description, for info.json.
        robot_type: for info.json.
    """

    fps: int
    codec: str
    sizes: Mapping[str, tuple[int, int]]
    features: Mapping[str, Any]
    robot_type: str

    def codec_of(self, name: str) -> str:
        """Return the codec of the video of a feature."""
        return DEPTH_CODEC if has_codes(self.features[name]) else self.codec


class Layout(Protocol):
    """The writer of the files of one session.

    For each episode: ``video`` of each camera, then ``add``; at the end ``finish``.

    Attributes:
        rows: what the metadata have about each episode.
        frames: number of frames so far.
    """

    rows: list[dict[str, Any]]
    frames: int

    def video(self, name: str, episode: int, count: int) -> VideoFile: ...
    def end_video(self, name: str, episode: int, video: VideoFile) -> None: ...
    def add(self, episode: int, task: str, table: pa.Table, stats: Mapping[str, Stats]) -> None: ...
    def finish(self) -> None: ...


def layout_of(version: str, root: Path, facts: Facts, first_frame: int) -> Layout:
    """Return the writer of a format; files of v3.0 are numbered from 0 on, whatever other sessions have."""
    return _Version21(root, facts) if version == "v2.1" else _Version30(root, facts, first_frame)


def float32_horizon_s() -> float:
    """Return the time from which on float32 seconds are further apart than the tolerance of the readers."""
    exponent = 0
    while float(np.spacing(np.float32(2.0**exponent))) <= TOLERANCE_S:
        exponent += 1
    return 2.0**exponent


def write_json(path: Path, value: Any) -> None:
    """Write an indented JSON file."""
    write_text(path, json.dumps(value, indent=4, ensure_ascii=False) + "\n")


def write_table(path: Path, table: pa.Table) -> None:
    """Write a Parquet file to a folder that may be new."""
    make_folder(path.parent, parents=True, exist_ok=True)
    with open_new(path) as file:
        parquet.write_table(table, file, compression="snappy")


def info_of(
    version: str, facts: Facts, *, episodes: int, frames: int, tasks: int, splits: Mapping[str, str]
) -> dict[str, Any]:
    """Return the content of info.json."""
    more = (
        {"total_videos": episodes * len(facts.sizes), "total_chunks": -(-episodes // CHUNK)}
        if version == "v2.1"
        else {"data_files_size_in_mb": DATA_MB, "video_files_size_in_mb": VIDEO_MB}
    )
    return {
        "codebase_version": version,
        "robot_type": facts.robot_type,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        **more,
        "chunks_size": CHUNK,
        "fps": facts.fps,
        "splits": dict(splits),
        **PATHS[version],
        "features": dict(facts.features),
    }


def file_of(version: str, kind: str, number: int, camera: str = "") -> str:
    """Return the path of a file in a data set of v3.0, or of an episode in one of v2.1.

    Args:
        version: of the format.
        kind: ``data_path`` or ``video_path``.
        number: of the file or the episode.
        camera: feature of the video.
    """
    place = {"chunk_index": number // CHUNK, "file_index": number % CHUNK}
    old = {"episode_chunk": number // CHUNK, "episode_index": number}
    return PATHS[version][kind].format(**(old if version == "v2.1" else place), video_key=camera)


@dataclass
class _Version21:
    """v2.1: a Parquet file for each episode, and a video for each episode and camera."""

    root: Path
    facts: Facts
    rows: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0

    def video(self, name: str, episode: int, _count: int) -> VideoFile:
        path = self.root / file_of("v2.1", "video_path", episode, name)
        return VideoFile(path, self.facts.sizes[name], self.facts.fps, self.facts.codec_of(name))

    def end_video(self, _name: str, _episode: int, video: VideoFile) -> None:
        video.close()

    def add(self, episode: int, task: str, table: pa.Table, stats: Mapping[str, Stats]) -> None:
        write_table(self.root / file_of("v2.1", "data_path", episode), table)
        plain = {
            name: {key: value for key, value in each.items() if key not in QUANTILES} for name, each in stats.items()
        }
        self.rows.append({"episode_index": episode, "tasks": [task], "length": table.num_rows, "stats": plain})
        self.frames += table.num_rows

    def finish(self) -> None:
        """All is written."""


@dataclass
class _OpenVideo:
    """A video of v3.0 that takes more episodes."""

    number: int
    file: VideoFile


@dataclass
class _Version30:
    """v3.0: files of Parquet and video take episodes until they are large."""

    root: Path
    facts: Facts
    first_frame: int
    rows: list[dict[str, Any]] = field(default_factory=list)
    tables: list[pa.Table] = field(default_factory=list)
    data_file: int = 0
    frames: int = 0
    videos: dict[str, _OpenVideo] = field(default_factory=dict)
    places: dict[str, Any] = field(default_factory=dict)

    def video(self, name: str, _episode: int, count: int) -> VideoFile:
        fps, is_open = self.facts.fps, self.videos.get(name)
        number = is_open.number if is_open else 0
        if is_open and is_open.file.count:
            # a reader compares float32 times, which end where their steps are larger than its tolerance
            is_long = (is_open.file.count + count) / fps > float32_horizon_s()
            if is_long or is_open.file.size >= VIDEO_MB * 1_000_000:
                is_open.file.close()
                is_open, number = None, number + 1
        if is_open is None:
            path = self.root / file_of("v3.0", "video_path", number, name)
            file = VideoFile(path, self.facts.sizes[name], fps, self.facts.codec_of(name))
            is_open = self.videos[name] = _OpenVideo(number, file)
        self.places |= {
            f"videos/{name}/chunk_index": is_open.number // CHUNK,
            f"videos/{name}/file_index": is_open.number % CHUNK,
            f"videos/{name}/from_timestamp": is_open.file.count / fps,
        }
        return is_open.file

    def end_video(self, name: str, _episode: int, video: VideoFile) -> None:
        self.places[f"videos/{name}/to_timestamp"] = video.count / self.facts.fps

    def add(self, episode: int, task: str, table: pa.Table, stats: Mapping[str, Stats]) -> None:
        if self.tables and sum(each.nbytes for each in self.tables) + table.nbytes > DATA_MB * 1_000_000:
            self._write_data()
        self.rows.append(
            {
                "episode_index": episode,
                "tasks": [task],
                "length": table.num_rows,
                "data/chunk_index": self.data_file // CHUNK,
                "data/file_index": self.data_file % CHUNK,
                "dataset_from_index": self.first_frame + self.frames,
                "dataset_to_index": self.first_frame + self.frames + table.num_rows,
                **self.places,
                **{f"stats/{name}/{key}": value for name, each in stats.items() for key, value in each.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self.tables.append(table)
        self.frames += table.num_rows
        self.places = {}

    def _write_data(self) -> None:
        path = self.root / file_of("v3.0", "data_path", self.data_file)
        write_table(path, pa.concat_tables(self.tables))
        self.tables, self.data_file = [], self.data_file + 1

    def finish(self) -> None:
        """Write the last rows, and the ends of the videos."""
        self._write_data()
        for each in self.videos.values():
            each.file.close()


def episodes_table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Return what the metadata of v3.0 have about episodes."""
    return pa.table({name: pa.array([row[name] for row in rows]) for name in rows[0]})


def task_table(tasks: Sequence[str]) -> pa.Table:
    """Return the tasks as a data frame of pandas whose index has the name ``task``."""
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    text = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    columns = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    description = {
        "index_columns": ["task"],
        "column_indexes": [columns | {"metadata": {"encoding": "UTF-8"}}],
        "columns": [each | {"metadata": None} for each in (number, text)],
        "pandas_version": "2.2.0",
    }
    arrays = {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())}
    return pa.table(arrays).replace_schema_metadata({"pandas": json.dumps(description)})

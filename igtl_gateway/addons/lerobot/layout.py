"""The files of the two formats: v2.1 has a file for each episode, v3.0 has files with many episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addon.writing import make_folder, open_new, write_text
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
        tasks: the tasks, in the order of their numbers.
        robot_type: for info.json.
        splits: name → range of episodes.
    """

    fps: int
    codec: str
    sizes: Mapping[str, tuple[int, int]]
    features: Mapping[str, Any]
    tasks: list[str]
    robot_type: str
    splits: Mapping[str, str]


class Layout(Protocol):
    """The writer of one format.  For each episode: ``video`` of each camera, then ``add``; at the end ``finish``."""

    def video(self, name: str, episode: int, count: int) -> VideoFile: ...
    def end_video(self, name: str, episode: int, video: VideoFile) -> None: ...
    def add(self, episode: int, task: str, table: pa.Table, stats: Mapping[str, Stats]) -> None: ...
    def finish(self, stats: Mapping[str, Stats]) -> None: ...


def layout_of(version: str, root: Path, facts: Facts) -> Layout:
    """Return the writer of a format."""
    return _Version21(root, facts) if version == "v2.1" else _Version30(root, facts)


def float32_horizon_s() -> float:
    """Return the time from which on float32 seconds are further apart than the tolerance of the readers."""
    exponent = 0
    while float(np.spacing(np.float32(2.0**exponent))) <= TOLERANCE_S:
        exponent += 1
    return 2.0**exponent


def write_json(path: Path, value: Any) -> None:
    """Write an indented JSON file."""
    write_text(path, json.dumps(value, indent=4, ensure_ascii=False) + "\n")


def _write_table(path: Path, table: pa.Table) -> None:
    make_folder(path.parent, parents=True, exist_ok=True)
    with open_new(path) as file:
        parquet.write_table(table, file, compression="snappy")


def _info(version: str, facts: Facts, episodes: int, frames: int, more: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "codebase_version": version,
        "robot_type": facts.robot_type,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": len(facts.tasks),
        **more,
        "chunks_size": CHUNK,
        "fps": facts.fps,
        "splits": dict(facts.splits),
        **PATHS[version],
        "features": dict(facts.features),
    }


@dataclass
class _Version21:
    """v2.1: a Parquet file for each episode, and a video for each episode and camera."""

    root: Path
    facts: Facts
    episodes: list[dict[str, Any]] = field(default_factory=list)
    stats: list[dict[str, Any]] = field(default_factory=list)

    def video(self, name: str, episode: int, _count: int) -> VideoFile:
        path = self.root / _V21["video_path"].format(
            episode_chunk=episode // CHUNK, video_key=name, episode_index=episode
        )
        return VideoFile(path, self.facts.sizes[name], self.facts.fps, self.facts.codec)

    def end_video(self, _name: str, _episode: int, video: VideoFile) -> None:
        video.close()

    def add(self, episode: int, task: str, table: pa.Table, stats: Mapping[str, Stats]) -> None:
        path = _V21["data_path"].format(episode_chunk=episode // CHUNK, episode_index=episode)
        _write_table(self.root / path, table)
        self.episodes.append({"episode_index": episode, "tasks": [task], "length": table.num_rows})
        plain = {
            name: {key: value for key, value in each.items() if key not in QUANTILES} for name, each in stats.items()
        }
        self.stats.append({"episode_index": episode, "stats": plain})

    def finish(self, _stats: Mapping[str, Stats]) -> None:
        meta = self.root / "meta"
        count = len(self.episodes)
        more = {"total_videos": count * len(self.facts.sizes), "total_chunks": -(-count // CHUNK)}
        frames = sum(each["length"] for each in self.episodes)
        write_json(meta / "info.json", _info("v2.1", self.facts, count, frames, more))
        tasks = [{"task_index": number, "task": text} for number, text in enumerate(self.facts.tasks)]
        for name, rows in (("tasks", tasks), ("episodes", self.episodes), ("episodes_stats", self.stats)):
            lines = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
            write_text(meta / f"{name}.jsonl", lines)


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
            path = self.root / _V30["video_path"].format(
                video_key=name, chunk_index=number // CHUNK, file_index=number % CHUNK
            )
            file = VideoFile(path, self.facts.sizes[name], fps, self.facts.codec)
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
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + table.num_rows,
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
        path = _V30["data_path"].format(chunk_index=self.data_file // CHUNK, file_index=self.data_file % CHUNK)
        _write_table(self.root / path, pa.concat_tables(self.tables))
        self.tables, self.data_file = [], self.data_file + 1

    def finish(self, stats: Mapping[str, Stats]) -> None:
        self._write_data()
        for each in self.videos.values():
            each.file.close()
        meta = self.root / "meta"
        more = {"data_files_size_in_mb": DATA_MB, "video_files_size_in_mb": VIDEO_MB}
        write_json(meta / "info.json", _info("v3.0", self.facts, len(self.rows), self.frames, more))
        write_json(meta / "stats.json", stats)
        _write_table(meta / "tasks.parquet", _tasks(self.facts.tasks))
        names = {name: pa.array([row[name] for row in self.rows]) for name in self.rows[0]}
        _write_table(meta / "episodes" / "chunk-000" / "file-000.parquet", pa.table(names))


def _tasks(tasks: list[str]) -> pa.Table:
    """The tasks as a data frame of pandas whose index has the name ``task``."""
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

"""Reads a data set of either format, as untrusted files: for each episode its table, its videos and its statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.lerobot.layout import CHUNK, PATHS
from igtl_gateway.untrusted import shape
from igtl_gateway.untrusted.files import read_bytes, size_of
from igtl_gateway.untrusted.text import parse_json

_INFO = shape.fields(
    {
        "codebase_version": shape.text,
        "robot_type": shape.anything,
        "total_episodes": shape.number,
        "total_frames": shape.number,
        "total_tasks": shape.number,
        "fps": shape.number,
        "splits": shape.map_of(shape.text),
        "data_path": shape.text,
        "video_path": shape.anything,
        "features": shape.map_of(
            shape.fields({"dtype": shape.text, "shape": shape.list_of(shape.number)}, ("dtype", "shape"))
        ),
    },
    ("codebase_version", "total_episodes", "total_frames", "total_tasks", "fps", "splits", "data_path", "features"),
)
_EPISODE = shape.fields(
    {"episode_index": shape.number, "tasks": shape.list_of(shape.text), "length": shape.number},
    ("episode_index", "tasks", "length"),
)
_TASK = shape.fields({"task_index": shape.number, "task": shape.text}, ("task_index", "task"))
_STATS = shape.fields({"episode_index": shape.number, "stats": shape.map_of(shape.map_of(shape.anything))})


@dataclass(frozen=True, slots=True)
class VideoPart:
    """The video of an episode: a file, and the frames in it."""

    path: Path
    first_s: float
    last_s: float | None


@dataclass(frozen=True, slots=True)
class FoundEpisode:
    """An episode as its files state it.

    Attributes:
        index, length, tasks: as stated.
        data: Parquet file, and first and last row (half-open), of which None is the whole file.
        rows: see ``data``.
        videos: feature → its part of a video.
        stats: feature → statistics; None if there are none.
    """

    index: int
    length: int
    tasks: list[str]
    data: Path
    rows: tuple[int, int] | None
    videos: Mapping[str, VideoPart]
    stats: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True)
class FoundDataSet:
    """A data set as its metadata state it.

    Attributes:
        root: the directory.
        info: info.json.
        tasks: number → text.
        episodes: the episodes.
    """

    root: Path
    info: Mapping[str, Any]
    tasks: Mapping[int, str]
    episodes: list[FoundEpisode]

    @property
    def version(self) -> str:
        """``v2.1`` or ``v3.0``."""
        return str(self.info["codebase_version"])

    @property
    def videos(self) -> list[str]:
        """The features with a video."""
        return [name for name, each in self.info["features"].items() if each["dtype"] == "video"]


def read_data_set(root: Path) -> FoundDataSet:
    """Read the metadata of a data set.  Raises GatewayError with file, place, found and expected."""
    info = _json(root / "meta" / "info.json", _INFO)
    version = info["codebase_version"]
    if version not in PATHS:
        raise shape.wrong(f"{root}/meta/info.json: codebase_version", version, f"one of {', '.join(PATHS)}")
    for key, template in PATHS[version].items():
        if info.get(key, template) != template:
            raise shape.wrong(f"{root}/meta/info.json: {key}", info[key], template)
    for name in info["features"]:
        if "/" in name or "\\" in name or name in ("", ".", ".."):
            raise shape.wrong(f"{root}/meta/info.json: features", name, "a name without slash")
    if not info["fps"]:
        raise shape.wrong(f"{root}/meta/info.json: fps", info["fps"], "1 or more")
    read = _version21 if version == "v2.1" else _version30
    tasks, episodes = read(root, [name for name, each in info["features"].items() if each["dtype"] == "video"])
    return FoundDataSet(root, info, tasks, episodes)


def read_table(path: Path) -> pa.Table:
    """Read a Parquet file.  Raises GatewayError."""
    size_of(path)
    try:
        return parquet.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError) as error:
        raise DamagedRecording(f"{path}: is not valid Parquet: {str(error).splitlines()[0]}") from None


def read_total_stats(root: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the statistics of a whole data set of v3.0: feature → name → values.  Raises GatewayError."""
    found: Mapping[str, Mapping[str, Any]] = _json(
        root / "meta" / "stats.json", shape.map_of(shape.map_of(shape.anything))
    )
    return found


def _json(path: Path, expected: shape.Shape) -> Any:
    value = parse_json(read_bytes(path).decode("utf-8", "replace"), str(path))
    expected(value, str(path))
    return value


def _lines(path: Path, expected: shape.Shape) -> list[Any]:
    text = read_bytes(path).decode("utf-8", "replace")
    found = []
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            value = parse_json(line, f"{path}:{number}")
            expected(value, f"{path}:{number}")
            found.append(value)
    return found


def _version21(root: Path, videos: list[str]) -> tuple[dict[int, str], list[FoundEpisode]]:
    meta = root / "meta"
    tasks = {each["task_index"]: each["task"] for each in _lines(meta / "tasks.jsonl", _TASK)}
    stats = {each["episode_index"]: each["stats"] for each in _lines(meta / "episodes_stats.jsonl", _STATS)}
    found = []
    for each in _lines(meta / "episodes.jsonl", _EPISODE):
        index = each["episode_index"]
        place = {"episode_chunk": index // CHUNK, "episode_index": index}
        paths = PATHS["v2.1"]
        parts = {
            name: VideoPart(root / paths["video_path"].format(**place, video_key=name), 0.0, None) for name in videos
        }
        data = root / paths["data_path"].format(**place)
        found.append(FoundEpisode(index, each["length"], each["tasks"], data, None, parts, stats.get(index)))
    return tasks, found


def _version30(root: Path, videos: list[str]) -> tuple[dict[int, str], list[FoundEpisode]]:
    rows = read_table(root / "meta" / "tasks.parquet").to_pylist()
    for number, row in enumerate(rows):
        _TASK(row, f"{root}/meta/tasks.parquet: row {number}")
    folder = root / "meta" / "episodes"
    episodes = [row for path in sorted(folder.glob("chunk-*/file-*.parquet")) for row in read_table(path).to_pylist()]
    paths, found = PATHS["v3.0"], []
    begins: dict[tuple[int, int], int] = {}  # first frame of each data file
    for number, row in enumerate(episodes):
        place = f"{folder}: row {number}"
        _EPISODE(row, place)
        for name in ("data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index"):
            shape.number(row.get(name), f"{place}: {name}")
        file = row["data/chunk_index"], row["data/file_index"]
        begin = begins.setdefault(file, row["dataset_from_index"])
        parts = dict(_parts(root, row, videos, place))
        stats: dict[str, dict[str, Any]] = {}
        for key, value in row.items():
            if key.startswith("stats/"):
                name, _, statistic = key.removeprefix("stats/").rpartition("/")
                stats.setdefault(name, {})[statistic] = value
        data = root / paths["data_path"].format(chunk_index=file[0], file_index=file[1])
        span = row["dataset_from_index"] - begin, row["dataset_to_index"] - begin
        found.append(FoundEpisode(row["episode_index"], row["length"], row["tasks"], data, span, parts, stats or None))
    return {row["task_index"]: row["task"] for row in rows}, found


def _parts(root: Path, row: Mapping[str, Any], videos: list[str], place: str) -> Iterator[tuple[str, VideoPart]]:
    for name in videos:
        key = f"videos/{name}"
        chunk, file = row.get(f"{key}/chunk_index"), row.get(f"{key}/file_index")
        shape.number(chunk, f"{place}: {key}/chunk_index")
        shape.number(file, f"{place}: {key}/file_index")
        times = [row.get(f"{key}/{each}_timestamp") for each in ("from", "to")]
        first, last = times
        if not (isinstance(first, float) and isinstance(last, float) and 0 <= first <= last < 1e9):
            raise shape.wrong(f"{place}: {key}", times, "from_timestamp and to_timestamp in seconds")
        path = root / PATHS["v3.0"]["video_path"].format(video_key=name, chunk_index=chunk, file_index=file)
        yield name, VideoPart(path, first, last)

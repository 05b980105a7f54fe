"""Reads a data set of either format, as untrusted files: for each episode its table, its videos and its statistics."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.messages import MAX_PIXELS
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import check_limit, parse_json, read_bytes, read_parquet, shape
from igtl_gateway.addons.lerobot.checksums import CHECKSUMS
from igtl_gateway.addons.lerobot.features import VIDEO, is_list, is_picture, picture_size
from igtl_gateway.addons.lerobot.frames import MAX_FRAMES
from igtl_gateway.addons.lerobot.layout import CHUNK, PATHS
from igtl_gateway.addons.lerobot.recipe_file import MAX_FPS
from igtl_gateway.addons.lerobot.session_list import SESSIONS
from igtl_gateway.addons.lerobot.writing import PROVENANCE, RECIPE

#: Numbers of a feature in a frame: none of a robot has more.
_MAX_NUMBERS = 1 << 20

_INFO = shape.fields(
    {
        "codebase_version": shape.text,
        "robot_type": shape.anything,
        "total_episodes": shape.number,
        "total_frames": shape.number,
        "total_tasks": shape.number,
        "total_videos": shape.number,
        "total_chunks": shape.number,
        "chunks_size": shape.number,
        "data_files_size_in_mb": shape.number,
        "video_files_size_in_mb": shape.number,
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
_VIDEO = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
#: What pandas, with which LeRobot reads the tasks, needs in its metadata of a table.
_PANDAS_COLUMN = shape.fields(
    {"pandas_type": shape.text, "numpy_type": shape.text},
    ("name", "field_name", "pandas_type", "numpy_type", "metadata"),
)
_PANDAS = shape.fields(
    {"column_indexes": shape.list_of(_PANDAS_COLUMN), "columns": shape.list_of(_PANDAS_COLUMN)},
    ("index_columns", "column_indexes", "columns"),
)
_TEXT = frozenset({"object", "str", "string", "unicode"})
#: Columns with the text of the tasks: by the name of the index, and without one, as LeRobot wrote it until 0.4.
_TASK_COLUMNS = ("task", "__index_level_0__")
#: Column of the tasks, None for the names of the columns → its types in pandas.
_PANDAS_TYPES: dict[str | None, frozenset[str]] = {
    "task_index": frozenset({"int64"}), None: _TEXT, **dict.fromkeys(_TASK_COLUMNS, _TEXT),
}  # fmt: skip
#: Files that only our sets have.
_OWN = (SESSIONS, RECIPE, PROVENANCE, CHECKSUMS)
_STATS = shape.fields(
    {"episode_index": shape.number, "stats": shape.map_of(shape.map_of(shape.anything))}, ("episode_index", "stats")
)


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
        index, length, tasks: as stated; LeRobot's conversion of pictures to videos leaves out the tasks.
        data: Parquet file, and first and last row (half-open), of which None is the whole file.
        rows: see ``data``.
        videos: feature → its part of a video.
        read_stats: returns feature → statistics; nothing if there are none.
    """

    index: int
    length: int
    tasks: list[str]
    data: Path
    rows: tuple[int, int] | None
    videos: Mapping[str, VideoPart]
    read_stats: Callable[[], Mapping[str, Any]]


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
        return [name for name, each in self.info["features"].items() if each["dtype"] == VIDEO]

    @property
    def is_ours(self) -> bool:
        """Whether it was exported by this program, also if another one has changed it."""
        return any((self.root / "meta" / each).exists() for each in _OWN)


def read_info(root: Path) -> Mapping[str, Any]:
    """Return info.json of a data set.  Raises GatewayError with file, place, found and expected."""
    info: Mapping[str, Any] = _json(root / "meta" / "info.json", _INFO)
    version = info["codebase_version"]
    if version not in PATHS:
        raise shape.wrong(f"{root}/meta/info.json: codebase_version", version, f"one of {', '.join(PATHS)}")
    videos = [name for name, each in info["features"].items() if each["dtype"] == VIDEO]
    for key, template in PATHS[version].items():
        found = info.get(key, template)
        if found != template and not (key == "video_path" and found is None and not videos):
            raise shape.wrong(f"{root}/meta/info.json: {key}", info[key], template)
    if not 1 <= info["fps"] <= MAX_FPS:
        raise shape.wrong(f"{root}/meta/info.json: fps", info["fps"], f"1 to {MAX_FPS}")
    for name, each in info["features"].items():
        _check_feature(name, each, f"{root}/meta/info.json: features")
    return info


def read_tasks(root: Path, version: str) -> dict[int, str]:
    """Return number → text of the tasks of a data set.  Raises GatewayError."""
    if version == "v2.1":
        path = root / "meta" / "tasks.jsonl"
        return _numbered(path, _lines(path, _TASK))
    path = root / "meta" / "tasks.parquet"
    table = read_table(path)
    text = next((each for each in _TASK_COLUMNS if each in table.schema.names), _TASK_COLUMNS[0])
    named = [{"task_index": row["task_index"], "task": row[text]} for row in _rows(path, ["task_index", text], table)]
    _check_index(table, text, f"{path}: metadata pandas")
    for number, row in enumerate(named):
        _TASK(row, f"{path}: row {number}")
    return _numbered(path, named)


def read_data_set(root: Path) -> FoundDataSet:
    """Read the metadata of a data set.  Raises GatewayError with file, place, found and expected."""
    info = read_info(root)
    version = info["codebase_version"]
    read = _version21 if version == "v2.1" else _version30
    videos = [name for name, each in info["features"].items() if each["dtype"] == VIDEO]
    tasks, episodes = read_tasks(root, version), read(root, videos)
    frames = sum(each.length for each in episodes)
    if frames > MAX_FRAMES:
        raise shape.wrong(f"{root}/meta: frames of all episodes", frames, f"at most {MAX_FRAMES:,}")
    return FoundDataSet(root, info, tasks, episodes)


def _check_feature(name: str, feature: Mapping[str, Any], place: str) -> None:
    if "/" in name or "\\" in name or name in ("", ".", ".."):
        raise shape.wrong(place, name, "a name without slash")
    sizes = feature["shape"]
    if is_picture(feature):
        if len(sizes) != 3 or not 0 < math.prod(picture_size(feature)) <= MAX_PIXELS:
            raise shape.wrong(
                f"{place}.{name}.shape", sizes, f"rows, columns and channels, of at most {MAX_PIXELS:,} pixels"
            )
    elif not sizes or not 0 < math.prod(sizes) <= _MAX_NUMBERS:
        raise shape.wrong(f"{place}.{name}.shape", sizes, f"sizes of 1 or more, with at most {_MAX_NUMBERS:,} numbers")


def read_table(path: Path) -> pa.Table:
    """Read a Parquet file whose columns have different names.  Raises GatewayError."""
    table = read_parquet(path)
    names = table.schema.names
    if len(set(names)) < len(names):
        raise DamagedRecording(
            f"{path}: found {counted(len(names) - len(set(names)), 'column')} with the name of another one"
        )
    return table


def read_total_stats(root: Path) -> Mapping[str, Mapping[str, Any]]:
    """Return the statistics of a whole data set of v3.0: feature → name → values.  Raises GatewayError."""
    found: Mapping[str, Mapping[str, Any]] = _json(
        root / "meta" / "stats.json", shape.map_of(shape.map_of(shape.anything))
    )
    return found


def _json(path: Path, expected: shape.Shape) -> Any:
    value = parse_json(_utf8(read_bytes(path), str(path)), str(path))
    expected(value, str(path))
    return value


def _utf8(data: bytes, place: str) -> str:
    """Return the text, as strictly as LeRobot reads it."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DamagedRecording(f"{place}: byte {error.start}: found {data[error.start]:#x}, expected UTF-8") from None


def _lines(path: Path, expected: shape.Shape) -> list[Any]:
    found = []
    for number, line in enumerate(_utf8(read_bytes(path), str(path)).split("\n"), 1):
        if line.strip():
            value = parse_json(line, f"{path}:{number}")
            expected(value, f"{path}:{number}")
            found.append(value)
            check_limit("count", len(found), str(path))
    return found


def _version21(root: Path, videos: list[str]) -> list[FoundEpisode]:
    meta = root / "meta"
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
        own = stats.get(index, {})
        found.append(FoundEpisode(index, each["length"], each["tasks"], data, None, parts, partial(dict, own)))
    return found


def _version30(root: Path, videos: list[str]) -> list[FoundEpisode]:
    found: list[FoundEpisode] = []
    begins: dict[tuple[int, int], int] = {}  # first frame of each data file
    for path in sorted((root / "meta" / "episodes").glob("chunk-*/file-*.parquet")):
        table = read_table(path)
        check_limit("count", len(found) + table.num_rows, f"{path}: episodes")
        found += _episodes(root, path, table, videos, begins)
    return found


def _check_index(table: pa.Table, text: str, place: str) -> None:
    """Raise DamagedRecording unless pandas makes the text of the tasks, a column, the index of their table."""
    found = parse_json(_utf8((table.schema.metadata or {}).get(b"pandas", b"{}"), place), place)
    _PANDAS(found, place)
    if found["index_columns"] != [text]:
        raise shape.wrong(f"{place}.index_columns", found["index_columns"], f'["{text}"]')
    for part, names in (("columns", sorted(table.schema.names)), ("column_indexes", [None])):
        columns = found[part]
        if sorted(map(repr, (each["field_name"] for each in columns))) != sorted(map(repr, names)):
            raise shape.wrong(f"{place}.{part}", [each["field_name"] for each in columns], f"the names {names}")
        for each in columns:
            name, types = each["field_name"], _PANDAS_TYPES.get(each["field_name"], frozenset())
            known = None if name == _TASK_COLUMNS[1] else name  # an index without a name
            if each["name"] != known or not {each["pandas_type"], each["numpy_type"]} <= types:
                raise shape.wrong(f"{place}.{part}", each, f"{name} of the type {min(types, default='')}")


def _numbered(path: Path, rows: list[Any]) -> dict[int, str]:
    """Return number → text of the tasks of a file.  Raises DamagedRecording for a number or a name that comes twice."""
    for key in ("task_index", "task"):
        again = next((each for each, count in Counter(row[key] for row in rows).items() if count > 1), None)
        if again is not None:
            raise shape.wrong(f"{path}: {key}", again, "each once")
    return {row["task_index"]: row["task"] for row in rows}


def _rows(path: Path, names: list[str], table: pa.Table | None = None) -> list[dict[str, Any]]:
    """The rows of a small table, with these columns alone."""
    table = read_table(path) if table is None else table
    check_limit("count", table.num_rows, f"{path}: rows")
    for name in names:
        if name not in table.schema.names:
            raise DamagedRecording(f"{path}: found no column {name}, expected one")
        if _leaves(table[name]) > max(16 * table.num_rows, 1 << 16):
            raise DamagedRecording(f"{path}: {name}: found {_leaves(table[name]):,} values, expected one for each row")
    found: list[dict[str, Any]] = table.select(names).to_pylist()
    return found


def _episodes(
    root: Path, path: Path, table: pa.Table, videos: list[str], begins: dict[tuple[int, int], int]
) -> Iterator[FoundEpisode]:
    indices = ["data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index"]
    names = ["episode_index", "length", *indices, *({"tasks"} & set(table.schema.names))]
    names += [f"videos/{name}/{each}" for name in videos for each in _VIDEO]
    for number, stated in enumerate(_rows(path, names, table)):
        row, place = {"tasks": [], **stated}, f"{path}: row {number}"
        _EPISODE(row, place)
        for name in indices:
            shape.number(row[name], f"{place}: {name}")
        file = row["data/chunk_index"], row["data/file_index"]
        begin = begins.setdefault(file, row["dataset_from_index"])
        span = row["dataset_from_index"] - begin, row["dataset_to_index"] - begin
        if not 0 <= span[0] <= span[1]:
            raise shape.wrong(f"{place}: dataset_from_index, dataset_to_index", span, "increasing frame numbers")
        parts = dict(_parts(root, row, videos, place))
        data = root / PATHS["v3.0"]["data_path"].format(chunk_index=file[0], file_index=file[1])
        yield FoundEpisode(
            row["episode_index"], row["length"], row["tasks"], data, span, parts,
            partial(_stats_of, table, number),
        )  # fmt: skip


def _stats_of(table: pa.Table, row: int) -> dict[str, dict[str, Any]]:
    """The statistics in the columns ``stats/FEATURE/STATISTIC`` of a row."""
    found: dict[str, dict[str, Any]] = {}
    for key in table.schema.names:
        if key.startswith("stats/"):
            name, _, statistic = key.removeprefix("stats/").rpartition("/")
            cell = table[key].slice(row, 1)
            found.setdefault(name, {})[statistic] = cell[0].as_py() if _leaves(cell) <= _MAX_NUMBERS else None
    return found


def _leaves(column: pa.ChunkedArray) -> int:
    """The values in all lists of a column."""
    while column.num_chunks and is_list(column.type):
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks])
    return len(column)


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

"""Checks a data set: the published rules, and the recording that it was made of.

``check`` returns findings as strings with place, found and expected.  The published readers accept an extra column and
a wrong number of frames silently; these are found here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.errors import GatewayError
from igtl_gateway.lerobot.episodes import TOLERANCE_S
from igtl_gateway.lerobot.reading import (
    FoundDataSet,
    FoundEpisode,
    VideoPart,
    read_data_set,
    read_table,
    read_total_stats,
)
from igtl_gateway.lerobot.recipe import ACTION, OWN_COLUMNS, STATE
from igtl_gateway.lerobot.stats import number_stats
from igtl_gateway.lerobot.video import read_video
from igtl_gateway.untrusted.files import read_bytes

Array = npt.NDArray[Any]

_STATISTICS = ("min", "max", "mean", "std", "count")
_ARROW = {
    "float32": pa.float32(),
    "float64": pa.float64(),
    "int64": pa.int64(),
    "string": pa.string(),
    "bool": pa.bool_(),
}


def check_rules(root: Path) -> tuple[FoundDataSet | None, list[str]]:
    """Check a data set against the published rules, and return it with the findings; None if it cannot be read."""
    try:
        found = read_data_set(root)
    except GatewayError as error:
        return None, [str(error)]
    return found, [*_metadata(found), *_files(found), *_episodes(found)]


def _metadata(found: FoundDataSet) -> Iterator[str]:
    info, episodes, place = found.info, found.episodes, "meta/info.json"
    frames = sum(each.length for each in episodes)
    totals = {"total_episodes": len(episodes), "total_frames": frames, "total_tasks": len(found.tasks)}
    if found.version == "v2.1":
        totals["total_videos"] = len(episodes) * len(found.videos)
    for name, expected in totals.items():
        if info.get(name) != expected:
            yield f"{place}: {name}: found {info.get(name)}, expected {expected}"
    features = info["features"]
    for name in (STATE, ACTION, *OWN_COLUMNS):
        if name not in features:
            yield f"{place}: features: found no {name}, expected one"
    for name, each in features.items():
        if each["dtype"] not in (*_ARROW, "video"):
            yield f"{place}: features.{name}.dtype: found {each['dtype']}, expected one of video, {', '.join(_ARROW)}"
    if not episodes:
        yield "meta/episodes: found no episode, expected one or more"
    if [each.index for each in episodes] != list(range(len(episodes))):
        yield "meta/episodes: found episodes that are not numbered from 0 on, expected 0, 1, 2 …"
    for name, text in info["splits"].items():
        start, _, end = text.partition(":")
        if not (start.isdecimal() and end.isdecimal() and int(start) < int(end) <= len(episodes)):
            yield f"{place}: splits.{name}: found {text!r}, expected a range within 0:{len(episodes)}"
    if found.version == "v3.0":
        yield from _total_stats(found)
    try:
        text = read_bytes(found.root / "meta" / "README.md").decode("utf-8", "replace").lower()
        if "synchron" not in text and "timestamp" not in text:
            yield "meta/README.md: found no statement on synchronization, expected one"
    except GatewayError as error:
        yield str(error)


def _total_stats(found: FoundDataSet) -> Iterator[str]:
    """Without these statistics a reader of v3.0 looks for them in the network."""
    try:
        stats = read_total_stats(found.root)
    except GatewayError as error:
        yield str(error)
        return
    frames = sum(each.length for each in found.episodes)
    for name, feature in found.info["features"].items():
        if feature["dtype"] == "string":
            continue
        missing = [each for each in _STATISTICS if stats.get(name, {}).get(each) is None]
        if missing:
            yield f"meta/stats.json: {name}: found no {', '.join(missing)}, expected them"
        elif feature["dtype"] != "video" and stats[name]["count"] != [frames]:
            yield f"meta/stats.json: {name}: count: found {stats[name]['count']}, expected {[frames]}"


def _files(found: FoundDataSet) -> Iterator[str]:
    """Files of data and videos that no episode names."""
    known = {each.data for each in found.episodes}
    known |= {part.path for each in found.episodes for part in each.videos.values()}
    for folder, suffix in (("data", "parquet"), ("videos", "mp4")):
        for path in sorted((found.root / folder).rglob(f"*.{suffix}")):
            if path not in known:
                yield f"{path.relative_to(found.root)}: found a file of no episode, expected none"


def _episodes(found: FoundDataSet) -> Iterator[str]:
    first, tables = 0, Tables()
    for episode in found.episodes:
        place = f"episode {episode.index}"
        try:
            table = tables.of(episode)
        except GatewayError as error:
            yield str(error)
            continue
        if table.num_rows != episode.length:
            yield f"{place}: found {table.num_rows:,} rows, expected {episode.length:,}"
        yield from (f"{place}: {each}" for each in _columns(found, table))
        yield from (f"{place}: {each}" for each in _own_columns(found, episode, table, first))
        yield from (f"{place}: {each}" for each in _stats(found, episode, table))
        first += episode.length
    yield from _videos(found)


class Tables:
    """The rows of episodes; a file with several episodes is read once."""

    def __init__(self) -> None:
        self._last: tuple[Path, pa.Table] | None = None

    def of(self, episode: FoundEpisode) -> pa.Table:
        """Return the rows of an episode.  Raises GatewayError."""
        if self._last is None or self._last[0] != episode.data:
            self._last = episode.data, read_table(episode.data)
        table = self._last[1]
        if episode.rows is None:
            return table
        return table.slice(episode.rows[0], episode.rows[1] - episode.rows[0])


def _columns(found: FoundDataSet, table: pa.Table) -> Iterator[str]:
    features = {name: each for name, each in found.info["features"].items() if each["dtype"] != "video"}
    for name in table.schema.names:
        if name not in features:
            yield f"found the column {name!r}, expected only the features of info.json"
    for name, each in features.items():
        if name not in table.schema.names:
            yield f"found no column {name!r}, expected one"
            continue
        kind, size = _ARROW.get(each["dtype"]), int(np.prod(each["shape"]))
        expected = kind if size == 1 or kind is None else pa.list_(kind, size)
        actual = table.schema.field(name).type
        if expected is not None and actual != expected and actual != _nested(expected):
            yield f"{name}: found {actual}, expected {expected}"
        elif table[name].null_count:
            yield f"{name}: found {table[name].null_count:,} missing values, expected none"
        elif pa.types.is_floating(kind) and not np.isfinite(matrix_of(table, name)).all():
            yield f"{name}: found values that are not finite, expected numbers"


def _nested(kind: Any) -> Any:
    """The same list with the name of elements that other writers use."""
    if not pa.types.is_fixed_size_list(kind):
        return kind
    return pa.list_(pa.field("element", kind.value_type), kind.list_size)


def matrix_of(table: pa.Table, name: str) -> Array:
    """Return a column as (N, K) numbers."""
    column = table[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # of a table without rows
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    if pa.types.is_fixed_size_list(column.type):
        return np.asarray(column.flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)
    return np.asarray(column.to_numpy(zero_copy_only=False)).reshape(-1, 1)


def _is_numeric(table: pa.Table, name: str) -> bool:
    if name not in table.schema.names:
        return False
    kind = table.schema.field(name).type
    kind = kind.value_type if pa.types.is_fixed_size_list(kind) else kind
    return bool((pa.types.is_floating(kind) or pa.types.is_integer(kind)) and not table[name].null_count)


def _own_columns(found: FoundDataSet, episode: FoundEpisode, table: pa.Table, first: int) -> Iterator[str]:
    count, fps = table.num_rows, found.info["fps"]
    frames = np.arange(count)
    expected = {"frame_index": frames, "episode_index": np.full(count, episode.index), "index": first + frames}
    for name, values in expected.items():
        if _is_numeric(table, name):
            yield from _first_difference(name, matrix_of(table, name)[:, 0], values)
    if _is_numeric(table, "timestamp") and count:
        stamps = matrix_of(table, "timestamp")[:, 0]
        away = np.abs(stamps.astype(np.float64) - frames / fps)
        steps = np.abs(np.diff(stamps) - np.float32(1 / fps))
        if away.max() > TOLERANCE_S or (len(steps) and steps.max() > TOLERANCE_S):
            worst = int(np.argmax(away)) if away.max() > TOLERANCE_S else int(np.argmax(steps)) + 1
            yield f"timestamp: frame {worst}: found {stamps[worst]:.6f} s, expected {worst / fps:.6f} s"
    if _is_numeric(table, "task_index"):
        known = {number for number, text in found.tasks.items() if text in episode.tasks}
        if unknown := set(matrix_of(table, "task_index")[:, 0].tolist()) - known:
            yield f"task_index: found {min(unknown)}, expected the number of {' or '.join(map(repr, episode.tasks))}"


def _first_difference(name: str, values: Array, expected: Array) -> Iterator[str]:
    if len(values) == len(expected) and not np.array_equal(values, expected):
        row = int(np.argmax(values != expected))
        yield f"{name}: frame {row}: found {values[row]}, expected {expected[row]}"


def _stats(found: FoundDataSet, episode: FoundEpisode, table: pa.Table) -> Iterator[str]:
    for name, feature in found.info["features"].items():
        if feature["dtype"] == "string":
            continue
        stats = (episode.stats or {}).get(name)
        missing = [each for each in _STATISTICS if not isinstance(stats, dict) or stats.get(each) is None]
        if missing or not isinstance(stats, dict):
            yield f"stats of {name}: found no {', '.join(missing)}, expected them"
            continue
        size = (3, 1, 1) if feature["dtype"] == "video" else (int(np.prod(feature["shape"])),)
        try:
            values = {each: np.asarray(stats[each], np.float64) for each in _STATISTICS}
        except (TypeError, ValueError):
            yield f"stats of {name}: found no numbers, expected the shape {size}"
            continue
        for each in _STATISTICS[:4]:
            if values[each].shape != size:
                yield f"stats of {name}: {each}: found the shape {values[each].shape}, expected {size}"
                break
        else:
            if feature["dtype"] == "video":
                if not all((values[each] >= 0).all() and (values[each] <= 1).all() for each in _STATISTICS[:4]):
                    yield f"stats of {name}: found values outside of 0 to 1, expected pixels on that scale"
            elif _is_numeric(table, name) and table.num_rows:
                yield from _compare_stats(name, values, number_stats(matrix_of(table, name)))


def _compare_stats(name: str, values: dict[str, Array], expected: Any) -> Iterator[str]:
    for each in _STATISTICS:
        wanted = np.asarray(expected[each], np.float64)
        found = values[each]
        if found.shape != wanted.shape or not np.allclose(found, wanted, rtol=1e-4, atol=1e-5):
            yield f"stats of {name}: {each}: found {found.tolist()}, expected {wanted.tolist()}"


def _videos(found: FoundDataSet) -> Iterator[str]:
    for name in found.videos:
        rows, columns = found.info["features"][name]["shape"][:2]
        for path, parts in _by_file(found, name).items():
            try:
                times, sizes = [], set()
                for at, picture in read_video(path):
                    times.append(at)
                    sizes.add(picture.shape[:2])
            except GatewayError as error:
                yield str(error)
                continue
            place = str(path.relative_to(found.root))
            yield from (f"{place}: {each}" for each in _video_times(np.array(times), parts, found.info["fps"]))
            if sizes - {(rows, columns)}:
                yield f"{place}: found {_size(sizes - {(rows, columns)})} pixels, expected {columns} × {rows}"


def _size(sizes: set[Any]) -> str:
    rows, columns = min(sizes)
    return f"{columns} × {rows}"


def _by_file(found: FoundDataSet, name: str) -> dict[Path, list[tuple[FoundEpisode, VideoPart]]]:
    files: dict[Path, list[tuple[FoundEpisode, VideoPart]]] = {}
    for episode in found.episodes:
        part = episode.videos[name]
        files.setdefault(part.path, []).append((episode, part))
    return files


def _video_times(times: Array, parts: list[tuple[FoundEpisode, VideoPart]], fps: int) -> Iterator[str]:
    total = sum(episode.length for episode, _ in parts)
    if len(times) != total:
        yield f"found {len(times):,} frames, expected {total:,}"
    away = np.abs(times - np.arange(len(times)) / fps)
    if len(away) and away.max() > TOLERANCE_S:
        worst = int(np.argmax(away > TOLERANCE_S))
        yield f"frame {worst}: found the time {times[worst]:.6f} s, expected {worst / fps:.6f} s"
    first = 0
    for episode, part in parts:
        for text, at, frame in (("from", part.first_s, first), ("to", part.last_s, first + episode.length)):
            if at is not None and abs(at - frame / fps) > TOLERANCE_S:
                yield f"episode {episode.index}: {text}_timestamp: found {at:.6f} s, expected {frame / fps:.6f} s"
        first += episode.length


def pictures_of(found: FoundDataSet, name: str) -> Iterator[tuple[FoundEpisode, int, npt.NDArray[np.uint8]]]:
    """Yield episode, frame number and picture of a feature, in order.  Raises GatewayError."""
    for path, parts in _by_file(found, name).items():
        owners = ((episode, frame) for episode, _ in parts for frame in range(episode.length))
        for (episode, frame), (_, picture) in zip(owners, read_video(path), strict=False):
            yield episode, frame, picture

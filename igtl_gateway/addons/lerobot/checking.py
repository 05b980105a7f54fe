"""Checks a data set against the published rules.

Findings are strings with place, found and expected.  The published readers accept an extra column and a wrong number
of frames silently; these are found here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import Deadline, read_bytes, size_of, stored_bytes
from igtl_gateway.addons.lerobot.checking_edits import check_edits
from igtl_gateway.addons.lerobot.checking_images import check_images
from igtl_gateway.addons.lerobot.checking_stats import StatsCheck
from igtl_gateway.addons.lerobot.checking_videos import check_videos
from igtl_gateway.addons.lerobot.checksums import check_checksums, data_files
from igtl_gateway.addons.lerobot.columns import Tables, is_numeric, matrix_of, missing, row_shape
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S, longest
from igtl_gateway.addons.lerobot.features import ARROW, IMAGE, IMAGE_COLUMN, LANGUAGE, VIDEO, innermost
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, read_data_set
from igtl_gateway.addons.lerobot.recipe import ACTION, OWN_COLUMNS, STATE
from igtl_gateway.addons.lerobot.splits import MOST_RANGES, RANGE

Array = npt.NDArray[Any]

#: Types of features with a column.
_COLUMNS = (IMAGE, LANGUAGE, *ARROW)
#: Extra columns, or files of no episode, that are listed.
_MOST = 5
#: Findings of a data set; a small table may state 200,000 episodes, each of which would be wrong.
_MOST_FINDINGS = 1_000


def check_rules(root: Path, notes: list[str] | None = None) -> tuple[FoundDataSet | None, list[str]]:
    """Check a data set against the published rules, and return it with the findings; None if it cannot be read.

    Differences from our sets which are not findings are added to ``notes``.
    """
    try:
        found = read_data_set(root)
    except GatewayError as error:
        return None, [str(error)]
    deadline = Deadline(sum(stored_bytes(path, size_of(path)) for path in data_files(root)))
    stats = StatsCheck(found, [] if notes is None else notes)
    checksums = check_checksums(root, deadline) if found.is_ours else ()
    return found, first_findings(
        chain(_metadata(found), _files(found), check_edits(found), checksums, _episodes(found, stats, deadline))
    )


def first_findings(findings: Iterable[str]) -> list[str]:
    """Return the first findings; if there are more, a last one states that no more are looked for."""
    found = list(islice(findings, _MOST_FINDINGS + 1))
    if len(found) > _MOST_FINDINGS:
        found[_MOST_FINDINGS] = f"found more than {_MOST_FINDINGS:,} findings: no more are looked for"
    return found


def _metadata(found: FoundDataSet) -> Iterator[str]:
    info, episodes, place = found.info, found.episodes, "meta/info.json"
    frames = sum(each.length for each in episodes)
    totals = {"total_episodes": len(episodes), "total_frames": frames, "total_tasks": len(found.tasks)}
    if found.version == "v2.1":
        totals["total_videos"] = len(episodes) * len(found.videos)
    for name, expected in totals.items():
        if info.get(name) != expected:
            yield f"{place}: {name}: found {_short(info.get(name))}, expected {expected}"
    features = info["features"]
    for name in (*((STATE, ACTION) if found.is_ours else ()), *OWN_COLUMNS):
        if name not in features:
            yield f"{place}: features: found no {name}, expected one"
    known = (VIDEO, *_COLUMNS)
    for name, each in features.items():
        if each["dtype"] not in known:
            yield f"{place}: features.{name}.dtype: found {each['dtype']}, expected one of {', '.join(known)}"
    if found.version == "v3.0" and list(found.tasks) != list(range(len(found.tasks))):
        row = next(row for row, number in enumerate(found.tasks) if row != number)
        yield (
            f"meta/tasks.parquet: row {row}: found task_index {list(found.tasks)[row]}, expected {row}: LeRobot takes "
            "the row for the number"
        )
    if not episodes:
        yield "meta/episodes: found no episode, expected one or more"
    if [each.index for each in episodes] != list(range(len(episodes))):
        yield "meta/episodes: found episodes that are not numbered from 0 on, expected 0, 1, 2 …"
    for each in episodes:
        if each.length > longest(info["fps"]):
            yield (
                f"episode {each.index}: found {count_text(each.length, 'frame')}, expected at most "
                f"{longest(info['fps']):,}"
            )
    if without := [each.index for each in episodes if not each.tasks]:
        yield f"episode {without[0]}: found no task ({count_text(len(without), 'episode')}), expected one or more"
    yield from _splits(info["splits"], len(episodes), f"{place}: splits")
    if not found.is_ours:
        return
    try:
        text = read_bytes(found.root / "meta" / "README.md").decode("utf-8", "replace").lower()
        if "synchron" not in text and "timestamp" not in text:
            yield "meta/README.md: found no statement on synchronization, expected one"
    except GatewayError as error:
        yield str(error)


def _splits(splits: dict[str, str], count: int, place: str) -> Iterator[str]:
    """Splits that are invalid or overlap, and episodes without a split."""
    owners: list[str] = [""] * count
    ranges = ((name, each) for name, text in splits.items() for each in text.split(",", MOST_RANGES))
    for name, text in ranges:
        found = RANGE.fullmatch(text)
        start, end = (int(found[1]), int(found[2])) if found else (0, 0)
        if not start < end <= count:
            yield f"{place}.{name}: found {_short(repr(text))}, expected a range within 0:{count}"
            return
        both = next((number for number in range(start, end) if owners[number]), None)
        if both is not None:
            yield f"{place}.{name}: found episode {both}, which is in {owners[both]}, expected one split"
        owners[start:end] = [name] * (end - start)
    if "" in owners:
        yield f"{place}: found episode {owners.index('')} in no split ({owners.count('')} in none), expected one"


def _files(found: FoundDataSet) -> Iterator[str]:
    """Files of data and videos that no episode names."""
    known = {each.data for each in found.episodes}
    known |= {part.path for each in found.episodes for part in each.videos.values()}
    for folder, suffix in (("data", "parquet"), ("videos", "mp4")):
        others = [path for path in sorted((found.root / folder).rglob(f"*.{suffix}")) if path not in known]
        for path in others[:_MOST]:
            yield f"{path.relative_to(found.root)}: found a file of no episode, expected none"
        if len(others) > _MOST:
            yield f"{folder}: {len(others) - _MOST:,} more files of no episode"


def _episodes(found: FoundDataSet, stats: StatsCheck, deadline: Deadline) -> Iterator[str]:
    first, tables = 0, Tables()
    for episode in found.episodes:
        place = f"episode {episode.index}"
        deadline.check(str(found.root))
        try:
            table = tables.of(episode)
        except GatewayError as error:
            yield str(error)
            table = None
        if table is not None and table.num_rows != episode.length:
            yield f"{place}: found {count_text(table.num_rows, 'row')}, expected {episode.length:,}"
            table = None
        if table is not None and episode.length <= longest(found.info["fps"]):
            yield from (f"{place}: {each}" for each in _columns(found, table))
            yield from (f"{place}: {each}" for each in _own_columns(found, episode, table, first))
            yield from check_images(found, episode, table, stats, deadline)
        yield from stats.numbers(episode, table)
        first += episode.length
    yield from check_videos(found, stats)
    yield from stats.total()


def _columns(found: FoundDataSet, table: pa.Table) -> Iterator[str]:
    features = {name: each for name, each in found.info["features"].items() if each["dtype"] in _COLUMNS}
    others = [name for name in table.schema.names if name not in features]
    for name in others[:_MOST]:
        yield f"found the column {_short(repr(name))}, expected only the features of info.json"
    if len(others) > _MOST:
        yield f"found {len(others) - _MOST:,} more columns, expected only the features of info.json"
    for name, each in features.items():
        if name not in table.schema.names:
            yield f"found no column {name!r}, expected one"
        elif each["dtype"] == IMAGE:
            if table.schema.field(name).type != IMAGE_COLUMN:
                yield f"{name}: found {_short(str(table.schema.field(name).type))}, expected {IMAGE_COLUMN}"
        elif each["dtype"] in ARROW:
            yield from (f"{name}: {text}" for text in _values(table, name, ARROW[each["dtype"]], each["shape"]))


def _values(table: pa.Table, name: str, kind: pa.DataType, shape: list[int]) -> Iterator[str]:
    """What is wrong in a column of numbers or strings: its type, missing and infinite values, the lengths of lists.

    Lists may state their length in the type, as our writer does, or in each row, as LeRobot's merge leaves them.
    """
    size, column = math.prod(shape), table[name]
    inner, depth = innermost(column.type)
    depths = (0,) if shape == [1] else (1, len(shape))
    if (inner != kind and (kind, inner) != (pa.string(), pa.large_string())) or depth not in depths:
        yield f"found {_short(str(column.type))}, expected {kind if shape == [1] else pa.list_(kind, size)}"
        return
    if number := missing(column):
        yield f"found {count_text(number, 'missing value')}, expected none"
        return
    sizes = row_shape(column)
    if table.num_rows and sizes not in ((), tuple(shape), (size,)):
        found = "lists of several lengths" if sizes is None else f"lists of {_size(sizes)}"
        yield f"found {found}, expected {_size(shape)}"
    elif pa.types.is_floating(kind) and not np.isfinite(matrix_of(table, name)).all():
        yield "found values that are not finite, expected numbers"


def _own_columns(found: FoundDataSet, episode: FoundEpisode, table: pa.Table, first: int) -> Iterator[str]:
    count, fps = table.num_rows, found.info["fps"]
    frames = np.arange(count)
    expected = {"frame_index": frames, "episode_index": np.full(count, episode.index), "index": first + frames}
    for name, values in expected.items():
        if is_numeric(table, name):
            yield from _first_difference(name, matrix_of(table, name)[:, 0], values)
    if is_numeric(table, "timestamp") and count:
        stamps = matrix_of(table, "timestamp")[:, 0]
        away = np.abs(stamps.astype(np.float64) - frames / fps)
        steps = np.abs(np.diff(stamps) - np.float32(1 / fps))
        if away.max() > TOLERANCE_S or (len(steps) and steps.max() > TOLERANCE_S):
            worst = int(np.argmax(away)) if away.max() > TOLERANCE_S else int(np.argmax(steps)) + 1
            yield f"timestamp: frame {worst}: found {stamps[worst]:.6f} s, expected {worst / fps:.6f} s"
    if is_numeric(table, "task_index") and episode.tasks:
        known = {number for number, text in found.tasks.items() if text in episode.tasks}
        if unknown := set(matrix_of(table, "task_index")[:, 0].tolist()) - known:
            tasks = _short(" or ".join(map(repr, episode.tasks)))
            yield f"task_index: found {min(unknown)}, expected the number of {tasks}"


def _size(sizes: Sequence[int]) -> str:
    return _short(" × ".join(map(str, sizes)))


def _first_difference(name: str, values: Array, expected: Array) -> Iterator[str]:
    if len(values) == len(expected) and not np.array_equal(values, expected):
        row = int(np.argmax(values != expected))
        yield f"{name}: frame {row}: found {values[row]}, expected {expected[row]}"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 120 else f"{text[:120]}…"

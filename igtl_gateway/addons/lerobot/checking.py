"""Checks a data set against the published rules.

Findings are strings with place, found and expected.  The published readers accept an extra column and a wrong number
of frames silently; these are found here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import Deadline, read_bytes, size_of, stored_bytes
from igtl_gateway.addons.lerobot.checking_stats import StatsCheck
from igtl_gateway.addons.lerobot.checking_videos import check_videos
from igtl_gateway.addons.lerobot.checksums import check_checksums, data_files
from igtl_gateway.addons.lerobot.columns import ARROW, Tables, is_numeric, matrix_of, missing
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S, longest
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, read_data_set
from igtl_gateway.addons.lerobot.recipe import ACTION, OWN_COLUMNS, STATE

Array = npt.NDArray[Any]

#: Range of episodes of a split.
_RANGE = re.compile(r"([0-9]{1,9}):([0-9]{1,9})")
#: Ranges of a split that are read.
_MOST_RANGES = 10_000
#: Extra columns, or files of no episode, that are listed.
_MOST = 5
#: Findings of a data set; a small table may state 200,000 episodes, each of which would be wrong.
_MOST_FINDINGS = 1_000


def check_rules(root: Path) -> tuple[FoundDataSet | None, list[str]]:
    """Check a data set against the published rules, and return it with the findings; None if it cannot be read."""
    try:
        found = read_data_set(root)
    except GatewayError as error:
        return None, [str(error)]
    deadline = Deadline(sum(stored_bytes(path, size_of(path)) for path in data_files(root)))
    return found, first_findings(
        chain(_metadata(found), _files(found), check_checksums(root, deadline), _episodes(found, deadline))
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
    for name in (STATE, ACTION, *OWN_COLUMNS):
        if name not in features:
            yield f"{place}: features: found no {name}, expected one"
    for name, each in features.items():
        if each["dtype"] not in (*ARROW, "video"):
            yield f"{place}: features.{name}.dtype: found {each['dtype']}, expected one of video, {', '.join(ARROW)}"
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
    yield from _splits(info["splits"], len(episodes), f"{place}: splits")
    try:
        text = read_bytes(found.root / "meta" / "README.md").decode("utf-8", "replace").lower()
        if "synchron" not in text and "timestamp" not in text:
            yield "meta/README.md: found no statement on synchronization, expected one"
    except GatewayError as error:
        yield str(error)


def _splits(splits: dict[str, str], count: int, place: str) -> Iterator[str]:
    """Splits that are invalid or overlap, and episodes without a split."""
    owners: list[str] = [""] * count
    ranges = ((name, each) for name, text in splits.items() for each in text.split(",", _MOST_RANGES))
    for name, text in ranges:
        found = _RANGE.fullmatch(text)
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


def _episodes(found: FoundDataSet, deadline: Deadline) -> Iterator[str]:
    first, tables, stats = 0, Tables(), StatsCheck(found)
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
        yield from stats.numbers(episode, table)
        first += episode.length
    yield from check_videos(found, stats)
    yield from stats.total()


def _columns(found: FoundDataSet, table: pa.Table) -> Iterator[str]:
    features = {name: each for name, each in found.info["features"].items() if each["dtype"] in ARROW}
    others = [name for name in table.schema.names if name not in features]
    for name in others[:_MOST]:
        yield f"found the column {_short(repr(name))}, expected only the features of info.json"
    if len(others) > _MOST:
        yield f"found {len(others) - _MOST:,} more columns, expected only the features of info.json"
    for name, each in features.items():
        if name not in table.schema.names:
            yield f"found no column {name!r}, expected one"
            continue
        kind, size = ARROW[each["dtype"]], math.prod(each["shape"])
        expected = kind if size == 1 else pa.list_(kind, size)
        actual = table.schema.field(name).type
        if actual != expected and actual != _nested(expected):
            yield f"{name}: found {_short(str(actual))}, expected {expected}"
            continue
        if number := missing(table[name]):
            yield f"{name}: found {count_text(number, 'missing value')}, expected none"
        elif pa.types.is_floating(kind) and not np.isfinite(matrix_of(table, name)).all():
            yield f"{name}: found values that are not finite, expected numbers"


def _nested(kind: Any) -> Any:
    """The same list with the name of elements that other writers use."""
    if not pa.types.is_fixed_size_list(kind):
        return kind
    return pa.list_(pa.field("element", kind.value_type), kind.list_size)


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
    if is_numeric(table, "task_index"):
        known = {number for number, text in found.tasks.items() if text in episode.tasks}
        if unknown := set(matrix_of(table, "task_index")[:, 0].tolist()) - known:
            tasks = _short(" or ".join(map(repr, episode.tasks)))
            yield f"task_index: found {min(unknown)}, expected the number of {tasks}"


def _first_difference(name: str, values: Array, expected: Array) -> Iterator[str]:
    if len(values) == len(expected) and not np.array_equal(values, expected):
        row = int(np.argmax(values != expected))
        yield f"{name}: frame {row}: found {values[row]}, expected {expected[row]}"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 120 else f"{text[:120]}…"

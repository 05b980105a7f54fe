"""Checks the statistics of a data set: they are computed again, from the values and from the decoded videos.

Readers normalise with these numbers, so a wrong mean spoils a policy silently.  Statistics of other programs are sums
of float32, and those of pictures were taken before they were coded: the tolerances allow for both.  The comparison
with the recording has none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.lerobot.columns import ARROW, is_numeric, matrix_of
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, read_total_stats
from igtl_gateway.addons.lerobot.stats import QUANTILES, PictureStats, Stats, joined_stats, number_stats

Array = npt.NDArray[Any]

STATISTICS = ("min", "max", "mean", "std", "count")
_IN_ORDER = ("min", *QUANTILES, "max")
#: Tolerance of numbers, as a part of the largest one.
_NUMBERS = {"min": 1e-6, "max": 1e-6, "mean": 1e-4, "std": 1e-4}
#: Tolerance of pictures on a scale of 0 to 1: coding blurs edges and colours.
_PICTURES = {"min": 0.3, "max": 0.3, "mean": 0.03, "std": 0.15}


class StatsCheck:
    """Computes the statistics again, episode by episode, and at the end those of the whole set."""

    def __init__(self, found: FoundDataSet) -> None:
        self._found = found
        self._numbers: dict[str, list[Stats]] = {}
        self._pictures: dict[str, PictureStats] = {}
        self._incomplete: set[str] = set()

    def numbers(self, episode: FoundEpisode, table: pa.Table | None) -> Iterator[str]:
        """Yield the wrong statistics of an episode; without a table only those that are missing."""
        try:
            stats = episode.read_stats()
        except GatewayError as error:
            yield str(error)
            stats = {}
        for name, feature in self._found.info["features"].items():
            if feature["dtype"] == "string":
                continue
            yield from _form(f"episode {episode.index}: stats of {name}", feature, stats.get(name), episode.length)
            if feature["dtype"] not in ARROW:
                continue
            if table is None or not table.num_rows or not is_numeric(table, name):
                self._incomplete.add(name)
                continue
            matrix = matrix_of(table, name)
            if not np.isfinite(matrix).all():  # the columns have it
                self._incomplete.add(name)
                continue
            expected = number_stats(matrix)
            self._numbers.setdefault(name, []).append(expected)
            yield from _difference(f"episode {episode.index}: stats of {name}", stats.get(name), expected, _NUMBERS)

    def pictures(self, episode: FoundEpisode, name: str, seen: PictureStats) -> Iterator[str]:
        """Yield the wrong statistics of the pictures of an episode, of which ``seen`` are the sampled ones."""
        if not seen.pictures:
            self._incomplete.add(name)
            return
        self._pictures.setdefault(name, PictureStats()).join(seen)
        try:
            stats = episode.read_stats().get(name)
        except GatewayError:
            return  # reported with the numbers
        yield from _difference(f"episode {episode.index}: stats of {name}", stats, seen.stats(), _PICTURES)

    def total(self) -> Iterator[str]:
        """Yield the wrong statistics of the whole set, which v3.0 has: without them readers search the network."""
        if self._found.version != "v3.0":
            return
        try:
            stats = read_total_stats(self._found.root)
        except GatewayError as error:
            yield str(error)
            return
        frames = sum(each.length for each in self._found.episodes)
        for name, feature in self._found.info["features"].items():
            if feature["dtype"] == "string":
                continue
            place = f"meta/stats.json: {name}"
            yield from _form(place, feature, stats.get(name), frames)
            if name in self._incomplete:
                continue
            if name in self._pictures:
                yield from _difference(place, stats.get(name), self._pictures[name].stats(), _PICTURES)
            elif name in self._numbers:
                yield from _difference(place, stats.get(name), joined_stats(self._numbers[name]), _NUMBERS)


def _form(place: str, feature: Mapping[str, Any], stats: Any, frames: int) -> Iterator[str]:
    """Statistics that are missing, or have another form, scale or order."""
    missing = [each for each in STATISTICS if not isinstance(stats, dict) or stats.get(each) is None]
    if missing or not isinstance(stats, dict):
        yield f"{place}: found no {', '.join(missing)}, expected them"
        return
    is_video = feature["dtype"] == "video"
    size = (3, 1, 1) if is_video else (math.prod(feature["shape"]),)
    values = {each: numbers_of(stats[each]) for each in (*_IN_ORDER, "mean", "std", "count") if each in stats}
    for each, found in values.items():
        shape = None if found is None else found.shape
        if shape != ((1,) if each == "count" else size):
            text = "no numbers" if shape is None else f"the shape {shape}"
            yield f"{place}: {each}: found {text}, expected {size if each != 'count' else (1,)}"
            return
    count = values["count"]
    if count is not None and (not 1 <= count[0] <= frames if is_video else count[0] != frames):
        expected = f"1 to {frames}" if is_video else str(frames)
        yield f"{place}: count: found {_shown(count)}, expected {expected}"
    known = [(each, found) for each in _IN_ORDER if (found := values.get(each)) is not None]
    for (low, one), (high, two) in pairwise(known):
        if not (one <= two).all():
            yield f"{place}: {low}, {high}: found {_shown(one)} above {_shown(two)}, expected an increasing order"
    if is_video and not all(((found >= 0) & (found <= 1)).all() for _, found in known):
        yield f"{place}: found values outside of 0 to 1, expected pixels on that scale"


def _difference(place: str, stats: Any, expected: Stats, tolerances: Mapping[str, float]) -> Iterator[str]:
    """Statistics that differ by more than a tolerance, which is a part of the largest number for numbers."""
    if not isinstance(stats, dict):
        return
    low, high = (np.asarray(expected[each], np.float64) for each in ("min", "max"))
    scale = 1.0 if tolerances is _PICTURES else np.maximum(np.abs(low), np.abs(high)) + 1e-12
    wrong: list[str] = []
    for name, tolerance in tolerances.items():
        found, wanted = numbers_of(stats.get(name)), np.asarray(expected[name], np.float64)
        if found is not None and found.shape == wanted.shape and not (abs(found - wanted) <= tolerance * scale).all():
            wrong.append(f"{name}: found {_shown(found)}, expected {_shown(wanted)}")
    if wrong:
        yield f"{place}: {'; '.join(wrong)}"


def numbers_of(value: Any) -> Array | None:
    """Return statistics as numbers; None for others than finite numbers of one form."""
    try:
        found = np.asarray(value)
        if found.dtype.kind not in "iufb" or not np.isfinite(found).all():
            return None
        return found.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return None


def _shown(values: Array) -> str:
    text = ", ".join(f"{each:.6g}" for each in values.ravel()[:8])
    return f"[{text}{', …' if values.size > 8 else ''}]"

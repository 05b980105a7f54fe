"""Checks the statistics of a data set: they are computed again, from the values and from the decoded pictures.

Readers normalise with these numbers, so a wrong mean spoils a policy silently.  The tolerances are those of LeRobot,
which sums in float32, takes quantiles from histograms and the statistics of pictures before they are coded, of a part
of the pixels.  Its quantiles of a set are means of those of the episodes, which is a note.  The comparison with the
recording has no tolerance.

LeRobot's tools number episodes again and leave their statistics: these are reported once, not for each episode.
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
from igtl_gateway.addon.terminal import count_text, few_text
from igtl_gateway.addons.lerobot.assembling import number_totals
from igtl_gateway.addons.lerobot.columns import is_numeric, matrix_of
from igtl_gateway.addons.lerobot.depth import has_codes
from igtl_gateway.addons.lerobot.features import ARROW, TEXTS, is_depth, is_picture, picture_size, stats_shapes
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode, read_total_stats
from igtl_gateway.addons.lerobot.stats import QUANTILES, PictureStats, Stats, joined_stats, number_stats

Array = npt.NDArray[Any]

STATISTICS = ("min", "max", "mean", "std", "count")
#: Columns with the numbers of frames, episodes and tasks, and what is more than any of these.
NUMBERED = ("index", "episode_index", "task_index")
_MOST = 1 << 53
_IN_ORDER = ("min", *QUANTILES, "max")
#: Tolerance of numbers, as a part of the largest one.
_NUMBERS = {"min": 1e-6, "max": 1e-6, "mean": 1e-4, "std": 1e-4}
#: Tolerance of the square of a standard deviation, as a part of the square of the largest number: it is a difference
#: of float32 sums.
_SQUARES = 2e-6
#: Tolerance of pictures on a scale of 0 to 1: coding blurs edges and colours.
_PICTURES = {"min": 0.3, "max": 0.3, "mean": 0.03, "std": 0.15}
#: Rows or columns from which on LeRobot leaves out pixels, and with them the darkest and the brightest.
_THINNED = 300
#: Features that are listed.
_LISTED = 5
#: Why statistics are those of other numbers.
_LEFT = "LeRobot's merge, split, delete and modify_tasks do not renew them"
#: Smallest number that counts: LeRobot widens its histograms by 1e-10.
_LEAST = 1e-9
#: Bins of its histograms.
_BINS = 5000
#: Tolerance of quantiles, as a part of the largest number.
_JOINED = 1e-3


class StatsCheck:
    """Computes the statistics again, episode by episode, and at the end those of the whole set.

    Args:
        found: the data set.
        notes: a list to which notes are added.
    """

    def __init__(self, found: FoundDataSet, notes: list[str]) -> None:
        self._found, self._notes = found, notes
        self._numbers: dict[str, list[Stats]] = {}
        self._missing: dict[str, list[int]] = {}
        self._bounds: dict[str, dict[str, list[tuple[Array, Array]]]] = {}
        self._pictures: dict[str, PictureStats] = {}
        self._incomplete: set[str] = set()
        self._moved: dict[int, list[str]] = {}

    def numbers(self, episode: FoundEpisode, table: pa.Table | None) -> Iterator[str]:
        """Yield the wrong statistics of an episode; without a table only those that are missing."""
        try:
            stats = episode.read_stats()
        except GatewayError as error:
            yield str(error)
            stats = {}
        for name, feature in self._found.info["features"].items():
            if feature["dtype"] in TEXTS:
                continue
            own = stats.get(name)
            if own is None and not self._found.is_ours:
                self._missing.setdefault(name, []).append(episode.index)
            else:
                yield from _form(f"episode {episode.index}: stats of {name}", feature, own, episode.length)
            if feature["dtype"] not in ARROW:
                continue
            if table is None or not table.num_rows or not is_numeric(table, name):
                self._incomplete.add(name)
                continue
            matrix = _as_stated(matrix_of(table, name), feature, own)
            if not np.isfinite(matrix).all():  # the columns have it
                self._incomplete.add(name)
                continue
            expected = number_stats(matrix)
            self._numbers.setdefault(name, []).append(expected)
            wrong = list(_difference(f"episode {episode.index}: stats of {name}", own, expected, _NUMBERS))
            if wrong and name in NUMBERED and _is_moved(own, expected):
                self._moved.setdefault(episode.index, []).append(name)
                continue
            ordered = np.sort(matrix.astype(np.float64), axis=0)
            for key, share in QUANTILES.items():
                of_name = self._bounds.setdefault(name, {})
                of_name.setdefault(key, []).append(_around(ordered, share))
            yield from wrong or self._quantiles(f"episode {episode.index}: stats of {name}", own, ordered, name)

    def pictures(self, episode: FoundEpisode, name: str, seen: PictureStats) -> Iterator[str]:
        """Yield the wrong statistics of the pictures of an episode, of which ``seen`` are the sampled ones."""
        feature = self._found.info["features"][name]
        if not seen.pictures or (is_depth(feature) and not has_codes(feature)):
            self._incomplete.add(name)
            return
        self._pictures.setdefault(name, PictureStats()).join(seen)
        try:
            stats = episode.read_stats().get(name)
        except GatewayError:
            return  # reported with the numbers
        yield from _difference(
            f"episode {episode.index}: stats of {name}", stats, seen.stats(), _of_pictures(feature, seen)
        )

    def total(self) -> Iterator[str]:
        """Yield the wrong statistics of the whole set, which v3.0 has: without them readers search the network."""
        yield from self._moved_episodes()
        yield from self._without_stats()
        if self._found.version != "v3.0":
            return
        try:
            stats = read_total_stats(self._found.root)
        except GatewayError as error:
            yield str(error)
            return
        frames, moved = sum(each.length for each in self._found.episodes), dict[str, str]()
        for name, feature in self._found.info["features"].items():
            if feature["dtype"] in TEXTS:
                continue
            place, own = f"meta/stats.json: {name}", stats.get(name)
            if own is None and len(self._missing.get(name, ())) == len(self._found.episodes):
                self._notes.append(f"{place}: no statistics: LeRobot does not normalise it")
                continue
            yield from _form(place, feature, own, frames)
            if name in self._incomplete:
                continue
            if name in self._pictures:
                pictures = self._pictures[name]
                yield from _difference(place, own, pictures.stats(), _of_pictures(feature, pictures))
            elif name in self._numbers:
                joined = joined_stats(self._numbers[name])
                wrong = list(_difference(place, own, joined, _NUMBERS))
                if wrong and name in NUMBERED and _are_numbers(own, joined):
                    moved[name] = wrong[0].removeprefix(f"{place}: ")
                else:
                    yield from wrong
        if moved:
            first = next(iter(moved.values()))
            yield f"meta/stats.json: {', '.join(moved)}: {first}: {_LEFT}"
        others = {*moved, *(name for names in self._moved.values() for name in names)} - {"task_index"}
        if others and list(self._found.info["splits"]) == ["train"]:
            self._notes.append(
                "meta/info.json: all episodes are in train: LeRobot's merge, delete and split write that, whatever the "
                "splits were before"
            )
        yield from self._total_quantiles(stats)

    def _moved_episodes(self) -> Iterator[str]:
        """Statistics that episodes had under other numbers."""
        if not self._moved:
            return
        names = [name for name in NUMBERED if any(name in each for each in self._moved.values())]
        count = count_text(len(self._moved), "episode")
        yield (
            f"episode {next(iter(self._moved))}: stats of {', '.join(names)}: found those of another number ({count}), "
            f"expected its own: {_LEFT}"
        )

    def _without_stats(self) -> Iterator[str]:
        """Features without statistics in some or all episodes of a set of others."""
        everywhere = [name for name, each in self._missing.items() if len(each) == len(self._found.episodes)]
        for name, numbers in self._missing.items():
            if name not in everywhere:
                count = count_text(len(numbers), "episode")
                yield f"episode {numbers[0]}: stats of {name}: found none ({count}), expected them"
        if everywhere:
            self._notes.append(f"no episode has statistics of {few_text(everywhere, _LISTED)}")

    def _total_quantiles(self, stats: Mapping[str, Any]) -> Iterator[str]:
        """Quantiles of the set that are neither its own nor the mean of those of the episodes."""
        features = {
            name: self._found.info["features"][name]
            for name in self._numbers
            if name not in self._incomplete and name not in NUMBERED and isinstance(stats.get(name), dict)
            and QUANTILES.keys() & stats[name].keys()
        }  # fmt: skip
        if not features:
            return
        try:
            exact = number_totals(self._found.root, features)
        except GatewayError:
            return  # the tables have it
        far: list[tuple[float, str]] = []
        for name in features:
            place, tolerances = f"meta/stats.json: {name}", dict.fromkeys(QUANTILES, _JOINED)
            wrong = list(_difference(place, stats[name], exact[name], tolerances))
            if not wrong or not self._are_joined(name, stats[name]):
                yield from wrong
            elif len(self._found.episodes) > 1:
                far.append(max(_distances(name, stats[name], exact[name])))
        if far:
            self._notes.append(
                f"meta/stats.json: quantiles are means of those of the episodes, as LeRobot joins them: {max(far)[1]}"
            )

    def _quantiles(self, place: str, stats: Any, ordered: Array, name: str) -> Iterator[str]:
        """Quantiles of the last episode that no definition gives numbers (N, K) float64, in order."""
        for key in QUANTILES.keys() & stats.keys() if isinstance(stats, dict) else ():
            found, (low, high) = numbers_of(stats[key]), self._bounds[name][key][-1]
            if found is not None and found.shape == low.shape and not ((low <= found) & (found <= high)).all():
                wanted = np.quantile(ordered, QUANTILES[key], axis=0)
                yield f"{place}: {key}: found {_shown(found)}, expected {_shown(wanted)}"

    def _are_joined(self, name: str, stats: Mapping[str, Any]) -> bool:
        """Whether the quantiles of the set are between those of its episodes, as means of them are."""
        for key in QUANTILES.keys() & stats.keys():
            found, bounds = numbers_of(stats[key]), self._bounds[name][key]
            low, high = np.min([one for one, _ in bounds], axis=0), np.max([two for _, two in bounds], axis=0)
            if found is None or found.shape != low.shape or not ((low <= found) & (found <= high)).all():
                return False
        return True


def _distances(name: str, stats: Mapping[str, Any], exact: Stats) -> Iterator[tuple[float, str]]:
    """How far each quantile is from its own, as a part of the extent, with both as a string."""
    extent = np.subtract(exact["max"], exact["min"]) + _LEAST
    for key in QUANTILES.keys() & stats.keys():
        found, wanted = np.asarray(stats[key], np.float64), np.asarray(exact[key])
        away = np.maximum(np.abs(found - wanted) - _LEAST, 0) / extent
        worst = int(np.argmax(away))
        text = f"{key} of {name}[{worst}] is {found[worst]:.6g}, its own {wanted[worst]:.6g}"
        yield float(away[worst]), text


def _as_stated(matrix: Array, feature: Mapping[str, Any], stats: Any) -> Array:
    """Numbers of several dimensions as the statistics have them: LeRobot takes all but the last for frames."""
    mean = numbers_of(stats.get("mean")) if isinstance(stats, dict) else None
    last = feature["shape"][-1]
    if mean is None or mean.shape != (last,) or matrix.shape[1] % last:
        return matrix
    return matrix.reshape(-1, last)


def _is_moved(stats: Any, expected: Stats) -> bool:
    """Whether statistics are those of other numbers with the same distances."""
    low, high = (numbers_of(stats.get(each)) for each in ("min", "max"))
    return (
        _are_numbers(stats, expected)
        and low is not None
        and high is not None
        and float(high[0] - low[0]) == expected["max"][0] - expected["min"][0]
    )


def _are_numbers(stats: Any, expected: Stats) -> bool:
    """Whether statistics, and those of the tables, are of numbers that count something."""
    found = [numbers_of(each.get(name)) for each in (stats, expected) for name in ("min", "max")]
    return all(
        each is not None and each.shape == (1,) and 0 <= each[0] < _MOST and each[0].is_integer() for each in found
    )


def _of_pictures(feature: Mapping[str, Any], pictures: PictureStats) -> Mapping[str, float]:
    """The tolerances of pictures on the scale of their values, of large ones without the darkest and the brightest."""
    left_out = ("min", "max") if max(picture_size(feature)) >= _THINNED else ()
    scale = pictures.high - pictures.low
    return {name: tolerance * scale for name, tolerance in _PICTURES.items() if name not in left_out}


def _form(place: str, feature: Mapping[str, Any], stats: Any, frames: int) -> Iterator[str]:
    """Statistics that are missing, or have another form, scale or order."""
    missing = [each for each in STATISTICS if not isinstance(stats, dict) or stats.get(each) is None]
    if missing or not isinstance(stats, dict):
        yield f"{place}: found no {', '.join(missing)}, expected them"
        return
    pictures, sizes = is_picture(feature), stats_shapes(feature)
    values = {each: numbers_of(stats[each]) for each in (*_IN_ORDER, "mean", "std", "count") if each in stats}
    for each, found in values.items():
        shape = None if found is None else found.shape
        if shape not in ([(1,)] if each == "count" else sizes):
            text = "no numbers" if shape is None else f"the shape {shape}"
            yield f"{place}: {each}: found {text}, expected {sizes[0] if each != 'count' else (1,)}"
            return
    if len({found.shape for name, found in values.items() if found is not None and name != "count"}) > 1:
        yield f"{place}: found statistics of several shapes, expected {sizes[0]}"
        return
    count = values["count"]
    if count is not None and (count[0] < 1 if pictures else count[0] != frames):
        yield f"{place}: count: found {_shown(count)}, expected {'1 or more' if pictures else frames}"
    known = [(each, found) for each in _IN_ORDER if (found := values.get(each)) is not None]
    least = _NUMBERS["min"] * np.maximum(np.abs(known[0][1]), np.abs(known[-1][1])) + _LEAST
    for (low, one), (high, two) in pairwise(known):
        if not (one <= two + least).all():
            yield f"{place}: {low}, {high}: found {_shown(one)} above {_shown(two)}, expected an increasing order"
    if (
        pictures
        and not is_depth(feature)
        and not all(((found >= -least) & (found <= 1 + least)).all() for _, found in known)
    ):
        yield f"{place}: found values outside of 0 to 1, expected pixels on that scale"


def _difference(place: str, stats: Any, expected: Stats, tolerances: Mapping[str, float]) -> Iterator[str]:
    """Statistics that differ by more than a tolerance, which is a part of the largest number for numbers."""
    if not isinstance(stats, dict):
        return
    low, high = (np.asarray(expected[each], np.float64) for each in ("min", "max"))
    scale = np.ones_like(low) if low.ndim > 1 else np.maximum(np.abs(low), np.abs(high))
    wrong: list[str] = []
    for name, tolerance in tolerances.items():
        found, wanted = numbers_of(stats.get(name)), np.asarray(expected[name], np.float64)
        if found is None or found.shape != wanted.shape:
            continue
        with np.errstate(over="ignore", invalid="ignore"):  # doubles near the largest one
            good = np.abs(found - wanted) <= tolerance * scale + _LEAST
            if name == "std":
                good |= np.abs(found**2 - wanted**2) <= _SQUARES * scale**2
        if not good.all():
            wrong.append(f"{name}: found {_shown(found)}, expected {_shown(wanted)}")
    if wrong:
        yield f"{place}: {'; '.join(wrong)}"


def _around(ordered: Array, share: float) -> tuple[Array, Array]:
    """The lowest and the highest quantile that a definition gives numbers (N, K) float64, in order.

    It is beside the numbers around it, as far as a bin of LeRobot's histograms.
    """
    count, rank = len(ordered), math.ceil(share * len(ordered))
    with np.errstate(over="ignore"):  # doubles near the largest one
        bin_size = (ordered[-1] - ordered[0]) / _BINS
        room = bin_size + _JOINED * np.maximum(np.abs(ordered[0]), np.abs(ordered[-1])) + _LEAST
        return ordered[max(rank - 2, 0)] - room, ordered[min(rank, count - 1)] + room


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

"""Compares a data set with the recording that it was made of: every value, statistic, provenance row and frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import parquet_columns, printable
from igtl_gateway.addons.lerobot.assembling import provenance_of
from igtl_gateway.addons.lerobot.checking import check_rules, first_findings
from igtl_gateway.addons.lerobot.checking_stats import numbers_of
from igtl_gateway.addons.lerobot.columns import Tables, is_numeric, matrix_of
from igtl_gateway.addons.lerobot.comparing_pictures import PictureCheck
from igtl_gateway.addons.lerobot.features import is_number
from igtl_gateway.addons.lerobot.frames import Episode, Place, Plan, build
from igtl_gateway.addons.lerobot.native import native_name, native_of, native_rows, native_table
from igtl_gateway.addons.lerobot.parts import content_digest
from igtl_gateway.addons.lerobot.reading import FoundDataSet, read_total_stats
from igtl_gateway.addons.lerobot.recipe import STAMPS, TIME, Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.schema import unlike
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList, read_session_list
from igtl_gateway.addons.lerobot.stats import QUANTILES, PictureStats, Stats, number_stats
from igtl_gateway.addons.lerobot.writing import RECIPE, facts_of, own_columns, trace_of

Array = npt.NDArray[Any]

#: Difference of a statistic to the one computed again, as a part of the largest number: that of other machines.
_STATISTIC = 1e-9


@dataclass(frozen=True, slots=True)
class Checked:
    """What was found.

    Attributes:
        found: the data set; None if it cannot be read.
        findings: with place, found and expected.
        notes: what was not compared.
    """

    found: FoundDataSet | None
    findings: list[str]
    notes: list[str] = field(default_factory=list)


def check(root: Path, paths: Sequence[Path]) -> Checked:
    """Check a data set against the published rules, and against those of its recordings that are given, in any order.

    Raises GatewayError: a recording cannot be read.
    """
    notes: list[str] = []
    found, findings = check_rules(root, notes)
    if found is None or not paths:
        return Checked(found, findings, notes)
    try:
        recipe, listed = read_recipe(root / "meta" / RECIPE), read_session_list(root)
    except GatewayError as error:
        return Checked(found, [*findings, f"cannot be compared with {paths[0]}: {error}"])
    known = {_place(each) for each in findings}  # a value that a rule has found already
    compared = (each for each in _sessions(found, recipe, listed, paths, notes) if _place(each) not in known)
    return Checked(found, first_findings(chain(findings, compared)), notes)


def _place(finding: str) -> str:
    return finding.partition(": found ")[0]


@dataclass(slots=True)
class _Totals:
    """What the statistics of a whole data set are made of."""

    numbers: dict[str, list[Array]] = field(default_factory=dict)
    pictures: dict[str, PictureStats] = field(default_factory=dict)


def _sessions(
    found: FoundDataSet, recipe: Recipe, listed: SessionList | None, paths: Sequence[Path], notes: list[str]
) -> Iterator[str]:
    """Compare the sessions of a set with those recordings that they are of."""
    sessions = listed.sessions if listed else ()
    others = listed.others if listed else 0
    if others + sum(each.episodes for each in sessions) != len(found.episodes) and listed:
        notes.append("the recordings were not compared: the set has other episodes than at its export")
        return
    given: dict[str, Path] = {}
    for path in paths:
        given[content_digest(path)] = path
    if listed is None or (len(sessions) == len(paths) == 1 and not others):
        yield from _session(found, recipe, Place(), 0, paths[0], _Totals(), is_whole=len(paths) == 1)
        return
    yield from _groups(listed, recipe)
    totals, episode, frame, compared = _Totals(), others, sum(each.length for each in found.episodes[:others]), 0
    names = {each.row: each.names for each in listed.rows if each.names}
    for number, each in enumerate(sessions):
        episodes = found.episodes[episode : episode + each.episodes]
        if each.sha256 in given:
            part = replace(found, episodes=episodes)
            place = Place(episode, frame, tuple(found.tasks[key] for key in sorted(found.tasks)), names)
            path = given.pop(each.sha256)
            texts = _session(part, recipe, place, number, path, totals, is_own=not others)
            yield from (f"{printable(str(path))}: {text}" for text in texts)
            compared += 1
        episode, frame = episode + each.episodes, frame + sum(one.length for one in episodes)
    for path in given.values():
        yield f"{printable(str(path))}: found a recording that meta/{SESSIONS} does not list, expected one of the set"
    if compared < len(sessions):
        notes.append(
            f"no recording given for {len(sessions) - compared:,} of {count_text(len(sessions), 'session')}: "
            "not compared"
        )
    elif not given and not others:
        yield from _totals(found, totals)
    if others:
        notes.append(f"{count_text(others, 'episode')} of another program: not compared, no recording is known")


def _groups(listed: SessionList, recipe: Recipe) -> Iterator[str]:
    """Groups in two splits."""
    owners: dict[str, str] = {}
    for each in listed.sessions:
        if owners.setdefault(each.group, each.split) != each.split and recipe.splits:
            yield f"meta/{SESSIONS}: found {each.group!r} in {owners[each.group]} and {each.split}, expected one split"


def _session(
    found: FoundDataSet,
    recipe: Recipe,
    place: Place,
    number: int,
    path: Path,
    totals: _Totals,
    *,
    is_whole: bool = False,
    is_own: bool = True,
) -> Iterator[str]:
    """Compare the episodes of one session; ``is_whole``: the set has no others; ``is_own``: nor of other programs."""
    with open_recording(path) as recording:
        try:
            plan = build(recording, recipe, place)
        except GatewayError as error:
            yield f"cannot be compared with {path}: {error}"
            return
        yield from _compare(found, plan, number, totals, is_whole=is_whole, is_own=is_own)
        for index in native_rows(plan):
            file = f"meta/{native_of(native_name(plan, index), number)}"
            yield from _table(found, file, native_table(recording, plan, index))
    if is_whole:
        yield from _totals(found, totals)


def _compare(
    found: FoundDataSet, plan: Plan, number: int, totals: _Totals, *, is_whole: bool, is_own: bool
) -> Iterator[str]:
    expected = facts_of(plan)
    if not is_own:
        yield from (f"meta/info.json: {each}" for each in unlike(expected.features, found.info["features"]))
    for name in sorted({*found.info["features"], *expected.features} if is_own else ()):
        one, two = found.info["features"].get(name), expected.features.get(name)
        if one != two:
            yield f"meta/info.json: features.{name}: found {_short(one)}, expected {_short(two)}"
    wanted: list[tuple[str, Any]] = [("fps", expected.fps), ("robot_type", expected.robot_type)]
    if is_whole and (plan.splits or not plan.recipe.splits):
        wanted.append(("splits", plan.splits or {"train": f"0:{len(plan.episodes)}"}))
    for key, value in wanted:
        if found.info.get(key) != value:
            yield f"meta/info.json: {key}: found {_short(found.info.get(key))}, expected {_short(value)}"
    lengths = [each.length for each in found.episodes], [each.count for each in plan.episodes]
    if lengths[0] != lengths[1]:
        yield f"episodes: found {_short(lengths[0])} frames, expected {_short(lengths[1])} from the recording"
        return
    tables = Tables()
    for one, two in zip(found.episodes, plan.episodes, strict=True):
        if one.tasks != [two.task]:
            yield f"episode {one.index}: tasks: found {_short(one.tasks)}, expected {_short([two.task])}"
        try:
            table = tables.of(one)
        except GatewayError:
            continue  # the rules have it
        yield from (f"episode {one.index}: {each}" for each in _columns(plan, two, table))
    yield from _table(found, f"meta/{provenance_of(number)}", trace_of(plan))
    yield from _statistics(found, plan, totals)


def _statistics(found: FoundDataSet, plan: Plan, totals: _Totals) -> Iterator[str]:
    """Frames of the videos, and the statistics of episodes, as the export computes them."""
    pictures = {
        name: PictureCheck(found, plan, name)
        for name in plan.recipe.names
        if plan.kind(name) == "picture" and name in found.videos
    }
    for each in pictures.values():
        yield from each.frames()
    first = plan.place.frame
    for one, two in zip(found.episodes, plan.episodes, strict=True):
        columns = {name: plan.values(two, name) for name in plan.recipe.names if plan.kind(name) == "numbers"}
        expected: dict[str, Stats] = {}
        for name, values in (columns | own_columns(plan, two, first)).items():
            matrix = values.reshape(len(values), -1)
            totals.numbers.setdefault(name, []).append(matrix)
            expected[name] = number_stats(matrix)
        expected |= {name: each.stats(two.index) for name, each in pictures.items()}
        try:
            yield from _differences(f"episode {one.index}: stats of ", one.read_stats(), expected, found.version)
        except GatewayError:
            return  # the rules have it
        first += two.count
    for name, check_of in pictures.items():
        totals.pictures.setdefault(name, PictureStats()).join(check_of.total)


def _totals(found: FoundDataSet, totals: _Totals) -> Iterator[str]:
    """Wrong statistics of the whole set, which v3.0 has."""
    if found.version != "v3.0":
        return
    total = {name: number_stats(np.concatenate(each)) for name, each in totals.numbers.items()}
    total |= {name: each.stats() for name, each in totals.pictures.items()}
    try:
        yield from _differences("meta/stats.json: ", read_total_stats(found.root), total, found.version)
    except GatewayError:
        return


def _differences(place: str, stats: Any, expected: dict[str, Stats], version: str) -> Iterator[str]:
    for name, each in expected.items():
        scale = max(1e-12, *(abs(value) for key in ("min", "max") for value in np.ravel(each[key]).tolist()))
        own, wrong = stats.get(name), list[str]()
        for key, value in each.items():
            if not isinstance(own, dict) or (key in QUANTILES and (version == "v2.1" or key not in own)):
                continue  # which quantiles there are is a matter of the rules
            one, two = numbers_of(own.get(key)), np.asarray(value, np.float64)
            if one is None or one.shape != two.shape or not (np.abs(one - two) <= _STATISTIC * scale).all():
                wrong.append(f"{key}: found {_short(own.get(key))}, expected {_short(value)}")
        if wrong:
            yield f"{place}{name}: {'; '.join(wrong)}"


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:120]}…"


def _columns(plan: Plan, episode: Episode, table: Any) -> Iterator[str]:
    stamps = own_columns(plan, episode, 0) if plan.recipe.stamps else {}
    for name in (*plan.recipe.names, *(each for each in (TIME, STAMPS) if each in stamps)):
        kind = "numbers" if name in stamps else plan.kind(name)
        if kind == "picture" or name not in table.schema.names or table.num_rows != episode.count:
            continue
        expected = stamps[name].reshape(episode.count, -1) if name in stamps else plan.values(episode, name)
        if kind == "text":
            wrong = np.array([one != two for one, two in zip(table[name].to_pylist(), expected, strict=True)])
        else:
            if not is_numeric(table, name) or (values := matrix_of(table, name)).shape != expected.shape:
                continue  # the rules have it
            wrong = (values != expected).any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            number = int(wrong.sum())
            others = f" ({count_text(number, 'frame')} differ)" if number > 1 else ""
            yield f"{name}: frame {row}: found {_value(table, name, row)}, expected {_shown(expected[row])}{others}"


def _value(table: Any, name: str, row: int) -> str:
    return _shown(table[name][row].as_py())


def _shown(value: Any) -> str:
    if isinstance(value, list | np.ndarray):
        numbers = (f"{each:.6g}" if isinstance(each, float | np.floating) else str(each) for each in value)
        return _short("[" + ", ".join(numbers) + "]")
    return _short(repr(value))


def _table(found: FoundDataSet, place: str, expected: pa.Table) -> Iterator[str]:
    """Differences of a table of numbers beside the frames."""
    try:
        with parquet_columns(found.root / place) as columns:
            if columns.schema.names != expected.schema.names or columns.rows != expected.num_rows:
                yield f"{place}: found other columns or rows, expected those of the recipe"
                return
            for name in expected.schema.names:  # each alone, and only numbers: none has more memory than it should
                is_plain = is_number(columns.schema.field(name).type)
                if not is_plain or not is_numeric(table := columns.read([name]), name):
                    yield f"{place}: {name}: found missing values or no numbers, expected numbers"
                    continue
                one, two = matrix_of(table, name)[:, 0], matrix_of(expected, name)[:, 0]
                differ = (one != two) & ~(np.isnan(one) & np.isnan(two))
                if differ.any():
                    row = int(np.argmax(differ))
                    yield f"{place}: {name}: row {row}: found {one[row]}, expected {two[row]}"
    except GatewayError as error:
        yield str(error)

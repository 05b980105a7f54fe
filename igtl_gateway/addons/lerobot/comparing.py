"""Compares a data set with the recording that it was made of: every value, statistic, provenance row and frame."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addon.untrusted import parquet_columns
from igtl_gateway.addons.lerobot.checking import check_rules, first_findings
from igtl_gateway.addons.lerobot.checking_stats import numbers_of
from igtl_gateway.addons.lerobot.columns import Tables, is_number, is_numeric, matrix_of
from igtl_gateway.addons.lerobot.comparing_pictures import PictureCheck
from igtl_gateway.addons.lerobot.frames import Episode, Plan, build
from igtl_gateway.addons.lerobot.reading import FoundDataSet, read_total_stats
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.stats import QUANTILES, Stats, number_stats
from igtl_gateway.addons.lerobot.writing import PROVENANCE, RECIPE, facts_of, own_columns, trace_of

Array = npt.NDArray[Any]

#: Difference of a statistic to the one computed again, as a part of the largest number: that of other machines.
_STATISTIC = 1e-9


def check(root: Path, path: Path) -> tuple[FoundDataSet | None, list[str]]:
    """Check a data set against the published rules and against its recording.

    Returns:
        The data set (None if it cannot be read), and the findings with place, found and expected.

    Raises:
        GatewayError: the recording cannot be read.
    """
    found, findings = check_rules(root)
    if found is None:
        return None, findings
    with open_recording(path) as recording:
        try:
            plan = build(recording, read_recipe(root / "meta" / RECIPE))
        except GatewayError as error:
            return found, [*findings, f"cannot be compared with {path}: {error}"]
        known = {_place(each) for each in findings}  # a value that a rule has found already
        compared = (each for each in _compare(found, plan) if _place(each) not in known)
        return found, first_findings(chain(findings, compared))


def _place(finding: str) -> str:
    return finding.partition(": found ")[0]


def _compare(found: FoundDataSet, plan: Plan) -> Iterator[str]:
    expected = facts_of(plan)
    for name in sorted({*found.info["features"], *expected.features}):
        one, two = found.info["features"].get(name), expected.features.get(name)
        if one != two:
            yield f"meta/info.json: features.{name}: found {_short(one)}, expected {_short(two)}"
    for key, wanted in (("fps", expected.fps), ("splits", expected.splits), ("robot_type", expected.robot_type)):
        if found.info.get(key) != wanted:
            yield f"meta/info.json: {key}: found {_short(found.info.get(key))}, expected {_short(wanted)}"
    lengths = [each.length for each in found.episodes], [each.count for each in plan.episodes]
    if lengths[0] != lengths[1]:
        yield f"episodes: found {_short(lengths[0])} frames, expected {_short(lengths[1])} from the recording"
        return
    tables = Tables()
    for one, two in zip(found.episodes, plan.episodes, strict=True):
        if one.tasks != [two.task]:
            yield f"episode {two.index}: tasks: found {_short(one.tasks)}, expected {_short([two.task])}"
        try:
            table = tables.of(one)
        except GatewayError:
            continue  # the rules have it
        yield from (f"episode {two.index}: {each}" for each in _columns(plan, two, table))
    yield from _provenance(found, plan)
    yield from _statistics(found, plan)


def _statistics(found: FoundDataSet, plan: Plan) -> Iterator[str]:
    """Frames of the videos, and all statistics, as the export computes them."""
    everything: dict[str, list[Array]] = {}
    pictures = {
        name: PictureCheck(found, plan, name)
        for name in plan.recipe.names
        if plan.kind(name) == "picture" and name in found.videos
    }
    for each in pictures.values():
        yield from each.frames()
    first = 0
    for one, two in zip(found.episodes, plan.episodes, strict=True):
        columns = {name: plan.values(two, name) for name in plan.recipe.names if plan.kind(name) == "numbers"}
        expected: dict[str, Stats] = {}
        for name, values in (columns | own_columns(plan, two, first)).items():
            matrix = values.reshape(len(values), -1)
            everything.setdefault(name, []).append(matrix)
            expected[name] = number_stats(matrix)
        expected |= {name: each.stats(two.index) for name, each in pictures.items()}
        try:
            yield from _differences(f"episode {two.index}: stats of ", one.read_stats(), expected, found.version)
        except GatewayError:
            return  # the rules have it
        first += two.count
    if found.version == "v3.0":
        total = {name: number_stats(np.concatenate(each)) for name, each in everything.items()}
        total |= {name: each.total() for name, each in pictures.items()}
        try:
            yield from _differences("meta/stats.json: ", read_total_stats(found.root), total, found.version)
        except GatewayError:
            return


def _differences(place: str, stats: Any, expected: dict[str, Stats], version: str) -> Iterator[str]:
    for name, each in expected.items():
        scale = max(1e-12, *(abs(value) for key in ("min", "max") for value in np.ravel(each[key]).tolist()))
        own, wrong = stats.get(name), list[str]()
        for key, value in each.items():
            if (version == "v2.1" and key in QUANTILES) or not isinstance(own, dict):
                continue
            one, two = numbers_of(own.get(key)), np.asarray(value, np.float64)
            if one is None or one.shape != two.shape or not (np.abs(one - two) <= _STATISTIC * scale).all():
                wrong.append(f"{key}: found {_short(own.get(key))}, expected {_short(value)}")
        if wrong:
            yield f"{place}{name}: {'; '.join(wrong)}"


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 120 else f"{text[:120]}…"


def _columns(plan: Plan, episode: Episode, table: Any) -> Iterator[str]:
    for name in plan.recipe.names:
        kind = plan.kind(name)
        if kind == "picture" or name not in table.schema.names or table.num_rows != episode.count:
            continue
        expected = plan.values(episode, name)
        if kind == "text":
            wrong = np.array([one != two for one, two in zip(table[name].to_pylist(), expected, strict=True)])
        else:
            if not is_numeric(table, name) or (values := matrix_of(table, name)).shape != expected.shape:
                continue  # the rules have it
            wrong = (values != expected).any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            number = int(wrong.sum())
            others = f" ({number:,} frames differ)" if number > 1 else ""
            yield f"{name}: frame {row}: found {_value(table, name, row)}, expected {_shown(expected[row])}{others}"


def _value(table: Any, name: str, row: int) -> str:
    return _shown(table[name][row].as_py())


def _shown(value: Any) -> str:
    if isinstance(value, list | np.ndarray):
        return _short("[" + ", ".join(f"{each:.6g}" for each in value) + "]")
    return _short(repr(value))


def _provenance(found: FoundDataSet, plan: Plan) -> Iterator[str]:
    path = found.root / "meta" / PROVENANCE
    expected = trace_of(plan)
    try:
        with parquet_columns(path) as columns:
            if columns.schema.names != expected.schema.names or columns.rows != expected.num_rows:
                yield f"meta/{PROVENANCE}: found other columns or rows, expected those of the recipe"
                return
            for name in expected.schema.names:  # each alone, and only numbers: none has more memory than it should
                is_plain = is_number(columns.schema.field(name).type)
                if not is_plain or not is_numeric(table := columns.read([name]), name):
                    yield f"meta/{PROVENANCE}: {name}: found missing values or no numbers, expected numbers"
                    continue
                one, two = matrix_of(table, name)[:, 0], matrix_of(expected, name)[:, 0]
                if not np.array_equal(one, two):
                    row = int(np.argmax(one != two))
                    yield f"meta/{PROVENANCE}: {name}: row {row}: found {one[row]}, expected {two[row]}"
    except GatewayError as error:
        yield str(error)

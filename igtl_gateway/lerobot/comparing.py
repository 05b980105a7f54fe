"""Compares a data set with the recording that it was made of, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api import recording as recordings
from igtl_gateway.errors import GatewayError
from igtl_gateway.lerobot.checking import Tables, check_rules, matrix_of, pictures_of
from igtl_gateway.lerobot.frames import Episode, Plan, build
from igtl_gateway.lerobot.reading import FoundDataSet, read_table
from igtl_gateway.lerobot.recipe_file import read_recipe
from igtl_gateway.lerobot.writing import PROVENANCE, RECIPE, facts_of, trace_of

Array = npt.NDArray[Any]

#: A frame shows another picture if the mean squared difference to that one is below this part of its own.
_CLEARLY_LESS = 0.5
#: Mean squared difference that an encoder may cause, and beyond which a frame is no picture near it.
_CODING, _UNLIKE = 4.0, 2500.0
_NEIGHBOURS = 3
#: Findings of one video that are listed.
_MOST = 5


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
    with recordings.open(path) as recording:
        try:
            plan = build(recording, read_recipe(root / "meta" / RECIPE))
        except GatewayError as error:
            return found, [*findings, f"cannot be compared with {path}: {error}"]
        return found, [*findings, *_compare(found, plan)]


def _compare(found: FoundDataSet, plan: Plan) -> Iterator[str]:
    expected = facts_of(plan)
    for name in sorted({*found.info["features"], *expected.features}):
        one, two = found.info["features"].get(name), expected.features.get(name)
        if one != two:
            yield f"meta/info.json: features.{name}: found {_short(one)}, expected {_short(two)}"
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
    for name in plan.recipe.names:
        if plan.kind(name) == "picture" and name in found.videos:
            yield from _pictures(found, plan, name)


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
            values = matrix_of(table, name)
            if values.shape != expected.shape:
                continue
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
    try:
        table = read_table(path)
    except GatewayError as error:
        yield str(error)
        return
    expected = trace_of(plan)
    if table.schema.names != expected.schema.names or table.num_rows != expected.num_rows:
        yield f"meta/{PROVENANCE}: found other columns or rows, expected those of the recipe"
        return
    for name in table.schema.names:
        one, two = matrix_of(table, name)[:, 0], matrix_of(expected, name)[:, 0]
        if not np.array_equal(one, two):
            row = int(np.argmax(one != two))
            yield f"meta/{PROVENANCE}: {name}: row {row}: found {one[row]}, expected {two[row]}"


def _pictures(found: FoundDataSet, plan: Plan, name: str) -> Iterator[str]:
    """Frames that show another picture of the stream than the one of their time."""
    samples, listed = plan.of(name)[0], 0
    if samples.pictures is None:
        return
    near: dict[int, Array] = {}
    try:
        for owner, frame, picture in pictures_of(found, name):
            rows = plan.episodes[owner.index].picks[plan.recipe.rows(name)[0]]
            if rows is None or listed >= _MOST:
                return
            own = int(rows.before[frame])
            others = range(max(own - _NEIGHBOURS, 0), min(own + _NEIGHBOURS + 1, len(samples.times)))
            for each in others:
                if each not in near:
                    near[each] = samples.pictures.rgb(int(samples.values[each]))[::2, ::2].astype(np.float32)
            near = {each: near[each] for each in others}
            if picture.shape[:2] != samples.pictures.padded:
                return
            seen = picture[::2, ::2].astype(np.float32)
            errors = {each: float(np.mean((seen - near[each]) ** 2)) for each in others}
            best = min(errors, key=lambda each: errors[each])
            if best != own and errors[own] > _CODING and errors[best] < _CLEARLY_LESS * errors[own]:
                away_ms = (samples.times[best] - samples.times[own]) / 1e6
                text = f"found the picture of entry {samples.entries[best]} ({away_ms:+.1f} ms)"
            elif errors[own] > _UNLIKE:
                text = "found another picture"
            else:
                continue
            listed += 1
            yield f"episode {owner.index}: {name}: frame {frame}: {text}, expected that of entry {samples.entries[own]}"
    except GatewayError as error:
        yield f"{name}: {error}"

"""Reads a recipe from a TOML file and checks it: each error has place, value found and value expected."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.settings import read_toml
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.lerobot.recipe import (
    ACTION,
    CLOCKS,
    CODECS,
    CUTS,
    FILLS,
    FORMATS,
    ORIENTATIONS,
    RATES,
    RULES,
    STATE,
    Cuts,
    Feature,
    Range,
    Recipe,
)
from igtl_gateway.addons.lerobot.splits import PATIENT

_FEATURE = re.compile(r"(?:action|observation|meta(?=\.))(?:\.[A-Za-z0-9_-]+)*")
MAX_FPS, _MAX_MS, _MAX_TEXT = 1000, 3_600_000, 2000
#: Largest depth that readers give in whole mm.
_MAX_DEPTH_MM = 65_535
#: Names of a split, characters of a name, and the error of a sum of shares.
_MAX_NAMES, _MAX_PATTERN, _SHARES = 10_000, 200, 1e-6


def read_recipe(path: Path) -> Recipe:
    """Read and check a recipe.  Raises ConfigError with file, place, value found and value expected."""
    document = read_toml(path)
    try:
        return _recipe(document)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def is_feature_name(name: str) -> bool:
    """Return whether a feature can have this name."""
    return _FEATURE.fullmatch(name) is not None and len(name) <= 100


def _wrong(place: str, found: Any, expected: str) -> ConfigError:
    text = repr(found)
    return ConfigError(f"{place}: found {text if len(text) <= 60 else text[:60] + '…'}, expected {expected}")


Check = tuple[Callable[[Any], bool], str]


def _text(most: int = _MAX_TEXT, least: int = 0) -> Check:
    expected = f"a string of {least} to {counted(most, 'character')} without line breaks"
    return lambda value: isinstance(value, str) and least <= len(value) <= most and value.isprintable(), expected


def _foreign(value: Any) -> bool:
    """A name or the begin of a string in the recording, which may have any characters."""
    return isinstance(value, str) and 1 <= len(value) <= _MAX_TEXT


def _choice(choices: tuple[str, ...]) -> Check:
    return lambda value: isinstance(value, str) and value in choices, f"one of {', '.join(choices)}"


def _whole(least: int, most: int) -> Check:
    return lambda value: type(value) is int and least <= value <= most, f"an integer from {least} to {most}"


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) < 1 << 62


def _number(least: float, most: float) -> Check:
    return lambda value: _is_number(value) and least <= value <= most, f"a number from {least:g} to {most:g}"


def _tolerance(value: Any) -> bool:
    return value == "any" or (_is_number(value) and 0 < value <= _MAX_MS)


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) and item and item.isprintable() for item in value)


def _window(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)) and value[0] < value[1]


_TRUTH: Check = (lambda value: type(value) is bool, "true or false")
_DATASET: dict[str, Check] = {
    "fps": _whole(1, MAX_FPS),
    "task": _text(least=1),
    "format": _choice(FORMATS),
    "robot_type": _text(200, 1),
    "clock": _choice(CLOCKS),
    "codec": _choice(CODECS),
    "min_frames": _whole(1, 1_000_000),
    "rates": _choice(RATES),
    "split_long": _TRUTH,
    "measure_lags": _TRUTH,
    "stamps": _TRUTH,
}
_FEATURES: dict[str, Check] = {
    "name": (
        lambda value: isinstance(value, str) and is_feature_name(value),
        "action, observation.state, observation.images.VIEW or another name below action., observation. or meta.",
    ),
    "stream": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "frame": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "fields": (_texts, 'names of columns, such as ["position"]'),
    "names": (_texts, 'strings, such as ["x", "y"]'),
    "orientation": _choice(ORIENTATIONS),
    "rule": _choice(RULES),
    "tolerance_ms": (_tolerance, f'a number above 0 and up to {_MAX_MS}, or "any"'),
    "fill": _choice(FILLS),
    "lag_ms": _number(-_MAX_MS, _MAX_MS),
    "lag": _choice(("measured",)),
    "against": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "window": (_window, "two increasing numbers, such as [0, 4095]"),
    "depth_mm": (
        lambda value: _window(value) and 0 <= value[0] and value[1] <= _MAX_DEPTH_MM,
        f"two increasing numbers of mm from 0 to {_MAX_DEPTH_MM:,}, such as [0, 4095]",
    ),
    "native": _TRUTH,
    "next_of": _text(least=1),
}
_CUTS: dict[str, Check] = {
    "by": _choice(CUTS),
    "stream": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "start": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "stop": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "label": (_foreign, f"a string of 1 to {_MAX_TEXT} characters"),
    "pause_s": _number(1e-3, 1e6),
    "still_mm": _number(1e-6, 1e6),
}
_RANGES: dict[str, Check] = {"start": _number(0, 1e9), "end": _number(0, 1e9), "task": _text()}

Row = TypeVar("Row", Feature, Range, Cuts, Recipe)


def _recipe(document: Mapping[str, Any]) -> Recipe:
    tables = ("dataset", "episodes", "feature", "splits", "card")
    for name in document:
        if name not in tables:
            raise ConfigError(f"{name}: unknown table, expected {one_of(name, tables)}")
    cuts = dict(_table(document.get("episodes", {}), "episodes"))
    ranges = _array(cuts.pop("range", []), "episodes.range")
    episodes = _of(Cuts, cuts, _CUTS, "episodes", range=tuple(
        _of(Range, row, _RANGES, f"episodes.range[{number}]") for number, row in enumerate(ranges)))  # fmt: skip
    rows = _array(document.get("feature", []), "feature")
    features = tuple(_of(Feature, row, _FEATURES, f"feature[{number}]") for number, row in enumerate(rows))
    card = _strings(_table(document.get("card", {}), "card"), "card")
    splits, patient = _splits(dict(_table(document.get("splits", {}), "splits")))
    dataset = _table(document.get("dataset", {}), "dataset")
    recipe = _of(
        Recipe, dataset, _DATASET, "dataset", features=features, episodes=episodes, splits=splits, patient=patient,
        card=card,
    )  # fmt: skip
    _check_features(recipe)
    _check_cuts(episodes)
    return recipe


def _splits(table: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """The splits, which are all of one form, and what is a patient."""
    patient = table.pop("patient", "")
    if patient and not _is_pattern(patient):
        raise _wrong("splits.patient", patient, f'a name with {PATIENT} once, such as "{PATIENT}_*" or "{PATIENT}/*"')
    found: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, str) and re.fullmatch(r"[0-9]{1,9}:[0-9]{1,9}", value):
            found[name] = value
        elif type(value) in (int, float) and 0 < value <= 1:
            found[name] = float(value)
        elif _texts(value) and value and len(value) <= _MAX_NAMES and max(map(len, value)) <= _MAX_PATTERN:
            found[name] = tuple(value)
        else:
            raise _wrong(
                f"splits.{name}", value,
                'a share such as 0.8, names such as ["P01", "P02"], or a half-open range of demonstrations of one '
                'session, such as "0:8"',
            )  # fmt: skip
    if len({type(value) for value in found.values()}) > 1:
        raise _wrong("splits", table, "shares, names or ranges for all splits")
    shares = [value for value in found.values() if isinstance(value, float)]
    if shares and abs(sum(shares) - 1) > _SHARES:
        raise _wrong("splits", round(sum(shares), 9), "shares with the sum 1")
    if patient and any(isinstance(value, str) for value in found.values()):
        raise _wrong("splits.patient", patient, "it with shares or names, not with ranges of demonstrations")
    return found, patient


def _is_pattern(value: Any) -> bool:
    return (
        isinstance(value, str) and value.isprintable() and value.count(PATIENT) == 1 and value.count("*") <= 3
        and len(value) <= _MAX_PATTERN and all(value.split("/"))
    )  # fmt: skip


def _table(value: Any, place: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(place, value, f"a table [{place}]")
    return value


def _array(value: Any, place: str) -> list[Any]:
    if not isinstance(value, list):
        raise _wrong(place, value, f"tables [[{place}]]")
    return value


def _strings(table: Mapping[str, Any], place: str) -> Mapping[str, str]:
    for name, value in table.items():
        if not isinstance(value, str):
            raise _wrong(f"{place}.{name}", value, "a string")
    return table


def _of(kind: type[Row], value: Any, checks: Mapping[str, Check], place: str, **others: Any) -> Row:
    """Return a row of a table with checked values."""
    settings = dict(_table(value, place))
    for name, found in settings.items():
        if name not in checks:
            raise ConfigError(f"{place}.{name}: unknown key, expected {one_of(name, checks)}")
        is_good, expected = checks[name]
        if not is_good(found):
            raise _wrong(f"{place}.{name}", found, expected)
        if isinstance(found, list):
            settings[name] = tuple(found)
        elif found == "any" and name == "tolerance_ms":
            settings[name] = None
    for field in fields(kind):
        if field.name in checks and field.default is MISSING and field.name not in settings:
            raise ConfigError(f"{place}: found no {field.name}, expected {checks[field.name][1]}")
    return kind(**settings, **others)


def _check_features(recipe: Recipe) -> None:
    names = recipe.names
    for needed in (STATE, ACTION):
        if needed not in names:
            raise ConfigError(f"feature: found no feature {needed}, expected one or more rows [[feature]] of this name")
    for number, row in enumerate(recipe.features):
        place = f"feature[{number}] ({row.name})"
        if row.next_of:
            if row != Feature(row.name, next_of=row.next_of):
                raise ConfigError(f"{place}: found next_of with other keys, expected name and next_of alone")
            sources = [recipe.features[index] for index in recipe.rows(row.next_of)]
            if not sources or any(each.next_of or each.is_picture for each in sources):
                raise _wrong(f"{place}.next_of", row.next_of, "the name of a feature with numbers that has streams")
        elif not row.stream:
            raise ConfigError(f"{place}: found no stream, expected the key of a stream, or next_of")
        if row.is_picture and (row.name.count(".") != 2 or row.fields or row.names or row.rule == "interpolate"):
            raise ConfigError(f"{place}: found fields, names, interpolate or a further dot, expected a picture")
        if row.depth_mm and (not row.is_picture or row.window):
            raise ConfigError(f"{place}.depth_mm: found it with a window, or without a picture, expected a picture")
        if row.depth_mm and recipe.format == "v2.1":
            raise ConfigError(f'{place}.depth_mm: found it with format = "v2.1", expected "v3.0": readers of the other '
                              "have 8 bits")  # fmt: skip
        if row.is_picture and row.native:
            raise ConfigError(f"{place}.native: found it for a picture, expected numbers or poses")
        if len(recipe.rows(row.name)) > 1 and (row.is_picture or row.next_of):
            raise ConfigError(f"{place}: found {counted(len(recipe.rows(row.name)), 'row')}, expected one")
        if (row.lag == "measured") != bool(row.against) or (row.lag and row.lag_ms):
            raise ConfigError(f'{place}: expected lag = "measured" with against, and without lag_ms')
        if row.rule == "none" and (row.fill != "cut" or row.tolerance_ms not in (None, Feature("").tolerance_ms)):
            raise ConfigError(f'{place}: found fill or tolerance_ms with rule = "none", expected none of them')
        if row.fill == "hold" and row.tolerance_ms is None:
            raise ConfigError(
                f'{place}: found fill = "hold" without a tolerance, expected tolerance_ms in milliseconds'
            )


def _check_cuts(cuts: Cuts) -> None:
    if (cuts.by in ("markers", "gap", "still")) != bool(cuts.stream):
        raise ConfigError(f"episodes.stream: found {cuts.stream!r}, expected one for markers, gap and still only")
    if (cuts.by == "ranges") != bool(cuts.range):
        raise ConfigError(
            f'episodes.range: found {counted(len(cuts.range), "range")}, expected some for by = "ranges" only'
        )
    if cuts.by in ("markers", "notes") and cuts.start == cuts.stop:
        raise ConfigError(f"episodes.stop: found {cuts.stop!r}, as start, expected another text")
    for number, each in enumerate(cuts.range):
        if each.end <= each.start:
            raise _wrong(f"episodes.range[{number}].end", each.end, f"more than start, {each.start:g}")
    for one, two in pairwise(sorted(cuts.range, key=lambda each: each.start)):
        if two.start < one.end:
            place = f"episodes.range[{cuts.range.index(two)}].start"
            raise _wrong(place, two.start, f"{one.end:g} or more: no frame is in two demonstrations")


def toml_value(value: Any) -> str:
    """Return a string, a number, a boolean or a list of them as TOML."""
    text = json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)
    return text.replace("\x7f", "\\u007f")  # the one character that JSON takes as it is and TOML does not

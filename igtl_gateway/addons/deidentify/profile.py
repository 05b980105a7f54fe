"""A profile: what stays, new names, rules for text and masks; and its TOML file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, matches, one_of
from igtl_gateway.addon.settings import read_toml
from igtl_gateway.addons.deidentify.masks import Fan, Mask, Rectangle
from igtl_gateway.addons.deidentify.patterns import replaced

TEXT_ACTIONS = ("remove", "replace", "keep", "pattern")
_LISTS = ("names", "metadata", "types")
_TABLES = ("keep", "names", "text", "mask")
_MAX_NAME = 20
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True, slots=True)
class TextRule:
    """What happens to the text of streams.

    Attributes:
        stream: glob of the stream: topic or TYPE/device.
        action: one of ``TEXT_ACTIONS``; ``replace``: the whole text becomes ``by``; ``pattern``: only what matches.
        by: new text.
        pattern: regular expression of Python.
    """

    stream: str
    action: str = "remove"
    by: str = ""
    pattern: str = ""

    def apply(self, text: str) -> str:
        """Return the new text.  Raises ConfigError for a pattern that takes too long (`patterns`)."""
        match self.action:
            case "keep":
                return text
            case "replace":
                return self.by
            case "pattern":
                return replaced(self.pattern, self.by, text)
            case _:
                return ""


_REMOVE = TextRule("**")


@dataclass(frozen=True, slots=True)
class Profile:
    """What a session may keep.  The profile ``basic`` keeps no name, no text and no metadata.

    Attributes:
        keep_names: globs of names that stay.
        keep_metadata: globs of metadata keys that stay with their values.
        keep_types: globs of types without a known layout whose messages stay.
        names: name → new name.
        text_rules: rules for text; the first one that matches the stream applies.
        masks: masks of pictures; the first one that matches the stream applies.
    """

    keep_names: tuple[str, ...] = ()
    keep_metadata: tuple[str, ...] = ()
    keep_types: tuple[str, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    text_rules: tuple[TextRule, ...] = ()
    masks: tuple[Mask, ...] = ()

    def text_rule(self, stream: str) -> TextRule:
        """Return the rule for the text of a stream."""
        return next((rule for rule in self.text_rules if matches(rule.stream, stream)), _REMOVE)

    def mask(self, stream: str) -> Mask | None:
        """Return the mask of a stream."""
        return next((mask for mask in self.masks if matches(mask.stream, stream)), None)


BASIC = Profile()


def read_profile(path: Path) -> Profile:
    """Read and check a profile.  Raises ConfigError with file, place, value found and value expected."""
    document = read_toml(path)
    try:
        return _profile(document)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _profile(document: Mapping[str, Any]) -> Profile:
    _known("", document, _TABLES)
    keep, names = _table("keep", document.get("keep", {})), _table("names", document.get("names", {}))
    _known("keep.", keep, _LISTS)
    lists = {f"keep_{name}": _strings(f"keep.{name}", keep.get(name, [])) for name in _LISTS}
    for name, new in names.items():
        if not isinstance(new, str) or not _NAME.fullmatch(new) or len(new) > _MAX_NAME:
            raise _wrong(f"names.{name}", new, f"a letter, then letters, digits and _, at most {_MAX_NAME}")
    if len(set(names.values())) < len(names):
        raise _wrong("names", "two equal new names", "different ones")
    rules = tuple(_text(f"text[{number}]", row) for number, row in enumerate(_rows("text", document)))
    masks = tuple(_mask(f"mask[{number}]", row) for number, row in enumerate(_rows("mask", document)))
    return Profile(**lists, names=names, text_rules=rules, masks=masks)


def _text(place: str, row: Mapping[str, Any]) -> TextRule:
    _known(f"{place}.", row, ("stream", "action", "by", "pattern"))
    found = {"stream": "", **row}
    rule = TextRule(**{name: _string(f"{place}.{name}", value) for name, value in found.items()})
    if rule.action not in TEXT_ACTIONS:
        raise _wrong(f"{place}.action", rule.action, f"one of {', '.join(TEXT_ACTIONS)}")
    if not rule.stream:
        raise _wrong(f"{place}.stream", rule.stream, "a glob of streams, such as STRING/*")
    if bool(rule.pattern) != (rule.action == "pattern"):
        raise _wrong(f"{place}.pattern", rule.pattern, 'a regular expression with action = "pattern", else none')
    try:
        re.compile(rule.pattern)
    except (re.error, RecursionError, OverflowError) as error:
        raise _wrong(f"{place}.pattern", rule.pattern, f"a regular expression ({error})") from None
    return rule


def _mask(place: str, row: Mapping[str, Any]) -> Mask:
    _known(f"{place}.", row, ("stream", "rectangles", "fan", "value"))
    stream, value = _string(f"{place}.stream", row.get("stream", "")), row.get("value", 0)
    if not stream:
        raise _wrong(f"{place}.stream", stream, "a glob of streams, such as IMAGE/*")
    if type(value) is not int or not 0 <= value <= 255:
        raise _wrong(f"{place}.value", value, "0 to 255")
    rectangles = row.get("rectangles", [])
    if not isinstance(rectangles, list):
        raise _wrong(f"{place}.rectangles", rectangles, "[[x, y, width, height], …]")
    shapes = tuple(
        Rectangle(*_numbers(f"{place}.rectangles[{number}]", each, "x, y, width, height", whole=True))
        for number, each in enumerate(rectangles)
    )
    fan = Fan(*_numbers(f"{place}.fan", row["fan"], "x, y, near, far, from_deg, to_deg")) if "fan" in row else None
    if fan and not (0 <= fan.near < fan.far and fan.from_deg < fan.to_deg <= fan.from_deg + 360):
        raise _wrong(f"{place}.fan", row["fan"], "0 ≤ near < far and from_deg < to_deg ≤ from_deg + 360")
    if not shapes and fan is None:
        raise _wrong(place, dict(row), "rectangles or a fan")
    return Mask(stream, shapes, fan, value)


def _numbers(place: str, found: Any, names: str, *, whole: bool = False) -> list[Any]:
    kinds = (int,) if whole else (int, float)
    good = isinstance(found, list) and len(found) == len(names.split(", "))
    if not good or not all(type(each) in kinds and math.isfinite(each) and abs(each) <= 1e6 for each in found):
        raise _wrong(place, found, f"[{names}], {'whole ' if whole else ''}numbers")
    if whole and min(found) < 0:
        raise _wrong(place, found, "0 or more")
    return found


def _rows(name: str, document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    rows = document.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise _wrong(name, rows, f"tables [[{name}]]")
    return rows


def _table(name: str, found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise _wrong(name, found, f"a table [{name}]")
    return found


def _strings(place: str, found: Any) -> tuple[str, ...]:
    if not isinstance(found, list):
        raise _wrong(place, found, "a list of strings")
    return tuple(_string(place, each) for each in found)


def _string(place: str, found: Any) -> str:
    if not isinstance(found, str):
        raise _wrong(place, found, "a string")
    return found


def _known(place: str, table: Mapping[str, Any], names: tuple[str, ...]) -> None:
    for name in table:
        if name not in names:
            raise ConfigError(f"{place}{name}: unknown, expected {one_of(name, names)}")


def _wrong(place: str, found: Any, expected: str) -> ConfigError:
    text = repr(found)
    return ConfigError(f"{place}: found {text if len(text) <= 60 else text[:60] + '…'}, expected {expected}")

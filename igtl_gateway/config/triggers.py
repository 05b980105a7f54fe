"""Triggers of the black box: what has the last seconds written to a file, without a person.

In a file each is a table ``[[trigger]]``; as an option, a parameter or in Python it is one text, such as
``link_down``, ``mark=slip*,after=5`` or ``value=/force,field=wrench.force.z,above=5``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import did_you_mean, near_names, one_of
from igtl_gateway.config.note_codes import NOTE_CODES

#: Longest window before and after a trigger, s.
MAX_WINDOW_S = 3600.0
_USUAL_AFTER_S = 10.0


@dataclass(frozen=True, slots=True)
class Kind:
    """A row of the table.

    Attributes:
        about: when it is triggered.
        matched: what the pattern, a glob, is compared with.
        pattern: that without one; "": one is needed.
        topics: glob of the ROS topics that are looked at, and recorded therefore; ``{}`` stands for the pattern.
        expected: topic that is there if the pattern names something; ``""``: the pattern is not of ROS.
        only_ros: whether only ROS nodes send what is looked at.
    """

    about: str
    matched: str
    pattern: str = "**"
    topics: str = ""
    expected: str = ""
    only_ros: bool = False


KINDS = {
    "guard": Kind("a finding of the guard: stamps, units, ages", "stream"),
    "link_down": Kind("a link is lost", "address of the peer"),
    "clock": Kind("the clock of a peer, or of this host, was set", "address of the peer"),
    "loss": Kind("messages were dropped: by a queue, the middleware, an encoder or the recorder", "stream"),
    "diagnostics": Kind(
        "a status in `/diagnostics` becomes ERROR", "name of the status", topics="/diagnostics", only_ros=True
    ),
    "status": Kind("a STATUS of a peer is not OK", "device"),
    "operating_state": Kind(
        "a CRTK arm gets the operating state FAULT", "topic", "/**/operating_state", topics="{}", expected="{}"
    ),
    "action_aborted": Kind(
        "a server aborts a goal", "action", topics="{}/_action/**", expected="{}/_action/status", only_ros=True
    ),
    "value": Kind("a number of a ROS message leaves its range", "topic", "", topics="{}", expected="{}"),
    "mark": Kind("a mark is made", "label"),
    "note": Kind("a note is written", "code", ""),
}


@dataclass(frozen=True, slots=True)
class Trigger:
    """One rule.

    Attributes:
        kind: of ``KINDS``.
        pattern: glob; see there.
        before_s: seconds that the file has before the trigger; None: all that memory has.
        after_s: seconds after it.
        field: of a value: its path in the message, such as ``wrench.force.z`` or ``position[2]``.
        below, above: of a value: the range that it leaves.

    Raises ConfigError.
    """

    kind: str
    pattern: str = ""
    before_s: float | None = None
    after_s: float = _USUAL_AFTER_S
    field: str = ""
    below: float | None = None
    above: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"kind: found {self.kind!r}, expected {one_of(self.kind, KINDS)}")
        row = KINDS[self.kind]
        if not self.pattern:
            if not row.pattern:
                raise ConfigError(f"pattern: found none, expected a glob of the {row.matched} with kind {self.kind}")
            object.__setattr__(self, "pattern", row.pattern)
        if self.kind == "note" and not any(matches(self.pattern, code) for code in NOTE_CODES):
            near = did_you_mean(near_names(self.pattern, NOTE_CODES))
            raise ConfigError(
                f"pattern: found {self.pattern!r}, expected the code of a note, or a glob of codes"
                + (f"; {near}" if near else "")
            )
        for name, value in (("before", self.before_s), ("after", self.after_s)):
            if value is not None and not 0 <= value <= MAX_WINDOW_S:
                raise ConfigError(f"{name}: found {value:g}, expected 0 to {MAX_WINDOW_S:g} s")
        given = bool(self.field) or self.below is not None or self.above is not None
        if self.kind != "value" and given:
            raise ConfigError(f"kind: found {self.kind} with field, below or above, expected value with them")
        if self.kind == "value" and not (self.field and (self.below is not None or self.above is not None)):
            raise ConfigError("kind: found value, expected field with it, and below or above")
        if self.below is not None and self.above is not None and self.below >= self.above:
            raise ConfigError(f"below: found {self.below:g}, expected less than above, {self.above:g}")

    def __str__(self) -> str:
        usual = KINDS[self.kind].pattern
        return self.kind if self.pattern == usual else f"{self.kind} {self.pattern}"


_NUMBERS = {"before": "before_s", "after": "after_s", "below": "below", "above": "above"}
_NAMES = ("kind", "pattern", "field", *_NUMBERS)


def trigger(text: str) -> Trigger:
    """Return the rule in ``KIND[=PATTERN][,NAME=VALUE…]``.  Raises ConfigError."""
    first, *rest = text.split(",")
    kind, _, pattern = first.partition("=")
    values: dict[str, Any] = {"kind": kind.strip()} | ({"pattern": pattern.strip()} if pattern else {})
    for each in rest:
        name, equals, value = (part.strip() for part in each.partition("="))
        if not equals or name not in _NAMES[2:] or name in values:
            near = did_you_mean(near_names(name, _NAMES[2:])) if name not in _NAMES[2:] else ""
            expected = f"one each of {'=, '.join(_NAMES[2:])}={near and f'; {near}'}"
            raise ConfigError(f"found {each.strip()!r} in {text!r}, expected {expected}")
        values[name] = value if name == "field" else _number(name, value)
    return _of(values)


def text_of_table(table: Any, place: str) -> str:
    """Return the text of a table ``[[trigger]]``.  Raises ConfigError."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{place}: found {table!r}, expected a table [[trigger]]")
    for name, value in table.items():
        if name not in _NAMES:
            raise ConfigError(f"{place}.{name}: unknown setting, expected {one_of(name, _NAMES)}")
        if name in _NUMBERS and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise ConfigError(f"{place}.{name}: found {value!r}, expected a number")
        if name not in _NUMBERS and (not isinstance(value, str) or "," in value):
            raise ConfigError(f"{place}.{name}: found {value!r}, expected a string in quotes without a comma")
    if "kind" not in table:
        raise ConfigError(f"{place}: found no kind, expected one of {', '.join(KINDS)}")
    try:
        _of(table)
    except ConfigError as error:
        raise ConfigError(f"{place}.{error}") from None
    first = f"{table['kind']}={table['pattern']}" if table.get("pattern") else str(table["kind"])
    return ",".join([first, *(f"{name}={table[name]}" for name in _NAMES[2:] if name in table)])


def _of(values: Mapping[str, Any]) -> Trigger:
    given: dict[str, Any] = {}
    for name, value in values.items():
        given[_NUMBERS.get(name, name)] = _number(name, value) if name in _NUMBERS else value
    return Trigger(**given)


def _number(name: str, text: str | float) -> float:
    try:
        value = float(text)
    except (ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{name}: found {text!r}, expected a number")
    return value

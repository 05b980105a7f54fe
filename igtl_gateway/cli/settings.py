"""Settings of ``bridge`` as options of the command line, made of rows of the table."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from typing import Any

from igtl_gateway.app import settings as app_settings
from igtl_gateway.app.rows import rows_of
from igtl_gateway.cli.options import Options, default, definitions, parser_of
from igtl_gateway.config.faults import FAULTS
from igtl_gateway.config.settings import BY_SETTING, ROWS, SETTINGS, Setting


class Usual(tuple[str, ...]):
    """Values that the help and the completion show, among others that are possible."""

    def __contains__(self, _value: object) -> bool:
        return True


def add_settings(group: Options, *names: str, words: bool = False) -> None:
    """Add the options of settings to a group; without a value they are None, False or [].

    Args:
        group: the parser, or a group of it.
        names: of the settings.
        words: an option of a list takes several words, as well as being repeatable.
    """
    for name in names:
        row = BY_SETTING[name]
        if isinstance(row.default, bool):
            text = row.about if row.default is False else f"do not {row.about}"
            group.add_argument(row.flag, action="store_true", help=_help(row, text))
            continue
        more: dict[str, Any] = {}
        if row.is_list:
            more = {"action": "extend", "nargs": "+"} if words else {"action": "append"}
            more["default"] = []
        if row.choices:
            usual = tuple(filter(None, row.choices))
            more["choices"] = Usual(usual) if row.reads else usual
        else:
            more["metavar"] = row.metavar
        group.add_argument(row.flag, type=parser_of(row.parse), help=_help(row, row.about), **more)


def common_options(*others: str) -> frozenset[str]:
    """Return the options that the short help shows: those of common settings, and ``others``."""
    return frozenset(row.flag for row in SETTINGS if row.common and row.flag).union(others)


def add_faults(parser: argparse.ArgumentParser, more: Iterable[str] = ()) -> None:
    """``--fault`` and ``--seed`` in a group of their own; ``more`` are lines of its description."""
    rows = [(f"{row.name}={row.unit.value}", row.meaning) for row in FAULTS]
    lines = definitions(rows)
    group = parser.add_argument_group(
        "fault injection",
        "\n".join(["Faults of --fault; TIME is such as 50ms, 2s or 1h, SHARE% such as 0.5%:", *lines, *more]),
    )
    add_settings(group, "faults", "fault_seed")


def _help(row: Setting, text: str) -> str:
    text = text.replace("%", "%%")
    if row.is_list:
        text += " (repeatable)"
    shown = row.shown
    if shown is None and row.default and not isinstance(row.default, bool | tuple):
        shown = f"{row.default:g}" if isinstance(row.default, float) else str(row.default)
    return f"{text} {default(shown)}" if shown else text


def given(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings that the command line has.  Raises ConfigError for rows of messages."""
    values: dict[str, Any] = {}
    for row in SETTINGS:
        found = getattr(options, row.flag.lstrip("-").replace("-", "_"), None) if row.flag else None
        if found is None or found is False or found == []:
            continue
        if row.table == ROWS:
            values[row.name] = rows_of(row, found)
        elif isinstance(row.default, bool):
            values[row.name] = not row.default
        else:
            values[row.name] = tuple(found) if row.is_list else found
    return values


def settled(options: argparse.Namespace, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of all settings, see ``app.settings``.  Raises ConfigError."""
    return app_settings.settled(given(options), overrides)

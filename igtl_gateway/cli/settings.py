"""Settings as options of the command line, made of the rows of a table."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from igtl_gateway.base.addons import ADDON_SETTINGS, check_setting, is_present
from igtl_gateway.cli.options import Options, StoredOption, default, definitions, keep_spellings, parser_of
from igtl_gateway.config.faults import FAULTS
from igtl_gateway.config.setting import ROWS, Setting, by_name, changed, check_effect
from igtl_gateway.config.settings import all_settings


class Usual(tuple[str | int, ...]):
    """Values that the help and the completion show, among others that are possible."""

    def __contains__(self, _value: object) -> bool:
        return True


def add_settings(parser: argparse.ArgumentParser, rows: Iterable[Setting], **about: str) -> None:
    """Add the options of settings, in their groups; without a value they are None, False or [].

    Args:
        parser: the parser of a verb.
        rows: the settings; one without an option is left out.
        about: group, with _ for blanks → its description.
    """
    groups: dict[str, Options] = {"": parser}
    exclusive: dict[str, Options] = {}
    for row in rows:
        if not row.flag:
            continue
        if row.group not in groups:
            groups[row.group] = parser.add_argument_group(row.group, about.get(row.group.replace(" ", "_")))
        place = groups[row.group]
        if row.instead:
            if row.instead not in exclusive:
                assert isinstance(place, argparse._ActionsContainer)
                exclusive[row.instead] = place.add_mutually_exclusive_group()
            place = exclusive[row.instead]
        _add(place, row)


def _add(group: Options, row: Setting) -> None:
    if isinstance(row.default, bool):
        text = row.about if row.default is False else f"do not {row.about}"
        group.add_argument(row.flag, action="store_true", help=_help(row, text))
        return
    more: dict[str, Any] = {"required": True} if row.required else {}
    if row.is_list:
        more |= {"action": "extend", "nargs": "+"} if row.words else {"action": "append"}
        more["default"] = []
    if row.bare is not None:
        more |= {"nargs": "?", "const": row.bare}
    if row.choices:
        more["choices"] = Usual(row.usual) if row.reads else row.usual
    if row.metavar:
        more["metavar"] = row.metavar
    if row.old:
        more["action"] = StoredOption
    names = (row.short, row.flag) if row.short else (row.flag,)
    action = group.add_argument(*names, type=parser_of(row.parse), help=_help(row, row.about), **more)
    keep_spellings(group, action, *row.old)


def add_absent(parser: argparse.ArgumentParser, *addons: str) -> None:
    """Add the options of add-ons that are not there, so that one of them is reported as that; without any: of all."""
    for addon in addons or ADDON_SETTINGS:
        if not is_present(addon):
            for name, flag in ADDON_SETTINGS[addon].items():
                parser.add_argument(flag, dest=f"absent_{name}", nargs="?", action=_Absent, help=argparse.SUPPRESS)


class _Absent(argparse.Action):
    def __call__(self, *_: Any) -> None:
        check_setting(self.dest.removeprefix("absent_"))


def common_options(rows: Iterable[Setting], *others: str) -> frozenset[str]:
    """Return the options that the short help shows: those of common settings, and ``others``."""
    return frozenset(row.flag for row in rows if row.common and row.flag).union(others)


def faults_text(*more: str) -> str:
    """The description of the group of fault injection; ``more`` are lines at its end."""
    rows = [(f"{row.name}={row.unit.value}", row.meaning) for row in FAULTS]
    return "\n".join(
        ["Faults of --fault; TIME is such as 50ms, 2s or 1h, SHARE% such as 0.5%:", *definitions(rows), *more]
    )


def _help(row: Setting, text: str) -> str:
    text = text.replace("%", "%%")
    if row.is_list:
        text += " (repeatable)"
    shown = row.shown
    if shown is None and row.default and not isinstance(row.default, bool | tuple):
        shown = f"{row.default:g}" if isinstance(row.default, float) else str(row.default)
    return f"{text} {default(shown)}" if shown else text


def given(options: argparse.Namespace, rows: Iterable[Setting]) -> dict[str, Any]:
    """Return the settings that the command line has.  Raises ConfigError for rows of messages."""
    from igtl_gateway.app.rows import rows_of  # here: the help needs no conversions

    values: dict[str, Any] = {}
    for row in rows:
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


def all_values(options: argparse.Namespace, rows: Iterable[Setting]) -> dict[str, Any]:
    """Return the values of all settings of a verb that has no configuration file for them."""
    table = by_name(rows)
    return {name: row.default for name, row in table.items()} | given(options, table.values())


def values_with_effect(
    options: argparse.Namespace,
    rows: Iterable[Setting],
    met: Mapping[str, bool] = MappingProxyType({}),
    absent: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the values of all settings of a verb.

    Args:
        options: of the command line.
        rows: the settings.
        met, absent: see `check_effect`.

    Raises:
        ConfigError: an option has no effect, because what it needs is not there.
    """
    table = by_name(rows)
    values = all_values(options, table.values())
    check_effect(table, values, changed(table, values), met, absent)
    return values


def settled(options: argparse.Namespace, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of all settings of a bridge, see ``app.setting_values``.  Raises ConfigError."""
    from igtl_gateway.app import setting_values  # here: as above

    return setting_values.settled(given(options, all_settings()), overrides)

"""The programs of a re-simulation from a TOML file: each error has place, value found and value expected.

::

    [[program]]
    name = "planner"                     # optional, for messages
    command = ["python", "planner.py"]   # or a string, as in a shell
    env = { SEED = "1" }                 # optional, added to the environment
    folder = "planner"                   # optional, from the folder of the file; default: where resim runs

    [[program]]
    command = "viewer --port {port}"
    igtl = "client"                      # of OpenIGTLink, or "server"; default: a program of ROS 2
    port = 18944                         # optional; default: a free one, for {port} and in $IGTL_PORT
    link = 1                             # whose peer it replaces; default: the only one of the recording

Before the tables, ``permit_races = true`` permits timers that race an input.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.settings import read_toml
from igtl_gateway.addons.resim.engine import Program
from igtl_gateway.addons.resim.igtl_peer import IgtlRole, check_role

_KEYS = ("name", "command", "env", "folder", "igtl", "port", "link")
_IGTL = ("client", "server")


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a file has: the programs, and whether their timers may race an input."""

    programs: list[Program]
    permits_races: bool = False


def read_recipe(path: Path) -> Recipe:
    """Read the programs.  Raises ConfigError with file, place, value found and value expected."""
    document = read_toml(path)
    try:
        for key in document:
            if key not in ("program", "permit_races"):
                raise ConfigError(f"{key}: unknown table, expected [[program]]")
        permits_races = document.get("permit_races", False)
        if not isinstance(permits_races, bool):
            raise ConfigError(f"permit_races: found {permits_races!r}, expected true or false")
        tables = document.get("program", [])
        if not isinstance(tables, list) or not all(isinstance(each, dict) for each in tables):
            raise ConfigError("program: found another value, expected tables [[program]]")
        if not tables:
            raise ConfigError("found no program, expected [[program]] with a command")
        programs = [_program(f"program[{index}]", each, path.parent) for index, each in enumerate(tables)]
        names = [program.title for program in programs]
        if double := next((name for name in names if names.count(name) > 1), None):
            raise ConfigError(f"program: found {double!r} twice, expected a name of its own for each")
        return Recipe(programs, permits_races)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _program(place: str, table: dict[str, Any], beside: Path) -> Program:
    for key in table:
        if key not in _KEYS:
            raise ConfigError(f"{place}.{key}: unknown key, expected {one_of(key, _KEYS)}")
    if "command" not in table:
        raise ConfigError(f"{place}: found no command, expected a string or a list of strings")
    folder = beside / _text(place, table, "folder") if "folder" in table else None
    if folder and not folder.is_dir():
        raise ConfigError(f"{place}.folder: found no folder {folder}, expected one")
    env = table.get("env", {})
    if not isinstance(env, dict) or not all(isinstance(value, str) and "\0" not in value for value in env.values()):
        raise ConfigError(f"{place}.env: found {env!r}, expected a table of strings")
    for name in env:
        if not name or "=" in name or "\0" in name:
            raise ConfigError(f"{place}.env: found {name!r}, expected names of variables")
    return Program(
        command_of(f"{place}.command", table["command"]), _text(place, table, "name"), env, folder, _role(place, table)
    )


def _role(place: str, table: dict[str, Any]) -> IgtlRole | None:
    """What a program is to OpenIGTLink; None for one of ROS 2.  Raises ConfigError."""
    numbers = {key: table.get(key, 0) for key in ("port", "link")}
    for key, value in numbers.items():
        if type(value) is not int:
            raise ConfigError(f"{place}.{key}: found {value!r}, expected a number")
        if key in table and "igtl" not in table:
            raise ConfigError(f"{place}.{key}: has no effect without igtl")
    if "igtl" not in table:
        return None
    if table["igtl"] not in _IGTL:
        raise ConfigError(f"{place}.igtl: found {table['igtl']!r}, expected {one_of(str(table['igtl']), _IGTL)}")
    role = IgtlRole(table["igtl"] == "server", **numbers)
    check_role(f"{place}.port", f"{place}.link", role)
    return role


def command_of(place: str, found: Any) -> tuple[str, ...]:
    """Return the words of a command: a string as in a shell, or a list.  Raises ConfigError, which names ``place``."""
    words: list[Any] = []
    if isinstance(found, str):
        try:
            words = list(shlex.split(found))
        except ValueError as error:
            raise ConfigError(f"{place}: found {found!r}, expected words of a shell: {error}") from None
    elif isinstance(found, list):
        words = found
    if not words or not all(isinstance(word, str) and "\0" not in word for word in words) or not words[0]:
        raise ConfigError(f"{place}: found {found!r}, expected a string or a list of strings")
    return tuple(words)


def _text(place: str, table: dict[str, Any], key: str) -> str:
    found = table.get(key, "")
    if not isinstance(found, str) or not found.isprintable() or (key in table and not found):
        raise ConfigError(f"{place}.{key}: found {found!r}, expected a string of printable characters")
    return found

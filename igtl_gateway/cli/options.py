"""Options that several verbs share: one text, one metavar and one form of the default for each."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

from igtl_gateway.untrusted import limits

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 18944

RECORDING = "recording (MCAP)"
RECORDING_OR_BAG = "recording, or MCAP file of rosbag2"
STREAM = "by TYPE/device, device or topic; * matches one level, ** any number"

#: Verbs with more options have a usage line without them: a screen of brackets hides the arguments.
_MANY_OPTIONS = 9
_WIDEST_HELP = 100
_LINE = 76


class Options(Protocol):
    """A parser, or a group of its options."""

    def add_argument(self, *names: str, **settings: Any) -> argparse.Action: ...


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of descriptions and examples; limits the width on a wide terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(shutil.get_terminal_size().columns, _WIDEST_HELP) - 2)

    def _format_action(self, action: argparse.Action) -> str:
        if action.nargs == argparse.PARSER:  # the verbs, without a line for the word VERB
            return "".join(map(self._format_action, self._iter_indented_subactions(action)))
        return super()._format_action(action)


def default(value: object) -> str:
    """The end of a help text: ``(default: 64)``."""
    return f"(default: {value})".replace("%", "%%")


def shorten_usage(parser: argparse.ArgumentParser) -> None:
    """Leave options that are not required out of the usage line of a parser that has many."""
    actions = parser._actions  # argparse has no other list of them
    optional = [each for each in actions if each.option_strings and each.help != argparse.SUPPRESS]
    if len(optional) <= _MANY_OPTIONS:
        return
    words = [f"{each.option_strings[-1]} {argument_name(each)}" for each in optional if each.required]
    for each in actions:
        if not each.option_strings:
            words.append(f"[{argument_name(each)}]" if each.nargs == "?" else argument_name(each))
    parser.usage = " ".join(["%(prog)s", "[OPTION ...]", *words])


def argument_name(action: argparse.Action) -> str:
    """Return the metavar of an argument, or its choices."""
    if action.choices is not None and action.metavar is None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    return str(action.metavar or action.dest.upper())


def add_file(parser: Options, what: str = RECORDING) -> None:
    """``FILE``: the recording that a verb reads."""
    parser.add_argument("file", metavar="FILE", type=Path, help=what)


def add_json(parser: Options, what: str = "print the result as one JSON object") -> None:
    """``--json``."""
    parser.add_argument("--json", action="store_true", help=what)


def add_overwrite(parser: Options, what: str = "an existing file") -> None:
    """``--overwrite``."""
    parser.add_argument("--overwrite", action="store_true", help=f"overwrite {what}")


def add_config(parser: Options, what: str = "use this configuration (TOML) instead of the recorded one") -> None:
    """``--config``."""
    parser.add_argument("--config", type=Path, metavar="FILE", help=what)


def add_streams(parser: Options, what: str = "select streams") -> None:
    """``--streams``, any number of times."""
    parser.add_argument("--streams", action="append", default=[], metavar="GLOB", help=f"{what} {STREAM} (repeatable)")


def add_limits_of_files(parser: Options) -> None:
    """``--limit``, any number of times."""
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change a limit for reading untrusted files: {', '.join(limits.MEANINGS)}; docs/hostile-files.md has "
        "meanings and defaults (repeatable)",
    )


# -- addresses -----------------------------------------------------------------------------------------------------


def address(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT``, ``:PORT``, ``PORT`` or ``HOST``; IPv6 hosts in brackets."""
    host, colon, port = text.rpartition(":")
    if text.startswith("[") and text.endswith("]"):
        host, colon, port = text, "", ""
    elif not colon:
        host, port = ("", text) if text.isdigit() else (text, "")
    if port and not (port.isdigit() and int(port) < 1 << 16):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected HOST:PORT with a port from 0 to 65535")
    return host.strip("[]") or DEFAULT_HOST, int(port) if port else DEFAULT_PORT


def add_addresses(parser: Options, kind: Callable[[str], tuple[str, int]] = address, form: str = "HOST:PORT") -> None:
    """``--listen`` and ``--connect``, any number of each."""
    parser.add_argument(
        "--listen",
        type=kind,
        action="append",
        default=[],
        metavar=form,
        help="listen for OpenIGTLink clients on this address; port 0 selects a free port (repeatable) "
        + default(f"{DEFAULT_HOST}:{DEFAULT_PORT}, unless --connect is given"),
    )
    parser.add_argument(
        "--connect",
        type=kind,
        action="append",
        default=[],
        metavar=form,
        help="connect to the OpenIGTLink server at this address; reconnect until stopped (repeatable)",
    )


def add_allow(parser: Options) -> None:
    """``--allow``, any number of times."""
    parser.add_argument(
        "--allow",
        action="append",
        default=[],
        metavar="CIDR",
        help="accept clients from this network only, 'any' for all; required if --listen is not a loopback address "
        "(repeatable)",
    )


def addresses(options: argparse.Namespace) -> tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...]]:
    """Return (listen, connect), with the default server if neither is given."""
    listen, connect = tuple(options.listen), tuple(options.connect)
    return listen if listen or connect else ((DEFAULT_HOST, DEFAULT_PORT),), connect


# -- fault injection -----------------------------------------------------------------------------------------------


def add_faults(parser: argparse.ArgumentParser, more: Iterable[str] = ()) -> None:
    """``--fault`` and ``--seed`` in a group of their own; ``more`` are lines of its description."""
    from igtl_gateway.faults import FAULTS  # here, for the verbs that need it: it imports the codecs

    rows = [(f"{row.name}={row.unit.value}", row.meaning) for row in FAULTS]
    lines = definitions(rows)
    group = parser.add_argument_group(
        "fault injection",
        "\n".join(["Faults of --fault; TIME is such as 50ms, 2s or 1h, SHARE% such as 0.5%:", *lines, *more]),
    )
    group.add_argument(
        "--fault", default="", metavar="NAME=VALUE[,…]", help="apply these faults to the OpenIGTLink messages"
    )
    group.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="seed of the fault injection; the same seed affects the same messages " + default(0),
    )


def definitions(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return the lines of a list for a description or for examples: names, and meanings in a second column."""
    columns = max(len(name) for name, _ in rows) + 2
    return [line for name, text in rows for line in _hanging(name, text, columns)]


def _hanging(name: str, text: str, columns: int) -> list[str]:
    first, *rest = textwrap.wrap(text, _LINE - columns - 2)
    return [f"  {name:<{columns}}{first}", *(" " * (columns + 2) + each for each in rest)]

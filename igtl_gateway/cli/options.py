"""Options that several verbs share: one text, one metavar and one form of the default for each."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol, TypeVar

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted import limits
from igtl_gateway.cli.terminal import print_line
from igtl_gateway.config import notations
from igtl_gateway.config.notations import STREAM

T = TypeVar("T")

#: Name of the node of a bridge, unless ROS arguments have another one.
NODE_NAME = "igtl_gateway"
DEFAULT_HOST, DEFAULT_PORT = notations.DEFAULT_HOST, notations.DEFAULT_PORT

RECORDING = "recording (MCAP)"
RECORDING_OR_BAG = "recording, or MCAP file of rosbag2"

#: Verbs with more options have a usage line without them: a screen of brackets hides the arguments.
_MANY_OPTIONS = 9
#: Columns of a terminal for which descriptions and examples are written.
_WRITTEN = 80
_WIDEST_HELP = 100
_COMMENT = "  # "
_LINE = 76


class Options(Protocol):
    """A parser, or a group of its options."""

    def add_argument(self, *names: str, **settings: Any) -> argparse.Action: ...


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of descriptions and examples, except on a narrow terminal; limits the width on a wide one."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(shutil.get_terminal_size().columns, _WIDEST_HELP) - 2)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled = super()._fill_text(text, width, indent)
        return filled if self._width >= _WRITTEN - 2 else fit(filled, self._width)


def fit(text: str, width: int) -> str:
    """Return text whose paragraphs and comments are at most as wide as this; commands and tables keep their lines."""
    found: list[str] = []
    for prefix, lines in groupby(text.splitlines(), _prefix):
        if prefix is None:
            found += lines
        else:
            words = " ".join(line[len(prefix) :] for line in lines)
            found += textwrap.wrap(words, width, initial_indent=prefix, subsequent_indent=prefix)
    return "\n".join(found)


def _prefix(line: str) -> str | None:
    """Return how a line of a paragraph or of a comment begins; None: it is neither."""
    return _COMMENT if line.startswith(_COMMENT) else None if line.startswith(" ") or not line else ""


def default(value: object) -> str:
    """The end of a help text: ``(default: 64)``."""
    return f"(default: {value})".replace("%", "%%")


def shorten_usage(parser: argparse.ArgumentParser) -> None:
    """Leave options that are not required out of the usage line of a parser that has many."""
    actions = parser._actions  # argparse has no other list of them
    optional = [each for each in actions if each.option_strings and each.help != argparse.SUPPRESS]
    if len(optional) <= _MANY_OPTIONS or parser.usage:
        return
    words = [f"{each.option_strings[-1]} {argument_name(each)}" for each in optional if each.required]
    for each in actions:
        if not each.option_strings and each.help != argparse.SUPPRESS:
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


class StoredOption(argparse.Action):
    """An option that has a value; one with old spellings prints its new one when an old one is used.

    The old spellings work for one release, and neither the help nor the completion has them.  The namespace also has
    ``<dest>_spelling``, as which the option was written.
    """

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        setattr(namespace, self.dest, values)
        setattr(namespace, f"{self.dest}_spelling", option)
        if option not in self.option_strings:
            new = "/".join(self.option_strings)
            print_line(f"{parser.prog}: {option}: the new spelling is {new}", error=True)


def keep_spellings(parser: Options, action: argparse.Action, *old: str) -> None:
    """Let a `StoredOption` be written by its old names, too."""
    assert isinstance(parser, argparse._ActionsContainer)
    parser._option_string_actions.update(dict.fromkeys(old, action))  # argparse has no hidden name of an option


def add_output(
    parser: Options,
    what: str = "file to write",
    read: Callable[[str], Path] = Path,
    *,
    metavar: str = "OUT",
    required: bool = False,
    old: Sequence[str] = ("--out",),
) -> None:
    """``-o/--output``: what a verb writes; ``old`` are earlier names of the option."""
    more: dict[str, Any] = {"type": read, "metavar": metavar, "required": required, "help": what}
    keep_spellings(parser, parser.add_argument("-o", "--output", action=StoredOption, **more), *old)


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


def add_file_mode(parser: Options) -> None:
    """``--file-mode``."""
    parser.add_argument(
        "--file-mode",
        metavar="MODE",
        help="mode of the files that it writes; directories may also be entered by those who may read files "
        + default("0600"),
    )


def add_limits_of_files(parser: Options) -> None:
    """``--limit``, any number of times."""
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change a limit for reading untrusted files: {', '.join(limits.MEANINGS)}; "
        "docs/reference/limits.md has meanings and defaults (repeatable)",
    )


# -- addresses -----------------------------------------------------------------------------------------------------


def parser_of(parse: Callable[[str], T]) -> Callable[[str], T]:
    """Return a function for ``type`` of an option: its message is that of the ConfigError."""

    def parsed(text: str) -> T:
        try:
            return parse(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return parsed


#: Parse ``HOST:PORT``, see ``notations``.
address = parser_of(notations.address)
#: Parse ``[tls://|tcp://]HOST:PORT``, see ``notations``.
peer_address = parser_of(notations.peer_address)


def file_name(*suffixes: str) -> Callable[[str], str]:
    """Return a function for ``reads`` of a setting: the name of a file to write, see ``notations.named``."""
    return lambda text: notations.named(text, *suffixes)


def output_file(*suffixes: str) -> Callable[[str], Path]:
    """Return a function for ``type`` of an option: the path of a file to write, see ``notations.named``."""
    return parser_of(lambda text: Path(file_name(*suffixes)(text)))


#: Parse the name of a recording to write.
new_recording = output_file(".mcap")


# -- lists of names ------------------------------------------------------------------------------------------------


def definitions(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return the lines of a list for a description or for examples: names, and meanings in a second column."""
    columns = max(len(name) for name, _ in rows) + 2
    return [line for name, text in rows for line in _hanging(name, text, columns)]


def _hanging(name: str, text: str, columns: int) -> list[str]:
    first, *rest = textwrap.wrap(text, _LINE - columns - 2)
    return [f"  {name:<{columns}}{first}", *(" " * (columns + 2) + each for each in rest)]

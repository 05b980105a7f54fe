"""All output of the command line: untrusted text reaches the terminal only through this module.

Each argument of :func:`print_line` is one line: line feeds, escape sequences and the like in it are escaped.
What the encoding of the output does not have is escaped as well, so that no name can stop the program.
In the journal of systemd each line has its priority in front.

Lines and tables fit into the columns of the terminal, or of the environment (COLUMNS).  Without either, a report has
80, so that a pipe or a file gets the same on every machine; an error, and a line of a log, stays one line there.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Iterable, Sequence, Set
from contextlib import suppress
from itertools import chain
from typing import Any, TextIO

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import OutputError
from igtl_gateway.base.near import did_you_mean, near_names, one_of
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.service import INFO, WARNING, is_journal
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.base.untrusted.text import json_line, printable
from igtl_gateway.cli.layout import table, wrapped

#: Longer lines are cut: a name of a megabyte must not bury the rest.  ``--json`` has everything.
LONGEST_LINE = 4000
#: Columns of a table that one text may take; the rest of its row moves to the right.
_WIDEST_COLUMN = 72
#: Columns of a report without a terminal, and the fewest that lines are wrapped for.
_COLUMNS, _FEWEST = 80, 40
_CLEAR = "\r\x1b[K"
#: Environment variable of a program that reads the progress: a line each on stderr, which begins with the word.
PROGRESS_VARIABLE, PROGRESS = "IGTL_GATEWAY_PROGRESS", "progress "
#: Time between two reports of the progress, ns.
_PROGRESS_NS = NS_PER_S // 2


class _LiveLine:
    """What the live line of standard output shows instead of the state: what the user types; "": nothing."""

    typed = ""


def print_line(
    *lines: str,
    error: bool = False,
    flush: bool = False,
    colour: str = "",
    priority: int | None = None,
    log: bool = False,
) -> None:
    """Print lines, each wrapped, whatever foreign text is in it: to stdout, or to stderr for an ``error``.

    A line of a ``log``, and an error, is one line where no terminal shows it.

    ``colour`` holds the parameters of the escape sequence SGR (``"1;31"``), for a terminal; the indent has none.  The
    environment can forbid colours: NO_COLOR (any value), TERM=dumb.  ``priority`` is that of the journal; a warning for
    an ``error`` by default.
    """
    front = _front(WARNING if error and priority is None else priority, error)
    is_coloured = bool(colour) and not os.environ.get("NO_COLOR") and not _is_dumb()
    room = columns(error, log=log or error)
    for text in chain.from_iterable(wrapped(_printable_line(line), room) for line in lines or ("",)):
        bare = text.lstrip()
        painted = f"{text[: len(text) - len(bare)]}\x1b[{colour}m{bare}\x1b[0m" if is_coloured else text
        _write(f"{front}{painted}\n", error)
    if flush:
        _flush(error)


def print_text(text: str, error: bool = False) -> None:
    """Print trusted text with lines of any length, such as a page of help."""
    _write("\n".join(map(printable, text.split("\n"))), error)


def print_json(value: Any, priority: int | None = None) -> None:
    """One JSON object on one line, at once; ``priority`` as in `print_line`."""
    text = json_line(value)
    try:
        text.encode(_stream().encoding or "utf-8")
    except UnicodeEncodeError:
        text = json_line(value, ascii_only=True)
    _write(f"{_front(priority)}{text}\n")
    _flush()


def live_line(text: str, error: bool = False) -> None:
    """Replace the last line of a terminal by this one, without a line end; :func:`clear_live_line` takes it away.

    A terminal without cursor control (TERM=dumb) has no such line.
    """
    if _is_dumb():
        return
    room = shutil.get_terminal_size().columns - 1
    if _LiveLine.typed and not error:
        _write(f"{_CLEAR}{_printable_line(_LiveLine.typed)[-room:]}")
        _flush()
        return
    _write(f"{_CLEAR}{_printable_line(text)[:room]}", error)
    _flush(error)


def show_typed(text: str) -> None:
    """Show what the user types in place of the :func:`live_line` from now on; "": show that again."""
    _LiveLine.typed = text
    if is_terminal():
        live_line("")


def clear_live_line(error: bool = False) -> None:
    """Take the :func:`live_line` line away."""
    if not _is_dumb():
        _write(_CLEAR, error)


class LiveProgress:
    """The progress of a verb on stderr: a live line of a terminal, or a line each for the program that started it."""

    def __init__(self) -> None:
        self._clock = SystemClock()
        self._is_read = bool(os.environ.get(PROGRESS_VARIABLE))
        self._is_shown = not self._is_read and is_terminal(error=True)
        self._next_ns = self._clock.monotonic_ns() + _PROGRESS_NS
        self._has_line = False

    @property
    def is_wanted(self) -> bool:
        """Whether anything takes it."""
        return self._is_read or self._is_shown

    def __call__(self, done: int, of: int) -> None:
        """Take how much is done, and of how much; it is shown twice a second at most."""
        now_ns = self._clock.monotonic_ns()
        if now_ns < self._next_ns or not of:
            return
        self._next_ns = now_ns + _PROGRESS_NS
        share = f"{100 * done / of:.0f} %"
        if self._is_read:
            print_line(f"{PROGRESS}{share}", error=True, flush=True)
        elif self._is_shown:
            self._has_line = True
            live_line(f"{share:>5} of {count_text(of, 'entry', 'entries')}", error=True)

    def end(self) -> None:
        """Take the live line away."""
        if self._has_line:
            clear_live_line(error=True)
            self._has_line = False


def is_terminal(error: bool = False) -> bool:
    """Whether a person reads stdout (or stderr) on a terminal."""
    return _stream(error).isatty()


def columns(error: bool = False, *, log: bool = False) -> int:
    """Return the number of columns of stdout (or stderr); 0: lines are not wrapped, as in the journal."""
    stream = _stream(error)
    if is_journal(stream):
        return 0
    stated = os.environ.get("COLUMNS", "")
    found = whole_number(stated) or 0
    if not found and stream.isatty():
        with suppress(OSError, ValueError):  # an imitation of a terminal
            found = os.get_terminal_size(stream.fileno()).columns
        found = found or _COLUMNS
    if not found:
        return 0 if log else _COLUMNS
    return max(found, _FEWEST)


def width(texts: Iterable[str], title: str = "") -> int:
    """Return the width of a column with these strings, as :func:`cell` shows them, within bounds."""
    return min(max((len(printable(text[:_WIDEST_COLUMN])) for text in (title, *texts)), default=0), _WIDEST_COLUMN)


def cell(text: str, columns: int = 0) -> str:
    """Return an untrusted string as it stands in a column of a table."""
    return _printable_line(text).ljust(columns)


def aligned(rows: Sequence[Sequence[str]], left: int = 1, indent: str = "  ", *, text: bool = False) -> list[str]:
    """Return the lines of a table; columns for which the terminal has no room stand below the others.

    Args:
        rows: cells, the first row being the titles; all rows have the same number of cells.
        left: this number of columns is aligned on the left, the others, which hold numbers, on the right.
        indent: what each line begins with.
        text: whether the last column has sentences, which are wrapped.
    """
    shown = [[_printable_line(cell) for cell in row] for row in rows]
    return table(shown, columns(), left=left, indent=indent, widest=_WIDEST_COLUMN, text=text)


class Parser(argparse.ArgumentParser):
    """A parser of arguments whose help and errors pass through here too."""

    color = False  # of Python 3.14: escape sequences in the help
    #: Arguments that only ``--help-all`` shows.
    _rare: frozenset[argparse.Action] = frozenset()
    #: The words that are parsed, for the message about one that means nothing.
    _words: Sequence[str] = ()
    #: Whether argparse is parsing options and other arguments one after the other.
    _is_mixed = False
    #: Whether what stands behind the first ``--`` are programs: the words of ``programs``, as they are.
    takes_programs = False

    def shorten_help(self, common: Set[str]) -> None:
        """Show only these options with ``--help``, and all with ``--help-all``."""
        options = [each for each in self._actions if each.option_strings and each.dest != "help"]
        self._rare = frozenset(each for each in options if common.isdisjoint(each.option_strings))
        self.add_argument("--help-all", action=_HelpAll, nargs=0, help=f"show all {counted(len(options), 'option')}")

    def format_help(self, *, everything: bool = False) -> str:
        """Return the help; groups without an option to show are left out."""
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for group in self._action_groups:
            shown = [each for each in group._group_actions if everything or each not in self._rare]
            if shown:
                formatter.start_section(group.title)
                formatter.add_text(group.description)
                formatter.add_arguments(shown)
                formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the words.  Where the number of files or streams is open, options may stand between them.

        argparse alone takes as many as follow each other, and refuses those behind the next option.
        """
        if self._is_mixed:
            return super().parse_known_args(args, namespace)
        self._words = list(sys.argv[1:] if args is None else args)
        if self.takes_programs:
            end = self._words.index("--") if "--" in self._words else len(self._words)
            args, programs = self._words[:end], self._words[end:]
            self._words = args
            found, rest = self._parse(args, namespace)
            found.programs = programs
            return found, rest
        return self._parse(args, namespace)

    def _parse(self, args: Any, namespace: Any) -> Any:
        if not any(each.nargs in ("?", "*", "+") for each in self._get_positional_actions()):
            return super().parse_known_args(args, namespace)
        self._is_mixed = True
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._is_mixed = False

    def unrecognized(self, word: str) -> str:
        """Return the message about a word that has no place here."""
        name = word.partition("=")[0]
        question = did_you_mean(near_names(name, self._option_string_actions)) if name.startswith("--") else ""
        return f"unrecognized arguments: {word}" + (f"; {question}" if question else "")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a word that is not one of the choices, with the nearest one."""
        if action.choices is not None and value not in action.choices:
            expected = one_of(str(value), map(str, action.choices))
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}, expected {expected}")

    def error(self, message: str) -> Any:
        """Print the usage and what is wrong with the arguments, and end the program.

        Where an argument is missing, a misspelt option may be why: the message names both.
        """
        if "required" in message:
            message = "; ".join([message, *map(self.unrecognized, self._misspelt())])
        self.print_usage(sys.stderr)
        print_line(f"{self.prog}: error: {message}", error=True)
        self.exit(2)

    def _misspelt(self) -> list[str]:
        """The words that look like an option, and are neither one nor the beginning of one."""
        own = self._words[: self._words.index("--")] if "--" in self._words else self._words
        names = [word.partition("=")[0] for word in own if word.startswith("--")]
        return [name for name in names if not any(flag.startswith(name) for flag in self._option_string_actions)]

    def _print_message(self, message: str, file: Any = None) -> None:
        if message:
            print_text(message, error=file is not sys.stdout)


class _HelpAll(argparse.Action):
    """``--help-all``: print the help with all options, and end the program."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        assert isinstance(parser, Parser)  # it made this action
        print_text(parser.format_help(everything=True))
        parser.exit()


def open_outputs() -> None:
    """Python has None for an output that the caller closed (``>&-``): nothing that is printed may fail for that."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))


def flush_outputs() -> None:
    """Write out what is still in memory.  Raises BrokenPipeError, OutputError."""
    _flush()


def discard_outputs() -> None:
    """Print to nowhere from now on: stdout takes nothing more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_dumb() -> bool:
    """Whether the terminal shows escape sequences instead of obeying them."""
    return os.environ.get("TERM") == "dumb"


def _printable_line(line: str) -> str:
    more = len(line) - LONGEST_LINE
    return printable(line) if more <= 0 else f"{printable(line[:LONGEST_LINE])} … and {more:,} more characters"


def _front(priority: int | None, error: bool = False) -> str:
    """What a line of the journal begins with: always something, so that no foreign text can state a priority."""
    return f"<{INFO if priority is None else priority}>" if is_journal(_stream(error)) else ""


def _stream(error: bool = False) -> TextIO:
    return sys.stderr if error else sys.stdout


def _write(text: str, error: bool = False) -> None:
    """Raises BrokenPipeError if the reader has closed the output, OutputError for other errors (a full disk)."""
    stream = _stream(error)
    try:
        try:
            stream.write(text)
        except UnicodeEncodeError:
            encoding = stream.encoding or "ascii"
            stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
    except BrokenPipeError:
        raise
    except OSError as problem:
        raise _output_error(problem, error) from None


def _flush(error: bool = False) -> None:
    try:
        _stream(error).flush()
    except BrokenPipeError:
        raise
    except OSError as problem:
        raise _output_error(problem, error) from None


def _output_error(problem: OSError, error: bool) -> OutputError:
    return OutputError(f"cannot write to standard {'error' if error else 'output'}: {problem.strerror or problem}")

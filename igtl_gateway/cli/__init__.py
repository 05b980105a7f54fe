"""The command line: one file per verb, one place that maps errors to exit codes.

Exit codes, the same for every verb (``docs/reference/command-line.md`` has the table):

* 0: success.
* 1: a finding (a difference, a wrong stitch, a damaged message), or a failure of a valid request: something is missing
  on this machine (ROS 2, rerun, PyAV, a free port), a file cannot be written, a recording is damaged, Ctrl-C.
* 2: wrong usage, for which a retry fails again: the command line, the configuration, an input that does not exist or
  has the wrong format.

Of a verb whose 1 is a verdict (``Verb.failure``), a failure is 2, too.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from igtl_gateway.base import extras
from igtl_gateway.base.errors import (
    ConfigError,
    DamagedRecording,
    GatewayError,
    MissingAddon,
    OutputError,
    Unavailable,
    UnsupportedRecording,
)
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.systems import service
from igtl_gateway.base.systems.signals import endings_interrupt
from igtl_gateway.base.untrusted import cpu_time, limits
from igtl_gateway.base.untrusted.files import near_file
from igtl_gateway.cli.early_port import early_ports
from igtl_gateway.cli.importing import folder_hint, import_hint, several_hint
from igtl_gateway.cli.options import HelpFormatter, add_file_mode, add_limits_of_files, shorten_usage
from igtl_gateway.cli.ros_arguments import without_ros_arguments
from igtl_gateway.cli.terminal import Parser, discard_outputs, flush_outputs, open_outputs, print_line
from igtl_gateway.cli.verbs import (
    JOINED,
    LABORATORY,
    OTHER_WORDS,
    RARE,
    WITHOUT_LABORATORY,
    Verb,
    available,
    groups,
    own_verb,
)
from igtl_gateway.cli.versions import VersionAction
from igtl_gateway.config import notations
from igtl_gateway.record.sessionfile.new_file import files_with_mode

FAILURE, USAGE = 1, 2

_ABOUT = "Gateway between OpenIGTLink and ROS 2: records, replays and verifies sessions."
_NAME_COLUMNS = 14


def main(argv: Sequence[str] | None = None, ready: Callable[[], None] | None = None) -> int:
    """Run one verb.

    Args:
        argv: words of the command line; those of the process by default.
        ready: called before the verb runs, when its modules are imported.

    Returns:
        The exit code.
    """
    open_outputs()
    given = list(sys.argv[1:] if argv is None else argv)
    verb, following = JOINED.get(tuple(given[:2]), ("", ()))
    if is_joined := bool(verb) and given[2:3] != [] and given[2] in following:
        given[:2] = [verb]
    asked = next((word for word in given if not word.startswith("-")), "")
    if not is_joined and (own := own_verb(asked)) and own.now:
        print_line(f"igtl-gateway {asked}: the new spelling is `igtl-gateway {own.now}`", error=True)
    if asked not in ("bridge", "replay"):
        return _run(given, asked, ready)
    given, ros_args = without_ros_arguments(given)
    if asked == "replay":
        return _run(given, asked, ready, ros_args=ros_args)
    from igtl_gateway.edges.reserved import ReservedPorts  # here: other verbs need no socket

    reserved = ReservedPorts(early_ports([*given, *ros_args[:1]]))
    try:
        return _run(given, asked, ready, reserved=reserved, ros_args=ros_args)
    finally:
        reserved.close()


def _run(given: Sequence[str], asked: str, ready: Callable[[], None] | None, **extra: object) -> int:
    """Run the verb ``asked``; ``extra`` are attributes of its options beside those of the command line."""
    parser = _parser()
    verbs = _verbs(parser)
    # import only the module of the requested verb: `info` must not wait for ROS; nor for the entry points of all
    own = own_verb(asked)
    known = {asked: own} if own else available()
    if asked and asked not in known:
        return _print_error(asked, WITHOUT_LABORATORY if asked in LABORATORY else _no_verb(asked, known), USAGE)
    failure = known[asked].failure if asked else FAILURE
    parser.description = f"{_ABOUT}\n\n{_list_of(known, everything='--help-all' in given)}"
    for name, verb in known.items():
        added = verbs.add_parser(
            name, help=verb.help, prog=f"{parser.prog} {verb.now or name}", formatter_class=HelpFormatter
        )
        if name == asked:
            if not verb.module:
                return _print_error(asked, verb.help, failure)
            try:
                with extras.in_use():
                    complete(added, verb)
            except GatewayError as error:  # of an add-on that it needs, or of a library
                return _print_error(asked, error, failure)
            added.set_defaults(**extra)
    try:
        options, rest = parser.parse_known_args(given)
        if rest:
            at = verbs.choices.get(asked, parser)
            hint = several_hint(asked, options, rest)
            at.error(at.unrecognized(rest[0]) + (f"; {hint}" if hint else ""))
        if not options.verb:
            parser.print_help()
            return USAGE
    except GatewayError as error:  # an option of an add-on that is not there, or an output that cannot be written
        if isinstance(error, OutputError):
            discard_outputs()
        return _print_error(asked, error, failure)
    except BrokenPipeError:  # of --help or --version
        discard_outputs()
        return failure
    try:
        with extras.in_use():
            run = options.runner()
        if ready is not None:
            ready()
        with (
            extras.in_use(),
            endings_interrupt(),
            limits.limits_in_force(limits.parse_limits(getattr(options, "limit", []))),
            files_with_mode(notations.file_mode(getattr(options, "file_mode", None) or "0600"), umask=True),
            _bounded(known[asked]) if known[asked].is_bounded else nullcontext(),
        ):
            code = int(run(options))
        flush_outputs()
        return code
    except (ConfigError, UnsupportedRecording) as error:
        return _print_error(options.verb, import_hint(error, options), USAGE)
    except GatewayError as error:
        if isinstance(error, OutputError):
            discard_outputs()
        if isinstance(error, DamagedRecording) and (folder := folder_hint(error, options)):
            return _print_error(options.verb, folder, USAGE)
        return _print_error(options.verb, error, failure)
    except BrokenPipeError:
        # the reader of the output has closed it: nothing more can be printed
        discard_outputs()
        return failure
    except OSError as error:  # of a path that no reader checks: its name is too long, its directory is not accessible
        near = near_file(Path(error.filename)) if error.filename and error.errno == errno.ENOENT else ""
        found = f"{error.filename}: {error.strerror}{near}" if error.filename else error
        return _print_error(options.verb, found, USAGE)
    except MemoryError:
        return _print_error(
            options.verb, "found too little memory for this file, expected more memory or a lower --limit", failure
        )
    except KeyboardInterrupt:
        print_line(error=True)
        return _print_error(options.verb, "interrupted", failure)


def parser_of_all_verbs() -> tuple[Parser, list[Parser]]:
    """Return the parser of the command line, and those of all verbs; imports the modules of all verbs.

    A verb is left out if it cannot be loaded here, because of an add-on that it needs.
    """
    parser = _parser()
    verbs, parsers = _verbs(parser), []
    verbs.help = None  # the script of a shell has no arguments that are suppressed
    for name, verb in available().items():
        if verb.module and _is_loaded(verb):
            parsers.append(verbs.add_parser(name, help=verb.help))
            complete(parsers[-1], verb)
    return parser, parsers


def _no_verb(asked: str, known: Mapping[str, Verb]) -> str:
    """The message about a word that is not a verb."""
    if asked in OTHER_WORDS:
        return f"found no verb {asked!r}, expected igtl-gateway {OTHER_WORDS[asked]}"
    near: dict[str, None] = {}
    for name in near_names(asked, {**OTHER_WORDS, **known}):
        verb = known.get(name)
        near[verb.now or name if verb else OTHER_WORDS[name].partition(",")[0]] = None
    meant = [name for name in near if " " not in name or name.split()[0] not in near]
    return f"found no verb {asked!r}, {did_you_mean(meant) or 'expected one that `igtl-gateway --help` lists'}"


def _list_of(known: Mapping[str, Verb], *, everything: bool) -> str:
    """The list of verbs in their groups, a line for each."""
    lines = []
    for group, rows in groups(known).items():
        if group != RARE or everything:
            lines += [f"{group}:", *(f"  {name:<{_NAME_COLUMNS}}{verb.help}" for name, verb in rows.items())]
    return "\n".join(lines)


def _is_loaded(verb: Verb) -> bool:
    try:
        with extras.in_use():
            importlib.import_module(verb.module)
    except (MissingAddon, Unavailable):
        return False
    return True


def _parser() -> Parser:
    parser = Parser(
        prog="igtl-gateway",
        usage="%(prog)s [-h] [--version] [--help-all] VERB ...",
        description=_ABOUT,
        epilog="`igtl-gateway VERB --help` lists the options of a verb, with examples.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action=VersionAction, help="print the versions of program, formats and libraries")
    parser.add_argument("--help-all", action="help", help="show this message with the verbs that are rarely needed")
    return parser


def _verbs(parser: Parser) -> argparse._SubParsersAction[Parser]:
    # the description lists them in groups
    return parser.add_subparsers(dest="verb", metavar="VERB", prog=parser.prog, help=argparse.SUPPRESS)


def complete(parser: argparse.ArgumentParser, verb: Verb) -> None:
    """Add description, options, examples and ``runner`` of a verb to its parser; imports its module.

    The module may have ``COMMON``, the options that the short help shows.  A module has ``run`` itself, or ``runner()``
    that imports and returns it: what only ``run`` needs is not imported for the help.
    """
    module = importlib.import_module(verb.module)
    module.add_arguments(parser)
    if verb.reads_files:
        add_limits_of_files(parser)
    if verb.writes_files:
        add_file_mode(parser)
    shorten_usage(parser)
    if hasattr(module, "COMMON") and isinstance(parser, Parser):
        parser.shorten_help(module.COMMON)
    parser.description = verb.help[0].upper() + verb.help[1:] + "."
    parser.epilog = "examples:\n" + module.EXAMPLES
    parser.set_defaults(runner=module.runner if hasattr(module, "runner") else lambda: module.run)


def _bounded(verb: Verb) -> AbstractContextManager[None]:
    """Bound the CPU time of a verb."""

    def give_up(error: GatewayError) -> None:
        discard_outputs()
        os._exit(_print_error(verb.now or verb.module.rpartition(".")[2], error, verb.failure))

    return cpu_time.bounded(give_up)


def _print_error(verb: str, error: object, code: int) -> int:
    own = own_verb(verb)
    called = " ".join(filter(None, ("igtl-gateway", own.now or verb if own else verb)))
    print_line(f"{called}: {error}", error=True, priority=service.ERROR)
    return code

"""The command line: one file per verb, errors to exit codes in one place.

Exit codes, the same for every verb (``docs/command-line.md`` has the table):

* 0: all is good.
* 1: a finding (a difference, a wrong stitch, a damaged message), or a failure of what was asked for rightly: something
  is missing on this machine (ROS 2, rerun, PyAV, a free port), the disk refuses, a recording is damaged, Ctrl-C.
* 2: usage, which no retry will mend: the command line, the configuration, an input that is not there or of the wrong
  kind.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from igtl_gateway import __version__
from igtl_gateway.cli.terminal import Parser, discard_outputs, flush_outputs, open_outputs, print_line
from igtl_gateway.cli.verbs import LABORATORY, WITHOUT_LABORATORY, available
from igtl_gateway.errors import ConfigError, GatewayError, OutputError, UnsupportedRecording
from igtl_gateway.untrusted import limits

FAILURE, USAGE = 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; the console script ``igtl-gateway``."""
    open_outputs()
    parser = Parser(
        prog="igtl-gateway",
        description="ROS 2 and OpenIGTLink: bridged, recorded, replayed, verified.",
        epilog="`igtl-gateway VERB --help` shows the options of a verb, with examples.",
    )
    parser.add_argument("--version", action="version", version=f"igtl-gateway {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", title="verbs")
    given = list(sys.argv[1:] if argv is None else argv)
    # only the module of the verb that is asked for is imported: `info` must not wait for ROS
    asked = next((word for word in given if not word.startswith("-")), "")
    known = available()
    if asked in LABORATORY and asked not in known:
        return _print_error(asked, WITHOUT_LABORATORY, USAGE)
    for name, verb in known.items():
        made = verbs.add_parser(
            name,
            help=verb.help,
            description=verb.help[0].upper() + verb.help[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == asked:
            if not verb.module:
                return _print_error(asked, verb.help, FAILURE)
            module = importlib.import_module(verb.module)
            module.add_arguments(made)
            if verb.reads_files:
                _add_limits(made)
            made.epilog = "examples:\n" + module.EXAMPLES
            made.set_defaults(run=module.run)
    options = parser.parse_args(given)
    if not options.verb:
        parser.print_help()
        return USAGE
    try:
        with limits.limits_in_force(limits.parse_limits(getattr(options, "limit", []))):
            code = int(options.run(options))
        flush_outputs()
        return code
    except (ConfigError, UnsupportedRecording) as error:
        return _print_error(options.verb, error, USAGE)
    except GatewayError as error:
        if isinstance(error, OutputError):
            discard_outputs()
        return _print_error(options.verb, error, FAILURE)
    except BrokenPipeError:
        # whoever read our output has seen enough; nothing more can be printed
        discard_outputs()
        return FAILURE
    except OSError as error:  # of a path that no reader asked for in vain: a name that is too long, a folder of others
        return _print_error(options.verb, f"{error.filename}: {error.strerror}" if error.filename else error, USAGE)
    except MemoryError:
        return _print_error(
            options.verb, "found no memory for this file, expected more of it (or a lower --limit)", FAILURE
        )
    except KeyboardInterrupt:
        print_line(error=True)
        return _print_error(options.verb, "interrupted", FAILURE)


def _add_limits(parser: argparse.ArgumentParser) -> None:
    """``--limit``, any number of times."""
    names = "; ".join(
        f"{name}: {meaning} ({getattr(limits.FileLimits(), name)})" for name, meaning in limits.MEANINGS.items()
    )
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"what reading a file may cost; may be repeated.  {names}",
    )


def _print_error(verb: str, error: object, code: int) -> int:
    print_line(f"igtl-gateway {verb}: {error}", error=True)
    return code

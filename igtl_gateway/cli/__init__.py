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
import keyword
import sys
from collections.abc import Sequence

from igtl_gateway import __version__
from igtl_gateway.cli.terminal import Parser, abandon, finish, open_outputs, say
from igtl_gateway.errors import ConfigError, GatewayError, OutputError, UnsupportedRecording
from igtl_gateway.untrusted import limits

FAILURE, USAGE = 1, 2

#: Verb → one line of help.  The module of the same name in this package has ``add_arguments`` and ``run``; verbs that
#: are words of Python have a module with an underscore behind the name.
VERBS = {
    "bridge": "run the gateway between OpenIGTLink and ROS 2, and record it",
    "replay": "drive OpenIGTLink or ROS 2 from a recording",
    "verify": "prove that a recording's outputs follow from its inputs, byte for byte",
    "diff": "compare two recordings, stream by stream, in millimetres and degrees",
    "slice": "cut a part out of a recording, by time and stream, that still verifies",
    "import": "make a session of another program's recording",
    "export": "write a session in the formats of other programs",
    "recover": "make a whole file of a damaged one, and tell what is lost",
    "info": "what is in a recording",
    "doctor": "connect to a peer, or wait for one, and say what is wrong",
    "lint": "the rules of doctor on a recording",
    "view": "a session in rerun: its window, a file, a page, a picture",
    "review": "is every stitch of a suture plan on the tissue, and how sure is the camera",
    "decode": "print the messages of a raw OpenIGTLink byte stream as JSON lines",
    "simulate": "play a scenario, live over ROS 2 and OpenIGTLink or as a recording",
    "bench": "measure latency, rate and cost, beside bare hops of the same bytes",
    "demo": "the main job in a minute: bridge, record, verify, replay",
}

#: Verbs that read files which somebody else may have written.
READERS = frozenset(VERBS) - {"bridge", "doctor", "simulate", "bench", "demo"}


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
    for verb, text in VERBS.items():
        made = verbs.add_parser(
            verb,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if verb == asked:
            module = importlib.import_module(f"igtl_gateway.cli.{verb}{'_' * keyword.iskeyword(verb)}")
            module.add_arguments(made)
            if verb in READERS:
                _add_limits(made)
            made.epilog = "examples:\n" + module.EXAMPLES
            made.set_defaults(run=module.run)
    options = parser.parse_args(given)
    if not options.verb:
        parser.print_help()
        return USAGE
    try:
        with limits.use(limits.parse(getattr(options, "limit", []))):
            code = int(options.run(options))
        finish()
        return code
    except (ConfigError, UnsupportedRecording) as error:
        return _say(options.verb, error, USAGE)
    except GatewayError as error:
        if isinstance(error, OutputError):
            abandon()
        return _say(options.verb, error, FAILURE)
    except BrokenPipeError:
        # whoever read our output has seen enough; nothing more can be printed
        abandon()
        return FAILURE
    except OSError as error:  # of a path that no reader asked for in vain: a name that is too long, a folder of others
        return _say(options.verb, f"{error.filename}: {error.strerror}" if error.filename else error, USAGE)
    except MemoryError:
        return _say(options.verb, "found no memory for this file, expected more of it (or a lower --limit)", FAILURE)
    except KeyboardInterrupt:
        say(error=True)
        return _say(options.verb, "interrupted", FAILURE)


def _add_limits(parser: argparse.ArgumentParser) -> None:
    """``--limit``, any number of times."""
    names = "; ".join(
        f"{name}: {meaning} ({getattr(limits.Limits(), name)})" for name, meaning in limits.MEANINGS.items()
    )
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"what reading a file may cost; may be repeated.  {names}",
    )


def _say(verb: str, error: object, code: int) -> int:
    say(f"igtl-gateway {verb}: {error}", error=True)
    return code

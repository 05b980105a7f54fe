"""``igtl-gateway count``: messages per second of a stream, as CSV; an add-on in one file."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from igtl_gateway.addon import NS_PER_S, GatewayError
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addon.terminal import Verb, add_file, add_overwrite, count_text, output_file, print_line
from igtl_gateway.addon.writing import check_target, write_text, written

#: What the entry point names: the verb is that of this module, and --file-mode is for its output.
VERB = Verb("count the messages of a stream in each second", __name__, writes_files=True)

EXAMPLES = """\
  igtl-gateway count out.mcap TRANSFORM/Probe -o count.csv"""

#: Seconds in one table: a day, so that no stamp makes a file without end.
_LONGEST_S = 86_400


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser)
    parser.add_argument("stream", metavar="STREAM", help="such as TRANSFORM/Probe or /camera/image")
    parser.add_argument("-o", "--output", required=True, metavar="OUT", type=output_file(".csv"), help="file to write")
    add_overwrite(parser, "OUT")


def run(options: argparse.Namespace) -> int:
    """Write the table; return the exit code.  An error that is raised is one line, and exit code 1 or 2."""
    check_target(options.output, overwrite=options.overwrite)
    counts = counts_of(options.file, options.stream)
    rows = ["second,messages", *(f"{second},{count}" for second, count in enumerate(counts))]
    with written(options.output, overwrite=options.overwrite) as path:  # moved to its place when it is whole
        write_text(path, "\n".join(rows) + "\n")
    print_line(f"{options.output}: {count_text(sum(counts), 'message')} in {count_text(len(counts), 'second')}")
    return 0


def counts_of(file: Path, stream: str) -> list[int]:
    """Return the number of messages in each second since the first one, by the clock of the gateway."""
    with open_recording(file) as recording:
        print_line(*recording.warnings, error=True)  # it was cut off
        try:
            times_ns = recording[stream].times
        except KeyError as error:
            raise GatewayError(error.args[0]) from None
    if not len(times_ns):
        return []
    seconds = (times_ns - times_ns[0]) // NS_PER_S
    if seconds[-1] >= _LONGEST_S:
        raise GatewayError(f"{file}: {stream}: found {seconds[-1]} seconds, expected at most {_LONGEST_S}")
    return [int(count) for count in np.bincount(seconds)]

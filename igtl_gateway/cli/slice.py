"""``igtl-gateway slice``: cut a part out of a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import (
    add_config,
    add_file,
    add_json,
    add_output,
    add_overwrite,
    add_streams,
    default,
    new_recording,
)

EXAMPLES = """\
  # seconds 12 to 15
  igtl-gateway slice out.mcap -o part.mcap --start 12 --end 15
  # from a time of day to the end
  igtl-gateway slice out.mcap -o part.mcap --start 2026-11-21T08:30:00Z
  # a phase that was marked
  igtl-gateway slice out.mcap -o part.mcap --start mark:suture --end mark:suture
  # some streams and the outputs that they cause
  igtl-gateway slice out.mcap -o probe.mcap --streams 'TRANSFORM/**'

TIME is in seconds from the beginning, in UTC seconds, a date and time such as
2026-11-21T08:30:00Z, or a mark such as mark:suture-3.  The part begins with
the few inputs that restore the state of the gateway at its start, so that it
verifies like the recording."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    parser.add_argument("out", nargs="?", type=new_recording, help=argparse.SUPPRESS)  # the old spelling
    add_output(parser, "file to write (required)", new_recording)
    parser.add_argument("--start", metavar="TIME", help="start at this time " + default("the beginning"))
    parser.add_argument("--end", metavar="TIME", help="skip messages from this time on " + default("the end"))
    add_streams(parser, "select inputs of these streams, and the inputs that cause outputs in them,")
    add_config(parser)
    add_overwrite(parser, "OUT")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.slice_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway info``: what is in a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import add_file, add_json

EXAMPLES = """\
  # streams, rates, gaps, errors, losses, peers, configuration
  igtl-gateway info out.mcap
  # for programs
  igtl-gateway info out.mcap --json
  # read all entries, also where the recorder has counted them
  igtl-gateway info out.mcap --full
  # a split recording as a whole, and its parts
  igtl-gateway info out"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, directory of a split recording, bag of rosbag2, or - for the standard input")
    parser.add_argument(
        "--full", action="store_true", help="read all entries; else the figures of the recorder, if the file has them"
    )
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.info_run import run  # here: the help does not wait for it

    return run

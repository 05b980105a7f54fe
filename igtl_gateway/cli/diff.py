"""``igtl-gateway diff``: two recordings side by side."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.options import RECORDING_OR_BAG, add_json, add_streams, default

EXAMPLES = """\
  # exit code 0: equal messages; 1: differences
  igtl-gateway diff monday.mcap tuesday.mcap
  # accept small differences
  igtl-gateway diff a.mcap b.mcap --tolerance-mm 0.1 --tolerance-deg 0.05
  # select streams
  igtl-gateway diff a.mcap b.mcap --streams 'TRANSFORM/**'
  # compare with the ROS topics of a rosbag2 MCAP file
  igtl-gateway diff out.mcap bag.mcap

The times of the gateway are not compared; their offset and jitter are
reported.  Of notes, code, level and stream are compared, not the text."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("one", metavar="A", type=Path, help=RECORDING_OR_BAG)
    parser.add_argument("other", metavar="B", type=Path, help="recording to compare with A")
    add_streams(parser)
    for name, unit, what in (("mm", "MM", "positions"), ("deg", "DEG", "rotations")):
        parser.add_argument(
            f"--tolerance-{name}",
            type=float,
            default=0.0,
            metavar=unit,
            help=f"treat {what} up to this distance apart as equal " + default(0),
        )
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.diff_run import run  # here: the help does not wait for it

    return run

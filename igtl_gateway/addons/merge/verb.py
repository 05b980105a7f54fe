"""``igtl-gateway merge``: make one session of the recordings of several recorders."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.addon.terminal import (
    add_json,
    add_output,
    add_overwrite,
    default,
    new_recording,
)

EXAMPLES = """\
  # two gateways that exchange messages: the offset of their clocks is measured
  igtl-gateway merge or1.mcap planning.mcap -o both.mcap
  # names of the parts, and a known offset: the clock of b is 12.3 ms ahead
  igtl-gateway merge a=one.mcap b=two.mcap -o both.mcap --offset b=+0.0123
  # nothing crosses, but both have seen the same movement
  igtl-gateway merge a.mcap b.mcap -o both.mcap \\
      --sync TRANSFORM/Probe /probe/pose
  # a part as a recording of its own
  igtl-gateway merge both.mcap --extract planning -o again.mcap

`verify` of a merged session verifies each part, and every verb reads a part
as OUT/NAME: `info both.mcap/planning`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files",
        metavar="[NAME=]FILE",
        nargs="+",
        help="recordings, and names of the parts; the clock of the first one is the reference",
    )
    add_output(parser, read=new_recording, required=True, old=())
    parser.add_argument(
        "--offset",
        action="append",
        default=[],
        metavar="NAME=S",
        help="how far the clock of a part is ahead of the reference, s (repeatable) " + default("it is measured"),
    )
    parser.add_argument(
        "--sync",
        nargs=2,
        metavar="STREAM",
        help="measure the offset of two recordings from what moves in a stream of each",
    )
    parser.add_argument(
        "--max-lag",
        type=float,
        metavar="S",
        help="with --sync: search offsets up to this size, as --max-lag of sync",
    )
    parser.add_argument("--extract", metavar="NAME", help="write this part of a merged session instead")
    add_overwrite(parser, "OUT")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.merge.verb_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway seal``: seal a recording that exists already."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.options import RECORDING_OR_BAG, add_file, add_output, add_overwrite, new_recording

EXAMPLES = """\
  # write a sealed copy of a recording
  igtl-gateway seal out.mcap --key recorder.key -o sealed.mcap
  # put the reply of a time-stamp authority into a copy of a sealed recording
  igtl-gateway seal sealed.mcap --time-stamp reply.tsr -o stamped.mcap

`seal keys new` makes a key; `bridge --seal KEY` seals while it records.
The seal states what the file contained at this moment, and nothing about the
time before it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--key", metavar="KEY", type=Path, help="private key (Ed25519, PEM)")
    what.add_argument(
        "--time-stamp", metavar="REPLY", type=Path, help="reply of a time-stamp authority (RFC 3161), for a sealed FILE"
    )
    add_output(parser, read=new_recording, required=True, old=())
    add_overwrite(parser, "OUT")


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.seal_run import run  # here: the help does not wait for it

    return run

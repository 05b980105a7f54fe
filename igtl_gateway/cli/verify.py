"""``igtl-gateway verify``: check that the outputs of a recording follow from its inputs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.options import add_config, add_file, add_json

EXAMPLES = """\
  # exit code 0: all outputs are equal; 1: print the first difference
  igtl-gateway verify out.mcap
  # number of differences and the first one of each stream
  igtl-gateway verify out.mcap --all
  # what another configuration would change
  igtl-gateway verify out.mcap --config new.toml
  # up to 1,000 differences, for programs
  igtl-gateway verify out.mcap --json
  # each part of a merged session, or one of them
  igtl-gateway verify both.mcap
  igtl-gateway verify both.mcap/planning
  # whether a sealed recording is as it was written, and by which key
  igtl-gateway verify out.mcap --seal --trusted recorder.key.pub
  # whether a time-stamp authority confirms when it was sealed
  igtl-gateway verify out.mcap --seal --tsa authority.pem"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    add_config(parser)
    parser.add_argument("--all", action="store_true", help="print the first difference of each stream")
    parser.add_argument("--seal", action="store_true", help="check the seal instead of the outputs")
    parser.add_argument(
        "--trusted",
        action="append",
        default=[],
        metavar="KEYS",
        type=Path,
        help="with --seal: accept only these public keys (PEM) and those that they introduce (repeatable)",
    )
    parser.add_argument(
        "--tsa",
        action="append",
        default=[],
        metavar="CERTS",
        type=Path,
        help="with --seal: require a time stamp of an authority with these certificates, PEM (repeatable)",
    )
    parser.add_argument("--reference", action="store_true", help="compute all outputs by the full path")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.verify_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway mark``: add a mark to a closed recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import RECORDING_OR_BAG, add_file, add_json

EXAMPLES = """\
  # a moment, 12.5 s after the start
  igtl-gateway mark out.mcap --at 12.5 --label slip --text "the needle slipped"
  # a phase, from a mark to a time
  igtl-gateway mark out.mcap --at mark:slip --until 31 --label repair --who Kim
  # remove a mark that was added
  igtl-gateway mark out.mcap --remove slip

The mark is written to FILE.marks.jsonl (marks.jsonl in the folder of a split
recording).  Every verb reads it with the recording, which stays as it is; no
seal covers it.  `info` lists all marks."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--label", metavar="LABEL", help="make a mark of this label")
    what.add_argument("--remove", metavar="LABEL[#N]", help="remove a mark that was added")
    parser.add_argument("--at", metavar="TIME", help="when it is, or begins: seconds from the start, UTC, mark:LABEL")
    parser.add_argument("--until", metavar="TIME", help="when the phase ends (default: it is a moment)")
    parser.add_argument("--text", default="", help="more words")
    parser.add_argument("--who", default="", metavar="NAME", help="who makes it")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.mark_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway recover``: repair a damaged recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import add_file, add_json, add_output, add_overwrite, default, new_recording

EXAMPLES = """\
  # after a crash: write out.recovered.mcap, closed and with an index
  igtl-gateway recover out.mcap
  # write another file
  igtl-gateway recover out.mcap -o whole.mcap
  # all parts of a split recording, into the directory out.recovered
  igtl-gateway recover out
  # what was read and what is lost, for programs
  igtl-gateway recover out.mcap --json

exit code 0: the new file has all that was recorded; 1: something is lost, and
the output lists it"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, directory of a split recording, or another MCAP file")
    add_output(
        parser, "file to write, or directory for parts " + default("FILE with .recovered.mcap"), new_recording, old=()
    )
    add_overwrite(parser, "OUT")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.recover_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway doctor FILE``, formerly ``lint``: the rules of ``doctor`` on a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import add_config, add_file, add_json

EXAMPLES = """\
  # findings about stamps, names, units, CRCs, header versions, losses
  igtl-gateway doctor out.mcap
  # for programs
  igtl-gateway doctor out.mcap --json

exit code 0: no error found; 1: an error; 2: wrong usage"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, or directory of a split recording")
    add_config(parser)
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.lint_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway page``: the recordings of a folder on a page for browsers, without a bridge."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addon.settings import add_settings
from igtl_gateway.addons.page.verb_options import OPTIONS

EXAMPLES = """\
  # list, verify, review, export and replay the recordings here
  igtl-gateway page .
  # at a fixed port
  igtl-gateway page recordings --address 8944"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="directory with recordings")
    add_settings(parser, OPTIONS)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.page.verb_run import run  # here: the help does not wait for it

    return run

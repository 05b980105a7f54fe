"""``igtl-gateway review``: is every stitch of the plan on the tissue, and what is the camera's depth worth there."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.addon.settings import add_settings
from igtl_gateway.addon.terminal import RECORDING_OR_BAG, add_file
from igtl_gateway.addons.review.verb_options import OPTIONS

EXAMPLES = """\
  # each stitch of the first and the last plan, with reasons
  igtl-gateway review out.mcap
  # all versions of the plan, one row for each stitch
  igtl-gateway review out.mcap -o stitches.csv
  # the wrong stitches, for programs
  igtl-gateway review out.mcap --json |
      jq '.plans[-1].stitches[] | select(.level == "wrong")'
  # select plan, cloud and tool
  igtl-gateway review out.mcap --plan /star/plan --cloud /star/cloud \\
      --tool suture_tool
  # stricter thresholds
  igtl-gateway review out.mcap --wrong-mm 0.8 --look-mm 0.4

exit code 0: no stitch of the last plan is wrong; 1: some stitches are wrong.
Method and formulae: docs/evidence/review.md"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    add_settings(parser, OPTIONS)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.review.verb_run import run  # here: the help does not wait for it

    return run

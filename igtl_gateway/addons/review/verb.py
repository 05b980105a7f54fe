"""``igtl-gateway review``: is every stitch of the plan on the tissue, and what is the camera's depth worth there."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from igtl_gateway.addon.settings import Setting, add_settings, values_with_effect
from igtl_gateway.addon.terminal import RECORDING_OR_BAG, add_file, command, file_name, print_json, print_next
from igtl_gateway.addons.review import Thresholds
from igtl_gateway.addons.review.model import rows_of
from igtl_gateway.addons.review.output import print_review, review_facts, write_csv
from igtl_gateway.addons.review.recorded import ReviewSelection, checked_thresholds, review_recording

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

OPTIONS = (
    *rows_of(ReviewSelection),
    Setting(
        "output",
        "",
        "write a table with one row per stitch and version",
        metavar="OUT",
        reads=file_name(".csv"),
        short="-o",
        old=("--csv",),
    ),
    Setting("overwrite", False, "overwrite an existing table", needs=("output",)),
    Setting("json", False, "print the result as one JSON object"),
    *rows_of(Thresholds, "thresholds"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    add_settings(parser, OPTIONS)


def run(options: argparse.Namespace) -> int:
    values = values_with_effect(options, OPTIONS)
    thresholds = {each.name: values[each.name] for each in fields(Thresholds)}
    selection = ReviewSelection(**{each.name: values[each.name] for each in fields(ReviewSelection)})
    limits = checked_thresholds(thresholds, selection.clouds, lambda name: f"--{name.replace('_', '-')}")
    review, start_ns = review_recording(options.file, selection, limits)
    if values["output"]:
        write_csv(Path(values["output"]), review, values["overwrite"])
    if values["json"]:
        print_json(review_facts(options.file, review))
    else:
        print_review(options.file, review, start_ns)
        print_next(
            (command("view", options.file), "show the stitches and the cloud in rerun"),
            (command("review", options.file, "-o", "stitches.csv"), "write one row for each stitch"),
        )
    return 1 if review.last.wrong else 0

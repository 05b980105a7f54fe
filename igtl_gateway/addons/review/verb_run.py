"""``igtl-gateway review``: is every stitch of the plan on the tissue, and what is the camera's depth worth there."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from igtl_gateway.addon.settings import values_with_effect
from igtl_gateway.addon.terminal import command, print_json, print_next
from igtl_gateway.addons.review import Thresholds
from igtl_gateway.addons.review.choices import ReviewSelection
from igtl_gateway.addons.review.output import print_review, review_facts, write_csv
from igtl_gateway.addons.review.recorded import checked_thresholds, review_recording
from igtl_gateway.addons.review.verb_options import OPTIONS


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

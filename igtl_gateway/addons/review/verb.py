"""``igtl-gateway review``: is every stitch of the plan on the tissue, and what is the camera's depth worth there."""

from __future__ import annotations

import argparse
from dataclasses import fields

from igtl_gateway.addon import (
    RECORDING_OR_BAG,
    ConfigError,
    add_file,
    add_json,
    add_overwrite,
    command,
    default,
    output_file,
    print_json,
    print_next,
)
from igtl_gateway.addons.review import Thresholds
from igtl_gateway.addons.review.material import CLOUDS
from igtl_gateway.addons.review.output import print_review, review_facts, write_csv
from igtl_gateway.addons.review.recorded import ReviewSelection, checked_thresholds, review_recording

EXAMPLES = """\
  # each stitch of the first and the last plan, with reasons
  igtl-gateway review out.mcap
  # all versions of the plan, one row for each stitch
  igtl-gateway review out.mcap --csv stitches.csv
  # the wrong stitches, for programs
  igtl-gateway review out.mcap --json |
      jq '.plans[-1].stitches[] | select(.level == "wrong")'
  # select plan, cloud and tool
  igtl-gateway review out.mcap --plan /star/plan --cloud /star/cloud \\
      --tool suture_tool
  # stricter thresholds
  igtl-gateway review out.mcap --wrong-mm 0.8 --look-mm 0.4

exit code 0: no stitch of the last plan is wrong; 1: some stitches are wrong.
Method and formulae: docs/how-to/review.md"""

#: Option of each threshold: its meaning, and the reason of its default.
_THRESHOLDS = {
    "wrong_mm": "a point this far from the tissue is wrong; two fifths of the needle's bite of 2.5 mm",
    "look_mm": "a point this far from the tissue needs a look; the cost of lifting a point from one cloud",
    "sure": "standard errors that a distance must exceed to be wrong; once in 400 by chance",
    "noise_mm": "depth noise above which a point needs a look; 0.4 times --wrong-mm",
    "reading_mm": "depth difference to the tissue around it above which a point needs a look; wet spots, glints, folds",
    "density_mm2": "points/mm² below which a point needs a look; a hundred in the window for six unknowns",
    "missing": "share of pixels without depth above which a point needs a look",
    "spacing": "largest deviation from the usual spacing of the plan, as a share",
    "bite": "largest deviation from the usual bite length of the plan, as a share",
    "reach_mm": "the tool has reached a point if it came this near",
    "window_mm": "radius of the tissue that the quadric is fitted to",
    "place_mm": "radius in which noise, density and missing pixels are measured",
    "core_mm": "radius in which the depth at the point is measured",
}
#: Metavar by the last part of the name.
_UNITS = {"mm": "MM", "mm2": "PER_MM2", "missing": "SHARE", "spacing": "SHARE", "bite": "SHARE"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    parser.add_argument(
        "--plan", default="", metavar="TOPIC", help="topic of the plan " + default("pairs of points on the tissue")
    )
    parser.add_argument(
        "--cloud", default="", metavar="TOPIC", help="topic of the point cloud " + default("the largest")
    )
    parser.add_argument(
        "--tool",
        default="",
        metavar="TOPIC",
        help="topic or frame of the tool " + default("the one that comes nearest"),
    )
    parser.add_argument(
        "--clouds",
        type=int,
        default=CLOUDS,
        metavar="N",
        help="maximum number of clouds, evenly spread over time " + default(CLOUDS),
    )
    parser.add_argument(
        "--csv", type=output_file(".csv"), metavar="OUT", help="write a table with one row per stitch and version"
    )
    add_overwrite(parser, "an existing table")
    add_json(parser)
    group = parser.add_argument_group("thresholds")
    for threshold in fields(Thresholds):
        group.add_argument(
            f"--{threshold.name.replace('_', '-')}",
            type=float,
            default=threshold.default,
            metavar=_UNITS.get(threshold.name.rpartition("_")[2], "FACTOR"),
            help=f"{_THRESHOLDS[threshold.name]} " + default(f"{threshold.default:g}"),
        )


def run(options: argparse.Namespace) -> int:
    values = {threshold.name: getattr(options, threshold.name) for threshold in fields(Thresholds)}
    limits = checked_thresholds(values, options.clouds, lambda name: f"--{name.replace('_', '-')}")
    if options.overwrite and not options.csv:
        raise ConfigError("--overwrite: found no --csv OUT, expected it")
    selection = ReviewSelection(options.plan, options.cloud, options.tool, options.clouds)
    review, start_ns = review_recording(options.file, selection, limits)
    if options.csv:
        write_csv(options.csv, review, options.overwrite)
    if options.json:
        print_json(review_facts(options.file, review))
    else:
        print_review(options.file, review, start_ns)
        print_next(
            (command("view", options.file), "show the stitches and the cloud in rerun"),
            (command("review", options.file, "--csv", "stitches.csv"), "write one row for each stitch"),
        )
    return 1 if review.last.wrong else 0

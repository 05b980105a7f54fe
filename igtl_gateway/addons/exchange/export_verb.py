"""``igtl-gateway export``: a session in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.processes import part_of
from igtl_gateway.addon.streams import GAP_NS
from igtl_gateway.addon.terminal import (
    add_json,
    add_output,
    add_streams,
    default,
    definitions,
)
from igtl_gateway.addons.exchange.export_verb_options import LEROBOT, LEROBOT_ROW
from igtl_gateway.addons.exchange.targets import TARGETS

EXAMPLES = """\
  # the ROS topics, for `ros2 bag play bag/`
  igtl-gateway export out.mcap --to rosbag2 -o bag/
  # all topics of a recording with digests, for Foxglove, `ros2 bag` and rerun
  igtl-gateway export out.mcap --to mcap -o full.mcap
  # an IMAGE and its TRANSFORMs, for PLUS and 3D Slicer
  igtl-gateway export out.mcap --to igs.mha -o freehand.igs.mha
  # a scene that plays in 3D Slicer
  igtl-gateway export out.mcap --to mrb -o session.mrb
  # tables
  igtl-gateway export out.mcap --to csv -o tables/ --streams 'TRANSFORM/**'
  # all messages as tables for pandas, polars or DuckDB
  igtl-gateway export out.mcap --to parquet -o tables/
  # point clouds
  igtl-gateway export out.mcap --to ply -o clouds/ --streams /star/cloud
  # volumes
  igtl-gateway export out.mcap --to nrrd -o volumes/
  # a training set for LeRobot: a starting recipe, the set, and its check
  igtl-gateway export out.mcap --to lerobot --write-recipe recipe.toml
  igtl-gateway export out.mcap --to lerobot --recipe recipe.toml -o set/
  igtl-gateway export out.mcap --to lerobot --check set/
  # the messages behind a frame, and where they are in the file
  igtl-gateway export out.mcap --to lerobot --trace set/ --frame 17

formats of --to:
{formats}

exit code 1 if messages of the selected streams cannot be written, or if
--check finds something; the output has the reasons.""".format(
    formats="\n".join(definitions([*((name, target.text) for name, target in TARGETS.items()), *LEROBOT_ROW]))
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files",
        metavar="FILE",
        type=Path,
        nargs="*",
        help=f"recording (MCAP); --to {LEROBOT} takes several, and none with --check and --trace",
    )
    parser.add_argument(
        "--to", choices=(*TARGETS, LEROBOT), required=True, metavar="FORMAT", help="format to write, see below"
    )
    add_output(parser, "file or directory to write")
    add_streams(parser)
    parser.add_argument(
        "--max-gap",
        type=float,
        metavar="S",
        help="igs.mha: largest time between two poses of a transform that an image may lie between; in longer gaps it "
        "is INVALID " + default(GAP_NS / NS_PER_S),
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help="mrb, mrml, seq.nrrd: most messages of a stream in a second, the first of each period "
        + default("all, up to 20,000 a stream, and 2,000 surfaces, points or strings"),
    )
    parser.add_argument(
        "--outputs",
        choices=("full", "digest", "none"),
        help="mcap: all bytes of large outputs, their digests, or none of them " + default("full"),
    )
    if LEROBOT_ROW:
        part_of(LEROBOT, "options:add_lerobot")(parser)
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.exchange.export_verb_run import run  # here: the help does not wait for it

    return run

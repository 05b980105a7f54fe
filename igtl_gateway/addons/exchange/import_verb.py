"""``igtl-gateway import``: another program's recording as a session."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, iso_time
from igtl_gateway.addon.terminal import (
    add_json,
    add_output,
    add_overwrite,
    default,
    new_recording,
)

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
EXAMPLES = """\
  # ROS 1 bag; its messages are converted to ROS 2
  igtl-gateway import session.bag -o session.mcap
  # rosbag2: sqlite3 or MCAP, also split
  igtl-gateway import recording/ -o session.mcap
  # tracked ultrasound: IMAGE and TRANSFORM messages with their stamps
  igtl-gateway import freehand.igs.mha -o session.mcap
  igtl-gateway import freehand.igs.nrrd -o session.mcap \\
      --epoch 2026-03-14T09:00:00Z
  # image or volume (.mha .mhd .nrrd .nhdr): an IMAGE with its position
  igtl-gateway import head.nrrd -o session.mcap
  # NIfTI, with the extra nifti
  igtl-gateway import head.nii.gz -o session.mcap
  # a scene of 3D Slicer: poses, pictures, points and strings
  igtl-gateway import scene.mrb -o session.mcap
  # a transform of 3D Slicer or ITK (.h5 .tfm .mat .txt), as TRANSFORM
  igtl-gateway import ProbeToTracker.h5 -o session.mcap
  # markups of 3D Slicer (.mrk.json .fcsv), as POINT, TRAJ and POLYDATA
  igtl-gateway import Plan.mrk.json -o session.mcap
  # a LeRobot data set (v2.1, v3.0), or one of its episodes
  igtl-gateway import dataset/ -o session.mcap
  igtl-gateway import dataset/ -o episode.mcap --episodes 7
  igtl-gateway import dataset/ -o sessions/ --each
  # videos with tables of kinematics, by a recipe (examples/kinematics.toml)
  igtl-gateway import recipe.toml -o session.mcap
  # the bytes that an OpenIGTLink server sent
  igtl-gateway import probe.s2c.igtl -o session.mcap
  # OpenIGTLink in captured TCP, both directions
  igtl-gateway import traffic.pcap -o session.mcap

exit code 1 if messages that the source declares are missing in the result; the
output marks them.  If SOURCE is damaged, OUT is not written without --partial."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="SOURCE", type=Path, help="file, or directory of a rosbag2 recording or a LeRobot data set"
    )
    add_output(parser, "session file to write, or directory with --each", new_recording, required=True)
    parser.add_argument(
        "--epoch",
        metavar="TIME",
        type=epoch,
        help="start time of sequences and of messages without stamps, ISO 8601 " + default("2000-01-01T00:00:00Z"),
    )
    parser.add_argument(
        "--episodes",
        metavar="N:M",
        default="",
        help="of a LeRobot data set: an episode such as 3, or a half-open range such as 0:8 " + default("all"),
    )
    parser.add_argument(
        "--each", action="store_true", help="of a LeRobot data set: a session for each episode, in the directory OUT"
    )
    parser.add_argument(
        "--partial", action="store_true", help="if SOURCE is damaged, write what was read before the damage"
    )
    add_overwrite(parser, "OUT")
    add_json(parser)


def epoch(text: str) -> int:
    """Parse an ISO 8601 time; return UTC nanoseconds.  A time without a zone is UTC."""
    try:
        moment = iso_time(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time such as 2026-03-14T09:00:00Z") from None
    since = (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)) - _EPOCH
    if since.days < 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time after 1970-01-01")
    return (since.days * 86_400 + since.seconds) * NS_PER_S + since.microseconds * 1000


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.exchange.import_each import run_each  # here: the help does not wait for them
    from igtl_gateway.addons.exchange.import_verb_run import run

    return lambda options: run_each(options) if options.each else run(options)

"""``igtl-gateway view``: a session in rerun: in its window, as a file, as a page, as a picture."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from igtl_gateway.addon.terminal import (
    RECORDING_OR_BAG,
    add_file,
    add_json,
    add_output,
    add_overwrite,
    default,
    output_file,
)

if TYPE_CHECKING:
    pass

EXAMPLES = """\
  # in the window of rerun
  igtl-gateway view out.mcap
  # two runs in one window
  igtl-gateway view monday.mcap tuesday.mcap
  # as a recording of rerun
  igtl-gateway view out.mcap -o out.rrd
  # as a web page for a browser on this machine
  igtl-gateway view out.mcap --web
  # as an image, 4.5 s after the start, or at a mark; needs no screen
  igtl-gateway view out.mcap -o out.png --at 4.5
  igtl-gateway view out.mcap -o out.png --at mark:slip
  # with another layout: star, ultrasound, navigation, generic
  igtl-gateway view out.mcap --blueprint navigation
  # with point clouds coloured by one of their fields
  igtl-gateway view out.mcap --colour-by intensity
  # with the lag of a stream behind another one
  igtl-gateway view out.mcap --sync TRANSFORM/Probe IMAGE/Video
  # with any numbers by their names in CSV, in plots of their own
  igtl-gateway view out.mcap --plot TRANSFORM/Tool.z_mm \\
      --plot /joint_states.position[0]
  # with a robot, if the session has no /robot_description; two arms
  igtl-gateway view out.mcap --urdf psm.urdf
  igtl-gateway view out.mcap --urdf /PSM1=psm.urdf --urdf /PSM2=psm.urdf

Shows all ROS messages, and messages of OpenIGTLink peers as the ROS messages
that they were converted to.  Needs the extra `view`:
pip install "igtl-gateway[view]" """


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    parser.add_argument(
        "other",
        metavar="OTHER",
        nargs="?",
        type=Path,
        help="a second one, such as another run, to switch to in the viewer",
    )
    where = parser.add_mutually_exclusive_group()
    add_output(
        where,
        "write a recording of rerun, or an image, which needs no screen",
        output_file(".rrd", ".png"),
        metavar="OUT.rrd|OUT.png",
        old=("--save", "--screenshot"),
    )
    where.add_argument("--web", action="store_true", help="serve a web page on 127.0.0.1 until stopped")
    parser.add_argument(
        "--port", type=int, metavar="PORT", help="with --web: port of the page " + default("a free one")
    )
    parser.add_argument("--at", metavar="TIME", help="with -o OUT.png: time of the image " + default("the end"))
    parser.add_argument(
        "--blueprint", metavar="NAME", default="", help="layout of the views " + default("chosen by the content")
    )
    parser.add_argument("--colour-by", metavar="FIELD", default="", help="colour point clouds by this field")
    parser.add_argument(
        "--urdf",
        metavar="[NAMESPACE=]FILE",
        action="append",
        default=[],
        help="draw this robot; joint states below the namespace move it (repeatable)",
    )
    parser.add_argument(
        "--plot", metavar="STREAM.FIELD", action="append", default=[],
        help="plot numbers of a stream, by the name of a column of `export --to csv` (repeatable)",
    )  # fmt: skip
    parser.add_argument(
        "--sync", nargs=2, metavar="STREAM", help="draw the lag of the second stream behind the first, as `sync` does"
    )
    parser.add_argument("--no-review", action="store_true", help="do not review the suture plan of the session")
    add_overwrite(parser)
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.view.verb_run import run  # here: the help does not wait for it

    return run

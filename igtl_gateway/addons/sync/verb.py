"""``igtl-gateway sync``: the lags between the streams of a recording, and their correction."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addon.terminal import (
    add_file,
    add_json,
    add_output,
    add_overwrite,
    default,
    new_recording,
    output_file,
)
from igtl_gateway.addons.sync.defaults import CUT_OFF_HZ, MAX_LAG_S

EXAMPLES = """\
  # how late is each stream against the first one?
  igtl-gateway sync out.mcap TRANSFORM/Probe IMAGE/Video /joint_states
  # all streams in which something moves
  igtl-gateway sync out.mcap
  # all recordings in and below a folder: a table of lags
  igtl-gateway sync sessions/ TRANSFORM/Probe IMAGE/Video
  # a jaw that opens and closes periodically, and an insertion that does not:
  # kinematics and video, one lag
  igtl-gateway sync out.mcap /psm/jaw /video/jaw --max-lag 5 \\
      --pair /psm/insertion /video/insertion
  # the water tank of PLUS: two imported files, and the line in the pictures
  igtl-gateway sync video.mcap IMAGE/Image TRANSFORM/ProbeToTracker \\
      --with tracker.mcap --line --plot lag.svg
  # write a session with corrected stamps
  igtl-gateway sync out.mcap TRANSFORM/Probe IMAGE/Video --apply -o new.mcap

A positive lag means that the stamps of the stream are late: what the first
stream shows at time t, it shows at t + lag.  Exit code 0: all lags are
measured; 1: the data give no lag, and the reason is printed.  Of a folder, 0:
each row has a lag; 1: one has none, or a recording cannot be read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, or a folder of recordings")
    parser.add_argument(
        "streams",
        metavar="STREAM",
        nargs="*",
        help="streams such as TRANSFORM/Probe or /camera/image; the lags are those behind the first one "
        + default("all input streams in which something moves"),
    )
    parser.add_argument("--with", dest="other", type=Path, metavar="FILE", help="second recording, for further streams")
    parser.add_argument(
        "--max-lag",
        type=float,
        metavar="S",
        help="search lags up to this size; states that the lag is below it, as periodic movements need it "
        + default(MAX_LAG_S),
    )
    parser.add_argument(
        "--pair",
        nargs=2,
        action="append",
        default=[],
        metavar="STREAM",
        help="with two streams: two more streams of the same two clocks, whose movement has the same lag (repeatable)",
    )
    parser.add_argument(
        "--cut-off",
        type=float,
        default=CUT_OFF_HZ,
        metavar="HZ",
        help="highest cut-off of the low-pass filter; noisy signals get a lower one by themselves "
        + default(CUT_OFF_HZ),
    )
    parser.add_argument("--frame", default="", metavar="NAME", help="tool or child frame of streams with several poses")
    parser.add_argument("--line", action="store_true", help="follow the bright line in images, as in a water tank")
    parser.add_argument(
        "--plot", type=output_file(".svg"), metavar="FILE", help="draw signals, search and windows (SVG)"
    )
    parser.add_argument(
        "--apply",
        action="store_true",
        help="write a session with corrected stamps of the second stream (and of the second one of each --pair)",
    )
    add_output(parser, "with --apply: the file to write", new_recording, metavar="FILE")
    add_overwrite(parser, "files")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.sync.verb_run import run  # here: the help does not wait for it

    return run

"""``igtl-gateway bench``: how fast, on this machine, and against what it costs without us."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.options import add_json, default
from igtl_gateway_lab.bench.cases import BOTH, SLICER, Direction
from igtl_gateway_lab.bench.peers import PEERS
from igtl_gateway_lab.bench.runner import NATIVE, PYTHON
from igtl_gateway_lab.bench.sweeps import SWEEPS

EXAMPLES = """\
  # 30 Hz in both directions, and the bare hops
  igtl-gateway bench --case transform
  igtl-gateway bench --case transform --rate 1000 --direction ros-to-igtl
  # at the highest rate without loss
  igtl-gateway bench --case image-fullhd --flood --json
  # with and without a recording, alternately
  igtl-gateway bench --case mixed --duration 60 --record --rounds 3
  # what seals cost: recordings with and without them
  igtl-gateway bench --case mixed --duration 30 --seal --no-floor
  # also over Zenoh through a router, with its own floor
  igtl-gateway bench --case transform --zenoh
  # also with the C++ library and pyigtl as peers
  igtl-gateway bench --case transform image-vga --peers
  # also as 3D Slicer sends it, in turns with header version 1
  igtl-gateway bench --case transform-n --direction igtl-to-ros --peer slicer
  # in turns with another bridge (docs/evidence/performance.md)
  igtl-gateway bench --case transform --against "my_bridge --port {port}"
  # measurements other than the transfer of messages
  igtl-gateway bench --case start-up idle replay verify
  # the verbs on recordings of 10 s, beside pymcap-cli and rerun: within five
  # minutes, also without ROS
  igtl-gateway bench --case offline
  # the same on 300 s in three rounds, which the goals are for: an hour
  igtl-gateway bench --case offline --duration 300 --rounds 3
  # where the gateway spends its time
  igtl-gateway bench --case mixed --flame out.svg
  # growing load, with fitted lines and plots
  igtl-gateway bench --sweep payload streams --plot out
  # Table 1 of the ROS-IGTL-Bridge paper: 1000 messages each, 30 Hz
  igtl-gateway bench --table1 --plot out"""

_SLICER = "slicer"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--list", action="store_true", help="list all cases and sweeps, then exit")
    add_json(parser)
    what = parser.add_argument_group("what to measure")
    what.add_argument("--case", nargs="+", default=[], metavar="NAME", help="measure these cases")
    what.add_argument("--table1", action="store_true", help="measure the cases of the paper's Table 1")
    what.add_argument(
        "--sweep",
        nargs="+",
        default=[],
        choices=tuple(SWEEPS),
        metavar="NAME",
        help=f"measure with a growing load: {', '.join(SWEEPS)}",
    )
    what.add_argument(
        "--direction",
        choices=(*(direction.value for direction in Direction), BOTH),
        default=BOTH,
        help="direction of the messages " + default(BOTH),
    )
    speed = what.add_mutually_exclusive_group()
    speed.add_argument("--rate", type=float, metavar="HZ", help="rate of the messages " + default("rate of the case"))
    speed.add_argument("--flood", action="store_true", help="send at the highest rate without loss")
    length = what.add_mutually_exclusive_group()
    length.add_argument(
        "--duration", type=float, default=10.0, metavar="SECONDS", help="duration of each measurement " + default(10)
    )
    length.add_argument("--count", type=int, metavar="N", help="number of messages of each measurement")
    comparisons = parser.add_argument_group("comparisons")
    comparisons.add_argument(
        "--rounds", type=int, default=1, metavar="N", help="measure N times alternately and print medians " + default(1)
    )
    comparisons.add_argument(
        "--zenoh",
        action="store_true",
        help="also measure with ROS over Zenoh through a router, with the measuring programs in Python, and the same "
        "over DDS",
    )
    comparisons.add_argument("--record", action="store_true", help="also measure with a recording")
    comparisons.add_argument("--seal", action="store_true", help="also measure with recordings, sealed and not")
    comparisons.add_argument(
        "--floor",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also send the same bytes over a bare DDS hop and a bare TCP connection, and through a bridge that only "
        "passes them on " + default("--floor"),
    )
    comparisons.add_argument(
        "--against",
        action="append",
        default=[],
        metavar="COMMAND",
        help="also measure another bridge, in turns with ours; replaces {port} and {case} in it (repeatable)",
    )
    comparisons.add_argument(
        "--programs",
        choices=(NATIVE, PYTHON),
        help="the measuring programs on both sides " + default(f"{NATIVE}, without a C compiler {PYTHON}"),
    )
    comparisons.add_argument(
        "--peers", action="store_true", help=f"also measure with {' and '.join(PEERS)} as peer, if installed"
    )
    comparisons.add_argument(
        "--peer",
        choices=(_SLICER,),
        help="also send to ROS what this program sends instead: header version 2, its metadata and ids, no stamps; "
        f"of {', '.join(SLICER)}",
    )
    plots = parser.add_argument_group("plots")
    plots.add_argument("--plot", type=Path, metavar="DIR", help="write plots of the result (SVG) to this directory")
    plots.add_argument("--flame", type=Path, metavar="FILE", help="write a flame graph of the gateway (SVG, py-spy)")


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway_lab.cli.bench_run import run  # here: the help does not wait for it

    return run

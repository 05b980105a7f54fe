"""``igtl-gateway bench``: how fast, on this machine, and against what it costs without us."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.bench.cases import CASES, FLOOD, TABLE_1, Case, Direction
from igtl_gateway.bench.runner import Extent, Plan, Row, Runner
from igtl_gateway.cli.common import print_json
from igtl_gateway.clock import SystemClock
from igtl_gateway.errors import ConfigError

EXAMPLES = """\
  igtl-gateway bench --case transform                     30 Hz, both ways, and the bare hops
  igtl-gateway bench --case transform --rate 1000 --direction ros-to-igtl
  igtl-gateway bench --case image-fullhd --flood --json
  igtl-gateway bench --case mixed --duration 60 --record  with and without recording
  igtl-gateway bench --table1                             the paper's table: 1000 messages each, 30 Hz"""

_TABLE_COUNT, _TABLE_HZ = 1000, 30.0
_MOST_S, _MOST_HZ, _MOST_COUNT = 3600.0, 100_000.0, 10_000_000
_BOTH = "both"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--case", nargs="+", default=[], metavar="NAME", help="what is measured; --list shows all")
    parser.add_argument("--table1", action="store_true", help="the cases of the paper's Table 1")
    parser.add_argument("--list", action="store_true", help="show the cases, then end")
    parser.add_argument(
        "--direction",
        choices=(*(direction.value for direction in Direction), _BOTH),
        default=_BOTH,
        help="which way (%(default)s)",
    )
    speed = parser.add_mutually_exclusive_group()
    speed.add_argument("--rate", type=float, metavar="HZ", help="messages a second (default: as the case has it)")
    speed.add_argument("--flood", action="store_true", help="as fast as the sender can")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--duration", type=float, default=10.0, metavar="S", help="how long each (%(default)g s)")
    length.add_argument("--count", type=int, metavar="N", help="messages each, instead")
    parser.add_argument("--record", action="store_true", help="again with a recording, and what that costs")
    parser.add_argument(
        "--floor",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="measure the same bytes over a bare DDS hop and a bare TCP connection too",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(options: argparse.Namespace) -> int:
    if options.list:
        for case in CASES.values():
            print(f"{case.name:<15} {case.text}")
        return 0
    plans = _plans(options)
    if importlib.util.find_spec("rclpy") is None:
        raise ConfigError('rclpy is not installed here: pip install "igtl-gateway[ros]"')
    # a measurement must neither hear nor disturb other robots
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    before = _ambient()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="igtl-gateway-bench-") as folder:
        runner = Runner(Path(folder), SystemClock(), lambda line: None)
        for plan in plans:
            rows += runner.measure(plan)
    if options.json:
        print_json({"rows": rows, "ambient": before})
    else:
        for row in rows:
            print(row)
    return 0


def _plans(options: argparse.Namespace) -> list[Plan]:
    """What is to be measured.  Raises ConfigError."""
    names = [*options.case, *(TABLE_1 if options.table1 else ())]
    if unknown := [name for name in names if name not in CASES]:
        raise ConfigError(f"--case: found {unknown[0]!r}, expected one of {', '.join(CASES)}")
    if not names:
        raise ConfigError("found nothing to measure, expected --case NAME or --table1 (--list shows the cases)")
    for name, value, most in (
        ("--rate", options.rate, _MOST_HZ),
        ("--duration", options.duration, _MOST_S),
        ("--count", options.count, _MOST_COUNT),
    ):
        if value is not None and not 0 < value <= most:
            raise ConfigError(f"{name}: found {value:g}, expected above 0 and at most {most:g}")
    directions = tuple(one for one in Direction if options.direction in (one.value, _BOTH))
    count = options.count or (_TABLE_COUNT if options.table1 else 0)
    plans = []
    for name in dict.fromkeys(names):
        case = _at_rate(CASES[name], options)
        plan = Plan(case, directions, Extent(options.duration, count), options.floor)
        plans += [plan, replace(plan, record=True, floor=False)] if options.record else [plan]
    return plans


def _at_rate(case: Case, options: argparse.Namespace) -> Case:
    if case.together and (options.rate or options.flood):
        raise ConfigError(f"--rate, --flood: {case.name} has rates of its own")
    if options.flood:
        return case.at(FLOOD)
    if options.rate or options.table1:
        return case.at(options.rate or _TABLE_HZ)
    return case


def _ambient() -> dict[str, Any]:
    """What else there is to know: the machine, and how busy it is."""
    return {
        "load": [round(load, 2) for load in os.getloadavg()],
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "igtl_gateway": __version__,
    }

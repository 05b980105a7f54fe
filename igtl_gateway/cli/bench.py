"""``igtl-gateway bench``: how fast, on this machine, and against what it costs without us."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import sys
import tempfile
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.bench.cases import CASES, FLOOD, TABLE_1, Case, Direction
from igtl_gateway.bench.figures import ratio
from igtl_gateway.bench.peers import PEERS, lacks
from igtl_gateway.bench.plot import latency_plots
from igtl_gateway.bench.runner import Extent, Plan, Row, Runner
from igtl_gateway.bench.works import WORKS, Workshop
from igtl_gateway.cli.common import print_json
from igtl_gateway.clock import Clock, SystemClock
from igtl_gateway.errors import ConfigError

EXAMPLES = """\
  igtl-gateway bench --case transform                     30 Hz, both ways, and the bare hops
  igtl-gateway bench --case transform --rate 1000 --direction ros-to-igtl
  igtl-gateway bench --case image-fullhd --flood --json
  igtl-gateway bench --case mixed --duration 60 --record  with and without recording
  igtl-gateway bench --case transform image-vga --peers   with the C++ library and pyigtl as peers, too
  igtl-gateway bench --case start-up replay verify        what is no passage of messages
  igtl-gateway bench --table1 --plot out                  the paper's table: 1000 messages each, 30 Hz"""

_TABLE_COUNT, _TABLE_HZ = 1000, 30.0
_MOST_S, _MOST_HZ, _MOST_COUNT = 3600.0, 100_000.0, 10_000_000
_BOTH = "both"

#: Column → field of a row and how it is shown.
_COLUMNS = {
    "case": ("case", ""),
    "direction": ("direction", ""),
    "Hz": ("rate_hz", "g"),
    "sent": ("sent", ",d"),
    "delivered": ("delivered", ",d"),
    "/s": ("received_per_s", ",.0f"),
    "p50 ms": ("p50_ms", ".3f"),
    "p99 ms": ("p99_ms", ".3f"),
    "mean ms": ("mean_ms", ".3f"),
    "sd ms": ("sd_ms", ".3f"),
    "max ms": ("max_ms", ".3f"),
    "floor ms": ("floor_p50_ms", ".3f"),
    "ratio": ("ratio", ".2f"),
    "CPU %": ("gateway_cpu_percent", ".0f"),
    "RSS MB": ("gateway_rss_mb", ".0f"),
}
_PACKAGES = ("ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "numpy", "fastcrc", "mcap")


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
    parser.add_argument(
        "--peers", action="store_true", help=f"again with {' and '.join(PEERS)} instead of our client, where installed"
    )
    parser.add_argument("--plot", type=Path, metavar="DIR", help="draw the rows into SVG files there")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(options: argparse.Namespace) -> int:
    if options.list:
        for case in CASES.values():
            print(f"{case.name:<15} {case.text}")
        for name, work in WORKS.items():
            print(f"{name:<15} {work.text}")
        return 0
    plans, works = _asked(options)
    if importlib.util.find_spec("rclpy") is None:
        raise ConfigError('rclpy is not installed here: pip install "igtl-gateway[ros]"')
    # a measurement must neither hear nor disturb other robots
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    clock = SystemClock()
    ambient = _ambient(clock)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="igtl-gateway-bench-") as folder:
        runner = Runner(Path(folder), clock, _tell)
        for plan in plans:
            rows += runner.measure(plan)
        workshop = Workshop(Path(folder), clock, _tell)
        for name in works:
            rows += WORKS[name].run(workshop)
    rows = _with_costs(rows)
    ambient["load_after"] = _load()
    if options.plot:
        options.plot.mkdir(parents=True, exist_ok=True)
        for name, text in latency_plots(rows).items():
            (options.plot / name).write_text(text, "utf-8")
    if options.json:
        print_json({"rows": rows, "ambient": ambient})
    else:
        print("\n".join([*_table(rows), "", *_words(ambient)]))
    return 0


def _asked(options: argparse.Namespace) -> tuple[list[Plan], list[str]]:
    """What is to be measured: passages of messages, and other work.  Raises ConfigError."""
    names = list(dict.fromkeys([*options.case, *(TABLE_1 if options.table1 else ())]))
    if unknown := [name for name in names if name not in CASES and name not in WORKS]:
        raise ConfigError(f"--case: found {unknown[0]!r}, expected one of {', '.join([*CASES, *WORKS])}")
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
    for name in names:
        if name in CASES:
            plan = Plan(_at_rate(CASES[name], options), directions, Extent(options.duration, count), options.floor)
            plans += [plan, replace(plan, record=True, floor=False)] if options.record else [plan]
            plans += _with_peers(plan) if options.peers else []
    return plans, [name for name in names if name in WORKS]


def _with_peers(plan: Plan) -> list[Plan]:
    """The same with each peer that is there; of the others it is said why not."""
    reasons = {peer: lacks(peer, plan.case) for peer in PEERS}
    for reason in filter(None, reasons.values()):
        _tell(f"left out: {reason}")
    return [replace(plan, peer=peer) for peer, reason in reasons.items() if not reason]


def _at_rate(case: Case, options: argparse.Namespace) -> Case:
    if case.together and (options.rate or options.flood):
        raise ConfigError(f"--rate, --flood: {case.name} has rates of its own")
    if options.flood:
        return case.at(FLOOD)
    if options.rate or options.table1:
        return case.at(options.rate or _TABLE_HZ)
    return case


def _with_costs(rows: list[Row]) -> list[Row]:
    """The rows, those of recordings with how many times they took of what they take without."""

    def key(row: Row) -> tuple[Any, ...]:
        return row["case"], row.get("stream"), row.get("direction"), row.get("peer")

    plain = {key(row): row for row in rows if not row.get("recording")}
    return [
        row
        | {
            f"recording_{name}_ratio": ratio(row[f"{name}_ms"], plain[key(row)][f"{name}_ms"])
            for name in ("p50", "p99")
        }
        if row.get("recording") and key(row) in plain
        else row
        for row in rows
    ]


def _table(rows: list[Row]) -> list[str]:
    """The passages as a table; whatever else there is to say about a row stands below."""
    passages = [row for row in rows if row.get("direction")]
    lines = []
    if passages:
        cells = [list(_COLUMNS), *([_cell(row, *column) for column in _COLUMNS.values()] for row in passages)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines += [
            "  ".join(
                text.ljust(width) if index < 2 else text.rjust(width)
                for index, (text, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in cells
        ]
    for row in rows:
        if row not in passages:
            told = ", ".join(
                f"{name.replace('_', ' ')} {_shown(value)}" for name, value in row.items() if name != "case"
            )
            lines.append(f"{row['case']}: {told}")
        elif "recording_p50_ratio" in row:
            times = " and ".join(f"{name} {row[f'recording_{name}_ratio']} times" for name in ("p50", "p99"))
            lines.append(f"{_name(row)}, {row['direction']}: {times} that without recording")
    return lines


def _cell(row: Row, field: str, form: str) -> str:
    if field == "case":
        return _name(row)
    if field == "rate_hz" and row[field] is None:
        return "flood"
    value = row.get(field)
    return "" if value is None else format(value, form)


def _name(row: Row) -> str:
    marks = (row["case"], row.get("stream"), "+rec" if row.get("recording") else "", row.get("peer"))
    return " ".join(filter(None, marks))


def _shown(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _ambient(clock: Clock) -> dict[str, Any]:
    """What else there is to know: the machine, how busy it is, and versions."""
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "utc_ns": clock.utc_ns(),
        "load": _load(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "igtl_gateway": __version__,
        "packages": versions,
    }


def _load() -> list[float]:
    return [round(load, 2) for load in os.getloadavg()]


def _words(ambient: dict[str, Any]) -> list[str]:
    packages = ", ".join(f"{name} {version}" for name, version in ambient["packages"].items())
    return [
        f"load {ambient['load'][0]} before, {ambient['load_after'][0]} after, on {ambient['cores']} cores",
        f"igtl-gateway {ambient['igtl_gateway']}, Python {ambient['python']}, {packages}",
    ]


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)

"""``igtl-gateway bench``: how fast, on this machine, and against what it costs without us."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import shlex
import tempfile
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.extras import missing
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.version import __version__
from igtl_gateway.cli.terminal import print_json, print_line, print_text
from igtl_gateway_lab.bench import flame, offline
from igtl_gateway_lab.bench.bounds import shown, with_verdict
from igtl_gateway_lab.bench.cases import BOTH, CASES, FLOOD, SLICER, TABLE_1, Case, Direction
from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.peers import PEERS, lacks
from igtl_gateway_lab.bench.plot import latency_plots, sweep_plots
from igtl_gateway_lab.bench.probe import lacks_probe
from igtl_gateway_lab.bench.rounds import against_version_1, merge_rounds, with_costs
from igtl_gateway_lab.bench.runner import NATIVE, PYTHON, BenchPlan, Extent, Runner
from igtl_gateway_lab.bench.sweeps import SWEEPS, fit_lines
from igtl_gateway_lab.bench.works import WORKS, WorkContext

_TABLE_COUNT, _TABLE_HZ = 1000, 30.0
_MOST_S, _MOST_HZ, _MOST_COUNT, _MOST_ROUNDS = 3600.0, 100_000.0, 10_000_000, 100
_OFFLINE = "offline"  # without ROS, its row of resim apart
_COMMAND_ENDS = 20  # characters of a command that the table shows at each end

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
    "p99.9 ms": ("p999_ms", ".3f"),
    "mean ms": ("mean_ms", ".3f"),
    "sd ms": ("sd_ms", ".3f"),
    "max ms": ("max_ms", ".3f"),
    "floor ms": ("floor_p50_ms", ".3f"),
    "ratio": ("ratio", ".2f"),
    "p99 ratio": ("ratio_p99", ".2f"),
    "hop ms": ("hop_p50_ms", ".3f"),
    "to hop": ("ratio_hop", ".2f"),
    "CPU %": ("gateway_cpu_percent", ".0f"),
    "CPU us": ("gateway_cpu_us_per_message", ".0f"),
    "RSS MB": ("gateway_rss_mb", ".0f"),
    "bounds": ("bounds", ""),
}
_LEFT_ALIGNED = frozenset({"case", "direction", "bounds"})
_PACKAGES = ("ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "numpy", "fastcrc", "mcap")


def run(options: argparse.Namespace) -> int:
    if options.list:
        for case in CASES.values():
            print_line(f"{case.name:<15} {case.text}")
        for name, work in WORKS.items():
            print_line(f"{name:<15} {work.text}")
        for name, sweep in SWEEPS.items():
            print_line(f"{f'--sweep {name}':<15} {sweep.text}")
        return 0
    offline_only = options.case == [_OFFLINE] and not (options.sweep or options.table1)
    options.programs = options.programs or (PYTHON if offline_only else _programs_here())
    groups, works = _selected(options)
    if not offline_only and importlib.util.find_spec("rclpy") is None:
        raise Unavailable(missing("rclpy"))
    # a measurement must neither receive from other robots nor disturb them
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    clock = SystemClock()
    ambient = _ambient(clock)
    ticks = _ticks()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="igtl-gateway-bench-") as folder:
        runner = Runner(Path(folder), clock, _print_status)
        for group in groups:
            rows += against_version_1(merge_rounds([_measured(runner, group) for _ in range(options.rounds)]))
        against = tuple(options.against)
        workshop = WorkContext(Path(folder), clock, _print_status, options.programs, against, options.duration)
        for name in works:
            rows += merge_rounds([WORKS[name].run(workshop) for _ in range(options.rounds)])
    rows = [with_verdict(row) for row in rows]
    lines = fit_lines(rows)
    ambient["load_after"] = _load()
    ambient["stolen_percent"] = _stolen_percent(ticks, _ticks())
    if options.plot:
        options.plot.mkdir(parents=True, exist_ok=True)
        for name, text in (latency_plots(rows) | sweep_plots(rows, lines)).items():
            (options.plot / name).write_text(text, "utf-8")
    if options.json:
        print_json({"rows": rows, **({"fits": lines} if lines else {}), "ambient": ambient})
    else:
        verbs = [row for row in rows if row["case"] == _OFFLINE]
        if verbs:
            print_text("".join(f"{line}\n" for line in offline.about(verbs)))  # Markdown: a row is one line
        print_line(*_table([row for row in rows if row not in verbs]), *_fitted(lines), "", *_ambient_text(ambient))
    return 0


@dataclass(frozen=True, slots=True)
class _Group:
    """What is measured in turns, to be compared, and what marks its rows."""

    plans: tuple[BenchPlan, ...]
    marks: Row = field(default_factory=dict)


def _measured(runner: Runner, group: _Group) -> list[Row]:
    """One round."""
    return with_costs([row | group.marks for plan in group.plans for row in runner.measure(plan)])


def _selected(options: argparse.Namespace) -> tuple[list[_Group], list[str]]:
    """What is to be measured: passages of messages, and other work.  Raises ConfigError."""
    names = list(dict.fromkeys([*options.case, *(TABLE_1 if options.table1 else ())]))
    if unknown := [name for name in names if name not in CASES and name not in WORKS]:
        raise ConfigError(f"--case: found {unknown[0]!r}, expected {one_of(unknown[0], [*CASES, *WORKS])}")
    if not names and not options.sweep:
        raise ConfigError(
            "found nothing to measure, expected --case NAME, --sweep or --table1 (--list shows the cases)"
        )
    for name, value, most in (
        ("--rate", options.rate, _MOST_HZ),
        ("--duration", options.duration, _MOST_S),
        ("--count", options.count, _MOST_COUNT),
        ("--rounds", options.rounds, _MOST_ROUNDS),
    ):
        if value is not None and not 0 < value <= most:
            raise ConfigError(f"{name}: found {value:g}, expected above 0 and at most {most:g}")
    for command in options.against:
        _check_command(command)
    directions = tuple(one for one in Direction if options.direction in (one.value, BOTH))
    extent = Extent(options.duration, options.count or (_TABLE_COUNT if options.table1 else 0))
    groups = [_group(_at_rate(CASES[name], options), directions, extent, options) for name in names if name in CASES]
    for name in options.sweep:
        plans = SWEEPS[name].plans(Extent(options.duration, options.count or 0), directions)
        if not plans:
            raise ConfigError(f"--direction: found {options.direction}, --sweep {name} goes the other way only")
        groups += [
            _Group((replace(plan, programs=options.programs),), {"sweep": name} | marks) for marks, plan in plans
        ]
    works = [name for name in names if name in WORKS]
    if options.flame:
        groups = _in_flames(groups, works, options)
    return groups, works


def _check_command(command: str) -> None:
    """Raises ConfigError for a command of another bridge that cannot be started."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"--against: found {command!r}, expected a command ({error})") from None
    if not any("{port}" in word for word in words):
        raise ConfigError(f"--against: found {command!r}, expected {{port}} in it")


def _group(case: Case, directions: tuple[Direction, ...], extent: Extent, options: argparse.Namespace) -> _Group:
    """One case, with what it is to be compared with."""
    ways = tuple(way for way in directions if way in case.ways)
    if not ways:
        raise ConfigError(f"--direction: found {options.direction}, {case.name} goes {case.ways[0].value} only")
    alone = case.stalls
    plan = BenchPlan(
        case,
        ways,
        extent,
        options.floor and not alone,
        hop=options.floor and not alone and options.programs == NATIVE,
        against=() if alone else tuple(options.against),
        programs=options.programs,
    )
    recording = replace(plan, record=True, floor=False, hop=False, against=())
    recorded = [recording] * (options.record or options.seal) + [replace(recording, seal=True)] * options.seal
    over = []
    if options.zenoh:
        same = replace(plan, programs=PYTHON, hop=False, against=())
        over = [*([same] if plan.programs != PYTHON else []), replace(same, zenoh=True)]
    slicer = [_from_slicer(one, options) for one in (plan, *recorded)] if options.peer else []
    return _Group((plan, *recorded, *slicer, *over, *(_with_peers(plan) if options.peers else ())))


def _from_slicer(plan: BenchPlan, options: argparse.Namespace) -> BenchPlan:
    """The same to ROS, as 3D Slicer sends it.  Raises ConfigError."""
    name = plan.case.name
    if name not in SLICER or Direction.IGTL_TO_ROS not in plan.directions:
        expected = f"a case of {', '.join(SLICER)}, to ROS"
        raise ConfigError(f"--peer {options.peer}: found {name} {plan.directions[0].value}, expected {expected}")
    case = _at_rate(CASES[SLICER[name]], options)
    return replace(plan, case=case, directions=case.ways, against=())


def _in_flames(groups: list[_Group], works: list[str], options: argparse.Namespace) -> list[_Group]:
    """The one measurement that there is, with a picture of it."""
    runs = sum(1 if plan.case.at_once else len(plan.directions) for group in groups for plan in group.plans)
    found = len(works) + runs * options.rounds
    if found != 1 or works:
        raise ConfigError(
            f"--flame: found {counted(found, 'measurement')}, expected one of messages: --case NAME --direction WAY"
        )
    if not flame.tool():
        raise ConfigError("--flame: found no py-spy on the path, it is needed: pip install py-spy")
    (group,) = groups
    return [_Group((replace(group.plans[0], hop=False, against=(), flame=options.flame.absolute()),), group.marks)]


def _programs_here() -> str:
    """The native measuring programs where they can be compiled."""
    reason = lacks_probe()
    if reason:
        _print_status(f"the measuring programs are those in Python: {reason}")
    return PYTHON if reason else NATIVE


def _with_peers(plan: BenchPlan) -> list[BenchPlan]:
    """Return the plan once for each available peer; print why the others are left out."""
    reasons = {peer: lacks(peer, plan.case) for peer in PEERS}
    for reason in filter(None, reasons.values()):
        _print_status(f"left out: {reason}")
    plan = replace(plan, floor=False, hop=False, against=())
    return [replace(plan, peer=peer) for peer, reason in reasons.items() if not reason]


def _at_rate(case: Case, options: argparse.Namespace) -> Case:
    if case.together and (options.rate or options.flood):
        raise ConfigError(f"--rate, --flood: {case.name} has rates of its own")
    if options.flood:
        return case.at(FLOOD)
    if options.rate or options.table1:
        return case.at(options.rate or _TABLE_HZ)
    return case


def _table(rows: list[Row]) -> list[str]:
    """The transmissions as a table, followed by remarks on single rows."""
    passages = [row for row in rows if row.get("direction")]
    lines = []
    if passages:
        cells = [list(_COLUMNS), *([_cell(row, *column) for column in _COLUMNS.values()] for row in passages)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines += [
            "  ".join(
                text.ljust(width) if column in _LEFT_ALIGNED else text.rjust(width)
                for column, text, width in zip(_COLUMNS, line, widths, strict=True)
            ).rstrip()
            for line in cells
        ]
    for row in rows:
        if row not in passages:
            values = ", ".join(
                f"{name.replace('_', ' ')} {_shown(value)}"
                for name, value in row.items()
                if name not in ("case", "rounds", "bounds")
            )
            lines.append(f"{row['case']}: {values}" + (f", bounds {shown(row)}" if "bounds" in row else ""))
        else:
            lines += [f"{_name(row)}, {row['direction']}: {text}" for text in _remarks(row)]
    return lines


def _remarks(row: Row) -> list[str]:
    """What has no column."""
    remarks = []
    if "recording_p50_ratio" in row:
        times = " and ".join(f"{name} {row[f'recording_{name}_ratio']} times" for name in ("p50", "p99"))
        remarks.append(f"{times} that without recording")
    if "sealing_p50_ratio" in row:
        times = " and ".join(f"{name} {row[f'sealing_{name}_ratio']} times" for name in ("p50", "p99"))
        remarks.append(f"{times} that without seals, {row['sealing_cpu_percent']} % of a core more")
    if "version_1_p50_ratio" in row:
        remarks.append(
            f"p50 {row['version_1_p50_ratio']} and CPU {row['version_1_cpu_ratio']} times those of header version 1"
        )
    for name, key in (("DDS", "floor_dds_per_s"), ("Zenoh", "floor_zenoh_per_s")):
        if key not in row:
            continue
        hop = f", with the hop between them {row['hop_per_s']:,.0f}/s" if row.get("hop_per_s") else ""
        bare = f"{row[key]:,.0f}/s ({name}) and {row['floor_tcp_per_s']:,.0f}/s (TCP)"
        remarks.append(f"bare hops {bare}{hop}")
    if "sent_after_resume" in row:
        after = f"{row['delivered_after_resume']:,} of {row['sent_after_resume']:,} sent after it read again"
        remarks.append(f"{after}, {row['gateway_dropped']:,} dropped by the gateway")
    return remarks


def _fitted(lines: list[dict[str, Any]]) -> list[str]:
    return [
        f"{line['sweep']}, {line['direction']}: {line['figure']} = {line['a']:g} + {line['b']:g} x, r2 {line['r2']}"
        for line in lines
    ]


def _cell(row: Row, field: str, form: str) -> str:
    if field == "case":
        return _name(row)
    if field == "rate_hz" and row[field] is None:
        return "flood"
    if field == "bounds":
        return shown(row)
    value = row.get("ratio_p50") if field == "ratio" and field not in row else row.get(field)
    return "" if value is None else format(value, form)


def _name(row: Row) -> str:
    clients = f"x{row['x']:g}" if row.get("sweep") == "clients" else ""
    marks = (
        row["case"],
        row.get("stream"),
        row.get("client"),
        clients,
        "+rec" if row.get("recording") else "",
        "+seal" if row.get("sealed") else "",
        row.get("peer"),
        _shortened(row.get("bridge", "")),
        "over Zenoh" if row.get("middleware") == "zenoh" else "",
        "(Python programs)" if row.get("programs") == PYTHON else "",
    )
    return " ".join(filter(None, marks))


def _shortened(command: str) -> str:
    """A long command without its middle: the ends are what differs."""
    most = 2 * _COMMAND_ENDS + 1
    return command if len(command) <= most else f"{command[:_COMMAND_ENDS]}…{command[-_COMMAND_ENDS:]}"


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


def _ticks() -> list[int]:
    """What all cores did since the start of the machine: user, nice, system, idle, wait, irq, softirq, stolen."""
    try:
        first = Path("/proc/stat").read_text("ascii").splitlines()[0]
    except (OSError, IndexError):
        return []
    return [int(word) for word in first.split()[1:9]]


def _stolen_percent(before: list[int], after: list[int]) -> float | None:
    """Of the time in which the cores had something to do: how long the neighbours of a virtual machine had them."""
    spent = [late - early for early, late in zip(before, after, strict=True)]
    busy = sum(spent[:3]) + sum(spent[5:]) if spent else 0
    return round(100 * spent[7] / busy, 1) if busy else None


def _ambient_text(ambient: dict[str, Any]) -> list[str]:
    packages = ", ".join(f"{name} {version}" for name, version in ambient["packages"].items())
    return [
        f"load {ambient['load'][0]} before, {ambient['load_after'][0]} after, on {counted(ambient['cores'], 'core')}"
        + (f"; neighbours took {stolen} % of the busy time" if (stolen := ambient["stolen_percent"]) else ""),
        f"igtl-gateway {ambient['igtl_gateway']}, Python {ambient['python']}, {packages}",
    ]


def _print_status(line: str) -> None:
    print_line(line, error=True, flush=True)

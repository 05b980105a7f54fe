"""The checks of a soak test, and their report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway_lab.bench.plot import to_svg
from tools.evidence.soak_findings import Check, Found, Sample, Settings
from tools.evidence.soak_guests import MANNERS, MOST_GUESTS

BACK = ("threads", "fds")
#: Between two parts the recorder has a file less.
_PARTS = 1
#: Of each stream something has to arrive that was sent in the last twentieth of the time.
_LAST = 0.95
#: The workers of rclpy's executor, each of which is started when it is first needed, and then stays.
WORKERS = 8
PROCESSES = ("gateway", "recorder")
_MEMORY = {"rss_mb": "memory (RSS)", "anon_mb": "private memory", "shared_mb": "shared memory"}


def trend(at_s: Sequence[float], values: Sequence[float], windows: int = 50) -> float:
    """How much a robust line grows from the first to the last time.

    The line goes through the minima of windows of time (a queue that is filled and emptied again is not growth), by
    Theil and Sen: its slope is the median of the slopes between all pairs.
    """
    times, found = np.asarray(at_s, float), np.asarray(values, float)
    edges = np.linspace(times[0], times[-1], windows + 1)
    number = np.clip(np.searchsorted(edges, times, "right") - 1, 0, windows - 1)
    least = [np.flatnonzero(number == one)[np.argmin(found[number == one])] for one in np.unique(number)]
    x, y = times[least], found[least]
    first, second = np.triu_indices(len(least), 1)
    if not len(first):
        raise ValueError(f"found {len(values)} samples, expected some more for a line")
    slope = float(np.median((y[second] - y[first]) / (x[second] - x[first])))
    return slope * float(times[-1] - times[0])


def judge(settings: Settings, found: Found) -> list[Check]:
    """Everything that has to be so."""
    checks = []

    def check(name: str, good: bool, text: str) -> None:
        checks.append(Check(name, bool(good), text))

    counted = [sample for sample in found.samples if sample["at_s"] >= settings.warm_s]
    at_s = [sample["at_s"] for sample in counted]
    for who in PROCESSES:
        for what in ("rss_mb", "anon_mb", "shared_mb"):
            memory = [sample[who][what] for sample in counted]
            growth = trend(at_s, memory)
            check(
                f"{_MEMORY[what]} of the {who} is flat",
                growth <= settings.growth_mb,
                f"the line grows by {growth:+.1f} MB in {at_s[-1] - at_s[0]:.0f} s (at most {settings.growth_mb:g}), "
                f"between {min(memory):.0f} and {max(memory):.0f} MB",
            )
        for what in BACK:
            before, after, more = found.baseline[who][what], found.end[who][what], spare(who, what)
            most = max(sample[who][what] for sample in found.samples)
            line = trend(at_s, [sample[who][what] for sample in counted])
            check(
                f"{what} of the {who} are flat, and return",
                after <= before + more and line <= more + MOST_GUESTS,
                f"{before} before the first short-lived peer, at most {most}, {after} after the last one; the line "
                f"grows by {line:+.2f}" + (f"; {more} more are accepted" if more else ""),
            )
    told = found.stopped["ledger"]
    open_ends = [*gaps(told), *told.get("gaps", ())]
    check("the ledger closes", not open_ends, "; ".join(open_ends) or "by stream, by peer and in total")
    recorded, entries = found.stopped["recording"], sum(found.stopped["counts"].values())
    check(
        "the recording is complete",
        not recorded["failure"] and not recorded["dropped"] and recorded["entries"] == entries,
        f"{recorded['entries']:,} of {entries:,} entries, {recorded['dropped']:,} dropped by the recorder"
        + (f": {recorded['failure']}" if recorded["failure"] else ""),
    )
    good = [part for part in found.parts if part["good"] and not part["code"]]
    verified = sum(part["inputs"] + part["outputs"] for part in good)
    numbers = {what: sum(part[what] for part in good) for what in ("equal", "lost", "missing", "orphans", "late")}
    check(
        "the recording verifies",
        len(good) == len(found.parts) and verified == recorded["entries"],
        f"{len(good)} of {len(found.parts)} parts, {verified:,} entries; "
        f"outputs equal {numbers.pop('equal'):,}, {numbers}",
    )
    check(
        "every stream arrives to the end",
        all(row["last"] > _LAST for row in found.passages),
        ", ".join(f"{row['stream']} {row['direction']} {row['delivered']:,}/{row['sent']:,}" for row in found.passages),
    )
    manners = {name.split(",")[0] for name in found.guests}
    expected = {*MANNERS, "ROS node"}
    check("short-lived peers of all kinds connected", manners >= expected, f"{sum(found.guests.values()):,}")
    check("no other failure", not found.failures, "; ".join(found.failures) or "none")
    return checks


def spare(who: str, what: str) -> int:
    """Accepted growth over the number before the first short-lived peer."""
    return {("gateway", "threads"): WORKERS, ("recorder", "fds"): _PARTS}.get((who, what), 0)


def report(settings: Settings, found: Found, checks: Sequence[Check]) -> dict[str, Any]:
    """All of it, for programs."""
    streams_told = found.stopped["ledger"].get("streams", {})
    dropped: Counter[str] = Counter()
    for direction, books in streams_told.items():
        for fates in books.values():
            for reason, number in fates.get("dropped", {}).items():
                dropped[f"{direction} {reason}"] += number
    return {
        "good": all(check.good for check in checks),
        "settings": {name: str(value) if name == "folder" else value for name, value in asdict(settings).items()},
        "checks": [asdict(check) for check in checks],
        "passages": found.passages,
        "guests": dict(sorted(found.guests.items())),
        "notes": dict(sorted(found.notes.items())),
        "dropped": dict(sorted(dropped.items())),
        "counts": found.stopped["counts"],
        "recording": {name: value for name, value in found.stopped["recording"].items() if name != "files"},
        "parts": found.parts,
        "baseline": found.baseline,
        "end": found.end,
        "samples": found.samples,
        "ledger": found.stopped["ledger"],
    }


_PANELS: tuple[tuple[str, str, Callable[[Sample], float]], ...] = (
    ("RSS of the gateway, MB", "#1f77b4", lambda sample: float(sample["gateway"]["rss_mb"])),
    ("of this its own, MB", "#1f77b4", lambda sample: float(sample["gateway"]["anon_mb"])),
    ("RSS of the recorder, MB", "#2ca02c", lambda sample: float(sample["recorder"]["rss_mb"])),
    ("threads of the gateway", "#d62728", lambda sample: float(sample["gateway"]["threads"])),
    ("file descriptors of the gateway", "#9467bd", lambda sample: float(sample["gateway"]["fds"])),
    ("waiting in queues to peers, MB", "#8c564b", lambda sample: float(sample["queued_mb"])),
    ("waiting in the recorder's queue, MB", "#7f7f7f", lambda sample: float(sample["recorder_queued_mb"])),
)


def picture(samples: Sequence[Sample], seconds: float, title: str) -> str:
    """An SVG with one panel for each figure, over time in minutes."""
    from matplotlib.figure import Figure

    figure = Figure((9.0, 1.2 * len(_PANELS)), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    minutes = [float(sample["at_s"]) / 60 for sample in samples]
    for axes, (name, colour, of) in zip(figure.subplots(len(_PANELS), sharex=True), _PANELS, strict=True):
        values = [of(sample) for sample in samples]
        axes.plot(minutes, values, color=colour, linewidth=0.8)
        axes.set_title(f"{name}: {min(values):g} to {max(values):g}", loc="left", fontsize=9)
        axes.set_xlim(0, seconds / 60)
        axes.set_ylim(0, max(*values, 1.0) * 1.05)
    axes.set_xlabel("minutes")
    return to_svg(figure)


def words(told: dict[str, Any]) -> list[str]:
    """The same for people."""
    lines = [f"{'ok  ' if check['good'] else 'BAD '} {check['name']}: {check['text']}" for check in told["checks"]]
    lines.append("stream        direction     sent       arrived    p50 ms    p99 ms")
    for row in told["passages"]:
        lines.append(
            f"{row['stream']:<13} {row['direction']:<12} {row['sent']:>10,} {row['delivered']:>10,} "
            f"{row['p50_ms'] or 0:9.2f} {row['p99_ms'] or 0:9.1f}"
        )
    for name in ("guests", "notes", "dropped", "counts", "recording"):
        lines.append(f"{name}: {', '.join(f'{key} {value}' for key, value in told[name].items()) or 'none'}")
    return lines

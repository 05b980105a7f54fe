"""The run of many worlds, its table, and the page ``docs/evidence/truth.md``."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tools.truth.conditions import CONDITIONS, plan_of
from tools.truth.files import make
from tools.truth.judges.truth import Truth, is_stated
from tools.truth.routes import ROUTES, Case

RIGHT, REFUSED, STATED, SILENT = "right", "refused", "stated", "SILENT"
VERDICTS = (RIGHT, REFUSED, STATED, SILENT)
_ROOT = Path(__file__).parents[2]
PAGE = _ROOT / "docs" / "evidence" / "truth.md"


@dataclass
class Verdict:
    """What a route made of a world.

    Attributes:
        seed, conditions, route: which.
        verdict: one of ``VERDICTS``.
        samples: compared.
        lines: the faults that nothing stated, or that were stated, or the reason of a refusal.
    """

    seed: int
    conditions: tuple[str, ...]
    route: str
    verdict: str
    samples: int = 0
    lines: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def command(self) -> str:
        """How to have it again."""
        return (
            f"python -m tools.truth --seed {self.seed} --worlds 1 --route {self.route} # {', '.join(self.conditions)}"
        )


def judge(case: Case, name: str) -> Verdict:
    """Take one route of one world."""
    plan, started = case.plan, time.perf_counter()
    verdict = Verdict(plan.seed, plan.conditions, name, RIGHT)
    try:
        result = ROUTES[name].run(case)
    except Exception:
        verdict.verdict = SILENT
        verdict.lines = [f"raises {traceback.format_exc().strip().splitlines()[-1]}", traceback.format_exc()]
        return verdict
    finally:
        verdict.seconds = time.perf_counter() - started
    text = "\n".join((result.text, case.recording.stated, case.recording.refused))
    findings = result.findings
    verdict.samples = findings.samples
    unsaid = [one for one in findings.faults if not is_stated(one, text)]
    if unsaid:
        verdict.verdict, verdict.lines = SILENT, [f"{one.kind}: {one.text}" for one in unsaid]
    elif findings.faults:
        verdict.verdict, verdict.lines = STATED, [f"{one.kind}: {one.text}" for one in findings.faults]
    elif not findings.samples:
        verdict.verdict = REFUSED if result.code else SILENT
        verdict.lines = [result.text.strip()[-300:] or "no reason"]
        if result.code and not result.text.strip():
            verdict.verdict = SILENT
    return verdict


def world(seed: int, routes: Sequence[str], conditions: Sequence[str] | None = None) -> list[Verdict]:
    """Make a world, and take its routes."""
    plan = plan_of(seed, conditions)
    with tempfile.TemporaryDirectory(prefix="truth-") as folder:
        recording = make(plan, Path(folder))
        case = Case(plan, recording, Truth(plan, recording), Path(folder))
        return [judge(case, name) for name in routes]


def routes_of(seed: int, asked: Sequence[str]) -> list[str]:
    """The routes of a world: of those that are alike or cost much, it takes one in turn."""
    return list(asked) or [name for name, route in ROUTES.items() if (seed + route.turn) % route.every == 0]


def run(
    seeds: Iterable[int], asked: Sequence[str], conditions: Sequence[str] | None, workers: int
) -> Iterator[Verdict]:
    """All verdicts of some worlds, in their order."""
    jobs = [(seed, routes_of(seed, asked), conditions) for seed in seeds]
    if workers < 2:
        for job in jobs:
            yield from world(*job)
        return
    pool = ProcessPoolExecutor(workers)
    try:
        for found in pool.map(world, *zip(*jobs, strict=True)):
            yield from found
    finally:
        pool.shutdown(cancel_futures=True)


def summed(verdicts: Iterable[Verdict]) -> dict[str, Counter[str]]:
    """Verdicts and samples of each route."""
    found: dict[str, Counter[str]] = {}
    for one in verdicts:
        counts = found.setdefault(one.route, Counter())
        counts[one.verdict] += 1
        counts["samples"] += one.samples
    return found


def table(counts: dict[str, Counter[str]]) -> str:
    """The table of a run, in Markdown."""
    lines = ["| route | judged by | within | worlds | samples | right | refused | stated | SILENT |"]
    lines.append("|---|---|---|---|---|---|---|---|---|")
    total: Counter[str] = Counter()
    for name, route in ROUTES.items():
        if name not in counts:
            continue
        row = counts[name]
        total.update(row)
        worlds = sum(row[each] for each in VERDICTS)
        numbers = " | ".join(f"{row[each]:,}" for each in VERDICTS)
        lines.append(f"| {name} | {route.reader} | {route.tolerance} | {worlds:,} | {row['samples']:,} | {numbers} |")
    numbers = " | ".join(f"{total[each]:,}" for each in VERDICTS)
    checks = sum(total[each] for each in VERDICTS)
    lines.append(f"| **all** | | | {checks:,} | {total['samples']:,} | {numbers} |")
    return "\n".join(lines)


def conditions_table(verdicts: Iterable[Verdict]) -> str:
    """The verdicts of all worlds that have a condition, in Markdown."""
    found: dict[str, Counter[str]] = {name: Counter() for name in CONDITIONS}
    meaning = {name: (change.__doc__ or "").strip().rstrip(".") for name, change in CONDITIONS.items()}
    for one in verdicts:
        for name in one.conditions:
            found[name][one.verdict] += 1
    lines = ["| condition | | right | refused | stated | SILENT |", "|---|---|---|---|---|---|"]
    for name, counts in found.items():
        numbers = " | ".join(f"{counts[each]:,}" for each in VERDICTS)
        lines.append(f"| `{name}` | {meaning[name]} | {numbers} |")
    return "\n".join(lines)


def write_page(text: str) -> None:
    """Put a run between the marks of the page."""
    begin, end = "<!-- measured by tools/truth -->\n", "<!-- end of tools/truth -->"
    before, _, rest = PAGE.read_text().partition(begin)
    PAGE.write_text(before + begin + "\n" + text + "\n\n" + end + rest.partition(end)[2])


def main(argv: Sequence[str] | None = None) -> int:
    """Run worlds; exit code 1 if something is silent."""
    parser = argparse.ArgumentParser(prog="python -m tools.truth", description=__doc__)
    parser.add_argument("--worlds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1, help="of the first world")
    parser.add_argument("--route", action="append", default=[], choices=list(ROUTES))
    parser.add_argument("--conditions", help="names with commas, instead of those of the seed; empty: none")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=0, help="end after this time with the worlds that are done")
    parser.add_argument("--verbose", action="store_true", help="what was stated and refused, too")
    parser.add_argument("--write", action="store_true", help="write the table to docs/evidence/truth.md")
    options = parser.parse_args(argv)
    conditions = None if options.conditions is None else [one for one in options.conditions.split(",") if one]
    for name in conditions or ():
        if name not in CONDITIONS:
            parser.error(f"found condition {name!r}, expected one of {', '.join(CONDITIONS)}")
    started = time.monotonic()
    verdicts: list[Verdict] = []
    for one in run(range(options.seed, options.seed + options.worlds), options.route, conditions, options.workers):
        if options.seconds and time.monotonic() - started > options.seconds and one.seed != verdicts[-1].seed:
            break
        verdicts.append(one)
        if one.verdict == SILENT or options.verbose:
            print(f"{one.verdict} {one.command}")
            for text in one.lines[:6]:
                print(f"    {text}")
            sys.stdout.flush()
    counts = summed(verdicts)
    print(table(counts))
    seconds, worlds = time.monotonic() - started, len({one.seed for one in verdicts})
    print(f"{worlds:,} worlds from seed {options.seed} in {seconds:.0f} s")
    if options.write:
        commit = subprocess.check_output(["git", "rev-parse", "--short=8", "HEAD"], cwd=_ROOT, text=True)
        write_page(
            f"{worlds:,} worlds from seed {options.seed} on commit {commit.strip()}, "
            f"{options.workers} at a time, {seconds:,.0f} s.\n\n{table(counts)}\n\n{conditions_table(verdicts)}"
        )
    return int(any(one.verdict == SILENT for one in verdicts))

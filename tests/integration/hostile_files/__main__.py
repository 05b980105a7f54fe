"""Run the table and write ``docs/evidence/hostile-files.md`` again: ``python -m tests.integration.hostile_files``.

``--tree`` runs the command line of another checkout, whose counts stand on the page as those of before; ``--sort`` runs
files of some sorts, whose counts stand beside those of the last run of all.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from igtl_gateway.cli.terminal import print_line
from tests.integration.hostile_files.case import VERBS
from tests.integration.hostile_files.page import RESULTS, answers, results, write
from tests.integration.hostile_files.table import CASES, Outcome, outcomes, summary
from tests.places import ROOT


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tree", type=Path, default=ROOT, help="run the command line of this checkout")
    parser.add_argument("--only", default="", help="files whose name begins so; nothing is written")
    parser.add_argument("--sort", action="append", choices=VERBS, help="only files of this sort; may be repeated")
    parser.add_argument(
        "--verbs", type=int, help="run the first verb of each sort and N others, round-robin (default: all)"
    )
    parser.add_argument("--page", action="store_true", help="only write the page of the results that are there")
    options = parser.parse_args()
    if options.page:
        write(results())
        return 0
    found: list[Outcome] = []
    sorts = options.sort or VERBS
    cases = [case for case in CASES if case.name.startswith(options.only) and case.sort in sorts]
    for outcome in outcomes(cases, options.tree, patient=options.tree == ROOT, verbs=options.verbs):
        found.append(outcome)
        if outcome.faults:
            cost = f"{outcome.seconds:5.1f} s {outcome.peak_mb:6.0f} MB  {outcome.why[:120]!r}"
            print_line(f"{outcome.name:<28} {outcome.verb[:40]:<40} {', '.join(outcome.faults):<20} {cost}", flush=True)
    counts = summary(found)
    print_line(json.dumps(counts))
    if options.only:
        return int(bool(counts["files with a fault"]))
    commit = subprocess.run(
        ["git", "-C", str(options.tree), "log", "-1", "--format=%h"], capture_output=True, text=True, check=True
    ).stdout.strip()
    told = results() if RESULTS.exists() else {}
    which = "before" if options.tree != ROOT else "added" if options.sort else "now"
    told[which] = {"tree": f"`{commit}`" + "".join(f", {sort}" for sort in options.sort or ()), **counts}
    if which == "now":
        told.pop("added", None)
    if options.tree == ROOT:
        told["answers"] = (told["answers"] if options.sort else {}) | answers(found)
    RESULTS.write_text(json.dumps(told, indent=0, ensure_ascii=False, sort_keys=True) + "\n", "utf-8")
    write(told)
    return int(bool(counts["files with a fault"]))


if __name__ == "__main__":
    sys.exit(main())

"""The table of offline verbs of docs/evidence/performance.md: one command, one commit, one machine, one day.

.venv/bin/python -m tools.evidence.offline_table [--duration 300] [--rounds 3]     measure, and write the page
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

from tools.core import ROOT

PAGE = ROOT / "docs" / "evidence" / "performance.md"
BEGIN, END = "<!-- measured by igtl-gateway: bench --case offline -->\n", "<!-- end of igtl-gateway -->\n"


def with_table(page: str, measured: str, stated: str) -> str:
    """Return the page with what was measured, and how, in place of what is there."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    table, _, ambient = measured.strip().partition("\n\n")
    return f"{before}{BEGIN}\n{stated}\n{ambient}\n\n{table}\n\n{END}{after}"


def main() -> int:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", default="300", help="seconds of the recordings")
    parser.add_argument("--rounds", default="3")
    options = parser.parse_args()
    words = ["bench", "--case", "offline", "--duration", options.duration, "--rounds", options.rounds]
    measured = subprocess.run(
        [sys.executable, "-m", "igtl_gateway", *words], check=True, stdout=subprocess.PIPE, text=True
    )
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout.strip()
    day = time.strftime("%Y-%m-%d", time.gmtime())
    stated = f"`igtl-gateway {' '.join(words)}` at {commit}, {day};"
    PAGE.write_text(with_table(PAGE.read_text("utf-8"), measured.stdout, stated), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

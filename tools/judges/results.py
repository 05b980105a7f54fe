"""Results of real programs with the gateway: a file of JSON lines for each program, and the page of all of them.

Strategy: a judge compares, message by message, and reports "exact", how it differs and whose fault that is, or that
it failed.  Date, commit and load stand in the first line of the file.  ``tools/docs.py`` makes the page from the files.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "evidence" / "real-programs"
#: The last one: the program has no means to send or receive it.
EXACT, DIFFERS, FAILS, CANNOT = "exact", "differs", "fails", "cannot"
TO_ROS, TO_IGTL, BOTH = "to ROS", "to OpenIGTLink", "both"


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that was compared.

    Attributes:
        what: a message type, or what was done.
        direction: one of the directions above, seen from the gateway.
        result: one of the results above.
        cases: the number of messages that were compared.
        text: how it differs or fails, and whose fault it is.
    """

    what: str
    direction: str
    result: str
    cases: int = 1
    text: str = ""


def summed(rows: Iterable[Row]) -> list[Row]:
    """One row for all exact rows of a thing and direction; every other row stays."""
    exact: dict[tuple[str, str], Row] = {}
    others = []
    for row in rows:
        key = (row.what, row.direction)
        if row.result != EXACT or row.text:
            others.append(row)
        else:
            before = exact.get(key)
            exact[key] = Row(*key, EXACT, row.cases + (before.cases if before else 0))
    return [*exact.values(), *others]


def commit() -> str:
    """The commit of the work tree, with a plus sign if files differ from it."""
    name = _git("rev-parse", "--short=10", "HEAD")
    return name + "+" * bool(_git("status", "--porcelain", "--untracked-files=no", "--", "igtl_gateway"))


def write(judge: str, program: str, version: str, role: str, rows: Sequence[Row], folder: Path = FOLDER) -> int:
    """Write the file of a judge and print its rows; 1 if one of them differs or fails."""
    head: dict[str, Any] = {"program": program, "version": version, "role": role}
    head |= {"date": time.strftime("%Y-%m-%d", time.gmtime()), "commit": commit(), "load": round(os.getloadavg()[0], 1)}
    lines = [head, *map(asdict, rows)]
    folder.mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
    (folder / f"{judge}.jsonl").write_text(text, "utf-8")
    for line in lines:
        print(*line.values(), sep=" | ")
    return int(any(row.result in (DIFFERS, FAILS) for row in rows))


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

"""The page of the real programs, from the files that their judges wrote; ``tools/docs.py`` calls it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from tools.judges.results import CANNOT, DIFFERS, EXACT, FAILS, FOLDER

Json = dict[str, Any]
RESULTS = (EXACT, DIFFERS, FAILS, CANNOT)
MARK = "<!-- measured by tools/judges, written by tools/docs.py -->"
INTRODUCTION = """
Programs of others, run against the gateway, and what each message became. A judge in `tools/judges` starts
a bridge and the program, compares message by message, and writes `docs/evidence/real-programs/NAME.jsonl`; nothing is
adjusted afterwards. *exact*: each field as the table of conversions has it, or all that the program prints.
*differs*: how, and whose fault it is. *cannot*: the program has no means to send it. The number in brackets is that of
the messages. A plus behind a commit: with changes that were not committed. The judges are not a part of the gate: they
need the program.
"""


def page(folder: Path = FOLDER) -> str:
    programs = [_read(path) for path in sorted(folder.glob("*.jsonl"))]
    parts = ["# Real programs", MARK, INTRODUCTION.strip(), _overview(programs)]
    return "\n\n".join([*parts, *(_program(*each) for each in programs)])


def _read(path: Path) -> tuple[Json, list[Json]]:
    head, *rows = map(json.loads, path.read_text("utf-8").splitlines())
    return head, rows


def _table(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *([cell.replace("|", r"\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _overview(programs: list[tuple[Json, list[Json]]]) -> str:
    lines = []
    for head, rows in programs:
        counts: Counter[str] = Counter()
        for row in rows:
            counts[row["result"]] += row["cases"]
        facts = [head[key] for key in ("program", "version", "role")]
        run = [head["date"], f"`{head['commit']}`", str(head["load"])]
        lines.append([*facts, *(str(counts[result]) for result in RESULTS), *run])
    return _table(["program", "version", "role", *RESULTS, "run", "commit", "load"], lines)


def _program(head: Json, rows: list[Json]) -> str:
    cells: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    directions = sorted({row["direction"] for row in rows}, reverse=True)
    for row in rows:
        text = f"{row['result']} ({row['cases']})" + (f": {row['text']}" if row["text"] else "")
        if text not in cells[row["what"]][row["direction"]]:
            cells[row["what"]][row["direction"]].append(text)
    lines = [[what, *("; ".join(of[each]) for each in directions)] for what, of in cells.items()]
    return f"## {head['program']}\n\n" + _table(["message", *directions], lines)

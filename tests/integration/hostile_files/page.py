"""The generated part of ``docs/evidence/hostile-files.md``: results, limits, and a row for each file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from igtl_gateway.untrusted.limits import MEANINGS, FileLimits
from tests.integration.hostile_files.case import ROOT, VERBS, Hostile
from tests.integration.hostile_files.table import CASES, FAULTS, Outcome

PAGE = ROOT / "docs" / "evidence" / "hostile-files.md"
RESULTS = Path(__file__).with_name("results.json")
#: Mark before the tables of the page.
MARK = "<!-- from tests/integration/hostile_files -->\n"

_WIDEST = 110


def results() -> dict[str, Any]:
    """``{"before": counts, "now": counts, "answers": {name: [exit code, text]}}``"""
    told: dict[str, Any] = json.loads(RESULTS.read_text("utf-8"))
    return told


def answers(found: Iterable[Outcome]) -> dict[str, tuple[object, str]]:
    """Name → exit code and first line of the output of the first verb of the sort."""
    first: dict[str, tuple[object, str]] = {}
    for outcome in found:
        text = outcome.answer if outcome.code else ""
        first.setdefault(outcome.name, (outcome.code, text if len(text) <= _WIDEST else f"{text[:_WIDEST]}…"))
    return first


def page(told: Mapping[str, Any]) -> str:
    """The tables of the page."""
    columns = [entry for entry in ("before", "now") if entry in told]
    lines = ["## Results", "", f"| | {' | '.join(str(told[entry]['tree']) for entry in columns)} |"]
    lines.append("| --- |" + " ---: |" * len(columns))
    keys = [
        "files",
        "runs",
        "files with a fault",
        *(f"{fault}, {what}" for fault in FAULTS for what in ("files", "runs")),
    ]
    lines += [f"| {key} | {' | '.join(f'{told[entry][key]:,}' for entry in columns)} |" for key in keys]
    lines += ["", "## Limits", "", "| `--limit` | default | meaning |", "| --- | ---: | --- |"]
    usual = FileLimits()
    lines += [
        f"| `{each.name}` | {getattr(usual, each.name):,} | {MEANINGS[each.name]} |" for each in fields(FileLimits)
    ]
    lines += ["", "## Verbs", "", "| sort of file | verbs |", "| --- | --- |"]
    lines += [f"| {sort} | {', '.join(f'`{verb}`' for verb in verbs)} |" for sort, verbs in VERBS.items()]
    lines += [
        "",
        "## Files",
        "",
        "Result: of the first verb of its sort; exit code, and the message if it is not 0.",
    ]
    for sort in VERBS:
        rows = [case for case in CASES if case.sort == sort]
        lines += [
            "",
            f"### {sort[0].upper()}{sort[1:]}",
            "",
            "| file | danger | content | result |",
            "| --- | --- | --- | --- |",
        ]
        lines += [_row(case, told["answers"].get(case.name, ("?", ""))) for case in rows]
    return "\n".join(lines) + "\n"


def _row(case: Hostile, answer: tuple[object, str]) -> str:
    code, text = answer
    return f"| {case.name} | {case.danger.value} | {_cell(case.what)} | {code}{': ' + _quoted(text) if text else ''} |"


def _cell(text: str) -> str:
    """Untrusted text in a table of Markdown: without markup."""
    return "".join(f"\\{char}" if char in "\\|*_<>[]#&" else char for char in text.replace("`", "'"))


def _quoted(text: str) -> str:
    """Output of a program in a table of Markdown."""
    return "`" + text.replace("`", "'").replace("|", "\\|") + "`"


def write(told: Mapping[str, Any]) -> None:
    """Write the page again, below its mark."""
    before = PAGE.read_text("utf-8").partition(MARK)[0]
    PAGE.write_text(before + MARK + page(told), "utf-8")

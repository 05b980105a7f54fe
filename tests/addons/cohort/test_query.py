"""Questions to tables that hold foreign text, and the page of their answers."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("duckdb", reason='needs DuckDB: pip install "igtl-gateway[cohort]"')
pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')

from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.query import asking
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.base.untrusted.limits import limits_in_force, parse_limits
from igtl_gateway.cli import main

HOSTILE = "</td><script>alert(1)</script>\x1b[31m'; DROP TABLE tasks; --"


def task(number: int, verb: str, status: str = "ok", error: str = "") -> dict[str, Any]:
    return {"task": f"{verb}{number}", "file": f"{number}{HOSTILE}", "verb": verb, "status": status, "error": error}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions that have a review, one of them is broken for `verify`; every text is hostile."""
    folder = tmp_path_factory.mktemp("cohort") / "out"
    results = Results(folder)
    with results.locked():
        results.add({"tasks": [task(1, "review", "failed", HOSTILE)]}, {"verb": "review"})
        name = {"task": "review1", "file": f"1{HOSTILE}"}
        plans = [
            name | {"plan": plan, "is_first": plan == 1, "is_last": plan == 2, "number": number, "level": "ok"}
            | {"entry_noise_mm": 0.05 * number, "exit_noise_mm": 0.22, "corrected": None if plan == 1 else number == 1}
            for plan in (1, 2)
            for number in (1, 2, 5)
        ]  # fmt: skip
        rows = {
            "tasks": [task(1, "review"), task(1, "verify", "broken", HOSTILE), task(1, "info"), task(2, "lint")],
            "recordings": [{"task": "info1", "file": f"1{HOSTILE}", "start": 1_767_225_600_123_456_789, "entries": 7}],
            "reviews": [name | {"plans": 2, "stitches": 3, "corrected": 1, "wrong_first": 1, "wrong_last": 0}],
            "stitches": plans,
            "findings": [
                {"task": "lint2", "file": f"2{HOSTILE}", "rule": "IGTL-W301", "title": HOSTILE, "severity": "warning"},
                {"task": "gone", "file": f"2{HOSTILE}", "rule": "IGTL-E101", "severity": "error"},
            ],
            "latencies": [
                {"task": "lint2", "file": "2", "host": HOSTILE, "least_ms": 1.0, "jitter_ms": 0.5, "spread_ms": 9.0}
                | {"messages": 3}
            ],
        }
        results.add(rows, {"verb": "all"})
    return folder


def test_views_have_the_rows_that_count(out: Path) -> None:
    with asking(out) as questions:
        sessions = questions.rows("SELECT file, review, verify, entries, start FROM sessions ORDER BY file")
        assert [tuple(row.values())[1:] for row in sessions] == [
            ("ok", "broken", 7, "2026-01-01 00:00:00.123456789Z"),
            (None, None, None, None),
        ]
        assert questions.rows("SELECT rule FROM findings") == [{"rule": "IGTL-W301"}]
        assert questions.rows("SELECT 1 AS a, 2 AS a") == [{"a": 1, "a:2": 2}]


WRONG = (
    "",
    "SELECT",
    "DROP TABLE tasks",
    "SELECT 1; SELECT 2",
    "COPY tasks TO 'x.csv'",
    "SELECT * FROM read_csv('/etc/passwd')",
    "SELECT * FROM '/etc/passwd'",
    "ATTACH 'x.db'",
    "SET enable_external_access = true",
    "INSTALL httpfs",
    "SELECT nothing FROM tasks",
)


def test_questions_only_read_the_tables(out: Path) -> None:
    with asking(out) as questions:
        for sql in WRONG:
            with pytest.raises(ConfigError, match="query: "):
                questions.answer(sql)
        assert questions.rows("SELECT count(*) AS n FROM tasks") == [{"n": 4}]


def test_sql_takes_all_names_without_quotes(out: Path) -> None:
    with asking(out) as questions:
        for name, columns in TABLES.items():
            for column in columns:
                questions.rows(f"SELECT {column} FROM {name} WHERE {column} IS NOT NULL ORDER BY {column}")
        for old, new, of in (("end", "end_time", "marks"), ("foreign", "is_foreign", "recordings")):
            for sql in (f"SELECT {old} FROM {of}", f'SELECT "{old}" FROM {of}', f"SELECT m.{old} FROM {of} m"):
                with pytest.raises(ConfigError, match=f"; the column is {new}$"):
                    questions.rows(sql)


def test_answers_as_table_json_csv_and_parquet(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    question = ["cohort", "query", "SELECT file, error, 0.5 AS x FROM tasks WHERE verb = 'verify'", "-o", str(out)]
    assert main(question) == 0
    printed = capsys.readouterr().out
    assert "\\x1b[31m" in printed
    assert "\x1b" not in printed
    assert main([*question, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == [{"file": f"1{HOSTILE}", "error": HOSTILE, "x": 0.5}]
    for kind in ("csv", "parquet"):
        target = tmp_path / f"answer.{kind}"
        assert main([*question, f"--{kind}", str(target)]) == 0
        assert target.stat().st_size > 50
        assert main([*question, f"--{kind}", str(target)]) == 2
    assert main(["cohort", "query", "SELECT 1", "-o", str(tmp_path / "nothing")]) == 2
    assert "found no cohort.json" in capsys.readouterr().err


def test_the_report_escapes_all_foreign_text(out: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    assert main(["cohort", "report", "-o", str(out), "--html", str(page)]) == 0
    text = page.read_text("utf-8")
    assert "<script" not in text
    assert "\x1b" not in text
    assert text.count("&lt;script&gt;") >= 4
    assert "of 3 stitches of the last versions, 1 was corrected" in text
    assert "http" not in text  # nothing is loaded from elsewhere
    assert ">50%<div" in text  # of the two stitches with 0.22 mm, one was corrected


def test_an_empty_cohort_has_a_report(tmp_path: Path) -> None:
    results = Results(tmp_path / "out")
    with results.locked():
        results.add({"tasks": [task(1, "info", "timeout")]}, {})
    page = tmp_path / "report.html"
    assert main(["cohort", "report", "-o", str(tmp_path / "out"), "--html", str(page)]) == 0
    text = page.read_text("utf-8")
    assert "<p>1 file.</p>" in text
    titles = re.findall("<h2>(.*?)</h2>", text)
    assert titles == ["Sessions", "Files without a result", "Not on this page"], "no heading stands over nothing"
    assert "Not asked yet: lint, verify, review, sync" in text


def test_a_report_compares_only_what_differs(tmp_path: Path) -> None:
    results = Results(tmp_path / "out")
    names = ("10.mcap", "9.mcap", "b.mcap", "A.mcap")
    with results.locked():
        rows = {
            "tasks": [task(0, "lint") | {"task": name, "file": name} for name in names]
            + [task(0, "info", "broken", "cut off") | {"task": f"i{name}", "file": name} for name in names],
            "latencies": [
                {"task": name, "file": name, "host": name, "messages": 3, "least_ms": 1.0, "jitter_ms": 0.0}
                | {"spread_ms": 2e-7 * number}
                for number, name in enumerate(names)
            ],
        }
        results.add(rows, {})
    page = tmp_path / "report.html"
    assert main(["cohort", "report", "-o", str(tmp_path / "out"), "--html", str(page)]) == 0
    text = page.read_text("utf-8")
    assert 'class="bars"' not in text, "spreads of less than a microsecond are no bars"
    assert "0.0000" not in text
    assert text.count("&lt; 0.001") == 3
    titles = re.findall("<h2>(.*?)</h2>", text)
    assert titles == [
        "Sessions",
        "Files without a result",
        "What lint finds most",
        "Latency by peer",
        "Not on this page",
    ]
    ordered = ["9.mcap", "10.mcap", "A.mcap", "b.mcap"]
    assert re.findall(r'<td class="long">([^<]*mcap)</td>', text) == ordered * 2


@pytest.mark.parametrize(
    ("sql", "words", "text"),
    [
        ("SELECT " + "(" * 40_000 + "1" + ")" * 40_000, (), "characters, expected at most 65,536"),
        ("SELECT " + ",".join(["1"] * 2000), (), "found 2,000 columns"),
        ("SELECT * FROM range(5000)", ("count=100",), "expected at most 100"),
        ("SELECT list(range) FROM range(100000000)", ("memory=20000000",), "--limit memory="),
        (
            "SELECT count(*) FROM range(9000000000) a, range(9000000) b WHERE a.range % 7 = b.range",
            ("seconds=1",),
            "1 s",
        ),
    ],
)
def test_a_question_is_bounded(tmp_path: Path, sql: str, words: tuple[str, ...], text: str) -> None:
    results = Results(tmp_path)
    with results.locked():
        results.add({"tasks": [{"task": "a", "file": "a", "verb": "info", "status": "ok"}]}, {})
    with limits_in_force(parse_limits(list(words))), asking(tmp_path) as questions:
        with pytest.raises(GatewayError, match=text) as error:
            questions.answer(sql)
        assert "\n" not in str(error.value)
        assert questions.answer("SELECT 1 AS a").rows == [{"a": 1}]  # and goes on

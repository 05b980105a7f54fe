"""DuckDB reads the tables: the rows that count, whatever the folder is called and a run does to it meanwhile."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("duckdb", reason='needs DuckDB: pip install "igtl-gateway[cohort]"')
pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')

import pyarrow
import pyarrow.parquet

from igtl_gateway.addons.cohort import loading, parts
from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.query import asking, of_table
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.base.errors import ConfigError, GatewayError

#: Globs, quotes, what looks like a partition by a column, bytes that are not UTF-8.
ODD = os.fsdecode(b"file=x'[1]*?\xff\n; --")
START_NS = 1_767_225_600_123_456_789


def filled(folder: Path, count: int = 7) -> Results:
    """Parts with two files each, of which those of the first file replace each other; names in no order."""
    results = Results(folder)
    with results.locked():
        for number in range(count):
            files = (("a\u202e'", f"t{number}"), (f"{9 - number}", f"s{number}"))
            name = [{"task": task, "file": file} for file, task in files]
            rows: dict[str, list[dict[str, Any]]] = {
                "tasks": [each | {"verb": "info", "status": "ok", "seconds": number / 3} for each in name],
                "recordings": [each | {"start": START_NS + number * 1000, "entries": number} for each in name],
                "latencies": [each | {"host": f"ä{row}", "link": row} for each in name for row in (2, 1, 3)],
            }
            results.add(rows, {"verb": "info"})
    return results


@pytest.mark.parametrize("joined", [False, True])
def test_the_tables_are_those_of_the_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, joined: bool) -> None:
    monkeypatch.setattr(loading, "_OPEN", 2)  # descriptors are used again
    results = filled(tmp_path / ODD)
    expected = {name: of_table(results.read(name)) for name in TABLES}
    if joined:
        with results.locked():
            results.compact()
    with asking(tmp_path / ODD) as questions:
        assert len(questions._tables.devices) == (3 if joined else 0)
        for name in TABLES:
            assert questions.answer(f"SELECT * FROM {name}") == expected[name]
        [row] = questions.rows("SELECT max(start) AS last FROM sessions")
        assert row == {"last": "2026-01-01 00:00:00.123462789Z"}


def test_a_run_that_joins_the_parts_meanwhile_loses_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = filled(tmp_path)
    opened = parts.files_of

    def files_of(folder: Path, names: list[str], table: str) -> list[Path]:
        if table == "recordings":
            with results.locked():
                results.compact()
        return opened(folder, names, table)

    monkeypatch.setattr(loading, "files_of", files_of)
    with asking(tmp_path) as questions:
        assert questions.rows("SELECT count(*) AS n FROM recordings") == [{"n": 8}]


def remove(folder: Path) -> None:
    shutil.rmtree(folder / "parts" / "000002")


def tear(folder: Path) -> None:
    path = folder / "parts" / "000002" / "latencies.parquet"
    path.write_bytes(path.read_bytes()[:-20])


def other_type(folder: Path) -> None:
    path = folder / "parts" / "000002" / "latencies.parquet"
    table = pyarrow.parquet.read_table(path)
    column = table.schema.get_field_index("link")
    pyarrow.parquet.write_table(table.set_column(column, "link", pyarrow.array(["x"] * len(table))), path)


def fifo(folder: Path) -> None:
    path = folder / "parts" / "000002" / "tasks.parquet"
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (remove, "found no part 000002"),
        (tear, r"000002/latencies\.parquet: found no table of this version \(.*; remove the folder"),
        (other_type, r"000002/latencies\.parquet: .*column link is VARCHAR, expected BIGINT"),
        (fifo, "found no part 000002"),
    ],
)
def test_a_damaged_part_is_named(tmp_path: Path, damage: Callable[[Path], None], text: str) -> None:
    filled(tmp_path, 3)
    damage(tmp_path)
    with pytest.raises(GatewayError, match=text) as raised, asking(tmp_path):
        pass
    assert "\n" not in str(raised.value)
    assert "/dev/fd" not in str(raised.value)


#: Questions that would read or write more than the tables.
FOREIGN = (
    "SELECT * FROM read_text('/etc/passwd')",
    "SELECT * FROM read_blob('/dev/fd/0')",
    "SELECT * FROM glob('/*')",
    "FROM '/etc/passwd'",
    "SELECT * FROM read_json('http://127.0.0.1:9/x')",
    "SELECT * FROM query('COPY tasks TO ''OUT''')",
    "SELECT * FROM parquet_metadata('/etc/passwd')",
    "SELECT * FROM sqlite_scan('x.db', 'x')",
    "COPY (SELECT 1) TO 'OUT'",
    "EXPORT DATABASE 'OUT'",
    "ATTACH 'OUT'",
    "CREATE TABLE x AS SELECT 1",
    "INSERT INTO tasks SELECT * FROM tasks",
    "DELETE FROM tasks",
    "LOAD httpfs",
    "INSTALL httpfs FROM 'http://127.0.0.1:9'",
    "PRAGMA database_list",
    "CALL pragma_version()",
    "SET allowed_paths = ['/etc/passwd']",
    "RESET enable_external_access",
    "CHECKPOINT",
    "SELECT * FROM of_python",
    "EXPLAIN ANALYZE SELECT 1",
    "SELECT getenv('HOME')",
)


@pytest.mark.parametrize("joined", [False, True])
def test_no_question_reaches_beyond_the_tables(tmp_path: Path, joined: bool) -> None:
    results = filled(tmp_path / "out", 2)
    if joined:
        with results.locked():
            results.compact()
    out = tmp_path / "stolen"
    of_python = pyarrow.table({"secret": [1]})
    with asking(tmp_path / "out") as questions:
        for sql in FOREIGN:
            with pytest.raises(ConfigError, match="query: ") as raised:
                questions.table(sql.replace("OUT", str(out)))
            assert "\n" not in str(raised.value)
        assert len(questions.rows("FROM tasks")) == 3
    assert not out.exists()
    assert len(of_python) == 1


def test_a_question_needs_no_library_that_takes_long_to_import(tmp_path: Path) -> None:
    filled(tmp_path / "out", 2)
    program = (
        "import sys; from igtl_gateway.cli import main; code = main(sys.argv[1:]);"
        "print(code, sorted({'numpy', 'pandas', 'pyarrow', 'dask', 'igtl_gateway.convert'} & set(sys.modules)))"
    )
    question = ["cohort", "query", "SELECT count(*) AS n FROM sessions", "-o", str(tmp_path / "out")]
    done = subprocess.run([sys.executable, "-c", program, *question], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[-2] == "0 []"

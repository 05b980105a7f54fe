"""Hostile cohorts: folders of tables, questions, and folders with all hostile sessions of this table."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from igtl_gateway.addons.cohort.columns import SCHEMA_VERSION
from igtl_gateway.addons.cohort.parts import MANIFEST
from igtl_gateway.addons.cohort.tables import arrow_table, schema
from tests.integration.hostile_files import foreign, sessions
from tests.integration.hostile_files.case import MIB, NAUGHTY, SMALL, Danger, Hostile, file

_DEEP = "[" * 100_000 + "]" * 100_000
_PART = "000001"
_ROWS = 1_000_000


def write_cohort(folder: Path, parts: object = (_PART,), version: object = SCHEMA_VERSION) -> Path:
    """Write the folder of a cohort with one part and one row; return the folder of the part."""
    part = folder / "parts" / _PART
    part.mkdir(parents=True)
    (folder / MANIFEST).write_text(json.dumps({"schema_version": version, "parts": parts}), "utf-8")
    (part / "tasks.parquet").write_bytes(_parquet(arrow_table("tasks", [_task()])))
    return part


def _task(**facts: object) -> dict[str, Any]:
    return {"task": "a", "file": str(SMALL), "verb": "info", "status": "ok", "bytes": 4} | facts


def _parquet(table: pa.Table, copies: int = 1, **options: Any) -> bytes:
    memory = BytesIO()
    with pq.ParquetWriter(memory, table.schema, compression="zstd", **options) as writer:
        for _ in range(copies):
            writer.write_table(table)
    return memory.getvalue()


def _cohort(change: Callable[[Path, Path], object], **facts: Any) -> Callable[[Path], Path]:
    """A builder of a cohort; ``change`` gets its folder and the folder of its part."""

    def build(folder: Path) -> Path:
        out = folder / "cohort"
        out.mkdir()
        change(out, write_cohort(out, **facts))
        return out

    return build


def _manifest(text: Callable[[], bytes]) -> Callable[[Path], Path]:
    return _cohort(lambda out, _part: (out / MANIFEST).write_bytes(text()))


def _table(data: Callable[[], bytes], name: str = "tasks") -> Callable[[Path], Path]:
    return _cohort(lambda _out, part: (part / f"{name}.parquet").write_bytes(data()))


def _nothing(out: Path, part: Path) -> None:
    pass


def _replaced(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


def _types() -> list[tuple[str, pa.DataType]]:
    return [(each.name, each.type) for each in schema("tasks")]


def _repeated(characters: int, rows: int) -> bytes:
    """One long text in many rows, which a dictionary of the file has once."""
    index = pa.array([0], pa.int32()).take(pa.array([0] * rows))
    text = pa.DictionaryArray.from_arrays(index, pa.array(["x" * characters]))
    columns = {name: pa.nulls(rows, kind) for name, kind in _types()} | {"error": text}
    return _parquet(pa.table(columns))


def _flipped() -> bytes:
    data = bytearray(_parquet(arrow_table("tasks", [_task() for _ in range(50)])))
    for at in range(8, len(data) - 8, 7):
        data[at] ^= 0x55
    return bytes(data)


def _naughty_rows() -> bytes:
    return _parquet(arrow_table("tasks", [_task(task=NAUGHTY, file=NAUGHTY, status=NAUGHTY, error=NAUGHTY)]))


def _nested_type() -> bytes:
    kind: pa.DataType = pa.int64()
    for _ in range(60):
        kind = pa.list_(kind)
    return _parquet(pa.table({"task": pa.nulls(1, kind)}))


def _provenance(text: bytes) -> bytes:
    table = arrow_table("tasks", [_task()])
    return _parquet(table.replace_schema_metadata({b"igtl_gateway.cohort": text}))


def _columns() -> bytes:
    return _parquet(pa.table({f"c{number}": [1] for number in range(5_000)}))


_FOLDERS: Sequence[tuple[str, Danger, str, Callable[[Path], Path]]] = (
    ("deep", Danger.BOMB, "a list of parts that is nested 100,000 deep", _manifest(_DEEP.encode)),
    ("zeros", Danger.BOMB, "a list of parts of 64 MiB of zeros", _manifest(lambda: bytes(64 * MIB))),
    ("list", Danger.SHAPE, "a list", _manifest(lambda: b"[1]")),
    ("version", Danger.TERMINAL, "a hostile version", _cohort(_nothing, version=NAUGHTY)),
    ("parts", Danger.TERMINAL, "hostile names of parts", _cohort(_nothing, parts=[NAUGHTY])),
    ("path", Danger.LIE, "a part of another folder", _cohort(_nothing, parts=["../../000001"])),
    ("number", Danger.SHAPE, "a number for the parts", _cohort(_nothing, parts=5)),
    ("digits", Danger.LIE, "a part with 5,000 digits", _cohort(_nothing, parts=["1" * 5_000])),
    ("many", Danger.BOMB, "500,000 parts", _cohort(_nothing, parts=[_PART] * 500_000)),
    ("twice", Danger.LIE, "a part that is listed twice", _cohort(_nothing, parts=[_PART, _PART])),
    ("absent", Danger.LIE, "a part that is not there", _cohort(_nothing, parts=["000007"])),
    ("empty", Danger.LIE, "a table of no bytes", _table(lambda: b"")),
    ("garbage", Danger.LIE, "a table of random bytes", _table(lambda: bytes(range(256)) * 40)),
    ("cut", Danger.LIE, "a table that is cut off", _table(lambda: _parquet(arrow_table("tasks", [_task()]))[:-9])),
    ("footer", Danger.LIE, "a footer of 2 GiB", _table(lambda: b"PAR1" + bytes(64) + b"\xff\xff\xff\x7fPAR1")),
    ("flipped", Danger.LIE, "a table with damaged bytes", _table(_flipped)),
    ("repeated", Danger.BOMB, "a string of 100 kB in 1,000,000 rows", _table(lambda: _repeated(100_000, _ROWS))),
    ("columns", Danger.SHAPE, "5,000 other columns", _table(_columns)),
    ("nested", Danger.SHAPE, "a column that is nested 60 deep", _table(_nested_type)),
    ("naughty", Danger.TERMINAL, "hostile text in all columns", _table(_naughty_rows)),
    ("provenance", Danger.SHAPE, "a provenance that is invalid JSON", _table(lambda: _provenance(b"{"))),
    ("provenance-list", Danger.SHAPE, "a provenance that is a list", _table(lambda: _provenance(b"[1]"))),
    ("provenance-deep", Danger.BOMB, "a provenance that is nested", _table(lambda: _provenance(_DEEP.encode()))),
    ("provenance-bytes", Danger.SHAPE, "a provenance of bytes", _table(lambda: _provenance(b"\xff\xfe"))),
    ("other", Danger.LIE, "another table that is damaged", _table(lambda: b"PAR1", "findings")),
    (
        "fifo",
        Danger.LIE,
        "a table that is a FIFO",
        _cohort(lambda _o, part: _replaced(part / "tasks.parquet", os.mkfifo)),
    ),
    (
        "link",
        Danger.LIE,
        "a table that is a link to /dev/zero",
        _cohort(lambda _o, part: _replaced(part / "tasks.parquet", lambda path: path.symlink_to("/dev/zero"))),
    ),
    (
        "manifest-fifo",
        Danger.LIE,
        "a list that is a FIFO",
        _cohort(lambda out, _p: _replaced(out / MANIFEST, os.mkfifo)),
    ),
    ("lock-fifo", Danger.LIE, "a lock that is a FIFO", _cohort(lambda out, _p: os.mkfifo(out / ".lock"))),
    ("lock-folder", Danger.LIE, "a lock that is a folder", _cohort(lambda out, _p: (out / ".lock").mkdir())),
)

_QUESTIONS: Sequence[tuple[str, Danger, str]] = (
    ("empty", Danger.LIE, ""),
    ("range", Danger.BOMB, "SELECT * FROM range(100000000000)"),
    ("cross", Danger.BOMB, "SELECT count(*) FROM range(10000000) a, range(10000000) b WHERE a.range + b.range = 3"),
    ("recursion", Danger.BOMB, "WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM t) SELECT max(x) FROM t"),
    ("repeat", Danger.BOMB, "SELECT repeat('a', 2000000000)"),
    ("list", Danger.BOMB, "SELECT list(range) FROM range(200000000)"),
    (
        "sort",
        Danger.BOMB,
        "SELECT max(x) FROM (SELECT md5(range::VARCHAR) x FROM range(200000000) ORDER BY 1 LIMIT 99999999)",
    ),
    ("deep", Danger.BOMB, "SELECT " + "(" * 100_000 + "1" + ")" * 100_000),
    ("operators", Danger.BOMB, "SELECT 1" + "+1" * 100_000),
    ("columns", Danger.BOMB, "SELECT " + ",".join(["1"] * 20_000)),
    ("regex", Danger.BOMB, f"SELECT regexp_matches('{'a' * 5000}!', '(a+)+$')"),
    ("two", Danger.LIE, "SELECT 1; SELECT 2"),
    ("copy", Danger.LIE, "COPY (SELECT 1) TO 'stolen.csv'"),
    ("attach", Danger.LIE, "ATTACH 'stolen.db' AS a"),
    ("install", Danger.LIE, "INSTALL httpfs"),
    ("file", Danger.LIE, "SELECT * FROM read_csv('/etc/passwd')"),
    ("text", Danger.LIE, "SELECT * FROM read_text('/etc/passwd')"),
    ("name", Danger.LIE, "SELECT * FROM '/etc/passwd'"),
    ("set", Danger.LIE, "SET enable_external_access = true"),
    ("python", Danger.LIE, "SELECT * FROM questions"),
    ("environment", Danger.LIE, "SELECT getenv('AWS_SECRET_ACCESS_KEY')"),
    (
        "types",
        Danger.SHAPE,
        "SELECT [1], {'a': NULL}, MAP {1: 2}, 'a'::BLOB, INTERVAL 9 YEAR, 1::UHUGEINT, 'a'::ENUM('a')",
    ),
    (
        "times",
        Danger.SHAPE,
        "SELECT 'infinity'::TIMESTAMP, '-infinity'::DATE, '290000-01-01 (BC)'::DATE, '24:00:00'::TIME",
    ),
    ("numbers", Danger.SHAPE, "SELECT 'nan'::DOUBLE, 'inf'::FLOAT, 9e37::DECIMAL(38, 0), 0.1::DECIMAL(38, 38)"),
    ("names", Danger.SHAPE, 'SELECT 1 AS a, 2 AS a, 3 AS "a:2", 4 AS ""'),
    ("no-utf8", Danger.SHAPE, "SELECT '\\xff\\xfe'::BLOB, chr(55296)"),
    ("naughty", Danger.TERMINAL, f"SELECT '{NAUGHTY}' AS \"{NAUGHTY}\""),
    ("naughty-error", Danger.TERMINAL, f'SELECT "{NAUGHTY}"'),
    ("error", Danger.TERMINAL, f"SELECT error('{NAUGHTY}')"),
)

#: Sessions in one folder of a cohort.
_EACH = 6
_ALL = (*sessions.CASES, *foreign.CASES)[::8]


def _source(cases: Sequence[Hostile]) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        for case in cases:
            (folder / case.name).mkdir()
            case.build(folder / case.name)
        return folder

    return build


CASES = (
    *(Hostile(f"cohort-{name}", "cohort", danger, what, build) for name, danger, what, build in _FOLDERS),
    *(
        Hostile(
            f"sql-{name}",
            "question",
            danger,
            f"`{text[:60]}`" if danger is not Danger.TERMINAL else "hostile text",
            file("question.sql", text.encode),
        )
        for name, danger, text in _QUESTIONS
    ),
    *(
        Hostile(
            f"sources-{start // _EACH:02}",
            "sources",
            Danger.BOMB,
            f"{len(_ALL[start : start + _EACH])} hostile files from {_ALL[start].name} on",
            _source(_ALL[start : start + _EACH]),
        )
        for start in range(0, len(_ALL), _EACH)
    ),
)

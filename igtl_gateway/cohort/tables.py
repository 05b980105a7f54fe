"""The tables of a cohort: their columns with types and meanings, and rows as Arrow tables.

A change of a column's name, type or meaning makes a new ``SCHEMA_VERSION``.  All lengths are in the unit that the name
ends with; times are UTC.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa

SCHEMA_VERSION = 1
#: Key of the provenance in the metadata of a schema.
PROVENANCE = b"igtl_gateway.cohort"

Row = dict[str, Any]

_TYPES = {
    "text": pa.string(),
    "int": pa.int64(),
    "real": pa.float64(),
    "truth": pa.bool_(),
    "time": pa.timestamp("ns", tz="UTC"),
}
#: The first columns of every table: the task that made the row, and the file, as a path or URL.
_EACH = {"task": "text", "file": "text"}
_END = {
    "distance_mm": "real",
    "error_mm": "real",
    "noise_mm": "real",
    "reading_mm": "real",
    "density_mm2": "real",
    "missing": "real",
    "executed_mm": "real",
}

#: Table → column → type.
TABLES: Mapping[str, Mapping[str, str]] = {
    "tasks": {
        **_EACH,
        "verb": "text",
        "status": "text",
        "error": "text",
        "bytes": "int",
        "mark": "text",
        "content": "text",
        "settings": "text",
        "version": "text",
        "requests": "int",
        "bytes_read": "int",
        "seconds": "real",
    },
    "recordings": {
        **_EACH,
        "start": "time",
        "duration_s": "real",
        "entries": "int",
        "streams": "int",
        "format_version": "int",
        "foreign": "truth",
        "recorded_by": "text",
        "scenario": "text",
        "imported": "text",
        "part": "int",
        "links": "int",
        "notes": "int",
        "lost": "int",
        "has_ledger": "truth",
        "skipped": "int",
    },
    "streams": {
        **_EACH,
        "direction": "text",
        "stream": "text",
        "topic": "text",
        "type": "text",
        "messages": "int",
        "first": "time",
        "last": "time",
        "rate_hz": "real",
    },
    "verifications": {
        **_EACH,
        "good": "truth",
        "recorded_by": "text",
        "inputs": "int",
        "outputs": "int",
        "equal": "int",
        "differing": "int",
        "lost": "int",
        "missing": "int",
        "orphans": "int",
        "late": "int",
        "first_difference": "text",
    },
    "findings": {
        **_EACH,
        "rule": "text",
        "severity": "text",
        "title": "text",
        "place": "text",
        "text": "text",
    },
    "latencies": {
        **_EACH,
        "link": "int",
        "peer": "text",
        "host": "text",
        "stream": "text",
        "messages": "int",
        "unstamped": "int",
        "median_ms": "real",
        "least_ms": "real",
        "jitter_ms": "real",
        "spread_ms": "real",
        "drift_ppm": "real",
        "future": "int",
        "backwards": "int",
    },
    "reviews": {
        **_EACH,
        "plans": "int",
        "stitches": "int",
        "wrong_first": "int",
        "wrong_last": "int",
        "corrected": "int",
        "noise_mm": "real",
        "cloud": "text",
        "clouds": "int",
        "tool": "text",
    },
    "stitches": {
        **_EACH,
        "plan": "int",
        "is_first": "truth",
        "is_last": "truth",
        "topic": "text",
        "time": "time",
        "number": "int",
        "label": "text",
        "level": "text",
        "reasons": "text",
        "corrected": "truth",
        "moved_mm": "real",
        "bite_length_mm": "real",
        "bite_depth_mm": "real",
        "driven_depth_mm": "real",
        **{f"entry_{name}": kind for name, kind in _END.items()},
        **{f"exit_{name}": kind for name, kind in _END.items()},
    },
    "lags": {
        **_EACH,
        "fixed": "text",
        "stream": "text",
        "verdict": "text",
        "has_lag": "truth",
        "lag_ms": "real",
        "low_ms": "real",
        "high_ms": "real",
        "r2": "real",
        "skew_ppm": "real",
        "samples": "int",
        "common_s": "real",
        "reason": "text",
    },
}


def schema(table: str, provenance: Mapping[str, Any] | None = None) -> pa.Schema:
    """Return the schema of a table; ``provenance`` goes to its metadata as JSON."""
    facts = {"table": table, "schema_version": SCHEMA_VERSION, **(provenance or {})}
    metadata = {PROVENANCE: json.dumps(facts, sort_keys=True).encode()}
    return pa.schema([pa.field(name, _TYPES[kind]) for name, kind in TABLES[table].items()], metadata)


def arrow_table(name: str, rows: Sequence[Row]) -> pa.Table:
    """Return rows as a table; columns that a row does not have are null.  Text is valid UTF-8, and NaN is null."""
    columns = TABLES[name]
    arrays = [
        pa.array([_value(row.get(column), kind) for row in rows], _TYPES[kind]) for column, kind in columns.items()
    ]
    return pa.Table.from_arrays(arrays, schema=schema(name))


def _value(value: Any, kind: str) -> Any:
    if kind == "text" and value is not None:
        return str(value).encode("utf-8", "backslashreplace").decode()
    if kind == "real" and value is not None:
        return float(value) if value == value else None  # noqa: PLR0124  # NaN
    return value


def joined(name: str, tables: Iterable[pa.Table]) -> pa.Table:
    """Return the rows of several tables of one name, ordered by file and task; the order in a task stays."""
    whole = pa.concat_tables([each.cast(schema(name)) for each in tables] or [arrow_table(name, [])])
    numbered = whole.append_column("row", pa.array(range(len(whole)), pa.int64()))
    keys = [("file", "ascending"), ("task", "ascending"), ("row", "ascending")]
    return numbered.sort_by(keys).drop_columns(["row"])

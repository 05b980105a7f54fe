"""The tables of a cohort as Arrow tables."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa

from igtl_gateway.addons.cohort.columns import SCHEMA_VERSION, TABLES, Row

#: Key of the provenance in the metadata of a schema.
PROVENANCE = b"igtl_gateway.cohort"

_TYPES = {
    "text": pa.string(),
    "int": pa.int64(),
    "real": pa.float64(),
    "truth": pa.bool_(),
    "time": pa.timestamp("ns", tz="UTC"),
}


def schema(table: str, provenance: Mapping[str, Any] | None = None) -> pa.Schema:
    """Return the schema of a table; ``provenance`` goes to its metadata as JSON."""
    facts = {"table": table, "schema_version": SCHEMA_VERSION, **(provenance or {})}
    metadata = {PROVENANCE: json.dumps(facts, sort_keys=True).encode()}
    return pa.schema([pa.field(name, _TYPES[kind]) for name, kind in TABLES[table].items()], metadata)


def arrow_table(name: str, rows: Sequence[Row]) -> pa.Table:
    """Return rows as a table; columns that a row does not have are null.  Text is valid UTF-8.

    NaN is null, and so is an integer or a time (ns, UTC) that has no 64 bits with a sign: one after 2262.
    """
    arrays = []
    for column, kind in TABLES[name].items():
        values = [row.get(column) for row in rows]
        if clean := _CLEAN.get(kind):
            values = [None if value is None else clean(value) for value in values]
        arrays.append(pa.array(values, _TYPES[kind]))
    return pa.Table.from_arrays(arrays, schema=schema(name))


def _text(value: object) -> str:
    text = str(value)
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


def _real(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _whole(value: int) -> int | None:
    return value if -1 << 63 <= value < 1 << 63 else None


#: What makes the values of a type fit.
_CLEAN: Mapping[str, Callable[[Any], Any]] = {"text": _text, "real": _real, "int": _whole, "time": _whole}


def concatenated(name: str, tables: Iterable[pa.Table]) -> pa.Table:
    """Return the rows of several tables of one name, in their order."""
    return pa.concat_tables([each.cast(schema(name)) for each in tables] or [arrow_table(name, [])])


def joined(name: str, tables: Iterable[pa.Table]) -> pa.Table:
    """Return the rows of several tables of one name, ordered by file and task; the order in a task stays."""
    keys = [("file", "ascending"), ("task", "ascending"), ("row", "ascending")]
    return numbered(concatenated(name, tables)).sort_by(keys).drop_columns(["row"])


def numbered(table: pa.Table) -> pa.Table:
    """Return a table with the numbers of its rows as the last column, ``row``."""
    return table.append_column("row", pa.array(range(len(table)), pa.int64()))

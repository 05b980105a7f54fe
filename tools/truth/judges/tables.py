"""Tables: CSV by pandas, Parquet and Arrow by pyarrow, DuckDB's tables of cohorts by pyarrow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas
import pyarrow.feather
import pyarrow.parquet

from tools.truth.judges.samples import Sample, of_row


def by_pandas(folder: Path) -> Iterator[Sample]:
    """The CSV files of a folder; the name of a file is that of its stream."""
    for path in sorted(folder.glob("*.csv")):
        frame = pandas.read_csv(path, low_memory=False)
        whole = [name for name in frame.columns if name.endswith("_ns")]
        frame[whole] = frame[whole].astype("Int64")
        for number, row in enumerate(frame.to_dict("records")):
            cells = {name: value for name, value in row.items() if value is not pandas.NA}
            yield from of_row(cells, path.stem, number)


def by_parquet(folder: Path) -> Iterator[Sample]:
    """The Parquet files of a folder; the schema names the stream."""
    for path in sorted(folder.glob("*.parquet")):
        yield from of_table(pyarrow.parquet.read_table(path))


def by_feather(folder: Path) -> Iterator[Sample]:
    """The files of Arrow IPC of a folder."""
    for path in sorted(folder.iterdir()):
        yield from of_table(pyarrow.feather.read_table(path))


def of_table(table: Any) -> Iterator[Sample]:
    """The rows of an Arrow table."""
    facts = table.schema.metadata or {}
    stream = f"{facts.get(b'direction', b'').decode()}:{facts.get(b'stream', b'').decode()}"
    for number, row in enumerate(table.to_pylist()):
        yield from of_row(_of_fields(row, table.schema), stream, number)


def _of_fields(row: dict[str, Any], fields: Iterable[Any]) -> dict[str, Any]:
    """Cells under the names in CSV, which the metadata of a field have where it is another one; times in ns."""
    found = {}
    for field in fields:
        name = (field.metadata or {}).get(b"field", field.name.encode()).decode()
        found[name] = _of_type(row[field.name], field.type)
    return found


def _of_type(value: Any, kind: Any) -> Any:
    if value is None:
        return None
    if pyarrow.types.is_timestamp(kind):
        return value.value
    if pyarrow.types.is_struct(kind):
        return _of_fields(value, kind)
    return [_of_type(each, kind.value_type) for each in value] if pyarrow.types.is_list(kind) else value


def cohort_streams(folder: Path) -> list[dict[str, Any]]:
    """The rows of the table ``streams``."""
    return [
        row for path in sorted(folder.rglob("streams.parquet")) for row in pyarrow.parquet.read_table(path).to_pylist()
    ]

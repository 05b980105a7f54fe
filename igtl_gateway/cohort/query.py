"""Questions to the tables of a cohort: SQL (DuckDB) that can only read them.

The connection has a view for each table, with the rows that count.  It has no access to files, to the network and to
settings, so that a question of anyone can be answered.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway import extras
from igtl_gateway.cohort.ends import VERB_NAMES
from igtl_gateway.cohort.results import MANIFEST, Results
from igtl_gateway.cohort.tables import TABLES
from igtl_gateway.errors import ConfigError, GatewayError, Unavailable

if TYPE_CHECKING:
    import pyarrow

#: One row for each file: how each verb ended, and what `info` has found.
SESSIONS = "sessions"


class Questions:
    """An open connection to the tables; use `asking`."""

    def __init__(self, connection: Any, errors: type[Exception]) -> None:
        self._connection = connection
        self._errors = errors

    def ask(self, sql: str) -> pyarrow.Table:
        """Return the answer.  Raises ConfigError if the question is wrong, or is not one SELECT."""
        try:
            kinds = [each.type.name for each in self._connection.extract_statements(sql)]
            if kinds != ["SELECT"]:
                raise ConfigError(f"query: found {', '.join(kinds) or 'no statement'}, expected one SELECT")
            return self._connection.sql(sql).to_arrow_table()
        except self._errors as error:
            raise ConfigError(f"query: {str(error).strip()}") from None

    def rows(self, sql: str) -> list[dict[str, Any]]:
        """Return the answer as rows; see `plain_rows`."""
        return plain_rows(self.ask(sql))


@contextmanager
def asking(folder: Path) -> Iterator[Questions]:
    """Context manager: questions to the tables in a folder.

    Raises ConfigError if it has none, GatewayError if they cannot be read, Unavailable without DuckDB.
    """
    try:
        import duckdb
    except ImportError as error:
        raise Unavailable(extras.missing("duckdb", error)) from None
    if not (folder / MANIFEST).is_file():
        raise ConfigError(f"{folder}: found no {MANIFEST}, expected the folder of a cohort (--out)")
    results = Results(folder)
    connection = duckdb.connect(":memory:")
    try:
        for name in TABLES:
            connection.register(f"{name}_rows", results.read(name))
            connection.execute(f"CREATE TABLE {name} AS SELECT * FROM {name}_rows")
            connection.unregister(f"{name}_rows")
        connection.execute(_sessions())
        for setting in ("TimeZone = 'UTC'", "enable_external_access = false", "lock_configuration = true"):
            connection.execute(f"SET {setting}")
        yield Questions(connection, duckdb.Error)
    except duckdb.Error as error:
        raise GatewayError(f"{folder}: {str(error).strip()}") from None
    finally:
        connection.close()


def _sessions() -> str:
    """The definition of the view: all names in it are ours."""
    verbs = ", ".join(f"max(status) FILTER (verb = '{verb}') AS {verb}" for verb in VERB_NAMES)
    return (
        f"CREATE VIEW {SESSIONS} AS SELECT ends.*, recordings.* EXCLUDE (task, file) FROM "
        f"(SELECT file, max(bytes) AS bytes, {verbs} FROM tasks GROUP BY file) AS ends "
        "LEFT JOIN recordings USING (file)"
    )


def plain_rows(answer: pyarrow.Table) -> list[dict[str, Any]]:
    """Return the rows of an answer, with times as text (Python has none with nanoseconds), decimals as numbers."""
    import pyarrow

    for number, field in enumerate(answer.schema):
        if pyarrow.types.is_timestamp(field.type):
            answer = answer.set_column(number, field.name, answer.column(number).cast(pyarrow.string()))
        elif pyarrow.types.is_decimal(field.type):
            kind = pyarrow.float64() if field.type.scale else pyarrow.int64()  # of a sum of integers
            answer = answer.set_column(number, field.name, answer.column(number).cast(kind))
    names = answer.column_names  # of two columns with one name, both stay
    return [
        dict(zip(_unique(names), row, strict=True))
        for row in zip(*(each.to_pylist() for each in answer.columns), strict=True)
    ]


def _unique(names: list[str]) -> list[str]:
    return [name if names.index(name) == number else f"{name}:{number + 1}" for number, name in enumerate(names)]


def write_answer(answer: pyarrow.Table, path: Path, *, parquet: bool) -> None:
    """Write an answer as Parquet or as CSV.  Raises OSError, GatewayError for types that CSV does not have."""
    import pyarrow
    from pyarrow import csv
    from pyarrow import parquet as files

    try:
        if parquet:
            files.write_table(answer, path)
        else:
            csv.write_csv(answer, path)
    except pyarrow.ArrowException as error:
        raise GatewayError(f"query: cannot write the answer: {str(error).partition(chr(10))[0]}") from None

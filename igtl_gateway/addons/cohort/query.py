"""Questions to the tables of a cohort: SQL (DuckDB) that can only read them.

The connection has a view for each table, with the rows that count.  It has no access to files, to the network and to
settings, so that a question of anyone can be answered.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import ConfigError, GatewayError, Unavailable
from igtl_gateway.addon.processes import extras
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import limits
from igtl_gateway.addon.writing import open_new
from igtl_gateway.addons.cohort.columns import RENAMED
from igtl_gateway.addons.cohort.ends import VERB_NAMES
from igtl_gateway.addons.cohort.loading import Tables, reason
from igtl_gateway.addons.cohort.parts import MANIFEST

if TYPE_CHECKING:
    import pyarrow

#: One row for each file: how each verb ended, and what `info` has found.
SESSIONS = "sessions"
#: Settings of a database that answers the questions of anyone: no files, no network, no variables of Python.
_SAFE = (
    "autoinstall_known_extensions = false",
    "python_enable_replacements = false",
    "enable_external_access = false",
    "lock_configuration = true",
)


#: Longest question, characters.
_LONGEST = 1 << 16
_MOST_COLUMNS = 1000
#: Rows that are read at a time.
_BATCH = 10_000
#: Types whose values come as they are.
_PLAIN = frozenset({"VARCHAR", "BOOLEAN", "DOUBLE", "FLOAT", "DATE", "HUGEINT", "BIGINT", "INTEGER", "SMALLINT"})
#: Types of times → digits of the second that they have.  Times come as text: Python has none with nanoseconds.
_DIGITS = {
    "TIMESTAMP_S": 0,
    "TIMESTAMP_MS": 3,
    "TIMESTAMP": 6,
    "TIMESTAMP_NS": 9,
    "TIMESTAMP WITH TIME ZONE": 6,
    "TIMESTAMPTZ_NS": 9,
}


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a question, for people and JSON.

    Attributes:
        columns: their names, of which two may be equal.
        cells: the rows; times are text, decimals are numbers.
    """

    columns: list[str]
    cells: list[tuple[Any, ...]]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows by column; the second column of a name has its number behind the name."""
        names = [
            name if self.columns.index(name) == number else f"{name}:{number + 1}"
            for number, name in enumerate(self.columns)
        ]
        return [dict(zip(names, row, strict=True)) for row in self.cells]


class Questions:
    """An open connection to the tables; use `asking`."""

    def __init__(self, connection: Any, errors: type[Exception], tables: Tables) -> None:
        self._connection, self._errors, self._tables = connection, errors, tables

    def answer(self, sql: str) -> Answer:
        """Return the answer.  Raises ConfigError if the question is wrong, or is not one SELECT."""
        with self._asked(sql) as found:
            kinds = list(map(str, found.types))
            values = [_expression(number, kind) for number, kind in enumerate(kinds, 1)]
            if "" in values:
                return of_table(_bounded(found))
            most = limits.current_limits().count
            cells = found.project(", ".join(values)).limit(most + 1).fetchall()
            limits.check_limit("count", len(cells), "query: rows")
        times = [(number, _DIGITS[kind]) for number, kind in enumerate(kinds) if kind in _DIGITS]
        return Answer(found.columns, [_with_times(row, times) for row in cells] if times else cells)

    def table(self, sql: str) -> pyarrow.Table:
        """Return the answer as an Arrow table; raises as `answer`."""
        with self._asked(sql) as found:
            return _bounded(found)

    def rows(self, sql: str) -> list[dict[str, Any]]:
        """Return the rows of the answer."""
        return self.answer(sql).rows

    @contextmanager
    def _asked(self, sql: str) -> Iterator[Any]:
        """Context manager: the question; its time and memory are bounded, those of the answer by who reads it."""
        if len(sql) > _LONGEST:  # the memory of the parser grows with the levels of brackets
            raise ConfigError(f"query: found {count_text(len(sql), 'character')}, expected at most {_LONGEST:,}")
        bounds = limits.current_limits()
        over = threading.Timer(bounds.seconds, self._connection.interrupt)
        over.start()
        try:
            statements = self._connection.extract_statements(sql)
            kinds = [each.type.name for each in statements]
            if kinds != ["SELECT"]:
                raise ConfigError(f"query: found {', '.join(kinds) or 'no statement'}, expected one SELECT")
            found = self._connection.sql(statements[0])
            if len(found.columns) > _MOST_COLUMNS:
                raise ConfigError(
                    f"query: found {count_text(len(found.columns), 'column')}, expected at most {_MOST_COLUMNS:,}"
                )
            yield found
        except self._errors as error:
            match type(error).__name__:
                case "InterruptException":
                    raise limits.exceeded("seconds", "a longer question", "query", f"{bounds.seconds} s") from None
                case "OutOfMemoryException":
                    raise limits.exceeded("memory", "more memory", "query", counted(bounds.memory, "byte")) from None
            raise ConfigError(f"query: {reason(error, self._tables.devices)}{_renamed(str(error))}") from None
        except (OverflowError, ValueError) as error:
            raise _no_value(error) from None
        finally:
            over.cancel()


def _renamed(error: str) -> str:
    """Return what to write for a column of an older version that an error of DuckDB is about; "" for none."""
    named = re.search(r'(?:at or near|column|column named) "(\w+)"', error)
    return f"; the column is {RENAMED[named[1]]}" if named and named[1] in RENAMED else ""


def _no_value(error: Exception) -> ConfigError:
    """What to raise for dates before the year 1 and the like, which Python does not have."""
    text = str(error).partition("\n")[0]
    return ConfigError(f"query: found a value that cannot be converted ({text}); cast it to VARCHAR")


def _bounded(found: Any) -> pyarrow.Table:
    """Return an answer as an Arrow table of the limit ``memory`` at most.  Raises LimitExceeded."""
    import pyarrow

    size, batches = 0, []
    read = getattr(found, "to_arrow_reader", None) or found.fetch_arrow_reader  # the older name
    reader = read(_BATCH)
    for batch in reader:
        size += batch.nbytes
        limits.check_limit("memory", size, "query: bytes of the answer")
        batches.append(batch)
    return pyarrow.Table.from_batches(batches, reader.schema)


def _expression(number: int, kind: str) -> str:
    """What gives a column as values of Python; "" for a type that only Arrow has."""
    if kind in _DIGITS:
        return f"#{number}::VARCHAR"
    if kind.startswith("DECIMAL"):  # with digits after the point, and without: sums of integers
        return f"#{number}::{'HUGEINT' if kind.endswith(',0)') else 'DOUBLE'}"
    return f"#{number}" if kind in _PLAIN else ""


def _with_times(row: tuple[Any, ...], times: Sequence[tuple[int, int]]) -> tuple[Any, ...]:
    """The row with times as Arrow writes them, of those of DuckDB: without zeros at the end, ``+00`` for UTC."""
    cells = list(row)
    for column, digits in times:
        if (text := row[column]) and text[-1].isdigit():  # not "infinity"
            moment = text.removesuffix("+00")
            seconds, _, fraction = moment.partition(".")
            second = f"{seconds}.{fraction:0<{digits}}" if digits else seconds
            cells[column] = second + "Z" * (moment != text)
    return tuple(cells)


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
        raise ConfigError(f"{folder}: found no {MANIFEST}, expected the folder of a cohort (-o)")
    connection = duckdb.connect(":memory:")
    try:
        with Tables(connection, duckdb.Error, folder) as tables:
            memory = f"memory_limit = '{limits.current_limits().memory}B'"
            for setting in ("TimeZone = 'UTC'", memory, "temp_directory = ''"):  # nothing is written
                connection.execute(f"SET {setting}")
            tables.load()
            connection.execute(_sessions())
            devices = ", ".join(f"'{device}'" for device in tables.devices)
            for setting in (f"allowed_paths = [{devices}]", *_SAFE):
                connection.execute(f"SET {setting}")
            yield Questions(connection, duckdb.Error, tables)
    except duckdb.Error as error:
        raise GatewayError(f"{folder}: {reason(error, {})}") from None
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


def of_table(table: pyarrow.Table) -> Answer:
    """Return the cells of an Arrow table.  Raises ConfigError for values that Python does not have."""
    try:
        return _of_table(table)
    except (OverflowError, ValueError) as error:
        raise _no_value(error) from None


def _of_table(table: pyarrow.Table) -> Answer:
    import pyarrow

    columns = []
    for field, column in zip(table.schema, table.columns, strict=True):
        if pyarrow.types.is_timestamp(field.type):
            columns.append(column.cast(pyarrow.string()))
        elif pyarrow.types.is_decimal(field.type):
            columns.append(column.cast(pyarrow.float64() if field.type.scale else pyarrow.int64()))  # sums of integers
        else:
            columns.append(column)
    return Answer(table.column_names, list(zip(*(each.to_pylist() for each in columns), strict=True)))


def write_answer(answer: pyarrow.Table, path: Path, *, parquet: bool) -> None:
    """Write an answer as Parquet or as CSV.  Raises OSError, GatewayError for types that CSV does not have."""
    import pyarrow
    from pyarrow import csv
    from pyarrow import parquet as files

    try:
        with open_new(path, "wb") as out:
            if parquet:
                files.write_table(answer, out)
            else:
                csv.write_csv(answer, out)
    except pyarrow.ArrowException as error:
        raise GatewayError(f"query: cannot write the answer: {str(error).partition(chr(10))[0]}") from None

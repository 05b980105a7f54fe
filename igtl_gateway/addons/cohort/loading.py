"""The tables of a cohort in DuckDB: it reads the Parquet files itself, because pyarrow takes longer to import.

Files are opened here and named to DuckDB by their descriptors: no character of a foreign path is in any SQL.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.untrusted import files
from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.parts import Parts, files_of, parts_of, unreadable

_TYPES = {"text": "VARCHAR", "int": "BIGINT", "real": "DOUBLE", "truth": "BOOLEAN", "time": "TIMESTAMP"}
#: Types of DuckDB for a time with nanoseconds: the first that it knows.
_TIMES = ("TIMESTAMPTZ_NS", "TIMESTAMPTZ")
#: Files that are open at a time.
_OPEN = 128
#: How often to begin again because a run has joined the parts meanwhile.
_TRIES = 10


class Tables:
    """The tables in a folder, in a database: each has the rows that count, ordered by file and task.

    A context manager: files stay open in the with block.

    Args:
        connection: of DuckDB, to a database in memory.
        errors: what DuckDB raises.
        folder: that of ``--output``.

    Attributes:
        devices: files that DuckDB still reads for a question: name → path.
    """

    def __init__(self, connection: Any, errors: type[Exception], folder: Path) -> None:
        self.devices: dict[str, Path] = {}
        self._connection, self._errors, self._folder = connection, errors, folder
        self._opened = ExitStack()

    def __enter__(self) -> Tables:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def load(self) -> None:
        """Make all tables.  Raises ConfigError, GatewayError."""
        for _ in range(_TRIES):
            self._begin()
            parts = parts_of(self._folder)
            try:
                self._load_all(parts)
            except GatewayError:
                if parts.count_in(self._folder):
                    raise
            else:
                if parts.count_in(self._folder):  # a run removes parts after it has listed the one that replaces them
                    return
        raise GatewayError(f"{self._folder}: a run is writing to it; wait for its end")

    def _begin(self) -> None:
        """Have no tables: each try begins with an empty schema."""
        self._opened.close()
        self.devices.clear()
        for statement in (
            "USE memory.main",
            "DROP SCHEMA IF EXISTS cohort CASCADE",
            "CREATE SCHEMA cohort",
            "USE cohort",
        ):
            self._connection.execute(statement)

    def _load_all(self, parts: Parts) -> None:
        absent = set(parts.names) - {path.parent.name for path in files_of(self._folder, parts.names, "tasks")}
        if absent:
            raise GatewayError(f"{self._folder}: found no part {min(absent)}, expected it by the list; run again")
        for name in TABLES:
            paths = files_of(self._folder, parts.names, name)
            if parts.joined and paths:
                self._view(name, paths[0])
            else:
                self._copy(name, paths)

    def _view(self, name: str, path: Path) -> None:
        """Make a table whose rows all count and are in order: DuckDB reads what a question needs."""
        device = _device(self._opened.enter_context(files.open_file(path)).fileno())
        try:
            self._connection.execute(f"CREATE VIEW {name} AS {self._rows(name, [device])}")
        except (self._errors, ValueError) as error:
            raise unreadable(path, reason(error, {device: path})) from None
        self.devices[device] = path

    def _copy(self, name: str, paths: Sequence[Path]) -> None:
        """Make a table of the rows of several parts."""
        columns = ", ".join(f'"{column}"' for column in TABLES[name])
        kinds = {**_TYPES, "time": self._time_type()}
        types = ", ".join(f'"{column}" {kinds[kind]}' for column, kind in TABLES[name].items())
        self._connection.execute(f"CREATE OR REPLACE TABLE all_rows (row BIGINT, {types})")
        for start in range(0, len(paths), _OPEN):
            with ExitStack() as opened:
                group = {
                    _device(opened.enter_context(files.open_file(path)).fileno()): path
                    for path in paths[start : start + _OPEN]
                }
                self._insert(name, group)
        counts = (
            "row IN (SELECT max(row) FROM all_rows GROUP BY file, verb)"
            if name == "tasks"
            else "task IN (SELECT task FROM tasks)"
        )
        self._connection.execute(
            f"CREATE TABLE {name} AS SELECT {columns} FROM all_rows WHERE {counts} ORDER BY file, task, row"
        )
        self._connection.execute("DROP TABLE all_rows")

    def _insert(self, name: str, group: dict[str, Path]) -> None:
        [(before,)] = self._connection.execute("SELECT count(*) FROM all_rows").fetchall()
        try:
            rows = self._rows(name, list(group))
            self._connection.execute(f"INSERT INTO all_rows SELECT row_number() OVER () + {before}, * FROM ({rows})")
        except (self._errors, ValueError) as error:
            if len(group) > 1:  # which one is it?
                for device, path in group.items():
                    self._insert(name, {device: path})
            raise unreadable(next(iter(group.values())), reason(error, group)) from None

    def _rows(self, name: str, devices: Sequence[str]) -> str:
        """The query for the rows of files.  Raises ValueError for wrong types, and errors of DuckDB."""
        columns = ", ".join(f'"{column}"' for column in TABLES[name])
        listed = ", ".join(f"'{device}'" for device in devices)
        query = f"SELECT {columns} FROM read_parquet([{listed}], hive_partitioning=false)"
        for (column, kind), found in zip(TABLES[name].items(), self._connection.sql(query).types, strict=True):
            if not str(found).startswith(_TYPES[kind]):
                raise ValueError(f"column {column} is {found}, expected {_TYPES[kind]}")
        return query

    def _time_type(self) -> str:
        try:
            self._connection.execute(f"SELECT NULL::{_TIMES[0]}")
        except self._errors:
            return _TIMES[1]
        return _TIMES[0]


def reason(error: Exception, devices: dict[str, Path]) -> str:
    """Return the text of an error of DuckDB on one line, without the places that it shows on further lines.

    Args:
        error: of DuckDB.
        devices: names of files in it, and their paths.
    """
    text = " ".join(re.split(r"\n\n(?:LINE |Stack Trace)", str(error))[0].split())
    return re.sub(r"/dev/fd/[0-9]+", lambda found: str(devices.get(found[0], found[0])), text)


def _device(number: int) -> str:
    return f"/dev/fd/{number}"

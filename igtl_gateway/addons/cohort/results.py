"""The folder with the tables of a cohort: parts that are complete or absent, and the list of those that count.

``cohort.json`` lists the parts; a part is a folder ``parts/000001`` with one Parquet file for each table that has
rows.  A part is written under another name, renamed, and then listed: a run that is killed at any moment leaves a
folder that is valid, and loses the files of its last seconds.  Of two tasks of one file and verb the later one counts.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from igtl_gateway.addon import ConfigError, DamagedRecording, GatewayError
from igtl_gateway.addon.untrusted import files, parse_json, read_parquet, read_parquet_schema
from igtl_gateway.addon.writing import lock_handle, make_folder, open_new, open_text
from igtl_gateway.addons.cohort.columns import SCHEMA_VERSION, TABLES, Row
from igtl_gateway.addons.cohort.parts import MANIFEST, PARTS, Parts, files_of, parts_of, unreadable
from igtl_gateway.addons.cohort.tables import PROVENANCE, arrow_table, concatenated, joined, numbered, schema

_LOCK = ".lock"


class Results:
    """The tables in a folder.

    Args:
        folder: that of ``--output``; it need not exist yet.

    Raises ConfigError if the folder has something else, or tables of another version; GatewayError for others.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._found = Parts()
        self._latest: tuple[list[str], pa.Table] | None = None  # of these parts
        if (folder / MANIFEST).exists():
            self._found = parts_of(folder)
        elif folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder}: found a file, expected a folder for tables")
        elif folder.is_dir() and any(each.name not in (PARTS, _LOCK) for each in folder.iterdir()):
            raise ConfigError(
                f"{folder}: found a folder without {MANIFEST}, expected tables of a cohort or a new folder"
            )

    @property
    def parts(self) -> list[str]:
        """Names of the parts that count, in order."""
        return self._found.names

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Context manager: no other program writes.  Raises GatewayError if another does, or nothing can be written."""
        with self._writing():
            make_folder(self.folder / PARTS, parents=True, exist_ok=True)
            if found := files.obstacle(self.folder / _LOCK):
                raise GatewayError(f"cannot write to {self.folder / _LOCK}: {found}")
            file = open_new(self.folder / _LOCK, "ab")  # closed below
        with file:
            try:
                lock_handle(file.fileno())
            except BlockingIOError:
                raise GatewayError(f"{self.folder}: another run is writing to it; wait for its end") from None
            if (self.folder / MANIFEST).exists():
                self._found = parts_of(self.folder)
            self._remove_unlisted()
            yield

    def files(self, table: str) -> list[Path]:
        """Return the Parquet files of a table, in order."""
        return files_of(self.folder, self.parts, table)

    def read(self, table: str) -> pa.Table:
        """Return all rows of a table that count, ordered by file.  Raises GatewayError."""
        tasks = self._latest_tasks()
        if table == "tasks":
            return tasks
        found = joined(table, map(_read, self.files(table)))
        return found.filter(pc.is_in(found["task"], value_set=tasks["task"].combine_chunks()))

    def known(self, verb: str, names: Iterable[str]) -> dict[str, Row]:
        """Return file → the row of its latest task with a verb, for those of these files that have one.

        Raises GatewayError.
        """
        tasks = self._latest_tasks()
        asked = pc.and_(
            pc.equal(tasks["verb"], verb), pc.is_in(tasks["file"], value_set=pa.array(list(names), pa.string()))
        )
        return {row["file"]: row for row in tasks.filter(asked).to_pylist()}

    def _latest_tasks(self) -> pa.Table:
        """Return the latest task of each file and verb, ordered by file and task.  Raises GatewayError."""
        if self._latest is None or self._latest[0] != self.parts:
            # in Arrow: as rows of Python, a million takes gigabytes
            tasks = concatenated("tasks", map(_read, self.files("tasks")))
            groups = numbered(tasks).group_by(["file", "verb"], use_threads=False)
            last = groups.aggregate([("row", "max")])["row_max"]
            self._latest = list(self.parts), joined("tasks", [tasks.take(last.sort())])
        return self._latest[1]

    def add(self, rows: Mapping[str, Sequence[Row]], provenance: Mapping[str, Any]) -> None:
        """Write rows as one part, all or none.  Raises GatewayError."""
        tables = {name: arrow_table(name, found) for name, found in rows.items() if found}
        self._list(Parts([*self.parts, self._write(tables, [provenance])]))

    def compact(self) -> None:
        """Join all parts to one, without the rows that count no more, in order.  Raises GatewayError."""
        if self._found.joined or not self.parts:
            return
        runs: list[Mapping[str, Any]] = []
        for path in self.files("tasks"):
            for run in _provenance(path):
                if run not in runs:
                    runs.append(run)
        tables = {name: self.read(name) for name in TABLES if self.files(name)}
        part = self._write({name: table for name, table in tables.items() if len(table)}, runs)
        self._list(Parts([part], joined=True))
        self._remove_unlisted()

    def _write(self, tables: Mapping[str, pa.Table], runs: Sequence[Mapping[str, Any]]) -> str:
        name = f"{int(self.parts[-1]) + 1 if self.parts else 1:06d}"
        folder = self.folder / PARTS / name
        partial = folder.with_name(f".{name}.part")
        with self._writing():
            shutil.rmtree(partial, ignore_errors=True)
            shutil.rmtree(folder, ignore_errors=True)
            make_folder(partial)
            for table, content in tables.items():
                with open_new(partial / f"{table}.parquet") as file:
                    pq.write_table(content.cast(schema(table, {"runs": list(runs)})), file, compression="zstd")
                    os.fsync(file.fileno())
            os.replace(partial, folder)
        return name

    def _list(self, parts: Parts) -> None:
        partial = self.folder / f".{MANIFEST}.part"
        with self._writing():
            with open_text(partial, "w") as file:
                facts = {"schema_version": SCHEMA_VERSION, "parts": parts.names, "joined": parts.joined}
                json.dump(facts, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, self.folder / MANIFEST)
        self._found = parts

    def _remove_unlisted(self) -> None:
        for path in (self.folder / PARTS).iterdir():
            if path.name not in self.parts:
                shutil.rmtree(path, ignore_errors=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise GatewayError(f"cannot write to {self.folder}: {error.strerror or error}") from None


def _read(path: Path) -> pa.Table:
    try:
        return read_parquet(path).cast(schema(path.stem))
    except (pa.ArrowException, ValueError, DamagedRecording) as error:
        raise unreadable(path, str(error).partition("\n")[0]) from None


def _provenance(path: Path) -> list[Mapping[str, Any]]:
    metadata = read_parquet_schema(path).metadata or {}
    facts = parse_json(metadata.get(PROVENANCE, b"{}").decode("utf-8", "replace"), str(path))
    runs = facts.get("runs") if isinstance(facts, dict) else None
    return [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []

"""Export to Parquet and to Arrow IPC files: one file per stream, with a row per message and units in the schema.

Tables are those of ``arrow_tables``.  A file has the columns of all its messages: if later messages have other columns,
the file is written again with the columns of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Protocol

import pyarrow as pa

from igtl_gateway.addon.reading import Entry, Kind, block_of, recorded_acceptance, recorded_units
from igtl_gateway.addon.streams import TableMaker, fitted, unified
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.folder import FileNames, Folder, new_folder
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, Recording, chosen_entries

#: Files that are open at the same time; a usual session has a few dozen streams.
_MAX_FILES = 500
#: Messages of one stream, and bytes of all streams, that wait to become tables.
_ROWS, _BYTES = 20_000, 64 << 20


class _Writer(Protocol):
    def write_table(self, table: pa.Table) -> None: ...
    def close(self) -> None: ...


class _Parquet:
    """Files of Parquet."""

    suffix = "parquet"

    def writer(self, stream: BinaryIO, schema: pa.Schema) -> _Writer:
        from pyarrow import parquet

        writer: _Writer = parquet.ParquetWriter(stream, schema, compression="zstd")
        return writer

    def tables(self, path: Path) -> Iterator[pa.Table]:
        from pyarrow import parquet

        with parquet.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                yield file.read_row_group(group)


class _Ipc:
    """Files of Arrow IPC, which Feather also reads."""

    suffix = "arrow"

    def writer(self, stream: BinaryIO, schema: pa.Schema) -> _Writer:
        writer: _Writer = pa.ipc.new_file(stream, schema, options=pa.ipc.IpcWriteOptions(compression="lz4"))
        return writer

    def tables(self, path: Path) -> Iterator[pa.Table]:
        with pa.ipc.open_file(path) as file:
            for number in range(file.num_record_batches):
                yield pa.Table.from_batches([file.get_batch(number)])


def export_parquet(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out`` with Parquet files.  Raises UnsupportedRecording if it is not empty; OSError."""
    return _export(recording, out, globs, _Parquet())


def export_arrow(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out`` with Arrow files.  Raises UnsupportedRecording if it is not empty; OSError."""
    return _export(recording, out, globs, _Ipc())


def _export(recording: Recording, out: Path, globs: Sequence[str], form: _Parquet | _Ipc) -> ExportAccount:
    account, names = ExportAccount(), FileNames(recording.channels)
    decoder = MessageDecoder(lambda ros_type: recording.definitions.get(ros_type, ""))
    streams: dict[tuple[Kind, str, str, str], _Stream] = {}
    units, accepted, waiting = recorded_units(recording), recorded_acceptance(recording), 0
    with new_folder(out, account) as folder, ExitStack() as stack:
        for entry in chosen_entries(recording, (*IGTL_KINDS, *ROS_KINDS), globs, account):
            row = account.row(entry)
            unit = units.of(entry.kind, entry.channel, entry.type, entry.links)
            key = (entry.kind, entry.channel, entry.type, unit)
            stream = streams.get(key)
            if stream is None:
                if len(streams) >= _MAX_FILES:
                    row.fail(f"more than {_MAX_FILES} streams")
                    continue
                maker = TableMaker(
                    entry.kind, entry.type, entry.channel, recording.definitions, decoder, unit, accepted
                )
                # a column has one unit: what some peers get in another one is a file of its own
                other = any(known[:3] == key[:3] for known in streams)
                file = _File(folder, f"{names.of(entry)}{f'.{unit}' * other}.{form.suffix}", form)
                stack.callback(file.close)
                stream = streams[key] = _Stream(row, maker, file)
            stream.entries.append(entry)
            waiting += entry.size
            if waiting >= _BYTES:
                for each in streams.values():
                    each.flush()
                waiting = 0
            elif len(stream.entries) >= _ROWS:
                waiting -= sum(each.size for each in stream.entries)
                stream.flush()
        for each in streams.values():
            each.flush()
    account.files = sum(stream.file.is_open for stream in streams.values())
    account.notes += names.notes(f".{form.suffix}")
    return account


class _Stream:
    """A stream with messages that wait to be written."""

    def __init__(self, row: ExportedStream, maker: TableMaker, file: _File) -> None:
        self.row, self.maker, self.file = row, maker, file
        self.entries: list[Entry] = []

    def flush(self) -> None:
        """Write the waiting messages, and count them."""
        if not self.entries:
            return
        table, reasons = self.maker.table(block_of(self.entries))
        for why in reasons:
            self.row.fail(why)
        if table.num_rows:
            self.file.write(table)
        self.row.taken += table.num_rows
        self.entries = []


class _File:
    """A file that is being written; it exists from its first table on."""

    def __init__(self, folder: Folder, name: str, form: _Parquet | _Ipc) -> None:
        self._folder, self._name, self._form = folder, name, form
        self._schema: pa.Schema | None = None
        self._stream: BinaryIO | None = None
        self._writer: _Writer | None = None

    @property
    def is_open(self) -> bool:
        """Whether there is a file."""
        return self._schema is not None

    def write(self, table: pa.Table) -> None:
        if self._schema is None or self._writer is None:
            self._schema = table.schema
            self._stream = self._folder.create(self._name)
            self._writer = self._form.writer(self._stream, table.schema)
        elif not table.schema.equals(self._schema):
            wider = unified(self._schema, table.schema)
            if not wider.equals(self._schema):
                self._write_again(wider)
            table = fitted(table, wider)
        self._writer.write_table(table)

    def close(self) -> None:
        """Write the end of the file.  Idempotent."""
        if self._writer is not None and self._stream is not None:
            self._writer.close()
            self._stream.close()
            self._writer = None

    def _write_again(self, schema: pa.Schema) -> None:
        """Write what is there to a new file with more columns, which takes the place of the old one."""
        self.close()
        path = self._folder.path / self._name
        part = path.with_suffix(".part")
        stream = self._folder.create(part.name)
        writer = self._form.writer(stream, schema)
        for table in self._form.tables(path):
            writer.write_table(fitted(table, schema))
        part.replace(path)
        self._stream, self._writer, self._schema = stream, writer, schema

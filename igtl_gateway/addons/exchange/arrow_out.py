"""Export to Parquet and to Arrow IPC files: one file per stream, with a row per message and units in the schema.

Tables are those of ``arrow_tables``, with the columns of ``arrow_names``.  A file has the columns of all its messages:
if later messages have other columns, the file is written again with the columns of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
import pyarrow as pa

from igtl_gateway.addon.reading import (
    Kind,
    MessageBlock,
    block_of,
    joined_blocks,
    recorded_acceptance,
    recorded_units,
)
from igtl_gateway.addon.streams import TableMaker, fitted, unified
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.arrow_names import DatabaseColumns, Pictures, stamps_of
from igtl_gateway.addons.exchange.chosen_rows import ChosenRows, StreamMessages
from igtl_gateway.addons.exchange.folder import FileNames, Folder, new_folder
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, REPEATED, Recording

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
    account = ExportAccount()
    with new_folder(out, account) as folder, ExitStack() as stack:
        export = _Export(recording, account, folder, stack, form)
        for streams in ChosenRows(recording, globs, account):
            export.take(streams)
        export.finish()
    return account


class _Export:
    """The files that are being written."""

    def __init__(
        self, recording: Recording, account: ExportAccount, folder: Folder, stack: ExitStack, form: _Parquet | _Ipc
    ) -> None:
        self._recording, self._account, self._folder, self._stack = recording, account, folder, stack
        self._form, self._names = form, FileNames(recording.channels)
        self._decoder = MessageDecoder(lambda ros_type: recording.definitions.get(ros_type, ""))
        self._units, self._accepted = recorded_units(recording), recorded_acceptance(recording)
        self._streams: dict[tuple[Kind, str, str, str], _Stream] = {}
        self._pictures, self._waiting = Pictures(), 0

    def take(self, streams: Sequence[StreamMessages]) -> None:
        """Take the next messages of some streams."""
        size = sum(int((each.rows.ends - each.rows.begins).sum()) for each in streams)
        if self._waiting + size < _BYTES:
            for stream in streams:
                for part in self._of_one_unit(stream):
                    self._add(part)
            return
        places = [(int(at), stream, row) for stream in streams for row, at in enumerate(stream.order)]
        for _, stream, row in sorted(places, key=lambda place: place[0]):
            self._add(stream.where(slice(row, row + 1)))
            if self._waiting >= _BYTES:
                self._flush()
                self._waiting = 0

    def finish(self) -> None:
        """Write what waits, and complete the account."""
        self._flush()
        files = [stream.file for stream in self._streams.values()]
        self._account.files = sum(file.is_open for file in files)
        self._account.notes += [*self._names.notes(f".{self._form.suffix}"), *notes_of(files)]

    def _flush(self) -> None:
        for each in sorted(self._streams.values(), key=lambda stream: stream.file.order):
            each.flush()
        self._pictures.turn()

    def _of_one_unit(self, stream: StreamMessages) -> list[StreamMessages]:
        """Some messages by the unit of their lengths, in the order of their first ones: links may have several."""
        of_heads = {number: self._unit(stream, number) for number in dict.fromkeys(stream.rows.heads.tolist())}
        units = list(dict.fromkeys(of_heads.values()))
        if len(units) == 1:
            return [stream]
        which = np.array([units.index(of_heads[number]) for number in stream.rows.heads.tolist()])
        return [stream.where(np.flatnonzero(which == unit)) for unit in range(len(units))]

    def _unit(self, stream: StreamMessages, head: int) -> str:
        return self._units.of(stream.kind, stream.channel, stream.type, stream.heads.known[head].links)

    def _add(self, some: StreamMessages) -> None:
        """Add messages of one stream and unit, and write those that are enough for a table."""
        row = self._account.stream(some.kind, some.channel, some.type, len(some))
        if count := int(some.repeated.sum()):
            row.leave_out(REPEATED, count)
            some = some.where(np.flatnonzero(~some.repeated))
        if not len(some):
            return
        stream = self._stream(some, row)
        if stream is None:
            row.fail(f"more than {_MAX_FILES} streams", len(some))
            return
        while len(some):
            part, some = some.where(slice(0, _ROWS - stream.count)), some.where(slice(_ROWS - stream.count, None))
            self._waiting += stream.add(part)
            if self._waiting < _BYTES and stream.count >= _ROWS:
                self._waiting -= stream.flush()

    def _stream(self, some: StreamMessages, row: ExportedStream) -> _Stream | None:
        """The stream of messages with one unit; None where there are too many."""
        unit, streams, recording = self._unit(some, int(some.rows.heads[0])), self._streams, self._recording
        key = (some.kind, some.channel, some.type, unit)
        if key not in streams and len(streams) < _MAX_FILES:
            maker = TableMaker(
                some.kind, some.type, some.channel, recording.definitions, self._decoder, unit, self._accepted
            )
            # a column has one unit: what some peers get in another one is a file of its own
            other = any(known[:3] == key[:3] for known in streams)
            name = f"{self._names.of_stream(*key[:3])}{f'.{unit}' * other}.{self._form.suffix}"
            columns = columns_of(some.kind, some.type, recording, self._decoder)
            file = _File(self._folder, name, self._form, columns, self._pictures, is_output=not some.kind.is_input)
            self._stack.callback(file.close)
            streams[key] = _Stream(row, maker, file)
        return streams.get(key)


class _Stream:
    """A stream with messages that wait to be written.

    Attributes:
        count: number of these.
    """

    def __init__(self, row: ExportedStream, maker: TableMaker, file: _File) -> None:
        self.row, self.maker, self.file = row, maker, file
        self.count = 0
        self._size = 0
        self._blocks: list[MessageBlock] = []

    def add(self, some: StreamMessages) -> int:
        """Add messages; return the bytes of their payloads.  Raises UnsupportedRecording for times after 2262."""
        block = some.block()
        block = block_of([some.entry(row) for row in range(len(some))]) if block is None else block.compact()
        self._blocks.append(block)
        self.count += len(block)
        self._size += len(block.data)
        return len(block.data)

    def flush(self) -> int:
        """Write the waiting messages, and count them; return the bytes of their payloads."""
        if not self._blocks:
            return 0
        size, block = self._size, joined_blocks(self._blocks)
        self._blocks, self._size, self.count = [], 0, 0
        table, reasons = self.maker.table(block)
        for why in reasons:
            self.row.fail(why)
        if table.num_rows:
            self.file.write(table)
        self.row.taken += table.num_rows
        return size


def columns_of(kind: Kind, type_name: str, recording: Recording, decoder: MessageDecoder) -> DatabaseColumns:
    """Return the columns of a stream: which of its fields are stamps."""
    if kind in IGTL_KINDS:
        return DatabaseColumns(None)
    is_known = bool(recording.definitions.get(type_name))
    return DatabaseColumns(stamps_of(decoder.store(type_name).fielddefs, type_name) if is_known else frozenset())


def notes_of(files: Sequence[_File]) -> list[str]:
    """Return what is written in another way than in CSV, and than version 0.1 did."""
    if not any(each.is_open for each in files):
        return []
    files = sorted(files, key=lambda file: file.order)
    dotted = min((names for each in files if (names := each.columns.example)), default=None)
    found = ["columns time and source_time are times in UTC; CSV has time_ns and source_ns"]
    if dotted:
        found[0] += f"; dots are underscores: {dotted[0]} is {dotted[1]}"
    if once := [each for each in files if each.elsewhere]:
        other, column = min(once[0].elsewhere)
        more = f", and {len(once) - 1} more alike" if len(once) > 1 else ""
        found.append(f"pictures once: those of {once[0].name} are in {other}, at the entry in {column}{more}")
    return found


class _File:
    """A file that is being written; it exists from its first table on.

    Attributes:
        elsewhere: files that have pictures of this one, and its columns that name them.
    """

    def __init__(
        self,
        folder: Folder,
        name: str,
        form: _Parquet | _Ipc,
        columns: DatabaseColumns,
        pictures: Pictures,
        *,
        is_output: bool,
    ) -> None:
        self._folder, self.name, self._form = folder, name, form
        self.columns, self._pictures, self._is_output = columns, pictures, is_output
        self.elsewhere: set[tuple[str, str]] = set()
        self._schema: pa.Schema | None = None
        self._stream: BinaryIO | None = None
        self._writer: _Writer | None = None

    @property
    def is_open(self) -> bool:
        """Whether there is a file."""
        return self._schema is not None

    @property
    def order(self) -> tuple[bool, str]:
        """Place among the files that are written at once: inputs are before what was made of them."""
        return self._is_output, self.name

    def write(self, table: pa.Table) -> None:
        table, elsewhere = self._pictures.once(table, self.name, is_output=self._is_output)
        self.elsewhere |= elsewhere
        table = self.columns.table(table)
        if self._schema is None or self._writer is None:
            self._schema = table.schema
            self._stream = self._folder.create(self.name)
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
        path = self._folder.path / self.name
        part = path.with_suffix(".part")
        stream = self._folder.create(part.name)
        writer = self._form.writer(stream, schema)
        for table in self._form.tables(path):
            writer.write_table(fitted(table, schema))
        part.replace(path)
        self._stream, self._writer, self._schema = stream, writer, schema

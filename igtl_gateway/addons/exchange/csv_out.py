"""Export to CSV: one file per stream, with a row per message, or per element if a message contains a list.

Columns: ``entry`` (entry number in the session), ``time_ns`` (gateway time, UTC), ``source_ns`` (the sender's stamp,
empty if unset), ``item`` (index in the list, if there is one), then the fields of the message, named by
``api/columns.py``.  Numbers are those of the message; lengths of OpenIGTLink become millimetres.  Images, surfaces
and other long arrays of numbers are left out, because they do not fit in a table.

Poses, and ROS types of numbers and strings, are converted and written all at once; other messages one by one.

A file has the columns of all its messages: if a later message adds a column, the file is written again at the end.
Text is exported as received.  Spreadsheet programs interpret cells that begin with ``=``, ``+``, ``-`` or ``@`` as
formulas, so a note has their number.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igtl_gateway.addon import failure_text
from igtl_gateway.addon.igtl import BULKY, describe_content
from igtl_gateway.addon.reading import Entry, Kind, MessageBlock, recorded_acceptance, recorded_units
from igtl_gateway.addon.streams import (
    HEAD,
    LINK,
    MAX_COLUMNS,
    MAX_NUMBERS,
    POSE_TYPES,
    Cell,
    Cells,
    Column,
    NotColumns,
    TooLong,
    cell_text,
    csv_lines,
    name_igtl_fields,
    name_ros_fields,
    number_cell,
    pose_columns,
    pose_rows,
    ros_columns,
    rows_of_cell,
    table_rows,
)
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addon.writing import open_text
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.chosen_rows import ChosenRows, StreamMessages
from igtl_gateway.addons.exchange.folder import FileNames, Folder, new_folder
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, REPEATED, Recording

#: Files that are open at the same time; a usual session has a few dozen streams.
_MAX_FILES = 500
#: Larger messages are not decoded: each element of a list needs a few hundred bytes of memory.
_MAX_BYTES = 8 << 20
#: Characters of one cell: bytes are written as hexadecimal digits or as numbers.
_MAX_FIELD = 8 * _MAX_BYTES

_BULKY_TEXT = "pixels, points and cells do not fit in a table; use another format"
_UNDEFINED_TEXT = "the session has no definition of its type"
#: Messages of a stream from which on they are decoded at once.
_FEW = 8
#: Strings of a table that are kept as they are in the file.
_MOST_STRINGS = 1_000

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
_UNWRITABLE = re.compile(r"[\x00\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Strings:
    """The strings of a column."""

    values: list[str]


#: Name of a column → its cells.
NamedCells = dict[str, Cell | Strings]


def export_csv(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises UnsupportedRecording if it is not empty; OSError."""
    account = ExportAccount()
    with new_folder(out, account) as folder, ExitStack() as stack:
        export = _Export(recording, account, folder, stack)
        for streams in ChosenRows(recording, globs, account):
            export.write(streams)
        export.finish()
    return account


class _Export:
    """The tables that are being written."""

    def __init__(self, recording: Recording, account: ExportAccount, folder: Folder, stack: ExitStack) -> None:
        self._account, self._folder, self._stack = account, folder, stack
        self._names, self._links, self._read = FileNames(recording.channels), _Links(), _RowReader(recording)
        self._tables: dict[str, _Table] = {}

    def write(self, streams: Sequence[StreamMessages]) -> None:
        """Write the next messages of some streams, of each in order."""
        if len(self._tables) + len(streams) > _MAX_FILES:
            # which of the new ones get a file depends on the order of all messages
            places = [(int(at), stream, row) for stream in streams for row, at in enumerate(stream.order)]
            for _, stream, row in sorted(places, key=lambda place: place[0]):
                self._write_one(stream, row)
            return
        for stream in streams:
            if not (len(stream) >= _FEW and not stream.repeated.any() and self._write_all(stream)):
                for row in range(len(stream)):
                    self._write_one(stream, row)

    def finish(self) -> None:
        """Complete the tables and the account."""
        for table in self._tables.values():
            table.finish()
        account = self._account
        account.files = len(self._tables)
        account.notes += self._names.notes(".csv")
        if formulas := sum(table.formulas for table in self._tables.values()):
            account.notes.append(
                f"text cells that begin with = + - or @: {formulas:,}; "
                "spreadsheet programs interpret them as formulas; import these columns as text"
            )

    def _write_one(self, stream: StreamMessages, at: int) -> None:
        account_row = self._account.stream(stream.kind, stream.channel, stream.type)
        if stream.repeated[at]:
            account_row.leave_out(REPEATED)
            return
        name = self._names.of_stream(stream.kind, stream.channel, stream.type)
        entry = stream.entry(at)
        try:
            lines = list(self._read.rows(entry))
            if self._links.differ(entry):
                lines = [{**line, LINK: entry.links[0]} for line in lines]
            table = self._tables.get(name)
            if table is None:
                if len(self._tables) >= _MAX_FILES:
                    account_row.fail(f"more than {_MAX_FILES} streams")
                    return
                table = _Table(lines)
            columns = table.columns_with(lines)
        except TooLong as error:
            account_row.leave_out(str(error))
            return
        except Exception as error:  # decoding raises many types of errors; only this message is left out
            account_row.fail(failure_text(error))
            return
        self._open(name, table)
        table.write(columns, entry, lines)
        account_row.taken += 1

    def _write_all(self, stream: StreamMessages) -> bool:
        """Write the messages of a stream at once; False if that is not possible, and nothing is written."""
        count = len(stream)
        if why := self._read.why_none(stream):
            self._names.of_stream(stream.kind, stream.channel, stream.type)
            self._account.stream(stream.kind, stream.channel, stream.type, count).leave_out(why, count)
            return True
        cells = self._read.cells(stream)
        name = self._names.of_stream(stream.kind, stream.channel, stream.type)
        table = self._tables.get(name)
        if cells is None or (first := self._links.differ_from(stream)) is None:
            return False
        lines: list[Cells] = [dict.fromkeys(cells)] if first else []
        lines += [dict.fromkeys((*cells, LINK))] if first < count else []
        if table is None:
            table = _Table(lines[:1])
        try:
            columns = table.columns_with(lines)
        except TooLong:
            return False
        self._links.see(stream)
        self._open(name, table)
        table.write_lines(columns, stream, cells, first)
        self._account.stream(stream.kind, stream.channel, stream.type, count).taken += count
        return True

    def _open(self, name: str, table: _Table) -> None:
        if name not in self._tables:
            self._stack.callback(table.open(self._folder, f"{name}.csv").close)
            self._tables[name] = table


class _Links:
    """The links of the received streams."""

    def __init__(self) -> None:
        self._first: dict[str, int] = {}
        self._several: set[str] = set()

    def differ(self, entry: Entry) -> bool:
        """Return whether a second peer has sent the stream of an entry."""
        if entry.kind is not Kind.IGTL_IN or not entry.links:
            return False
        if self._first.setdefault(entry.channel, entry.links[0]) != entry.links[0]:
            self._several.add(entry.channel)
        return entry.channel in self._several

    def differ_from(self, stream: StreamMessages) -> int | None:
        """Return the first of some messages from which on a second peer has sent their stream, or their number.

        None if some have no link.
        """
        if stream.kind is not Kind.IGTL_IN:
            return len(stream)
        if not stream.links.all():
            return None
        if stream.channel in self._several:
            return 0
        others = stream.links != self._first.get(stream.channel, stream.links[0])
        return int(np.argmax(others)) if others.any() else len(stream)

    def see(self, stream: StreamMessages) -> None:
        """Take notice of messages of which all have a link."""
        if stream.kind is Kind.IGTL_IN:
            first = self._first.setdefault(stream.channel, int(stream.links[0]))
            if (stream.links != first).any():
                self._several.add(stream.channel)


class _Table:
    """A file that is being written; later messages can add columns."""

    def __init__(self, lines: list[Cells]) -> None:
        self.formulas = 0
        self._columns = dict.fromkeys((*HEAD[:3], *(lines[0] if lines else ())))
        self._head_columns = len(self._columns)

    def open(self, folder: Folder, name: str) -> io.TextIOWrapper:
        """Create the file and write its header row; the caller closes it."""
        self._path = folder.path / name
        self._stream = io.TextIOWrapper(folder.create(name), "utf-8", newline="")
        self._texts: dict[str, bytes] = {}
        self._writer = csv.writer(self._stream)
        self._head_columns = len(self._columns)
        self._writer.writerow(self._columns)
        return self._stream

    def columns_with(self, lines: list[Cells]) -> dict[str, None]:
        """Return the columns of the table after adding some rows.  Raises TooLong."""
        new = [name for line in lines for name in line if name not in self._columns]
        if not new:
            return self._columns
        columns = self._columns | dict.fromkeys(new)
        if len(columns) > MAX_COLUMNS:
            raise TooLong(f"more than {MAX_COLUMNS} columns")
        return columns

    def write(self, columns: dict[str, None], entry: Entry, lines: list[Cells]) -> None:
        """Write the rows of a message; ``columns`` are the result of ``columns_with``."""
        self._columns = columns
        head = {"entry": entry.seq, "time_ns": entry.stamp_ns, "source_ns": entry.source_ns or ""}
        for line in lines:
            cells = head | line
            row = [cells.get(name, "") for name in columns]
            self._writer.writerow([self._text(cell) if isinstance(cell, str) else cell for cell in row])

    def write_lines(self, columns: dict[str, None], stream: StreamMessages, cells: NamedCells, first: int) -> None:
        """Write a line for each of some messages.

        Args:
            columns: the result of ``columns_with``.
            cells: name → numbers, or its strings.
            first: of the messages that state their link.
        """
        self._columns = columns
        given = {name: self._cell(cell) for name, cell in cells.items()}
        numbers, times, stamps = stream.rows.numbers, stream.rows.times, stream.rows.stamps
        head = zip(HEAD, (number_cell(numbers), number_cell(times), number_cell(stamps, stamps != 0)), strict=False)
        given = dict(head) | given
        with_links = given | {LINK: number_cell(stream.links)}
        self._stream.flush()
        for rows, their in ((slice(first), given), (slice(first, len(stream)), with_links)):
            if count := len(stream.links[rows]):
                line = [rows_of_cell(their.get(name, b""), rows) for name in columns]
                self._stream.buffer.write(csv_lines(count, line))

    def _cell(self, cell: Cell | Strings) -> Cell:
        """Strings as they are in the file."""
        if not isinstance(cell, Strings):
            return cell
        values = cell.values
        if values.count(values[0]) == len(values):  # such as the name of a frame
            self.formulas += (len(values) - 1) * values[0].startswith(_FORMULA)
            return self._written(values[0])
        return [self._written(text) for text in values]

    def _written(self, text: str) -> bytes:
        """A string as it is in the file; equal ones are quoted once."""
        self.formulas += text.startswith(_FORMULA)
        found = self._texts.get(text)
        if found is None:
            if len(self._texts) >= _MOST_STRINGS:
                self._texts.clear()
            found = self._texts[text] = cell_text(_UNWRITABLE.sub("\ufffd", text))
        return found

    def _text(self, value: str) -> str:
        self.formulas += value.startswith(_FORMULA)
        return _UNWRITABLE.sub("\ufffd", value)

    def finish(self) -> None:
        """Close the file; write it again if columns were added after its header row."""
        self._stream.close()
        if len(self._columns) == self._head_columns:
            return
        whole = self._path.with_suffix(".part")
        limit = csv.field_size_limit(_MAX_FIELD)
        try:
            with (
                self._path.open(encoding="utf-8", newline="") as old,
                open_text(whole, newline="") as new,
            ):
                rows, writer = csv.reader(old), csv.writer(new)
                next(rows)
                writer.writerow(self._columns)
                for row in rows:
                    writer.writerow(row + [""] * (len(self._columns) - len(row)))
            whole.replace(self._path)
        finally:
            csv.field_size_limit(limit)
            whole.unlink(missing_ok=True)


def _has_large(stream: StreamMessages) -> bool:
    return bool((stream.rows.ends - stream.rows.begins > _MAX_BYTES).any())


class _RowReader:
    """Decodes messages to rows of cells."""

    def __init__(self, recording: Recording) -> None:
        self._definitions = definitions = recording.definitions
        self._units, self._acceptance = recorded_units(recording), recorded_acceptance(recording)
        self._decoder = MessageDecoder(lambda ros_type: definitions.get(ros_type, ""))

    def why_none(self, stream: StreamMessages) -> str:
        """Return why none of some messages fits in a table, without decoding them; ``""`` if one may."""
        if _has_large(stream):
            return ""
        if stream.kind in IGTL_KINDS:
            return _BULKY_TEXT if stream.type in BULKY else ""
        return "" if self._definitions.get(stream.type) else _UNDEFINED_TEXT

    def cells(self, stream: StreamMessages) -> NamedCells | None:
        """Return the cells of all messages, each of which is one row; None if they have to be decoded one by one."""
        block = stream.block()
        if block is None or _has_large(stream):
            return None
        try:
            columns = self._columns(stream, block)
        except Exception:  # decoding raises many types of errors; which message is wrong is found one by one
            return None
        found: NamedCells = {}
        for column in columns:
            name = f"{column.name}_" if column.name in HEAD else column.name
            values = column.values
            if column.is_text:
                more: NamedCells = {name: Strings(column.texts())}
            elif (
                column.offsets is not None or values.dtype.names or (values.ndim > 1 and values.shape[1] > MAX_NUMBERS)
            ):
                return None
            elif values.ndim > 1:
                more = {f"{name}.{index}": number_cell(values[:, index]) for index in range(values.shape[1])}
            else:
                more = {name: number_cell(values, column.valid)}
            if not found.keys().isdisjoint(more):
                return None
            found |= more
        return found if len(found) <= MAX_COLUMNS else None

    def _columns(self, stream: StreamMessages, block: MessageBlock) -> list[Column]:
        """The fields of all messages.  Raises NotColumns, and the errors of the decoders."""
        if stream.kind not in IGTL_KINDS:
            return ros_columns(block, self._decoder.store(stream.type).fielddefs, stream.type)
        units = {self._units.of(stream.kind, stream.channel, stream.type, links) for links in stream.all_links}
        if stream.type not in POSE_TYPES or len(units) > 1:
            raise NotColumns
        found = pose_rows(block, stream.type, self._acceptance)
        if len(found.rows) < len(block):
            raise NotColumns
        return pose_columns(found, units.pop())

    def rows(self, entry: Entry) -> Iterator[Cells]:
        """Yield the rows of a message.  Raises TooLong, and the errors of the decoders."""
        if entry.size > _MAX_BYTES:
            raise TooLong(f"found messages of more than {_MAX_BYTES >> 20} MiB, expected at most that in a table")
        if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            if entry.type in BULKY:
                raise TooLong(_BULKY_TEXT)
            unit = self._units.of(entry.kind, entry.channel, entry.type, entry.links)
            fields = name_igtl_fields(describe_content(self._acceptance.message(entry.data()).content), unit)
        elif not self._definitions.get(entry.type):
            raise TooLong(_UNDEFINED_TEXT)
        else:
            message = self._decoder.decode(entry.type, entry.data())
            fields = name_ros_fields(self._decoder.store(entry.type), message)
        yield from table_rows(fields, entry.size)

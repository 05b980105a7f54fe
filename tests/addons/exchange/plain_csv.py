"""Export to CSV message by message, for tests of ``csv_out``, which has to write the same.

Columns: ``entry`` (entry number in the session), ``time_ns`` (gateway time, UTC), ``source_ns`` (the sender's stamp,
empty if unset), ``item`` (index in the list, if there is one), then the fields of the message, named by
``api/columns.py``.  Numbers are those of the message; lengths of OpenIGTLink become millimetres.  Images, surfaces
and other long arrays of numbers are left out, because they do not fit in a table.

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
from pathlib import Path

from igtl_gateway.addon import failure_text
from igtl_gateway.addon.igtl import BULKY, describe_content
from igtl_gateway.addon.reading import Entry, Kind, recorded_acceptance, recorded_units
from igtl_gateway.addon.streams import (
    HEAD,
    LINK,
    MAX_COLUMNS,
    Cells,
    TooLong,
    name_igtl_fields,
    name_ros_fields,
    table_rows,
)
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addon.writing import open_text
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.folder import FileNames, Folder, new_folder
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, Recording, chosen_entries

#: Files that are open at the same time; a usual session has a few dozen streams.
_MAX_FILES = 500
#: Larger messages are not decoded: each element of a list needs a few hundred bytes of memory.
_MAX_BYTES = 8 << 20
#: Characters of one cell: bytes are written as hexadecimal digits or as numbers.
_MAX_FIELD = 8 * _MAX_BYTES

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
_UNWRITABLE = re.compile(r"[\x00\ud800-\udfff]")


def export_csv(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises UnsupportedRecording if it is not empty; OSError."""
    account, names, links = ExportAccount(), FileNames(recording.channels), _Links()
    tables: dict[str, _Table] = {}
    read = _RowReader(recording)
    with new_folder(out, account) as folder, ExitStack() as stack:
        for entry in chosen_entries(recording, (*IGTL_KINDS, *ROS_KINDS), globs, account):
            row, name = account.row(entry), names.of(entry)
            try:
                lines = list(read.rows(entry))
                if links.differ(entry):
                    lines = [{**line, LINK: entry.links[0]} for line in lines]
                table = tables.get(name)
                if table is None:
                    if len(tables) >= _MAX_FILES:
                        row.fail(f"more than {_MAX_FILES} streams")
                        continue
                    table = _Table(lines)
                columns = table.columns_with(lines)
            except TooLong as error:
                row.leave_out(str(error))
                continue
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                row.fail(failure_text(error))
                continue
            if name not in tables:
                stack.callback(table.open(folder, f"{name}.csv").close)
                tables[name] = table
            table.write(columns, entry, lines)
            row.taken += 1
        for table in tables.values():
            table.finish()
    account.files = len(tables)
    account.notes += names.notes(".csv")
    if formulas := sum(table.formulas for table in tables.values()):
        account.notes.append(
            f"text cells that begin with = + - or @: {formulas:,}; "
            "spreadsheet programs interpret them as formulas; import these columns as text"
        )
    return account


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


class _RowReader:
    """Decodes messages to rows of cells."""

    def __init__(self, recording: Recording) -> None:
        self._definitions = definitions = recording.definitions
        self._units, self._acceptance = recorded_units(recording), recorded_acceptance(recording)
        self._decoder = MessageDecoder(lambda ros_type: definitions.get(ros_type, ""))

    def rows(self, entry: Entry) -> Iterator[Cells]:
        """Yield the rows of a message.  Raises TooLong, and the errors of the decoders."""
        if entry.size > _MAX_BYTES:
            raise TooLong(f"found messages of more than {_MAX_BYTES >> 20} MiB, expected at most that in a table")
        if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            if entry.type in BULKY:
                raise TooLong("pixels, points and cells do not fit in a table; use another format")
            unit = self._units.of(entry.kind, entry.channel, entry.type, entry.links)
            fields = name_igtl_fields(describe_content(self._acceptance.message(entry.data()).content), unit)
        elif not self._definitions.get(entry.type):
            raise TooLong("the session has no definition of its type")
        else:
            message = self._decoder.decode(entry.type, entry.data())
            fields = name_ros_fields(self._decoder.store(entry.type), message)
        yield from table_rows(fields, entry.size)

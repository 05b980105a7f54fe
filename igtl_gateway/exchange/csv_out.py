"""Export to CSV: one file per stream, one row per message; several where a message lists several things.

Columns: ``entry`` (its number in the session), ``time_ns`` (gateway, UTC), ``source_ns`` (the sender's stamp, empty if
unset), ``item`` (place in the list, where there is one), then the fields of the message, nested ones with dots and
rows of numbers with their index.  OpenIGTLink numbers are as on the wire (millimetres), a TRANSFORM also as position
and quaternion; those of ROS as in the message.  Streams with pixels, points or other long rows of numbers are left
out: that is no table.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from igtl_gateway.convert.context import ToRos
from igtl_gateway.convert.poses import pose_of_matrix
from igtl_gateway.convert.units import Lengths
from igtl_gateway.errors import ConversionError, WireError
from igtl_gateway.exchange.recording import (
    IGTL_KINDS,
    ROS_KINDS,
    Account,
    Names,
    Recording,
    chosen,
    left_out,
    new_folder,
)
from igtl_gateway.exchange.source import Row
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.wire import decode
from igtl_gateway.wire.transform import Transform

#: Longer rows of numbers are no columns.
MAX_NUMBERS = 64
_HEAD = ("entry", "time_ns", "source_ns")
#: Files that are open at once; a session has some dozens of streams.
_MAX_FILES = 500

#: Types that are not read at all: what they say is in their pixels and points.
_NO_TABLES = frozenset({"IMAGE", "POLYDATA", "VIDEO", "COLORT", "COLORTABLE", "NDARRAY"})
_QUATERNION = ("qx", "qy", "qz", "qw")

Cells = dict[str, Any]

_AS_IT_IS = Lengths("mm", "mm")


class TooLong(Exception):
    """A message that does not fit a table."""


@dataclass(slots=True)
class _Table:
    stream: IO[str]
    writer: Any
    columns: list[str]


def export_csv(recording: Recording, out: Path, globs: Sequence[str]) -> Account:
    """Write the folder ``out``.  Raises UnsupportedRecording where it is not empty; OSError."""
    account, names, folder = Account(), Names(), new_folder(out)
    tables: dict[str, _Table] = {}
    closed: set[str] = set()
    read = _Reader(recording.definitions)
    with ExitStack() as stack:
        for entry in chosen(recording, (*IGTL_KINDS, *ROS_KINDS), globs):
            row, name = account.row(entry), names.of(entry)
            if name in closed:
                left_out(row, "")
                continue
            try:
                lines = list(read.rows(entry))
            except TooLong as error:
                left_out(row, str(error))
                if name not in tables:
                    closed.add(name)
                continue
            except (WireError, ValueError, LookupError, AssertionError) as error:
                row.why = f"cannot be decoded: {error}"
                continue
            if name not in tables:
                if len(tables) >= _MAX_FILES:
                    row.why = f"more than {_MAX_FILES} streams"
                    continue
                stream = stack.enter_context((folder / f"{name}.csv").open("x", encoding="utf-8", newline=""))
                columns = [*_HEAD, *(lines[0] if lines else ())]
                tables[name] = _Table(stream, csv.DictWriter(stream, columns, extrasaction="ignore"), columns)
                tables[name].writer.writeheader()
            _write(tables[name], entry, lines, row)
    account.files = len(tables)
    return account


def _write(table: _Table, entry: Entry, lines: list[Cells], row: Row) -> None:
    head = {"entry": entry.seq, "time_ns": entry.stamp_ns, "source_ns": entry.source_ns or ""}
    for line in lines:
        if not line.keys() <= set(table.columns):
            row.why = "some messages have more fields than the first one: those are not in the table"
        table.writer.writerow({**head, **line})
    row.taken += 1


class _Reader:
    """Messages as rows of cells."""

    def __init__(self, definitions: Mapping[str, str]) -> None:
        self._definitions = definitions
        self._decoders: dict[str, Callable[[bytes], dict[str, Any]]] = {}

    def rows(self, entry: Entry) -> Iterator[Cells]:
        """Raises TooLong, and whatever the decoders raise."""
        if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            if entry.type in _NO_TABLES:
                raise TooLong("no table")
            content = decode(entry.data()).content
            yield from listed(_pose(content) if isinstance(content, Transform) else content.describe())
            return
        if entry.type not in self._decoders:
            self._decoders[entry.type] = self._decoder(entry.type)
        yield from listed(self._decoders[entry.type](entry.data()))

    def _decoder(self, ros_type: str) -> Callable[[bytes], dict[str, Any]]:
        store: Typestore = get_typestore(Stores.EMPTY)
        text = self._definitions.get(ros_type, "")
        if not text:
            raise TooLong("the session has no definition of its type")
        store.register(get_types_from_msg(text, ros_type))
        return lambda data: _plain(store, store.deserialize_cdr(data, ros_type))


def _plain(store: Typestore, value: Any) -> Any:
    """A message of rosbags' as a dict, without its constants; its lists as they are."""
    ros_type = getattr(value, "__msgtype__", "")
    if ros_type:
        names = [name for name, _ in store.fielddefs[ros_type][1]]
        return {name: _plain(store, getattr(value, normalize_fieldname(name))) for name in names}
    return [_plain(store, one) for one in value] if isinstance(value, list) else value


def _pose(content: Transform) -> dict[str, Any]:
    named: dict[str, Any] = dict(zip("xyz", content.wire_matrix[9:], strict=True))
    try:
        pose = pose_of_matrix(content.wire_matrix, ToRos("", 0, "", "", _AS_IT_IS), "TRANSFORM")
        named |= zip(_QUATERNION, pose[3:], strict=True)
    except ConversionError:
        named |= dict.fromkeys(_QUATERNION, "")  # no rotation: the matrix tells what it is
    return named | {f"r{i + 1}{j + 1}": content.rows[i][j] for i in range(3) for j in range(3)}


def listed(fields: Mapping[str, Any]) -> Iterator[Cells]:
    """The rows of a message: one for each element where a field of it is a list of things, else one."""
    lists = [name for name, value in fields.items() if _is_list_of_things(value)]
    if not lists:
        yield dict(_cells("", fields))
        return
    rest = dict(_cells("", {name: value for name, value in fields.items() if name not in lists}))
    for index in range(max(len(fields[name]) for name in lists)):
        line: Cells = {"item": index, **rest}
        for name in lists:
            if index < len(fields[name]):
                line |= dict(_cells(name, fields[name][index]))
        yield line


def _is_list_of_things(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)


def _cells(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Columns and values of a field.  Raises TooLong."""
    if isinstance(value, np.ndarray | bytes | memoryview):
        if len(value) > MAX_NUMBERS:
            raise TooLong(f"{name}: {len(value)} numbers, expected at most {MAX_NUMBERS} in a table")
        value = value.tolist() if isinstance(value, np.ndarray) else list(value)
    match value:
        case dict():
            for key, inner in value.items():
                yield from _cells(f"{name}.{key}" if name else key, inner)
        case list() | tuple():
            if len(value) > MAX_NUMBERS:
                raise TooLong(f"{name}: {len(value)} values, expected at most {MAX_NUMBERS} in a table")
            for index, inner in enumerate(value):
                yield from _cells(f"{name}.{index}", inner)
        case str():
            yield name, re.sub(r"[\x00\ud800-\udfff]", "\ufffd", value)
        case _:
            yield name, value

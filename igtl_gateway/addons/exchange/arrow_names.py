"""The columns of files for databases: names that SQL takes without quotes, stamps as times, pictures once.

A name has letters, digits and underscores, and is no reserved word: ``transform.translation.x_m`` is
``transform_translation_x_m``.  A stamp is a time in UTC with nanoseconds, without the unit in its name:
``header.stamp_ns`` is ``header_stamp``; a duration stays a number.  The metadata of a field have the name in CSV, as
``field``, where it is another one.
"""

from __future__ import annotations

import hashlib
import re
import string
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rosbags.interfaces import Nodetype

UTC = pa.timestamp("ns", tz="UTC")
#: First columns → their names here.
_HEAD = {"time_ns": "time", "source_ns": "source_time"}
_STAMP = "builtin_interfaces/msg/Time"
#: Field of an OpenIGTLink message that ends as stamps do and is another thing.
_DURATIONS = frozenset({"resolution_ns"})
_STRANGE = re.compile(r"[^A-Za-z0-9_]+")
#: Words that cannot be the name of a column in DuckDB, PostgreSQL or SQLite.
RESERVED = frozenset(
    """
    add all alter analyse analyze and anti any array as asc asof asymmetric at authorization autoincrement
    between binary both by case cast check collate collation column commit concurrently constraint create cross
    current_catalog current_date current_role current_schema current_time current_timestamp current_user default
    deferrable delete desc describe distinct do drop else end escape except exists false fetch for foreign
    freeze from full glob group having ilike in index initially inner insert intersect into is isnull join
    lambda lateral leading left like limit localtime localtimestamp natural not nothing notnull null offset on
    only or order outer overlaps pivot pivot_longer pivot_wider placing positional primary qualify raise
    references regexp returning right select semi session_user set show similar some summarize symmetric table
    tablesample then to trailing transaction true union unique unpack unpivot update user using values variadic
    verbose when where window with
    """.split()
)
#: Bytes of a message from which on they are looked for in other messages.
_LARGE = 4096


def sql_name(name: str) -> str:
    """Return a name as SQL takes it without quotes."""
    plain = _STRANGE.sub("_", name).strip("_") or "field"
    if plain[0] in string.digits:
        plain = f"n{plain}"
    return f"{plain}_" if plain.lower() in RESERVED else plain


def stamps_of(types: Mapping[str, Any], ros_type: str) -> frozenset[str]:
    """Return the names in CSV of the fields of a ROS type that are stamps; ``types`` as rosbags has them."""
    return frozenset(_stamps(types, ros_type, ""))


def _stamps(types: Mapping[str, Any], ros_type: str, place: str) -> Iterator[str]:
    if ros_type not in types:
        return
    for field, (kind, inner) in types[ros_type][1]:
        path = f"{place}.{field}" if place else field
        of_list = kind in (Nodetype.SEQUENCE, Nodetype.ARRAY) and inner[0][0] == Nodetype.NAME
        name = inner if kind == Nodetype.NAME else inner[0][1] if of_list else ""
        if name == _STAMP:
            yield f"{path}_ns"
        elif name:
            yield from _stamps(types, name, path)


class DatabaseColumns:
    """The columns of one stream.

    Args:
        stamps: names in CSV of the fields that are stamps; None: every field whose unit is ns, except durations of
            OpenIGTLink.
    """

    def __init__(self, stamps: frozenset[str] | None) -> None:
        self._stamps = stamps
        self._names: dict[str, str] = {}
        self._taken: set[str] = set()

    @property
    def example(self) -> tuple[str, str] | None:
        """A column whose name in CSV has a dot, and its name here."""
        return next(((path, name) for path, name in self._names.items() if "." in path), None)

    def table(self, table: pa.Table) -> pa.Table:
        """Return a table of ``TableMaker`` with the names and the types of this file."""
        fields, arrays = [], []
        for field, column in zip(table.schema, table.columns, strict=True):
            array = column.combine_chunks()
            array = pa.concat_arrays(array.chunks) if isinstance(array, pa.ChunkedArray) else array
            new = self._field(field, field.name)
            fields.append(new)
            arrays.append(array if array.type.equals(new.type) else _as(array, new.type))
        return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=table.schema.metadata))

    def _field(self, field: pa.Field, path: str) -> pa.Field:
        name = self._names.get(path) or self._named(path)
        metadata = dict(field.metadata or {})
        if self._is_stamp(path) and field.type == pa.int64():
            metadata.pop(b"unit", None)
            kind = UTC
        else:
            kind = self._kind(field.type, path)
        if name != field.name:
            metadata[b"field"] = field.name.encode()
        return pa.field(name, kind, metadata=metadata or None)

    def _kind(self, kind: pa.DataType, path: str) -> pa.DataType:
        """A type with the names of the fields inside of lists."""
        if pa.types.is_struct(kind):
            names: set[str] = set()
            return pa.struct([self._inner(each, f"{path}.{each.name}", names) for each in kind])
        if pa.types.is_list(kind):
            return pa.list_(self._kind(kind.value_type, path))
        return kind

    def _inner(self, field: pa.Field, path: str, taken: set[str]) -> pa.Field:
        is_stamp = self._is_stamp(path) and field.type == pa.int64()
        name = _free(sql_name(field.name.removesuffix("_ns") if is_stamp else field.name), taken)
        metadata = dict(field.metadata or {}) | ({b"field": field.name.encode()} if name != field.name else {})
        if is_stamp:
            metadata.pop(b"unit", None)
        return pa.field(name, UTC if is_stamp else self._kind(field.type, path), metadata=metadata or None)

    def _is_stamp(self, path: str) -> bool:
        if path in _HEAD or self._stamps is not None:
            return path in _HEAD or path in (self._stamps or ())
        return path.endswith("_ns") and path.rpartition(".")[2] not in _DURATIONS

    def _named(self, path: str) -> str:
        wanted = _HEAD.get(path) or sql_name(path.removesuffix("_ns") if self._is_stamp(path) else path)
        self._names[path] = name = _free(wanted, self._taken)
        return name


def _free(wanted: str, taken: set[str]) -> str:
    """Return a name, with a number where another column has it: SQL takes no notice of capital letters."""
    name, number = wanted, 2
    while name.lower() in taken:
        name, number = f"{wanted}_{number}", number + 1
    taken.add(name.lower())
    return name


def _as(array: pa.Array, kind: pa.DataType) -> pa.Array:
    """The same bytes as another type: names within it, and integers as times."""
    if pa.types.is_list(kind):
        inner = _as(array.values, kind.value_type)
        return pa.Array.from_buffers(
            kind, len(array), array.buffers()[:2], array.null_count, array.offset, children=[inner]
        )
    if pa.types.is_struct(kind):
        whole = [array.field(number) for number in range(len(kind))]
        children = [_as(each, field.type) for each, field in zip(whole, kind, strict=True)]
        valid = None if not array.null_count else pa.py_buffer(np.packbits(array.is_valid(), bitorder="little"))
        return pa.Array.from_buffers(kind, len(array), [valid], array.null_count, 0, children=children)
    return array if array.type.equals(kind) else array.view(kind)


class Pictures:
    """Bytes that a message has in common with an earlier one, such as the pixels of a picture and of its outputs.

    They are written once: the later message has the entry number of the earlier one instead.
    """

    def __init__(self) -> None:
        self._now: dict[bytes, tuple[int, str]] = {}
        self._before: dict[bytes, tuple[int, str]] = {}

    def turn(self) -> None:
        """All that waited was written: keep what it had, for messages that follow from its last ones."""
        self._before, self._now = self._now, {}

    def once(self, table: pa.Table, file: str, *, is_output: bool) -> tuple[pa.Table, set[tuple[str, str]]]:
        """Return the table without bytes that earlier messages have; the files that have them, with the column for it.

        Args:
            table: of a stream.
            file: name of its file.
            is_output: whether the gateway made its messages: only of these something is left out.
        """
        elsewhere: set[tuple[str, str]] = set()
        for place, field in enumerate(table.schema):
            if field.type != pa.binary():
                continue
            column = table.column(place).combine_chunks()
            entries = table["entry"].to_pylist()
            found: list[int | None] = [None] * len(table)
            for row, value in enumerate(column):
                buffer = value.as_buffer()
                if buffer is None or len(buffer) < _LARGE:
                    continue
                digest = hashlib.blake2b(buffer, digest_size=16).digest()
                known = self._now.get(digest) or self._before.get(digest)
                if is_output and known and known[1] != file:
                    found[row] = known[0]
                    elsewhere.add((known[1], f"{field.name}_entry"))
                else:
                    self._now.setdefault(digest, (entries[row], file))
            sources = pa.array(found, pa.int64())
            if sources.null_count < len(table):
                kept = pc.if_else(pc.is_valid(sources), pa.scalar(None, pa.binary()), column)
                table = table.set_column(place, field, kept)
                table = table.append_column(pa.field(f"{field.name}_entry", pa.int64()), sources)
        return table, elsewhere

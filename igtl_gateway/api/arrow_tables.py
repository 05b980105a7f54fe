"""Messages of one stream as an Arrow table: a row per message, a column per field, units in the metadata of the fields.

Columns have the names that ``columns`` gives them, after ``entry``, ``time_ns`` and ``source_ns``.  A list of messages
in a message is a list of structs, numbers are lists, pixels and other bytes are binary.  Metadata of header version 2
is a map from key to text.  Poses and ROS types of numbers and strings are converted all at once; other messages one by
one.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from igtl_gateway.api.cdr_columns import Column, NotColumns, ros_columns, unit_text
from igtl_gateway.api.columns import HEAD, LINK, UNITS_OF_NAMES, name_igtl_fields, name_ros_fields
from igtl_gateway.api.igtl_columns import POSE_TYPES, pose_columns, pose_rows
from igtl_gateway.base.errors import ConversionError, GatewayError, Unavailable, failure_text
from igtl_gateway.base.extras import missing
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.convert.scaling import into_ros
from igtl_gateway.convert.units import ieee_754, millimetres
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.wire.message import metadata_of
from igtl_gateway.wire.registry import BULKY, describe_content

try:
    import pyarrow as pa
except ImportError as error:
    raise Unavailable(missing("pyarrow", error)) from None

#: Field of such a message that is an array of lengths → its name with the unit.
_BULKY_NAMES = {"points": "points_mm"}
_SURROGATES = re.compile(r"[\ud800-\udfff]")
_MAX_OFFSET = (1 << 31) - 1

Fields = dict[str, Any]
#: Column of the metadata of header version 2; no type has a field of this name.
METADATA = "metadata"


class TableMaker:
    """Makes tables of the messages of one stream.

    Args:
        kind: kind of the entries.
        type_name: OpenIGTLink or ROS type.
        name: of the stream, for the metadata of the schema.
        definitions: ROS type → definition.
        decoder: of ROS messages.
        unit: of lengths in OpenIGTLink messages, which become millimetres.
    """

    def __init__(
        self,
        kind: Kind,
        type_name: str,
        name: str,
        definitions: Mapping[str, str],
        decoder: MessageDecoder,
        unit: str,
        acceptance: Acceptance = DEFAULT_ACCEPTANCE,
    ) -> None:
        self._is_igtl = kind in (Kind.IGTL_IN, Kind.IGTL_OUT)
        self._type, self._definitions, self._decoder, self._unit = type_name, definitions, decoder, unit
        self._acceptance = acceptance
        self._links: set[int] = set()
        self._metadata = {"stream": _text(name), "type": _text(type_name), "direction": kind.value}

    def table(self, block: MessageBlock) -> tuple[pa.Table, list[str]]:
        """Return the table of the messages, and for each message that is left out the reason."""
        return self.table_and_rows(block)[:2]

    def table_and_rows(self, block: MessageBlock) -> tuple[pa.Table, list[str], np.ndarray[Any, Any]]:
        """Return as ``table``, and for each row of the table the index of the message, int64."""
        reasons: list[str] = []
        kept = np.arange(len(block), dtype=np.int64)
        try:
            columns = [(each.name, _array(each), each.unit) for each in self._columns(block)]
        except (NotColumns, GatewayError):
            rows, fields, reasons = self._one_by_one(block)
            kept = np.array(rows, np.int64)
            block = block.where(kept)
            columns = _columns_of(fields)
        head = [
            ("entry", pa.array(block.numbers), ""),
            ("time_ns", pa.array(block.times), "ns"),
            ("source_ns", pa.array(block.source_times, mask=block.source_times == 0), "ns"),
        ]
        columns += _metadata_column(block) if self._is_igtl else []
        if self._metadata["direction"] == Kind.IGTL_IN.value and block.links is not None:
            self._links.update(np.unique(block.links).tolist())
            if len(self._links) > 1:
                columns.append((LINK, pa.array(block.links), ""))
        taken = [(f"{name}_" if name in HEAD else name, array, unit) for name, array, unit in columns]
        return _table([*head, *taken], self._metadata), reasons, kept

    def _columns(self, block: MessageBlock) -> list[Column]:
        """The columns of all messages at once.  Raises NotColumns, GatewayError."""
        if not self._is_igtl and self._definitions.get(self._type):
            return ros_columns(block, self._decoder.store(self._type).fielddefs, self._type)
        if self._is_igtl and self._type in POSE_TYPES:
            found = pose_rows(block, self._type, self._acceptance)
            if len(found.rows) == len(block):
                return pose_columns(found, self._unit)
        raise NotColumns

    def _one_by_one(self, block: MessageBlock) -> tuple[list[int], list[Fields], list[str]]:
        rows, fields, reasons = [], [], []
        for row in range(len(block)):
            try:
                fields.append(self._fields(block.payload(row)))
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                reasons.append(failure_text(error))
            else:
                rows.append(row)
        return rows, fields, reasons

    def _fields(self, payload: memoryview) -> Fields:
        if self._is_igtl:
            content = self._acceptance.message(payload).content
            if self._type in BULKY:  # as they are: ``describe`` shortens them for people
                return _flat("", dict(self._bulky(*each) for each in _raw_fields(content).items()))
            return _flat("", name_igtl_fields(describe_content(content), self._unit))
        if not self._definitions.get(self._type):
            raise ConversionError("the session has no definition of its type")
        message = self._decoder.decode(self._type, bytes(payload))
        return _flat("", name_ros_fields(self._decoder.store(self._type), message))

    @ieee_754
    def _bulky(self, name: str, value: Any) -> tuple[str, Any]:
        """A field of a bulky type, with its name as a column."""
        if name not in _BULKY_NAMES:
            return name, value
        return _BULKY_NAMES[name], into_ros(millimetres(self._unit), value, np.empty(value.shape, np.float32))


def _metadata_column(block: MessageBlock) -> list[tuple[str, pa.Array, str]]:
    """The column of the metadata of header version 2; none if no message has any."""
    values: list[list[tuple[str, str]] | None] = [None] * len(block)
    for row in np.flatnonzero(block.data[block.begins + 1] != 1).tolist():  # last byte of the version
        items = [(_text(item.key), _text(item.text)) for item in metadata_of(block.payload(row))]
        values[row] = items or None
    return [(METADATA, pa.array(values, pa.map_(pa.string(), pa.string())), "")] if any(values) else []


def _raw_fields(content: Any) -> Fields:
    """The fields of a content as they are on the wire."""
    return {each.name: _raw(getattr(content, each.name)) for each in dataclasses.fields(content)}


def _raw(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _raw_fields(value)
    if isinstance(value, tuple | list):
        return [_raw(each) for each in value]
    if isinstance(value, memoryview):
        return bytes(value)
    return value


def _flat(place: str, value: Mapping[str, Any]) -> Fields:
    """The fields with the names of columns: structs in structs become one level."""
    fields: Fields = {}
    for name, inner in value.items():
        path = f"{place}.{name}" if place else name
        if isinstance(inner, dict):
            fields |= _flat(path, inner)
        else:
            fields[path] = _plain(inner, nested=False)
    return fields


def _plain(value: Any, *, nested: bool) -> Any:
    """A value that pyarrow takes: bytes for octets, lists or flat arrays for numbers."""
    if isinstance(value, np.ndarray):
        if value.dtype.names:
            return [_plain(dict(zip(value.dtype.names, row, strict=True)), nested=True) for row in value.tolist()]
        if value.dtype.kind == "V":
            return value.tobytes()
        if value.dtype.itemsize == 1 and value.dtype.kind == "u" and value.ndim == 1:
            return value.tobytes()
        native = value.astype(value.dtype.newbyteorder("="), copy=False)
        return native.tolist() if native.ndim > 1 and nested else native
    if isinstance(value, dict):
        return {name: _plain(inner, nested=True) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner, nested=True) for inner in value]
    if isinstance(value, str):
        return _text(value)
    return bytes(value) if isinstance(value, memoryview | bytearray) else value


def _text(text: str) -> str:
    """Text that UTF-8 can hold: bytes of a peer that are not text become question marks."""
    return _SURROGATES.sub("\ufffd", text)


def _columns_of(rows: list[Fields]) -> list[tuple[str, pa.Array, str]]:
    """The columns of messages: of all their fields, in order of the first message that has them."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = []
    for name in names:
        values = [row.get(name) for row in rows]
        # a quaternion of a matrix that is not a rotation: an empty cell
        if any(value == "" for value in values if isinstance(value, str)) and any(isinstance(v, float) for v in values):
            values = [None if isinstance(value, str) else value for value in values]
        columns.append((name, _inferred(values), _unit_of(name)))
    return columns


def _inferred(values: list[Any]) -> pa.Array:
    if all(isinstance(value, np.ndarray) for value in values):
        return _lists(values)
    try:
        return _with_units(pa.array(values))
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        pass
    try:
        return pa.array(values, pa.uint64())  # tick words
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        # values of different types: what all can be is text
        return pa.array([None if value is None else json.dumps(value, default=str) for value in values])


def _lists(arrays: list[Any]) -> pa.Array:
    """Lists of numbers, or of rows of numbers of one length."""
    width = {array.shape[1:] for array in arrays}
    if len(width) > 1 or len({array.dtype for array in arrays}) > 1 or max(map(len, width)) > 1:
        return pa.array([array.tolist() for array in arrays])
    offsets = np.concatenate(([0], np.cumsum([len(array) for array in arrays]))).astype(np.int32)
    values = pa.array(np.concatenate([np.ascontiguousarray(array).reshape(-1) for array in arrays]))
    (shape,) = width
    return pa.ListArray.from_arrays(
        pa.array(offsets), pa.FixedSizeListArray.from_arrays(values, shape[0]) if shape else values
    )


def _with_units(array: pa.Array) -> pa.Array:
    """The same values with units in the metadata of the fields inside of lists."""
    wanted = _type_with_units(array.type)
    return array if wanted.equals(array.type, check_metadata=True) else array.cast(wanted)


def _type_with_units(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_list(kind):
        return pa.list_(_type_with_units(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([_field(each.name, _type_with_units(each.type), _unit_of(each.name)) for each in kind])
    return kind


def _unit_of(name: str) -> str:
    """The unit at the end of the name of a column."""
    last = name.rpartition(".")[2]
    return next((unit_text(unit) for unit in UNITS_OF_NAMES if last.endswith(f"_{unit}")), "")


def _field(name: str, kind: pa.DataType, unit: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit} if unit else None)


def _table(columns: list[tuple[str, pa.Array, str]], metadata: Mapping[str, str]) -> pa.Table:
    schema = pa.schema([_field(name, array.type, unit) for name, array, unit in columns], metadata=dict(metadata))
    return pa.Table.from_arrays([array for _, array, _ in columns], schema=schema)


def _array(column: Column) -> pa.Array:
    """A column of ``cdr_columns`` without a copy of its numbers where that is possible."""
    values, offsets = column.values, column.offsets
    if offsets is None:
        native = np.ascontiguousarray(values, values.dtype.newbyteorder("="))
        if native.ndim > 1:
            return pa.FixedSizeListArray.from_arrays(pa.array(native.reshape(-1)), native.shape[1])
        return pa.array(native, mask=None if column.valid is None else ~column.valid)
    if int(offsets[-1]) > _MAX_OFFSET:
        raise NotColumns
    places = offsets.astype(np.int32)
    if values.dtype.names:
        return pa.ListArray.from_arrays(pa.array(places), _structs(values))
    if not column.is_text and values.dtype != np.uint8:
        return pa.ListArray.from_arrays(pa.array(places), pa.array(np.ascontiguousarray(values)))
    buffers = [None, pa.py_buffer(places), pa.py_buffer(np.ascontiguousarray(values))]
    return pa.Array.from_buffers(pa.string() if column.is_text else pa.binary(), len(places) - 1, buffers)


def _structs(values: np.ndarray[Any, Any]) -> pa.Array:
    """A structured array as structs."""
    arrays, fields = [], []
    for name in values.dtype.names or ():
        numbers = np.ascontiguousarray(values[name])
        flat = pa.array(numbers.reshape(-1))
        array = pa.FixedSizeListArray.from_arrays(flat, numbers.shape[1]) if numbers.ndim > 1 else flat
        arrays.append(array)
        fields.append(_field(name, array.type, _unit_of(name)))
    return pa.StructArray.from_arrays(arrays, fields=fields)


# -- tables of one stream ----------------------------------------------------------------------------------------


def joined(parts: list[tuple[pa.Table, list[str]]]) -> pa.Table:
    """One table of the parts of a stream; its metadata has the number of messages that are left out, by reason."""
    tables = [table for table, _ in parts]
    if not tables:
        return pa.table({name: pa.array([], pa.int64()) for name in HEAD[:3]})
    schema = tables[0].schema
    for table in tables[1:]:
        schema = schema if table.schema.equals(schema) else unified(schema, table.schema)
    if left_out := Counter(why for _, reasons in parts for why in reasons):
        schema = schema.with_metadata({**(schema.metadata or {}), b"left_out": json.dumps(left_out).encode()})
    return pa.concat_tables([fitted(table, schema) for table in tables])


def unified(one: pa.Schema, two: pa.Schema) -> pa.Schema:
    """The columns of both.  A column with types that have nothing in common is text in both.

    Arrow makes int64 of int64 and uint64; the former stands here for numbers that happen to fit.
    """
    try:
        schema = pa.unify_schemas([one, two], promote_options="permissive")
        for index, field in enumerate(schema):
            if pa.uint64() in [each.field(field.name).type for each in (one, two) if field.name in each.names]:
                schema = schema.set(index, field.with_type(pa.uint64() if field.type == pa.int64() else field.type))
        return schema
    except pa.ArrowException:
        fields = []
        for name in dict.fromkeys([*one.names, *two.names]):
            own = [schema.field(name) for schema in (one, two) if name in schema.names]
            try:
                fields.append(
                    pa.unify_schemas([pa.schema([each]) for each in own], promote_options="permissive").field(0)
                )
            except pa.ArrowException:
                fields.append(pa.field(name, pa.string()))
        return pa.schema(fields, metadata=one.metadata)


def fitted(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The table with the columns of a wider schema."""
    columns: list[Any] = []
    for field in schema:
        if field.name not in table.schema.names:
            columns.append(pa.nulls(table.num_rows, field.type))
            continue
        column = table.column(field.name)
        if field.type == pa.string() and column.type != pa.string():
            column = pa.array([None if value is None else str(value) for value in column.to_pylist()], pa.string())
        columns.append(_fitted_column(column, field.type))
    return pa.Table.from_arrays(columns, schema=schema)


def _fitted_column(column: Any, kind: pa.DataType) -> Any:
    if column.type.equals(kind):
        return column
    try:
        return column.cast(kind)
    except pa.ArrowException:
        return pa.array(column.to_pylist(), kind)  # structs with other fields


def side_by_side(
    columns: Mapping[str, tuple[Any, str]],
    tables: Mapping[str, tuple[pa.Table, np.ndarray[Any, Any], np.ndarray[Any, Any]]],
) -> pa.Table:
    """One table of N rows.

    Args:
        columns: name → values (N,), masked where there is none, and unit.
        tables: prefix of its columns → a table; the message of each of its rows, ascending; the wanted messages, (N,),
            -1 for none.
    """
    found = [
        (name, pa.array(np.ma.getdata(values), mask=_mask(values)), unit) for name, (values, unit) in columns.items()
    ]
    for prefix, (table, own, wanted) in tables.items():
        places = np.minimum(np.searchsorted(own, wanted), max(len(own) - 1, 0))
        # a message that cannot be decoded has no row
        none = own[places] != wanted if len(own) else np.ones(len(wanted), np.bool_)
        taken = table.take(pa.array(places, mask=none))
        for field, array in zip(table.schema, taken.columns, strict=True):
            unit = (field.metadata or {}).get(b"unit", b"").decode()
            found.append((f"{prefix}.{field.name}", array.combine_chunks(), unit))
    return _table(found, {})


def _mask(values: Any) -> np.ndarray[Any, Any] | None:
    return np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None

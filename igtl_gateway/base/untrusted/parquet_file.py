"""Reads untrusted Parquet files: what they unpack to is bounded before and while they are read.

A file of some kilobytes may unpack to terabytes: run lengths, dictionaries with long strings, shared prefixes,
compressed pages of zeros, and sizes that are not true.  So the footer and the headers of all pages are checked first
(``parquet_sizes``), and strings stay in their dictionaries until their sizes are known.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from pyarrow import compute, parquet

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.files import open_file
from igtl_gateway.base.untrusted.limits import check_unpacked, current_limits
from igtl_gateway.base.untrusted.parquet_sizes import check_sizes
from igtl_gateway.base.untrusted.text import printable

#: Characters of an error of pyarrow that are shown.
_SHOWN = 200
_ERRORS = (pa.ArrowException, OSError, ValueError, OverflowError, IndexError, KeyError)


class ParquetColumns:
    """An open Parquet file, whose columns are read when they are needed.

    Args:
        stream: the file.
        path: its name.

    Attributes:
        rows: number of rows, as the footer states it.
        schema: names and types of the columns.

    Raises as :func:`read_parquet`.
    """

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream, self._path = stream, path
        self.rows, self._size, self._strings = check_sizes(stream, path)
        try:
            self.schema: pa.Schema = _opened(stream).schema_arrow
        except _ERRORS as error:
            raise _invalid(path, error) from None

    def read(self, names: list[str] | None = None) -> pa.Table:
        """Return the columns with these names; None: all.  Raises as :func:`read_parquet`."""
        try:
            table = self._read(names)
            table.validate(full=True)  # the numbers in a dictionary are not checked before
            strings = sum(map(_string_bytes, table.columns))
            check_unpacked(self._size, strings, f"{self._path}: bytes of all strings")
            schema = (
                self.schema if names is None else pa.schema([self.schema.field(each) for each in table.schema.names])
            )
            return table.cast(schema) if table.schema != schema else table
        except _ERRORS as error:
            raise _invalid(self._path, error) from None

    def _read(self, names: list[str] | None) -> pa.Table:
        """The columns, with strings in their dictionaries."""
        file = _opened(self._stream, read_dictionary=self._strings)
        chosen = [each.type for each in self.schema if names is None or each.name in names]
        if file.num_row_groups < 2 or not any(pa.types.is_nested(each) and _has_strings(each) for each in chosen):
            return file.read(names, use_threads=False)
        # pyarrow does not join dictionaries in lists and structures (tasks, encoded pictures) of several groups
        groups = (file.read_row_group(number, names, use_threads=False) for number in range(file.num_row_groups))
        return pa.concat_tables(groups)


@contextmanager
def parquet_columns(path: Path) -> Iterator[ParquetColumns]:
    """Context manager: a Parquet file, open.  Raises as :func:`read_parquet`."""
    with open_file(path) as stream:
        yield ParquetColumns(stream, path)


def read_parquet(path: Path) -> pa.Table:
    """Read a Parquet file.

    Raises:
        UnsupportedRecording: it is missing, or not an ordinary file.
        DamagedRecording: it is not valid.
        LimitExceeded: it would unpack to more than the limits allow.
    """
    with parquet_columns(path) as found:
        return found.read()


def read_parquet_schema(path: Path) -> pa.Schema:
    """Return the schema of a Parquet file.  Raises as :func:`read_parquet`."""
    with parquet_columns(path) as found:
        return found.schema


def _invalid(path: Path, error: Exception) -> DamagedRecording:
    if isinstance(error, DamagedRecording):
        return error
    text = str(error).strip().partition("\n")[0]
    return DamagedRecording(f"{path}: is not valid Parquet: {printable(text[:_SHOWN]) or type(error).__name__}")


def _opened(stream: BinaryIO, **options: Any) -> Any:
    stream.seek(0)
    most = current_limits().count
    return parquet.ParquetFile(stream, pre_buffer=False, thrift_container_size_limit=most, **options)


def _has_strings(kind: pa.DataType) -> bool:
    """Whether a type is one of strings or bytes, or has such types in it."""
    inner = [kind.field(number).type for number in range(kind.num_fields)]
    return any(map(_has_strings, inner)) if inner else not pa.types.is_primitive(kind)


def _string_bytes(column: pa.ChunkedArray) -> int:
    return sum(_bytes_of(chunk) for chunk in column.chunks)


def _bytes_of(array: Any) -> int:
    """Return the bytes of the strings of an array, each as often as its dictionary gives it."""
    kind = array.type
    if pa.types.is_dictionary(kind):
        lengths = compute.binary_length(array.dictionary).fill_null(0).to_numpy(zero_copy_only=False)
        return int(lengths.astype(np.float64)[array.indices.drop_null().to_numpy()].sum())
    if pa.types.is_struct(kind):
        return sum(_bytes_of(array.field(number)) for number in range(kind.num_fields))
    if pa.types.is_map(kind):
        return _bytes_of(array.keys) + _bytes_of(array.items)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return _bytes_of(array.values)
    return 0

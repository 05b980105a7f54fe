"""Reads untrusted Parquet files: what they unpack to is bounded before and while they are read.

A file of some kilobytes may unpack to terabytes: run lengths, dictionaries with long strings, shared prefixes,
compressed pages of zeros, and sizes that are not true.  So the footer and the headers of all pages are checked first
(``parquet_sizes``), and strings stay in their dictionaries until their sizes are known.
"""

from __future__ import annotations

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


def read_parquet(path: Path) -> pa.Table:
    """Read a Parquet file.

    Raises:
        UnsupportedRecording: it is missing, or not an ordinary file.
        DamagedRecording: it is not valid.
        LimitExceeded: it would unpack to more than the limits allow.
    """
    with open_file(path) as stream:
        size, strings = check_sizes(stream, path)
        try:
            schema = _opened(stream).schema_arrow
            table = _opened(stream, read_dictionary=strings).read(use_threads=False)
            table.validate(full=True)  # the numbers in a dictionary are not checked before
            check_unpacked(size, sum(map(_string_bytes, table.columns)), f"{path}: bytes of all strings")
            return table.cast(schema) if table.schema != schema else table
        except _ERRORS as error:
            raise _invalid(path, error) from None


def read_parquet_schema(path: Path) -> pa.Schema:
    """Return the schema of a Parquet file.  Raises as :func:`read_parquet`."""
    with open_file(path) as stream:
        check_sizes(stream, path)
        try:
            return _opened(stream).schema_arrow
        except _ERRORS as error:
            raise _invalid(path, error) from None


def _invalid(path: Path, error: Exception) -> DamagedRecording:
    if isinstance(error, DamagedRecording):
        return error
    text = str(error).strip().partition("\n")[0]
    return DamagedRecording(f"{path}: is not valid Parquet: {printable(text[:_SHOWN]) or type(error).__name__}")


def _opened(stream: BinaryIO, **options: Any) -> Any:
    stream.seek(0)
    most = current_limits().count
    return parquet.ParquetFile(stream, pre_buffer=False, thrift_container_size_limit=most, **options)


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

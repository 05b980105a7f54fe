"""The columns of data tables, as arrays."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pyarrow import compute

from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.lerobot.features import innermost, is_list, is_number
from igtl_gateway.addons.lerobot.reading import FoundEpisode, read_table


class Tables:
    """The rows of episodes; a file with several episodes is read once."""

    def __init__(self) -> None:
        self._last: tuple[Path, pa.Table | GatewayError] | None = None

    def of(self, episode: FoundEpisode) -> pa.Table:
        """Return the rows of an episode.  Raises GatewayError."""
        if self._last is None or self._last[0] != episode.data:
            self._last = None  # its memory is free before the next table is read
            self._last = episode.data, _table_or_error(episode.data)
        table = self._last[1]
        if isinstance(table, GatewayError):
            raise table.with_traceback(None)
        if episode.rows is None:
            return table
        return table.slice(episode.rows[0], episode.rows[1] - episode.rows[0])


def _table_or_error(path: Path) -> pa.Table | GatewayError:
    try:
        return read_table(path)
    except GatewayError as error:
        return error


def matrix_of(table: pa.Table, name: str) -> npt.NDArray[Any]:
    """Return a column of which :func:`is_numeric` is true as (N, K) values."""
    array, sizes = _flat(table[name])
    return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(table.num_rows, math.prod(sizes or ()))


def is_numeric(table: pa.Table, name: str) -> bool:
    """Return whether a column is there, with numbers or lists of one length of them, and none is missing."""
    if name not in table.schema.names or not is_number(innermost(table.schema.field(name).type)[0]):
        return False
    sizes = None if missing(table[name]) else row_shape(table[name])
    return sizes is not None and all(sizes)


def row_shape(column: pa.ChunkedArray) -> tuple[int, ...] | None:
    """Return the lengths of the lists in each row, from the outer ones on: () of plain numbers; None if they differ."""
    return _flat(column)[1]


def missing(column: pa.ChunkedArray) -> int:
    """Return the number of cells, and of numbers in their lists, that are null."""
    count, chunks = 0, column.chunks
    while chunks:
        count += sum(chunk.null_count for chunk in chunks)
        chunks = [chunk.flatten() for chunk in chunks if is_list(chunk.type)]
    return count


def _flat(column: pa.ChunkedArray) -> tuple[pa.Array, tuple[int, ...] | None]:
    """The values in the innermost lists of a column without nulls, and the lengths of its lists."""
    array = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    sizes: tuple[int, ...] | None = ()
    while is_list(array.type):
        if pa.types.is_fixed_size_list(array.type):
            size, are_equal = array.type.list_size, True
        else:
            lengths = compute.list_value_length(array).to_numpy(zero_copy_only=False)
            size = int(lengths[0]) if len(lengths) else 0
            are_equal = bool((lengths == size).all())
        sizes = (*sizes, size) if are_equal and sizes is not None else None
        array = array.flatten()
    return array, sizes

"""The columns of data tables, as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.lerobot.reading import FoundEpisode, read_table

#: Types of features without pictures.
ARROW = {
    "float32": pa.float32(),
    "float64": pa.float64(),
    "int64": pa.int64(),
    "string": pa.string(),
    "bool": pa.bool_(),
}


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
    column = table[name]
    array = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    width = column.type.list_size if pa.types.is_fixed_size_list(column.type) else 1
    flat = array.flatten() if pa.types.is_fixed_size_list(column.type) else array
    return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(array), width)


def is_numeric(table: pa.Table, name: str) -> bool:
    """Return whether a column is there, with numbers or lists of one length of them, and none is missing."""
    return name in table.schema.names and is_form(table.schema.field(name).type) and not missing(table[name])


def is_form(kind: pa.DataType) -> bool:
    """Return whether a type is a number, or a list of one length of them."""
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size > 0 and is_number(kind.value_type)
    return is_number(kind)


def is_number(kind: pa.DataType) -> bool:
    """Return whether a type is a number."""
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def missing(column: pa.ChunkedArray) -> int:
    """Return the number of cells, and of numbers in their lists, that are null."""
    inner = (chunk.flatten().null_count for chunk in column.chunks if pa.types.is_fixed_size_list(column.type))
    return int(column.null_count + sum(inner))

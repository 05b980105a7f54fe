"""Many messages of CDR at once: those of a stream that differ in numbers and stamps only.

:class:`CdrRows` takes the place of the CdrReader in ``read`` of a message class.  The message that it gives has columns
where one message has floating-point numbers and stamps, so one definition of a message serves both.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.cdr import CdrReader

Array = npt.NDArray[Any]

_FLOATS = frozenset("0123456789fd")
_STAMP = "iI"


class Columns:
    """The numbers of a sequence in n messages: one column (n,) for each number.

    It has what a message class and its users need of the array that one message has.
    """

    __slots__ = ("_columns", "_width")

    def __init__(self, columns: list[Any], width: int = 1) -> None:
        self._columns, self._width = columns, width

    def __len__(self) -> int:
        return len(self._columns) // self._width

    def __iter__(self) -> Iterator[Any]:
        return iter(self.tolist())

    def reshape(self, shape: tuple[int, ...]) -> Columns:
        """The same for elements of ``shape[1]`` numbers."""
        return Columns(self._columns, *shape[1:])

    def tolist(self) -> list[Any]:
        """The columns; lists of columns for elements of several numbers."""
        width = self._width
        if width == 1:
            return list(self._columns)
        return [self._columns[at : at + width] for at in range(0, len(self._columns), width)]


class CdrRows(CdrReader):
    """Reads the fields of n messages of one size.

    Floating-point numbers become columns (n,), stamps columns of int64.  All else is what the first message has; with
    ``fixed`` the places of it are marked: messages that are equal there are read right.

    Args:
        rows: (n, size) bytes, uint8, contiguous; n > 0.
        type_name: for errors.
        fixed: (size,) bool, to be marked.
    """

    __slots__ = ("_fixed", "_rows")

    def __init__(self, rows: npt.NDArray[np.uint8], type_name: str, fixed: npt.NDArray[np.bool_] | None = None) -> None:
        super().__init__(rows[0].data, type_name)
        self._rows, self._fixed = rows, fixed
        if fixed is not None:
            fixed[: self._offset] = True

    def _take(self, size: int, align: int) -> int:
        offset = super()._take(size, align)
        if self._fixed is not None:
            self._fixed[offset : offset + size] = True
        return offset

    def unpack(self, layout: str, align: int) -> tuple[Any, ...]:
        if layout == _STAMP:
            offset = super()._take(8, align)
            seconds, nanoseconds = self._columns("i4", 1, offset), self._columns("u4", 1, offset + 4)
            return seconds[0].astype(np.int64), nanoseconds[0].astype(np.int64)
        if not _FLOATS.issuperset(layout):
            return super().unpack(layout, align)
        kind = f"f{struct.calcsize(layout[-1])}"
        size = struct.calcsize(layout)
        return tuple(self._columns(kind, size // int(kind[1:]), super()._take(size, align)))

    def array(self, dtype: str, count: int, align: int) -> Any:
        if not count:
            return Columns([])
        return Columns(list(self._columns(dtype, count, super()._take(count * int(dtype[1:]), align))))

    def _columns(self, dtype: str, count: int, offset: int) -> Array:
        """``count`` numbers of each message from ``offset`` on, in native byte order: (count, n)."""
        kind = np.dtype(self._order + dtype)
        rows = self._rows
        there: Array = np.ndarray((len(rows), count), kind, rows.data, offset, (rows.strides[0], kind.itemsize))
        return np.ascontiguousarray(there.T, kind.newbyteorder("="))

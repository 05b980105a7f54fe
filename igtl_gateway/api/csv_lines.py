"""Lines of a CSV file from arrays: numbers as ``csv.writer`` has them, without an object for each.

``_lines.c`` has the compiled function; it also exists here, with an equal result.  Floats are those of ``repr``, by the
function of CPython behind it.  Other libraries were measured with 100,000 floats: numpy needs longer than ``repr``, and
pyarrow, which is optional, a third of the time, but has another text for some numbers, and quotes all strings.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

#: The cells of a column: one string; one for each line; or kind (f float64, i int64, u uint64), values and mask (bool:
#: which lines have a value; None: all).  Strings are as in the file, see `cell_text`.
Cell = bytes | list[bytes] | tuple[str, npt.NDArray[Any], npt.NDArray[np.bool_] | None]

_DTYPES = {"f": np.float64, "i": np.int64, "u": np.uint64}


def number_cell(values: npt.NDArray[Any], mask: npt.NDArray[np.bool_] | None = None) -> Cell:
    """The cells of an array of numbers or truth values (n,)."""
    if values.dtype.kind == "b":
        return [b"True" if value else b"False" for value in values.tolist()]
    kind = values.dtype.kind
    with np.errstate(invalid="ignore"):  # a signalling NaN
        numbers = np.ascontiguousarray(values, _DTYPES[kind])
    return kind, numbers, None if mask is None else np.ascontiguousarray(mask)


def rows_of_cell(cell: Cell, rows: slice) -> Cell:
    """The cells of some lines."""
    if isinstance(cell, bytes):
        return cell
    if isinstance(cell, list):
        return cell[rows]
    kind, values, mask = cell
    return kind, values[rows], None if mask is None else mask[rows]


def cell_text(text: str) -> bytes:
    """A string as a cell of a line with other cells, quoted where that is necessary."""
    line = io.StringIO()
    csv.writer(line).writerow(("", text))
    return line.getvalue()[1:-2].encode()


def csv_lines(count: int, cells: Sequence[Cell]) -> bytes:
    """``count`` lines of cells, which end with CR and LF.  Raises ValueError if a cell has another number of values."""
    columns: list[list[bytes]] = []
    for cell in cells:
        if isinstance(cell, bytes):
            columns.append([cell] * count)
            continue
        if isinstance(cell, list):
            columns.append(cell)
        else:
            kind, values, mask = cell
            if kind not in _DTYPES or values.dtype != _DTYPES[kind]:
                raise ValueError("csv_lines: found another kind of numbers")
            columns.append([repr(value).encode() for value in values.tolist()])
            if mask is not None:
                if len(mask) != len(values):
                    raise ValueError("csv_lines: found another number of values than lines")
                columns[-1] = [text if has else b"" for text, has in zip(columns[-1], mask.tolist(), strict=True)]
        if len(columns[-1]) != count:
            raise ValueError("csv_lines: found another number of values than lines")
    return b"".join(b",".join(line) + b"\r\n" for line in (zip(*columns, strict=True) if columns else [()] * count))


if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._lines import csv_lines  # noqa: F401
    except ImportError:  # pragma: no cover - installed without the C part
        pass

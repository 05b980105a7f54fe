"""How results of the API look: one line in a console, a table in a notebook, and as an array for numpy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: Maximum number of rows of a table in a notebook.
MAX_ROWS = 100


def as_array(array: Array, dtype: npt.DTypeLike | None, copy: bool | None) -> Array:
    """Return an array for ``__array__``, as numpy 2 defines ``dtype`` and ``copy``; works with numpy 1.26 too.

    Raises ValueError if ``copy`` is False and the other dtype needs a copy.
    """
    if copy:
        return np.array(array, dtype=dtype)
    if copy is False and dtype is not None and np.dtype(dtype) != array.dtype:
        raise ValueError(f"copy: found False, expected True or None: {array.dtype} to {np.dtype(dtype)} needs a copy")
    return np.asarray(array, dtype=dtype)


def shape_text(array: Array) -> str:
    """Return shape and type of an array, such as ``1 × 480 × 640 uint8``."""
    return f"{' × '.join(f'{size:,}' for size in array.shape)} {array.dtype}"


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table for a notebook; its cells are untrusted."""
    found = list(rows)
    shown = [f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in found[:MAX_ROWS]]
    if len(found) > MAX_ROWS:
        shown.append(f"<tr><td colspan={len(head)}>… {len(found) - MAX_ROWS:,} more</td></tr>")
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f"<table><caption>{escape(caption)}</caption><tr>{titles}</tr>{''.join(shown)}</table>"


def html_line(text: str) -> str:
    """Return the text of ``repr`` for a notebook."""
    return f"<code>{escape(text)}</code>"

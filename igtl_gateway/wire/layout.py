"""Layouts as rows: the fields of a header or a content, in the order of the wire.

Each class of contents has its rows in ``LAYOUT``.  They are the only description of its bytes: ``compile_struct`` and
``offset_of`` derive from them what packs and unpacks, and ``tools/docs.py`` writes docs/reference/messages.md from
them.  A list of equal elements is described by a numpy dtype instead, from which ``of_dtype`` derives the rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from struct import Struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

#: Type → code of ``struct``.  All are big-endian; ``char`` is a byte of text.
CODES = {
    "u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q", "f32": "f",
    "f64": "d", "char": "s",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Field:
    """One row.

    Attributes:
        name: name of the attribute of the class, where it has one.
        type: key of ``CODES``; ``bytes`` for content that other fields describe.
        count: number of values, in words where it is not constant.
        about: unit, values, traps; "" where the docstring of the class states them.
        per: what the field is repeated for, "" if it occurs once.  Consecutive rows with the same ``per`` form one
            group: all values of the first, all of the second, …
    """

    name: str
    type: str
    count: int | str = 1
    about: str = ""
    per: str = ""

    @property
    def format(self) -> str | None:
        """The field in the notation of ``struct``; None if its size is not constant."""
        return f"{self.count}{CODES[self.type]}" if isinstance(self.count, int) else None

    @property
    def size(self) -> int | None:
        """Size in bytes, of one repetition; None if it is not constant."""
        return Struct(f">{self.format}").size if self.format else None


Layout = tuple[Field, ...]


def compile_struct(rows: Layout, per: str = "") -> Struct:
    """Return the struct of the first fields of constant size: of ``rows``, or of the group that is repeated ``per``."""
    group = rows if not per else tuple(row for row in rows if row.per == per)
    return Struct(">" + "".join(_leading_formats(group, per)))


def _leading_formats(rows: Layout, per: str) -> Iterator[str]:
    for row in rows:
        if row.format is None or row.per != per:
            return
        yield row.format


def offset_of(rows: Layout, name: str) -> int:
    """Return the offset of a field in bytes.  Raises KeyError for a name without a constant offset."""
    for at, row in enumerate(rows):
        if row.name == name:
            return compile_struct(rows[:at]).size
        if row.size is None or row.per:
            break
    raise KeyError(name)


def of_dtype(dtype: np.dtype[np.void], **about: str) -> Layout:
    """Return the rows of an array's element; ``about`` describes its fields.  Raises TypeError for unknown fields."""
    if unknown := about.keys() - set(dtype.names or ()):
        raise TypeError(f"layout: found {sorted(unknown)}, expected fields of {dtype}")
    rows = []
    for name in dtype.names or ():
        field = dtype[name]
        rows.append(
            Field(name, "char", field.itemsize, about.get(name, ""))
            if field.kind == "S"
            else Field(name, _type_of(field.base), math.prod(field.shape), about.get(name, ""))
        )
    return tuple(rows)


def _type_of(number: np.dtype[np.generic]) -> str:
    return f"{number.kind}{8 * number.itemsize}"

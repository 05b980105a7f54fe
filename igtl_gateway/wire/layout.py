"""Layouts as rows: what stands where in a content.

Each class of contents has its rows in ``LAYOUT``, in the order of the wire; ``tools/docs.py`` makes docs/messages.md
of them, and a test holds them against the structs and arrays that read the bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Type → code of ``struct``.  All are big-endian; ``char`` is a byte of text.
CODES = {
    "u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q", "f32": "f",
    "f64": "d", "char": "s",
}  # fmt: skip

_SIZES = {"B": 1, "b": 1, "s": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4, "Q": 8, "q": 8, "d": 8}


@dataclass(frozen=True, slots=True)
class Field:
    """One row.

    Attributes:
        name: as the class calls it, where it has it.
        type: key of ``CODES``; ``bytes`` for what only other fields explain.
        count: how many stand there, in words where that is no constant.
        about: unit, values, traps; "" where the docstring of the class says it.
        per: what it is repeated for, "" if it stands there once.  Rows of one ``per`` in a row stand together:
            all of the first, all of the second, …
    """

    name: str
    type: str
    count: int | str = 1
    about: str = ""
    per: str = ""

    @property
    def size(self) -> int | None:
        """Bytes, None where that is no constant; of one, where it is repeated."""
        return self.count * _SIZES[CODES[self.type]] if isinstance(self.count, int) else None


Layout = tuple[Field, ...]


def of_dtype(dtype: np.dtype[np.void], **about: str) -> Layout:
    """The rows of an array's element; ``about`` is said by field.  Raises TypeError for a field that there is not."""
    if unknown := about.keys() - set(dtype.names or ()):
        raise TypeError(f"layout: found {sorted(unknown)}, expected fields of {dtype}")
    rows = []
    for name in dtype.names or ():
        field = dtype[name]
        rows.append(
            Field(name, "char", field.itemsize, about.get(name, ""))
            if field.kind == "S"
            else Field(name, _name_of(field.base), int(np.prod(field.shape, dtype=int)), about.get(name, ""))
        )
    return tuple(rows)


def _name_of(number: np.dtype[np.generic]) -> str:
    return f"{number.kind}{8 * number.itemsize}"

"""Lists of elements: the limit on their number, and their strings (zero-padded bytes of the wire ⇄ str).

One rule applies to all strings that are too long: they are cut at the end of a character, with a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sized
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.context import ToIgtlContext
from igtl_gateway.wire.fields import cut_text, decode_text, visible

Array = npt.NDArray[Any]

#: Maximum number of rows of a plan or list: each row is a Python object and takes up to 0.1 ms.
MAX_ROWS = 10_000


def check_rows(elements: Sized, place: str, most: int = MAX_ROWS) -> None:
    """Raise ConversionError for more than ``most`` elements: converting them would delay all other messages."""
    if len(elements) > most:
        raise ConversionError(f"{place}: found {counted(len(elements), 'element')}, expected at most {most}")


def texts(elements: Array, field: str) -> list[str]:
    """Return a string field of every element, up to its first NUL, with undecodable bytes replaced."""
    return [visible(decode_text(value)) for value in elements[field].tolist()]


def set_text_fields(elements: Array, field: str, values: Iterable[str], to: ToIgtlContext) -> None:
    """Fill a field of every element.  Strings that are too long are cut, with one warning for all of them.

    One byte stays free: C++ readers refuse a string that fills its field.
    """
    fitting = fit_texts(values, elements.dtype[field].itemsize - 1, field, to)
    elements[field] = np.array([text.encode() for text in fitting], elements.dtype[field])


def fit_texts(values: Iterable[str], width: int, what: str, to: ToIgtlContext) -> list[str]:
    """Return strings of at most ``width`` bytes: up to the first NUL, where readers stop, and the last whole character.

    If any string is cut, a warning reports the first one, as ``what``, and the number of others.
    """
    wanted = list(values)
    fitting = [cut_text(visible(text), width) for text in wanted]
    if cut := [(text, fits) for text, fits in zip(wanted, fitting, strict=True) if text != fits]:
        (text, fits), *more = cut
        others = f", and {len(more)} more are cut" if more else ""
        to.warnings.append(("text_cut", f"{what} {text!r} is sent as {fits!r}{others}"))
    return fitting

"""Lists of elements: how many become messages of rows, and their texts: zero-padded bytes of the wire ⇄ str.

And the one rule for texts that do not fit: cut at the end of a character, with a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sized
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.context import ToIgtlContext
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.fields import cut_text, decode_text, visible

Array = npt.NDArray[Any]

#: Rows of plans and of what a peer has: each is an object of Python and costs up to 0.1 ms on its way.
MAX_ROWS = 10_000


def check_rows(elements: Sized, place: str, most: int = MAX_ROWS) -> None:
    """Raises ConversionError for more elements than become objects one by one: they would stop all other traffic."""
    if len(elements) > most:
        raise ConversionError(f"{place}: found {len(elements)} elements, expected at most {most}")


def texts(elements: Array, field: str) -> list[str]:
    """The field of every element, as people are meant to read it."""
    return [visible(decode_text(value)) for value in elements[field].tolist()]


def set_text_fields(elements: Array, field: str, values: Iterable[str], to: ToIgtlContext) -> None:
    """Fill the field of every element; what does not fit is cut, with one warning for all.

    One byte stays free: C++ readers refuse a text that is as long as its field.
    """
    fitting = fit_texts(values, elements.dtype[field].itemsize - 1, field, to)
    elements[field] = np.array([text.encode() for text in fitting], elements.dtype[field])


def fit_texts(values: Iterable[str], width: int, what: str, to: ToIgtlContext) -> list[str]:
    """Texts in ``width`` bytes each: up to the first NUL, where every reader stops, and to the last whole character.

    What is cut is told in one warning, which says ``what`` it is.
    """
    wanted = list(values)
    fitting = [cut_text(visible(text), width) for text in wanted]
    if cut := [(text, fits) for text, fits in zip(wanted, fitting, strict=True) if text != fits]:
        (text, fits), *more = cut
        others = f", and {len(more)} more are cut" if more else ""
        to.warnings.append(("text_cut", f"{what} {text!r} is sent as {fits!r}{others}"))
    return fitting

"""Text fields of element lists, a column at a time: zero-padded bytes of the wire ⇄ str."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.context import ToIgtl
from igtl_gateway.wire.fields import cut_text, decode_text, visible

Array = npt.NDArray[Any]


def texts(elements: Array, field: str) -> list[str]:
    """The field of every element, as people are meant to read it."""
    return [visible(decode_text(value)) for value in elements[field].tolist()]


def set_texts(elements: Array, field: str, values: Iterable[str], to: ToIgtl) -> None:
    """Fill the field of every element; what does not fit is cut, with one warning.

    One byte stays free: C++ readers refuse a text that is as long as its field.
    """
    width = elements.dtype[field].itemsize - 1
    wanted = [visible(value) for value in values]
    fitting = [cut_text(value, width) for value in wanted]
    if cut := [text for text, fits in zip(wanted, fitting, strict=True) if fits != text]:
        more = f" and {len(cut) - 1} more" if len(cut) > 1 else ""
        to.warnings.append(("text_cut", f"{field} {cut[0]!r}{more} cut to {width} bytes"))
    elements[field] = np.array([text.encode() for text in fitting], elements.dtype[field])

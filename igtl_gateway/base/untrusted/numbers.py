"""Integers in untrusted text and documents, with bounds.

Python converts at most 4,300 digits and raises ValueError for more, and an integer of more than 308 digits is no
``float`` (OverflowError).  So no other module converts digits of files and peers: :func:`whole_number` has the bound of
the field, :func:`check_numbers` that of a parsed document.
"""

from __future__ import annotations

from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import counted

#: Largest number of 64 bits.
MOST = (1 << 64) - 1
#: Digits of ``MOST``; more are refused, also if they are zeros in front.
_MOST_DIGITS = len(str(MOST))
#: Largest integer of a document, so that each can become a float.
_MOST_BITS = 1_000
_SHOWN = 40


def whole_number(text: object, most: int = MOST) -> int | None:
    """Return the integer from 0 to ``most`` that a string states in ASCII digits; None for anything else."""
    if not isinstance(text, str) or len(text) > _MOST_DIGITS or not text.isascii() or not text.isdigit():
        return None
    number = int(text)
    return number if number <= most else None


def bounded_integer(digits: str) -> int:
    """Return the integer of a JSON document.  Raises ValueError for one that no float could hold."""
    number = int(digits) if len(digits) <= _MOST_BITS else 1 << _MOST_BITS
    if number.bit_length() > _MOST_BITS:
        raise ValueError(
            f"found a number of {counted(len(digits.lstrip('-')), 'digit')}, expected at most {_MOST_BITS} bits"
        )
    return number


def check_numbers(document: Any, place: str) -> None:
    """Check the integers of a parsed document.  Raises DamagedRecording with the place of one that is too large."""
    waiting = [(place, document)]
    while waiting:
        at, value = waiting.pop()
        if isinstance(value, dict):
            waiting += [(f"{at}: {str(key)[:_SHOWN]}", each) for key, each in value.items()]
        elif isinstance(value, list):
            waiting += [(at, each) for each in value]
        elif isinstance(value, int) and value.bit_length() > _MOST_BITS:
            raise DamagedRecording(
                f"{at}: found a number of {counted(value.bit_length(), 'bit')}, expected at most {_MOST_BITS}"
            )

"""Checks definitions of ROS types: names, array sizes, values of constants, nesting, and the size of the result.

Types can multiply: a chain of ten arrays of ten needs ten short definitions for 10^10 elements, and rosbags generates
code for each element of a fixed array of strings or messages.  So both are counted before anything is generated.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import limits

#: Type → its constants (name, type, value) and its fields (name, description), as rosbags has them.
Types = Mapping[str, tuple[list[Any], list[Any]]]

LONGEST_NAME = 255
TYPE = re.compile(r"(?!\w*__)[A-Za-z]\w*(/(?!\w*__)[A-Za-z]\w*){1,3}", re.ASCII)
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_LONGEST_INT = 64
_SEVERAL = (Nodetype.ARRAY, Nodetype.SEQUENCE)


def check_types(types: Types, place: str) -> None:
    """Raise DamagedRecording for impossible types, LimitExceeded for types above the limits."""
    limits.check_limit("fields", sum(map(weight, types.values())), place)
    for name, (constants, fields) in types.items():
        if not TYPE.fullmatch(name) or len(name) > LONGEST_NAME:
            raise DamagedRecording(f"{place}: found the type {name[:LONGEST_NAME]!r}, expected package/msg/Name")
        names = [one[0] for one in (*fields, *constants)]
        for one in names:
            if not _NAME.fullmatch(one) or len(one) > LONGEST_NAME:
                raise DamagedRecording(f"{place}: found the field {one[:LONGEST_NAME]!r}, expected an identifier")
        if len(set(names)) < len(names):
            raise DamagedRecording(f"{place}: found two fields with the same name in {name}, expected distinct names")
        for constant, _, value in constants:
            _examine_value(value, f"{place}: constant {constant}")
        for field, description in fields:
            _examine_field(description, f"{place}: field {field}")
    _Sizes(types, place).examine()


def _examine_value(value: object, place: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise DamagedRecording(f"{place}: found {value}, expected a finite number")
    if isinstance(value, int) and value.bit_length() > _LONGEST_INT:
        raise DamagedRecording(
            f"{place}: found a number of {counted(value.bit_length(), 'bit')}, expected at most {_LONGEST_INT}"
        )


def _examine_field(description: Any, place: str) -> None:
    kind, inner = description
    if kind in _SEVERAL:
        (kind_of_each, each), size = inner
        if size < (kind == Nodetype.ARRAY) or size.bit_length() > _LONGEST_INT:
            raise DamagedRecording(f"{place}: found {str(size)[:20]} elements, expected a positive number")
        _examine_field((kind_of_each, each), place)
    elif kind == Nodetype.NAME:
        if not TYPE.fullmatch(inner) or len(inner) > LONGEST_NAME:
            raise DamagedRecording(f"{place}: found the type {inner[:LONGEST_NAME]!r}, expected package/msg/Name")
    elif not 0 <= inner[1] < 1 << _LONGEST_INT:
        raise DamagedRecording(
            f"{place}: found a string of {str(inner[1])[:20]} characters, expected a positive number"
        )


def weight(content: tuple[list[Any], list[Any]]) -> int:
    """Return the size of the code of a type: rosbags unrolls fixed arrays of strings and messages."""
    constants, fields = content
    return 1 + len(constants) + sum(_unrolled(description) for _, description in fields)


def _unrolled(description: Any) -> int:
    kind, inner = description
    return max(inner[1], 1) if kind == Nodetype.ARRAY and not _is_number(inner[0]) else 1


def _is_number(description: Any) -> bool:
    kind, inner = description
    return bool(kind == Nodetype.BASE and inner[0] not in ("string", "wstring"))


class _Sizes:
    """Nesting depth of types, and minimum size of a message."""

    def __init__(self, types: Types, place: str) -> None:
        self._types = types
        self._place = place
        self._known: dict[str, tuple[int, int, int, int]] = {}
        self._open: list[str] = []

    def examine(self) -> None:
        for name in self._types:
            self._of(name)

    def _of(self, name: str) -> tuple[int, int, int, int]:
        """Return nesting levels, fields in all of them, elements of a message, and bytes of its numbers."""
        if name in self._known:
            return self._known[name]
        if name in self._open:
            raise DamagedRecording(f"{self._place}: found {name} inside itself, expected types without a cycle")
        if name not in self._types:
            return 1, 1, 1, 0
        self._open.append(name)
        limits.check_limit("depth", len(self._open), f"{self._place}: nesting")
        levels, fields, elements, numbers = 0, 0, 0, 0
        for _, (kind, inner) in self._types[name][1]:
            (kind_of_each, each), size = inner if kind in _SEVERAL else ((kind, inner), 1)
            count = size if kind == Nodetype.ARRAY else 1
            if kind_of_each == Nodetype.NAME:
                below, inside, more, held = self._of(each)
                levels, fields = max(levels, below), fields + inside
                elements, numbers = elements + count * more, numbers + count * held
            elif each[0] in ("string", "wstring"):
                elements += count
            else:
                elements, numbers = elements + 1, numbers + 8 * count
        self._open.pop()
        found = levels + 1, fields + len(self._types[name][1]), elements, numbers
        limits.check_limit("depth", found[0], f"{self._place}: nesting of {name}")
        limits.check_limit("fields", found[1], f"{self._place}: fields of {name} and of all in it")
        limits.check_limit("count", elements, f"{self._place}: elements of one {name}")
        limits.check_limit("free", numbers, f"{self._place}: bytes of one {name}")
        self._known[name] = found
        return found

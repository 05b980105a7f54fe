"""Counts the objects that decoding a message would create, by a walk over its bytes before it is decoded.

An array of messages of one byte creates an object of about hundred bytes per byte.  Messages that are too short for
more elements than the limit ``count`` are not walked.  In ROS 1 a message without fields has no bytes at all, so an
array of such messages is as long as its count states.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import limits

_SIZES = {"bool": 1, "byte": 1, "char": 1, "octet": 1, "float32": 4, "float64": 8, "float128": 16} | {
    f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_ENCAPSULATION = 4
#: The field that rosidl adds to a type without fields; ROS 1 has no such byte.
PLACEHOLDER = "structure_needs_at_least_one_member"


class ElementCounter:
    """Counts for messages of one type.

    Args:
        types: the type and all its dependencies.
        ros_type: name of the type.
        ros1: whether the bytes are of ROS 1 (without alignment and encapsulation) or CDR.
    """

    def __init__(self, types: Mapping[str, Any], ros_type: str, *, ros1: bool = False) -> None:
        self._types = types
        self._root = ros_type
        self._ros1 = ros1
        self._several = any(
            kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and not _is_number(inner[0])
            for _, fields in types.values()
            for _, (kind, inner) in fields
        )
        self._empty = frozenset(
            name for name, (_, fields) in types.items() if ros1 and [field for field, _ in fields] == [PLACEHOLDER]
        )
        self._number = struct.Struct("<I")
        self._data = b""
        self._at = self._found = self._most = 0

    def check(self, data: bytes) -> None:
        """Raise LimitExceeded for a message with too many elements."""
        self._most = limits.current_limits().count
        if not self._several or (len(data) <= self._most and not self._empty):
            return
        self._data, self._at, self._found = data, 0 if self._ros1 else _ENCAPSULATION, 0
        self._number = struct.Struct("<I" if self._ros1 or data[1] & 1 else ">I")
        try:
            self._struct(self._root)
        except (struct.error, KeyError):
            return  # not of the type: decoding reports it
        finally:
            self._data = b""

    def _struct(self, name: str) -> None:
        self._found += 1
        if self._found > self._most:
            raise limits.exceeded(
                "count", f"more than {counted(self._most, 'element')}", f"a message of {self._root}", self._most
            )
        if name in self._empty:
            return
        for _, (kind, inner) in self._types[name][1]:
            if kind == Nodetype.ARRAY:
                self._each(inner[0], inner[1])
            elif kind == Nodetype.SEQUENCE:
                self._each(inner[0], self._count())
            else:
                self._one(kind, inner)

    def _each(self, description: Any, count: int) -> None:
        kind, inner = description
        if _is_number(description):
            if count:
                size = _SIZES[inner[0]]
                self._align(size)
                self._at += size * count
            return
        if count > self._most:
            self._found = self._most
        for _ in range(count):
            self._one(kind, inner)
            if self._at > len(self._data):
                return

    def _one(self, kind: int, inner: Any) -> None:
        if kind == Nodetype.NAME:
            self._struct(inner)
        elif inner[0] in ("string", "wstring"):
            self._found += 1
            if self._found > self._most:
                raise limits.exceeded(
                    "count", f"more than {counted(self._most, 'element')}", f"a message of {self._root}", self._most
                )
            length = self._count()
            self._at += length
        else:
            size = _SIZES[inner[0]]
            self._align(size)
            self._at += size

    def _count(self) -> int:
        self._align(4)
        (count,) = self._number.unpack_from(self._data, self._at)
        self._at += 4
        return int(count)

    def _align(self, size: int) -> None:
        if not self._ros1:
            self._at += -(self._at - _ENCAPSULATION) % min(size, 8)


def _is_number(description: Any) -> bool:
    kind, inner = description
    return bool(kind == Nodetype.BASE and inner[0] in _SIZES)

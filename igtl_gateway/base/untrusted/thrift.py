"""Untrusted Thrift in the compact protocol: structures of integers, strings, lists and structures, as Parquet has.

https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md
"""

from __future__ import annotations

from typing import NoReturn, TypeAlias

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.limits import check_limit

#: A value, and the fields of a structure by their numbers.  None stands for numbers with a fraction, and maps.
Value: TypeAlias = "int | bytes | list[Value] | Fields | None"
Fields: TypeAlias = dict[int, Value]

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _MAP, _STRUCT = 0, 1, 2, 3, 7, 8, 11, 12
_INTEGERS = frozenset({4, 5, 6})  # i16, i32, i64
_LISTS = frozenset({9, 10})  # list, set
#: Nesting of structures and lists; the metadata of Parquet have eight levels.
_MAX_DEPTH = 16


class Incomplete(Exception):
    """The bytes end inside of the structure."""


class ThriftReader:
    """Reads structures from bytes.

    Args:
        data: the bytes.
        place: where they are, for errors.

    Attributes:
        at: offset of the next byte.
    """

    def __init__(self, data: bytes, place: str) -> None:
        self._data, self._place = data, place
        self.at = 0
        self._elements = 0

    def struct(self, depth: int = 0) -> Fields:
        """Return the fields of the structure at ``at``.

        Raises:
            Incomplete: more bytes are needed.
            DamagedRecording: it is not such a structure.
            LimitExceeded: its lists have more elements than the limit ``count``.
        """
        if depth > _MAX_DEPTH:
            self._fail(f"structures in more than {_MAX_DEPTH} levels")
        found: Fields = {}
        number = 0
        while (head := self._byte()) != _STOP:
            number = number + (head >> 4) if head >> 4 else self._integer()
            kind = head & 15
            found[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self._value(kind, depth)
        return found

    def _value(self, kind: int, depth: int) -> Value:
        if kind in _INTEGERS:
            return self._integer()
        if kind == _BINARY:
            return self._bytes(self._varint())
        if kind == _STRUCT:
            return self.struct(depth + 1)
        if kind in _LISTS:
            return self._list(depth + 1)
        if kind in (_TRUE, _FALSE, _BYTE):  # in a list, true and false take a byte
            return self._byte()
        if kind == _DOUBLE:
            self._bytes(8)
            return None
        return self._fail(f"a field of type {kind}")

    def _list(self, depth: int) -> list[Value]:
        if depth > _MAX_DEPTH:
            self._fail(f"lists in more than {_MAX_DEPTH} levels")
        head = self._byte()
        size = head >> 4 if head >> 4 < 15 else self._varint()
        self._elements += size
        check_limit("count", self._elements, f"{self._place}: elements")
        return [self._value(head & 15, depth) for _ in range(size)]

    def _byte(self) -> int:
        if self.at >= len(self._data):
            raise Incomplete
        self.at += 1
        return self._data[self.at - 1]

    def _bytes(self, size: int) -> bytes:
        self.at += size
        if self.at > len(self._data):
            raise Incomplete
        return self._data[self.at - size : self.at]

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        return self._fail("an integer of more than 64 bits")

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)

    def _fail(self, found: str) -> NoReturn:
        raise DamagedRecording(f"{self._place}: byte {self.at}: found {found}, expected a structure of Parquet")

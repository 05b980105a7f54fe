"""Messages of one ROS type as columns: each field of all messages at once, without an object per message.

A cursor per message moves through the fields.  It fits numbers, strings, sequences of numbers, and sequences of
messages with numbers of one size, such as points.  Other types are decoded one message at a time, by the caller.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype

from igtl_gateway.api.columns import field_unit
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.record.sessionfile.bulk import Bytes, MessageBlock, Numbers, gathered, numbers_at
from igtl_gateway.record.sessionfile.records import Malformed

_TYPES = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "float32": "<f4", "float64": "<f8"} | {
    f"{sign}int{bits}": f"<{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_TIMES = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
_ENCAPSULATION = 4
#: Mean size in bytes from which on copying piece by piece is faster than by an index of all bytes.
_LARGE = 1024


class NotColumns(Exception):
    """The messages must be decoded one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """A field of n messages.

    Attributes:
        name: path of the field with its unit, as the tables of ``columns`` have it.
        unit: ``"m"``, ``"rad/s"`` …; ``""`` without one.
        values: shape (n,), or (n, k) for an array of k numbers; with ``offsets`` all elements of all messages.
        offsets: (n + 1,) int64: the elements of message i are ``values[offsets[i]:offsets[i + 1]]``; a structured array
            has messages as elements.
        is_text: the elements are the bytes of a string in UTF-8.
        valid: (n,) bool: which messages have the field; None: all.
    """

    name: str
    unit: str
    values: npt.NDArray[Any]
    offsets: Numbers | None = None
    is_text: bool = False
    valid: npt.NDArray[np.bool_] | None = None

    def text(self, index: int) -> str:
        """The string of one message."""
        assert self.offsets is not None
        return self.values[self.offsets[index] : self.offsets[index + 1]].tobytes().decode("utf-8", "replace")

    def texts(self) -> list[str]:
        """The strings of all messages; equal strings are one object."""
        assert self.offsets is not None
        count = len(self.offsets) - 1
        sizes = np.diff(self.offsets)
        if count and (sizes == sizes[0]).all():
            rows = self.values.reshape(count, int(sizes[0]))
            if (rows == rows[0]).all():
                return [self.text(0)] * count
        return [self.text(index) for index in range(count)]


def ros_columns(block: MessageBlock, types: Mapping[str, Any], ros_type: str) -> list[Column]:
    """The fields of messages of a type.  Raises NotColumns.

    Args:
        block: the messages, in CDR.
        types: definitions of the type and all its dependencies, as rosbags has them.
        ros_type: ``package/msg/Name``.
    """
    try:
        return _Walk(block, types).run(ros_type)
    except (Malformed, KeyError):
        raise NotColumns from None


class _Walk:
    """One pass over the fields."""

    def __init__(self, block: MessageBlock, types: Mapping[str, Any]) -> None:
        self._data, self._types = block.data, types
        self._starts, self._ends = block.begins + _ENCAPSULATION, block.ends
        self._at = self._starts.copy()
        self._columns: list[Column] = []
        if len(block) and (numbers_at(block.data, block.begins, ">u2") != 1).any():
            raise NotColumns  # not CDR in little-endian

    def run(self, ros_type: str) -> list[Column]:
        self._struct(ros_type, "", "")
        rest = self._ends - self._at
        if ((rest < 0) | (rest > 3)).any():
            raise NotColumns
        return self._columns

    def _struct(self, ros_type: str, place: str, unit: str) -> None:
        for field, (kind, inner) in self._types[ros_type][1]:
            own = field_unit(ros_type, field, unit)
            path = f"{place}.{field}" if place else field
            if kind == Nodetype.NAME and inner in _TIMES:
                seconds, nanoseconds = self._numbers("int32"), self._numbers("uint32")
                self._columns.append(Column(f"{path}_ns", "ns", seconds.astype(np.int64) * NS_PER_S + nanoseconds))
            elif kind == Nodetype.NAME:
                self._struct(inner, path, own)
            elif kind == Nodetype.BASE:
                self._base(f"{path}_{own}" if own else path, own, inner[0])
            elif kind == Nodetype.SEQUENCE and inner[0][0] == Nodetype.NAME:
                self._structs(path, own, self._record(inner[0][1], own))
            elif inner[0][0] != Nodetype.BASE or inner[0][1][0] not in _TYPES:
                raise NotColumns
            else:
                element, count = inner[0][1][0], inner[1]
                self._elements(f"{path}_{own}" if own else path, own, element, count if kind == Nodetype.ARRAY else -1)

    def _base(self, name: str, unit: str, element: str) -> None:
        if element in _TYPES:
            self._columns.append(Column(name, unit_text(unit), _truth(self._numbers(element), element)))
        elif element == "string":
            size = self._numbers("uint32").astype(np.int64) - 1
            self._check(size + 1)
            if (size < 0).any() or (gathered(self._data, self._at + size, 1) != 0).any():
                raise NotColumns  # without its NUL
            values, offsets = ragged(self._data, self._at, size, self._ends)
            self._at = self._at + size + 1
            self._columns.append(Column(name, "", _checked_text(values, offsets), offsets, is_text=True))
        else:
            raise NotColumns

    def _elements(self, name: str, unit: str, element: str, fixed: int) -> None:
        """An array of ``fixed`` numbers, or a sequence (-1)."""
        dtype = np.dtype(_TYPES[element])
        if fixed >= 0:
            self._align(dtype.itemsize)
            self._check(fixed * dtype.itemsize)
            values = gathered(self._data, self._at, fixed * dtype.itemsize).view(dtype)
            self._at = self._at + fixed * dtype.itemsize
            self._columns.append(Column(name, unit_text(unit), _truth(values, element)))
            return
        count = self._numbers("uint32").astype(np.int64)
        aligned = self._at + -(self._at - self._starts) % dtype.itemsize
        self._at = np.where(count > 0, aligned, self._at)  # without elements there is no padding
        values, offsets = ragged(self._data, self._at, count * dtype.itemsize, self._ends)
        self._at = self._at + count * dtype.itemsize
        numbers = _truth(values.view(dtype), element)
        self._columns.append(Column(name, unit_text(unit), numbers, offsets // dtype.itemsize))

    def _record(self, ros_type: str, unit: str) -> np.dtype[np.void]:
        """A type of numbers of one size, which needs no padding, as numpy has it.  Raises NotColumns for others."""
        fields: list[tuple[str, Any]] = []
        for field, (kind, inner) in self._types[ros_type][1]:
            own = field_unit(ros_type, field, unit)
            name = f"{field}_{own}" if own else field
            if kind == Nodetype.BASE and inner[0] in _TYPES:
                fields.append((name, np.dtype(_TYPES[inner[0]])))
            elif kind == Nodetype.ARRAY and inner[0][0] == Nodetype.BASE and inner[0][1][0] in _TYPES and inner[1] > 0:
                fields.append((name, (np.dtype(_TYPES[inner[0][1][0]]), (inner[1],))))
            else:
                raise NotColumns
        record = np.dtype(fields)
        if len({record[index].base.itemsize for index in range(len(fields))}) != 1:
            raise NotColumns
        return record

    def _structs(self, name: str, unit: str, record: np.dtype[np.void]) -> None:
        """A sequence of messages with numbers of one size."""
        count = self._numbers("uint32").astype(np.int64)
        aligned = self._at + -(self._at - self._starts) % record[0].base.itemsize
        self._at = np.where(count > 0, aligned, self._at)
        values, offsets = ragged(self._data, self._at, count * record.itemsize, self._ends)
        self._at = self._at + count * record.itemsize
        self._columns.append(Column(name, unit_text(unit), values.view(record), offsets // record.itemsize))

    def _numbers(self, element: str) -> npt.NDArray[Any]:
        dtype = np.dtype(_TYPES[element])
        self._align(dtype.itemsize)
        self._check(dtype.itemsize)
        values = numbers_at(self._data, self._at, dtype.str)
        self._at = self._at + dtype.itemsize
        return values

    def _align(self, size: int) -> None:
        self._at = self._at + -(self._at - self._starts) % size

    def _check(self, size: int | Numbers) -> None:
        if (self._at + size > self._ends).any():
            raise NotColumns


def _truth(values: npt.NDArray[Any], element: str) -> npt.NDArray[Any]:
    """Bytes as truth values if the element is one."""
    return values != 0 if element == "bool" else values


def ragged(data: Bytes, begins: Numbers, sizes: Numbers, ends: Numbers) -> tuple[Bytes, Numbers]:
    """Pieces of different sizes in one array, and its (n + 1,) offsets.  Raises NotColumns for one past ``ends``."""
    if (begins + sizes > ends).any():
        raise NotColumns
    offsets = np.zeros(len(sizes) + 1, np.int64)
    np.cumsum(sizes, out=offsets[1:])
    total = int(offsets[-1])
    if not total:
        return np.zeros(0, np.uint8), offsets
    if total >= _LARGE * len(sizes):
        pieces = [data[at : at + size] for at, size in zip(begins.tolist(), sizes.tolist(), strict=True)]
        return np.concatenate(pieces), offsets
    if (sizes == sizes[0]).all():
        return gathered(data, begins, int(sizes[0])).reshape(-1), offsets
    return data[np.repeat(begins - offsets[:-1], sizes) + np.arange(total)], offsets


def _checked_text(values: Bytes, offsets: Numbers) -> Bytes:
    """Raise NotColumns where a string is not UTF-8."""
    try:
        values.tobytes().decode()
    except UnicodeDecodeError:
        raise NotColumns from None
    inside = offsets[:-1][offsets[:-1] < len(values)]
    if ((values[inside] & 0xC0) == 0x80).any():  # begins in the middle of a character
        raise NotColumns
    return values


#: Unit in names of columns → the unit as text.
_UNIT_TEXTS = {
    "m_s": "m/s",
    "m_s2": "m/s^2",
    "rad_s": "rad/s",
    "rad_s2": "rad/s^2",
    "kg_m2": "kg m^2",
    "Nm": "N m",
    "C": "°C",
}


def unit_text(unit: str) -> str:
    """A unit as text; ``unit`` as in names of columns: ``"rad_s"`` → ``"rad/s"``."""
    return _UNIT_TEXTS.get(unit, unit)

"""ROS 2 messages as frozen dataclasses: the annotations of the fields give ``pack`` and ``unpack``.

This serves all messages that are not on the hot path; ``rosmsg`` has the others.  Number arrays are numpy views on the
received bytes, and octets are views of any size.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, get_type_hints

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import ns_to_ros, ros_to_ns
from igtl_gateway.base.versions import Self
from igtl_gateway.convert.cdr import CdrReader, CdrWriter
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header

#: The values of fields: number arrays, and structs or arrays of equal numbers.
Array = npt.NDArray[Any]
Point = tuple[float, float, float]
SixNumbers = tuple[float, float, float, float, float, float]
Pose = tuple[float, float, float, float, float, float, float]
Size = tuple[int, int, int]
Rgba = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class CdrType:
    """Writes and reads values of one type.

    Attributes:
        name: type name as in a .msg file.
        write: function that appends a value.
        read: function that reads the next value.
    """

    name: str
    write: Callable[[CdrWriter, Any], None]
    read: Callable[[CdrReader], Any]


def _number(name: str, code: str) -> CdrType:
    layout = struct.Struct("<" + code)

    def write(out: CdrWriter, value: Any) -> None:
        try:
            out.pack(layout, layout.size, value)
        except struct.error:
            raise ConversionError(f"found {value!r}, expected a number that fits {name}") from None

    return CdrType(name, write, lambda read: read.unpack(code, layout.size)[0])


_CODES = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
INT16, UINT8, UINT16, UINT32, UINT64 = (_number(n, _CODES[n]) for n in ("int16", "uint8", "uint16", "uint32", "uint64"))
FLOAT64 = _number("float64", "d")
BOOL = CdrType("bool", CdrWriter.bool, CdrReader.bool)
STRING = CdrType("string", CdrWriter.string, CdrReader.string)
#: uint8[]: any buffer, not copied.
OCTETS = CdrType("uint8[]", CdrWriter.octets, CdrReader.octets)

_TIME = struct.Struct("<iI")
#: builtin_interfaces/Time as UTC ns, 0 = unset.
TIME = CdrType(
    "builtin_interfaces/Time",
    lambda out, ns: out.pack(_TIME, 4, *ns_to_ros(ns)),
    lambda read: ros_to_ns(*read.unpack("iI", 4)),
)
HEADER = CdrType("std_msgs/Header", lambda out, header: header.write(out), Header.read)
DIAGNOSTIC_STATUS = CdrType(
    "diagnostic_msgs/DiagnosticStatus", lambda out, status: status.write(out), DiagnosticStatus.read
)


def fixed_array(name: str, count: int, *, as_name: str = "") -> CdrType:
    """Return the type of ``count`` equal numbers as a tuple: an array of fixed length, or a struct of equal fields."""
    code = f"{count}{_CODES[name]}"
    layout = struct.Struct("<" + code)
    align = layout.size // count
    shown = as_name or f"{name}[{count}]"

    def write(out: CdrWriter, values: Any) -> None:
        try:
            out.pack(layout, align, *values)
        except struct.error:
            raise ConversionError(f"found {values!r}, expected {counted(count, 'number')} that fit {shown}") from None

    return CdrType(shown, write, lambda read: read.unpack(code, align))


#: geometry_msgs/Point and Vector3: x, y, z.
POINT = fixed_array("float64", 3, as_name="geometry_msgs/Point")
#: geometry_msgs/Pose: position x, y, z, then orientation x, y, z, w.
POSE = fixed_array("float64", 7, as_name="geometry_msgs/Pose")
#: Linear, then angular x, y, z.
TWIST = fixed_array("float64", 6, as_name="geometry_msgs/Twist")
#: Force, then torque x, y, z.
WRENCH = fixed_array("float64", 6, as_name="geometry_msgs/Wrench")


def number_sequence(name: str, columns: int = 1, *, as_name: str = "") -> CdrType:
    """Return the type of a sequence of numbers as an array (n,), or of ``columns`` equal numbers as (n, columns)."""
    kind = np.dtype(_CODES[name])
    shape = (-1,) if columns == 1 else (-1, columns)

    def write(out: CdrWriter, values: Any) -> None:
        array = np.asarray(values, kind)
        out.sequence(array, kind.itemsize, len(array))

    return CdrType(
        as_name or f"{name}[]",
        write,
        lambda read: read.sequence(kind.str[1:], columns, kind.itemsize).reshape(shape),
    )


#: geometry_msgs/Point[] as an array (n, 3).
POINTS = number_sequence("float64", 3, as_name="geometry_msgs/Point[]")
#: geometry_msgs/Pose[] as an array (n, 7).
POSES = number_sequence("float64", 7, as_name="geometry_msgs/Pose[]")


def struct_of(of: CdrType | type[Struct]) -> CdrType:
    """Return the type of one struct inside another."""
    return of if isinstance(of, CdrType) else CdrType(of.TYPE, _write_struct, of.read)


def sequence_of(of: CdrType | type[Struct]) -> CdrType:
    """Return the type of a sequence of structs or strings as a tuple."""
    one = struct_of(of)

    def write(out: CdrWriter, values: Any) -> None:
        out.u32(len(values))
        for value in values:
            one.write(out, value)

    return CdrType(f"{one.name}[]", write, lambda read: tuple(one.read(read) for _ in range(read.count())))


class _Fields:
    """Finds the CDR types of a class when they are first asked for: at the import it would take a third of its time."""

    def __get__(self, _value: object, cls: type[Struct]) -> tuple[CdrType, ...]:
        hints = get_type_hints(cls, include_extras=True).values()
        cls.FIELDS = found = tuple(kind for hint in hints for kind in getattr(hint, "__metadata__", ()))
        return found


class Struct:
    """Base of the value classes: each field is annotated with its CDR type, in the order of the message.

    For example ``encoding: Annotated[int, UINT16]``; ``FIELDS`` contains the types in this order.
    """

    __slots__ = ()
    TYPE: ClassVar[str]
    FIELDS: ClassVar[tuple[CdrType, ...]]
    #: The names of the fields in their order, set by ``dataclass``.
    __match_args__: ClassVar[tuple[str, ...]]

    def __init_subclass__(cls) -> None:
        cls.FIELDS = _Fields()  # type: ignore[assignment]  # each class finds its own

    def write(self, out: CdrWriter) -> None:
        """Append all fields."""
        for name, kind in zip(self.__match_args__, self.FIELDS, strict=True):
            kind.write(out, getattr(self, name))

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        """Read all fields."""
        return cls(*[kind.read(cdr) for kind in cls.FIELDS])

    def pack(self) -> bytes:
        """Return the CDR bytes.  Raises ConversionError for a number that its field cannot hold."""
        out = CdrWriter()
        try:
            self.write(out)
        except ConversionError as error:
            raise ConversionError(f"{self.TYPE}: {error}") from None
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        """Return the message of CDR bytes.  Raises ConversionError if they are not of this type."""
        return cls.read(CdrReader(cdr, cls.TYPE))


def _write_struct(out: CdrWriter, value: Struct) -> None:
    value.write(out)

"""CDR, the serialisation of ROS 2 messages: a writer and a reader on plain buffers.

The format is that of rmw_fastrtps: XCDR version 1 with a 4-byte encapsulation header, each primitive aligned to its
size, counted from the end of that header.  Padding is always zero, so equal messages have equal bytes, and
verification can compare them.  (The native serialisation leaves padding uninitialised.)  The writer appends arrays as
buffers and joins all buffers once; the reader returns views on the received bytes.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import MANY_BYTES, Buffer, join_in_steps
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.long_text import LONG, decoded, encoded
from igtl_gateway.base.quantities import counted
from igtl_gateway.native.joining import join_parts

_ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR_LE, no options
_HEADER_SIZE = 4

#: Maximum number of elements of an array; it bounds elements of size zero too.
_MAX_ELEMENTS = 1 << 31


class CdrWriter:
    """Appends fields in the order of the message definition; ``finish`` returns the CDR bytes."""

    __slots__ = ("_parts", "_size")

    def __init__(self) -> None:
        self._parts: list[Buffer] = [_ENCAPSULATION]
        self._size = 0  # without the encapsulation header: alignment counts from its end

    def _append(self, part: Buffer, size: int) -> None:
        self._parts.append(part)
        self._size += size

    def align(self, to: int) -> None:
        """Append zero bytes up to the next multiple of ``to`` (1, 2, 4 or 8)."""
        pad = -self._size % to
        if pad:
            self._parts.append(_ZEROS[pad])
            self._size += pad

    def pack(self, layout: struct.Struct, align: int, *values: Any) -> None:
        """Append fixed fields without padding between them, the first one aligned to ``align``."""
        self.align(align)
        self._append(layout.pack(*values), layout.size)

    def u8(self, value: int) -> None:
        self._append(bytes((value,)), 1)

    def bool(self, value: bool) -> None:
        self.u8(1 if value else 0)

    def u32(self, value: int) -> None:
        self.pack(_U32, 4, value)

    def i32(self, value: int) -> None:
        self.pack(_I32, 4, value)

    def f64s(self, *values: float) -> None:
        """Append consecutive float64 fields."""
        self.align(8)
        self._append(_doubles(len(values)).pack(*values), 8 * len(values))

    def string(self, text: str) -> None:
        """Append a string: length, UTF-8 and a final NUL."""
        self.align(4)
        if len(text) >= LONG:
            pieces = encoded(text)
            size = sum(map(len, pieces)) + 1
            for piece in (_U32.pack(size), *pieces, b"\0"):
                self._append(piece, len(piece))
            return
        data = _name(text) if len(text) <= _NAME else _text(text)
        self._append(data, len(data))

    def array(self, values: npt.NDArray[Any], align: int) -> None:
        """Append the elements of an array without a length; copied only if not little-endian and contiguous."""
        if values.size:
            self.align(align)
            flat = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
            self._append(flat.reshape(-1).view(np.uint8).data, flat.nbytes)

    def sequence(self, values: npt.NDArray[Any], align: int, count: int) -> None:
        """Append a sequence of ``count`` primitives, or of structs that consist of one primitive type."""
        self.u32(count)
        self.array(values, align)

    def octets(self, data: Buffer) -> None:
        """Append a uint8[] from a buffer, not copied."""
        view = memoryview(data).cast("B") if memoryview(data).nbytes else memoryview(b"")
        self.u32(view.nbytes)
        if view.nbytes:
            self._append(view, view.nbytes)

    def finish(self) -> bytes:
        """Return the message, joined once, as ``bytes``: rclpy publishes no other type."""
        return b"".join(self._parts) if self._size < MANY_BYTES else (join_parts or join_in_steps)(self._parts)


_U32 = struct.Struct("<I")
_I32 = struct.Struct("<i")
_STAMP = struct.Struct("<iI")
_ZEROS = tuple(map(bytes, range(8)))

#: Longest string that is cached as bytes: frame ids and names repeat.
_NAME = 64


@lru_cache(maxsize=64)
def _doubles(count: int) -> struct.Struct:
    return struct.Struct(f"<{count}d")


def _text(text: str) -> bytes:
    data = text.encode("utf-8", "surrogateescape")
    return _U32.pack(len(data) + 1) + data + b"\x00"


_name = lru_cache(maxsize=4_096)(_text)
_POSE = struct.Struct("<7d")


def stamped_pose(before: bytes, stamp: tuple[int, int], frame_id: str, child_frame_id: str, pose: Any) -> bytes:
    """Return the CDR bytes of a message that ends with stamp, two names and a pose.

    It is built in one step, because trackers send poses at high rates.  ``before`` are the fields up to the stamp, in
    multiples of 4 bytes; ``pose`` is x, y, z, qx, qy, qz, qw.
    """
    names = _two_names if len(frame_id) + len(child_frame_id) <= _NAME else _two_texts
    start = _ENCAPSULATION + before + _STAMP.pack(*stamp)
    return start + names(len(start) - _HEADER_SIZE, frame_id, child_frame_id) + _POSE.pack(*pose)


def _two_texts(offset: int, first: str, second: str) -> bytes:
    """Return the CDR bytes of two strings at an offset, with the padding that aligns the next field to 8 bytes."""
    out = CdrWriter()
    out.f64s(*[0.0] * (offset // 8))
    if offset % 8:
        out.u32(0)
    out.string(first)
    out.string(second)
    out.align(8)
    return out.finish()[_HEADER_SIZE + offset :]


_two_names = lru_cache(maxsize=4_096)(_two_texts)


@lru_cache(maxsize=256)
def _layout(order: str, layout: str) -> struct.Struct:
    return struct.Struct(order + layout)


class CdrReader:
    """Reads fields in the order of the message definition from CDR bytes (either byte order).

    Raises ConversionError if the bytes end too early or a length is impossible.
    """

    __slots__ = ("_data", "_offset", "_order", "_size", "_type")

    def __init__(self, data: Buffer, type_name: str) -> None:
        self._data = memoryview(data)
        self._size = self._data.nbytes
        self._type = type_name
        if self._size < _HEADER_SIZE or self._data[0] != 0 or self._data[1] not in (0, 1):
            raise ConversionError(
                f"{type_name}: found encapsulation {bytes(self._data[:4]).hex() or 'nothing'}, "
                "expected 0000 (big-endian CDR) or 0001 (little-endian CDR)"
            )
        self._order = "<" if self._data[1] else ">"
        self._offset = _HEADER_SIZE

    def _take(self, size: int, align: int) -> int:
        """Return the aligned offset of the next ``size`` bytes, and advance past them."""
        offset = self._offset + (_HEADER_SIZE - self._offset) % align
        end = offset + size
        if end > self._size:
            raise ConversionError(
                f"{self._type}: CDR ends at byte {self._size}, expected {size} more bytes at offset {offset}"
            )
        self._offset = end
        return offset

    def unpack(self, layout: str, align: int) -> tuple[Any, ...]:
        """Read fixed fields without padding between them (``layout`` as in ``struct``, without byte order)."""
        packing = _layout(self._order, layout)
        return packing.unpack_from(self._data, self._take(packing.size, align))

    def u8(self) -> int:
        return self._data[self._take(1, 1)]

    def bool(self) -> bool:
        return self.u8() != 0

    def u32(self) -> int:
        (value,) = _layout(self._order, "I").unpack_from(self._data, self._take(4, 4))
        return value

    def i32(self) -> int:
        return int(self.unpack("i", 4)[0])

    def string(self) -> str:
        size = self.u32()
        offset = self._take(size, 1)
        return decoded(bytes(self._data[offset : offset + size]).rstrip(b"\x00"), "utf-8", "surrogateescape")

    def count(self) -> int:
        """Read the length of a sequence whose elements are read one by one."""
        count = self.u32()
        if count > self._data.nbytes:  # each element has at least one byte
            raise ConversionError(
                f"{self._type}: a sequence announces {counted(count, 'element')} in a message of "
                f"{counted(self._data.nbytes, 'byte')}"
            )
        return count

    def array(self, dtype: str, count: int, align: int) -> npt.NDArray[Any]:
        """Read ``count`` elements as a view on the received bytes; ``dtype`` without byte order, such as ``"f8"``."""
        kind = np.dtype(self._order + dtype)
        if count == 0:
            return np.empty(0, kind)
        if count > _MAX_ELEMENTS:
            raise ConversionError(
                f"{self._type}: a sequence announces {counted(count, 'element')}, expected at most {_MAX_ELEMENTS}"
            )
        offset = self._take(count * kind.itemsize, align)
        return np.frombuffer(self._data, kind, count, offset)

    def sequence(self, dtype: str, per_element: int, align: int) -> npt.NDArray[Any]:
        """Read a sequence of structs of ``per_element`` equal primitives as a flat view."""
        return self.array(dtype, self.u32() * per_element, align)

    def octets(self) -> memoryview:
        """Read a uint8[] as a view on the received bytes."""
        size = self.u32()
        offset = self._take(size, 1)
        return self._data[offset : offset + size]

"""NDARRAY: numbers in any number of dimensions (``Protocol/ndarray.md``)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError, MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import describe_values
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import Traits

#: Scalar type of the wire → numpy type, big-endian as the data always are; 13 is complex, two float64.
NDARRAY_SCALARS = {
    2: ">i1", 3: ">u1", 4: ">i2", 5: ">u2", 6: ">i4", 7: ">u4", 10: ">f4", 11: ">f8", 13: ">c16",
}  # fmt: skip
MAX_DIMENSIONS = 255


@dataclass(frozen=True, slots=True)
class NdArray:
    """NDARRAY: numbers in 1 … 255 dimensions.

    Attributes:
        scalar_type: 2 i8, 3 u8, 4 i16, 5 u16, 6 i32, 7 u32, 10 f32, 11 f64, 13 complex (two f64).
        size: length along each dimension, outermost first.
        data: the numbers, big-endian, the last index fastest.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(ns_per_byte=10, is_bulky=True)
    LAYOUT: ClassVar[Layout] = (
        Field("scalar_type", "u8"),
        Field("dimensions", "u8", 1, "number of dimensions"),
        Field("size", "u16", "dimensions"),
        Field("data", "bytes", "the rest"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    scalar_type: int
    size: tuple[int, ...]
    data: Buffer

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "NDARRAY content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        scalar_type, dimensions = cls._HEAD.unpack_from(content)
        data_at = cls._HEAD.size + 2 * dimensions
        if content.nbytes < data_at:
            found = f"{content.nbytes - cls._HEAD.size} bytes"
            raise TruncatedMessage("NDARRAY content, offset 2", found, f"{counted(dimensions, 'size')} of 2 bytes")
        size = struct.unpack_from(f">{dimensions}H", content, cls._HEAD.size)
        array = cls(scalar_type, size, content[data_at:])
        array.check()
        return array

    def check(self) -> None:
        """Raises MalformedBody where the data are not what type and size announce."""
        if self.scalar_type not in NDARRAY_SCALARS:
            expected = f"one of {sorted(NDARRAY_SCALARS)}"
            raise MalformedBody("NDARRAY content, offset 0, scalar type", self.scalar_type, expected)
        if not 1 <= len(self.size) <= MAX_DIMENSIONS:
            raise MalformedBody("NDARRAY content, offset 1, dimensions", len(self.size), f"1 … {MAX_DIMENSIONS}")
        found = memoryview(self.data).nbytes
        expected_bytes = math.prod(self.size) * np.dtype(NDARRAY_SCALARS[self.scalar_type]).itemsize
        if found != expected_bytes:
            raise MalformedBody(
                "NDARRAY data", counted(found, "byte"), f"{counted(expected_bytes, 'byte')} for {self.size}"
            )

    def pack(self) -> list[Buffer]:
        self.check()
        try:
            sizes = struct.pack(f">{len(self.size)}H", *self.size)
        except struct.error as error:
            raise MalformedBody("NDARRAY", f"size {self.size}", f"0 … 65535 each ({error})") from None
        return [self._HEAD.pack(self.scalar_type, len(self.size)) + sizes, self.data]

    @property
    def flat(self) -> npt.NDArray[Any]:
        """All numbers as a one-dimensional view."""
        return np.frombuffer(self.data, NDARRAY_SCALARS[self.scalar_type])

    @property
    def array(self) -> npt.NDArray[Any]:
        """The numbers as a view of shape ``size``.

        Raises ConversionError for a shape beyond numpy: more than 64 dimensions, or one of length 0 beside others
        whose product is beyond memory.
        """
        try:
            return self.flat.reshape(self.size)
        except ValueError as error:
            raise ConversionError(
                f"NDARRAY: found size {self.size}, expected a shape that numpy has ({error})"
            ) from None

    def describe(self) -> dict[str, Any]:
        return {"scalar_type": self.scalar_type, "size": list(self.size), "data": describe_values(self.flat)}

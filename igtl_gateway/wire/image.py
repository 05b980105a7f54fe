"""IMAGE: pixels of a slice or a volume with their place in the patient (``Protocol/image.md``)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import describe_crc, describe_values
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import Traits
from igtl_gateway.wire.transform import pack_floats, unpack_floats

#: Scalar type of the wire → numpy type without byte order.
SCALARS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8"}
BIG_ENDIAN, LITTLE_ENDIAN = 1, 2
#: OLD_LPS: what LPS was in the C++ library before March 2013, and is in openigtlink4java.
OLD_LPS, RAS, LPS = 0, 1, 2
_COORDINATES = (OLD_LPS, RAS, LPS)
#: 3D Slicer and OpenIGTLinkIO write VTK's number of a scalar type, which is the protocol's for all but these.
_SIGNED_CHAR = 15
_VTK_ONLY = {
    1: "bit", 8: "long", 9: "unsigned long", 12: "vtkIdType", 16: "long long", 17: "unsigned long long",
}  # fmt: skip
_ACCEPTED = SCALARS | {_SIGNED_CHAR: "i1"}
_ITEM_SIZES = {scalar: np.dtype(name).itemsize for scalar, name in _ACCEPTED.items()}
_UNSET_ENDIAN = 0
_ORDER = {BIG_ENDIAN: ">", LITTLE_ENDIAN: "<"}

_INT8 = 2

Sizes3 = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Image:
    """IMAGE: a slice or a volume with position and orientation.

    Accepted: either byte order, either coordinate system, parts of images.  Coordinate system 0, which was LPS in the
    C++ library before 2013.  Scalar type 15, VTK's signed char, which 3D Slicer writes.  Byte order 0 of pixels of one
    byte.  An empty body means that the peer has no image.

    Sent: coordinate system 1 or 2, scalar types without 15, byte order 1 or 2.

    Attributes:
        dimensions: full size of the volume: columns i, rows j, slices k.
        scalar_type: 2 i8, 3 u8, 4 i16, 5 u16, 6 i32, 7 u32, 10 f32, 11 f64; ``number_type`` is one of them.
        pixels: of the sub-volume, in the order of ``endian``; i fastest, components interleaved.
        num_components: values per pixel.
        endian: 1 big, 2 little: of the pixels only.
        coordinate: 1 RAS, 2 LPS: of the matrix; ``is_lps`` reads it.
        wire_matrix: T, S, N (directions × spacing) and P, in millimetres; P is the centre of the volume.
        subvol_offset: first pixel of the sub-volume.
        subvol_size: its size; ``dimensions`` for a whole image.
        image_version: 1.
    """

    PROTOCOL: ClassVar[str] = "1"
    TRAITS: ClassVar[Traits] = Traits(is_bulky=True)
    LAYOUT: ClassVar[Layout] = (
        Field("image_version", "u16"),
        Field("num_components", "u8"),
        Field("scalar_type", "u8"),
        Field("endian", "u8"),
        Field("coordinate", "u8"),
        Field("dimensions", "u16", 3),
        Field("wire_matrix", "f32", 12),
        Field("subvol_offset", "u16", 3),
        Field("subvol_size", "u16", 3),
        Field("pixels", "bytes", "the rest"),
    )
    # the matrix apart from the integers before and behind it: see ``unpack_floats``
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT[:6])
    _MATRIX: ClassVar[Struct] = compile_struct(LAYOUT[6:7])
    _SUB: ClassVar[Struct] = compile_struct(LAYOUT[7:])
    IDENTITY: ClassVar[tuple[float, ...]] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    dimensions: Sizes3
    scalar_type: int
    pixels: Buffer
    num_components: int = 1
    endian: int = LITTLE_ENDIAN
    coordinate: int = RAS
    wire_matrix: tuple[float, ...] = IDENTITY
    subvol_offset: Sizes3 = (0, 0, 0)
    subvol_size: Sizes3 | None = None
    image_version: int = 1

    @property
    def sub_size(self) -> Sizes3:
        """Size of what the pixels cover: the sub-volume, or the whole."""
        return self.dimensions if self.subvol_size is None else self.subvol_size

    @property
    def is_lps(self) -> bool:
        """Whether the matrix is in LPS, not in RAS."""
        return self.coordinate in (LPS, OLD_LPS)

    @property
    def number_type(self) -> int:
        """The scalar type by the protocol's number: a key of ``SCALARS``."""
        return _INT8 if self.scalar_type == _SIGNED_CHAR else self.scalar_type

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of a component, in the byte order of the wire."""
        return np.dtype(_ORDER.get(self.endian, ">") + _ACCEPTED[self.scalar_type])

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < HEAD_SIZE:
            raise TruncatedMessage("IMAGE content", counted(content.nbytes, "byte"), f"at least {HEAD_SIZE} bytes")
        version, components, scalar, endian, coordinate, *dims = cls._HEAD.unpack_from(content)
        matrix = unpack_floats(cls._MATRIX, content, cls._HEAD.size)
        sub = cls._SUB.unpack_from(content, cls._HEAD.size + cls._MATRIX.size)
        image = cls(
            (dims[0], dims[1], dims[2]),
            scalar,
            content[HEAD_SIZE:],
            components,
            endian,
            coordinate,
            matrix,
            sub[:3],
            sub[3:],
            version,
        )
        image.check()
        return image

    def check(self) -> None:
        """Raises MalformedBody where fields contradict each other or the pixels."""
        if not (
            self.num_components >= 1
            and self.scalar_type in _ACCEPTED
            and (self.endian in _ORDER or self._needs_no_order)
            and self.coordinate in _COORDINATES
        ):
            self._refuse()
        for axis, offset, size, full in zip("ijk", self.subvol_offset, self.sub_size, self.dimensions, strict=True):
            if offset + size > full:
                raise MalformedBody(
                    f"IMAGE content, sub-volume along {axis}", f"{offset} + {size}", f"at most {full}, the full size"
                )
        found, expected = memoryview(self.pixels).nbytes, self.expected_bytes
        if found != expected:
            raise MalformedBody(
                "IMAGE pixels",
                counted(found, "byte"),
                f"{counted(expected, 'byte')} for {self.sub_size}{self._hint}",
            )

    @property
    def _needs_no_order(self) -> bool:
        return self.endian == _UNSET_ENDIAN and _ITEM_SIZES.get(self.scalar_type) == 1

    @property
    def _hint(self) -> str:
        """Why a known sender has another number of pixels."""
        if self.scalar_type != _SIGNED_CHAR:
            return ""
        return ": the C++ library knows no size for the signed char (15) of 3D Slicer; cast the volume to short there"

    def _refuse(self) -> None:
        """Raises MalformedBody for the first field that is not one of its values."""
        for place, found, expected, good in (
            ("offset 2, components", self.num_components, "1 or more", self.num_components >= 1),
            ("offset 3, scalar type", self._named_scalar, self._expected_scalar, self.scalar_type in _ACCEPTED),
            ("offset 4, endian", self.endian, "1 (big) or 2 (little)", self.endian in _ORDER or self._needs_no_order),
            ("offset 5, coordinate system", self.coordinate, "1 (RAS) or 2 (LPS)", self.coordinate in _COORDINATES),
        ):
            if not good:
                raise MalformedBody(f"IMAGE content, {place}", found, expected)

    @property
    def _named_scalar(self) -> str:
        name = _VTK_ONLY.get(self.scalar_type)
        return f"{self.scalar_type} (VTK's {name})" if name else str(self.scalar_type)

    @property
    def _expected_scalar(self) -> str:
        advice = ": cast the volume to short, int, float or double in 3D Slicer"
        return f"one of {sorted(SCALARS)}{advice if self.scalar_type in _VTK_ONLY else ''}"

    @property
    def expected_bytes(self) -> int:
        """Bytes of the pixels that the fields announce."""
        return math.prod(self.sub_size) * self.num_components * _ITEM_SIZES[self.scalar_type]

    def pack(self) -> list[Buffer]:
        self.check()
        try:
            head = self._HEAD.pack(
                self.image_version,
                self.num_components,
                self.scalar_type,
                self.endian,
                self.coordinate,
                *self.dimensions,
            )
            sub = self._SUB.pack(*self.subvol_offset, *self.sub_size)
        except struct.error as error:
            raise MalformedBody("IMAGE", f"size {self.dimensions}", f"0 … 65535 each ({error})") from None
        return [head + pack_floats(self._MATRIX, self.wire_matrix, "IMAGE matrix") + sub, self.pixels]

    @property
    def array(self) -> npt.NDArray[Any]:
        """The pixels as a view of shape (k, j, i, components), in the byte order of the wire."""
        i, j, k = self.sub_size
        return np.frombuffer(self.pixels, self.dtype).reshape(k, j, i, self.num_components)

    def describe(self) -> dict[str, Any]:
        return {
            "image_version": self.image_version,
            "num_components": self.num_components,
            "scalar_type": self.scalar_type,
            "endian": self.endian,
            "coordinate": self.coordinate,
            "dimensions": list(self.dimensions),
            "wire_matrix": list(self.wire_matrix),
            "subvol_offset": list(self.subvol_offset),
            "subvol_size": list(self.sub_size),
            "data_size": memoryview(self.pixels).nbytes,
            "data": describe_values(self.array.reshape(-1)),
            "data_crc64": describe_crc(self.pixels),
        }


#: Bytes before the pixels.
HEAD_SIZE = compile_struct(Image.LAYOUT).size

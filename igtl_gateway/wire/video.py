"""VIDEO: one encoded frame with its place in the patient (protocol 3.1, ``Protocol/video.md``).

The document gives the coordinates three bytes and the size one number; ``LAYOUT`` is what the library sends.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import describe_crc
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.image import LITTLE_ENDIAN, RAS, Image, Sizes3
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import FRAME, Traits
from igtl_gateway.wire.transform import pack_floats, unpack_floats

KEY_FRAME = 1

#: Frame types above this one mark a grey image; the frame's real type is then in the upper byte.
_COLOUR_TYPES = 0xFF


@dataclass(frozen=True, slots=True)
class Video:
    """VIDEO: one encoded frame with position and orientation.

    Accepted: any values in the fields about the pixels.  The library's own writer fills some of them wrongly, and the
    frame can be forwarded, and usually decoded, without them.

    Attributes:
        codec: four letters: ``I420`` (raw), ``H264``, ``VP90``, ``X265``, ``O265``, ``AV10``.
        size: columns i, rows j, slices k of the image.
        data: one encoded frame.
        frame_type: 1 key frame, others need the frames before them; above 255 a grey image, its type in the upper byte.
        endian: 1 big, 2 little: of raw pixels.
        coordinate: 1 RAS, 2 LPS: of the matrix.
        wire_matrix: as in IMAGE, in millimetres.
        subvol_offset: first pixel of the sub-volume in the frame.
        subvol_size: its size; None stands for ``size``.
        video_version: 1.
    """

    PROTOCOL: ClassVar[str] = "3.1"
    TRAITS: ClassVar[Traits] = Traits(FRAME, is_bulky=True)
    LAYOUT: ClassVar[Layout] = (
        Field("video_version", "u16"),
        Field("endian", "u8"),
        Field("codec", "char", 4),
        Field("frame_type", "u16"),
        Field("coordinate", "u8"),
        Field("size", "u16", 3),
        Field("wire_matrix", "f32", 12),
        Field("subvol_offset", "u16", 3),
        Field("subvol_size", "u16", 3, "its size; ``size`` for a complete image"),
        Field("data", "bytes", "the rest"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT[:6])
    _MATRIX: ClassVar[Struct] = compile_struct(LAYOUT[6:7])
    _SUB: ClassVar[Struct] = compile_struct(LAYOUT[7:])

    codec: str
    size: Sizes3
    data: Buffer
    frame_type: int = KEY_FRAME
    endian: int = LITTLE_ENDIAN
    coordinate: int = RAS
    wire_matrix: tuple[float, ...] = Image.IDENTITY
    subvol_offset: Sizes3 = (0, 0, 0)
    subvol_size: Sizes3 | None = None
    video_version: int = 1

    @property
    def sub_size(self) -> Sizes3:
        """Size of what the frame shows: the sub-volume, or the whole."""
        return self.size if self.subvol_size is None else self.subvol_size

    @property
    def is_grey(self) -> bool:
        """Whether the frame is marked as a grey image."""
        return self.frame_type > _COLOUR_TYPES

    @property
    def is_key_frame(self) -> bool:
        """Whether the frame can be decoded without those before it."""
        return (self.frame_type >> 8 if self.is_grey else self.frame_type) == KEY_FRAME

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < _SIZE:
            raise TruncatedMessage("VIDEO content", counted(content.nbytes, "byte"), f"at least {_SIZE} bytes")
        version, endian, codec, frame_type, coordinate, *size = cls._HEAD.unpack_from(content)
        matrix = unpack_floats(cls._MATRIX, content, cls._HEAD.size)
        sub = cls._SUB.unpack_from(content, cls._HEAD.size + cls._MATRIX.size)
        return cls(
            decode_text(codec),
            (size[0], size[1], size[2]),
            content[_SIZE:],
            frame_type,
            endian,
            coordinate,
            matrix,
            sub[:3],
            sub[3:],
            version,
        )

    def pack(self) -> list[Buffer]:
        head = self._HEAD.pack(
            self.video_version,
            self.endian,
            encode_text(self.codec, 4, "VIDEO codec"),
            self.frame_type,
            self.coordinate,
            *self.size,
        )
        sub = self._SUB.pack(*self.subvol_offset, *self.sub_size)
        return [head + pack_floats(self._MATRIX, self.wire_matrix, "VIDEO matrix") + sub, self.data]

    def describe(self) -> dict[str, Any]:
        return {
            "video_version": self.video_version,
            "endian": self.endian,
            "codec": visible(self.codec),
            "frame_type": self.frame_type,
            "coordinate": self.coordinate,
            "size": list(self.size),
            "wire_matrix": list(self.wire_matrix),
            "subvol_offset": list(self.subvol_offset),
            "subvol_size": list(self.sub_size),
            "data_size": memoryview(self.data).nbytes,
            "data_crc64": describe_crc(self.data),
        }


_SIZE = compile_struct(Video.LAYOUT).size  # of all before the frame

"""The header of every OpenIGTLink message: 58 bytes, big-endian.

This is the only place with the offsets of its fields.  The module imports neither numpy nor the codecs of contents:
the process of the recorder needs the offsets and must start quickly.
"""

from __future__ import annotations

from struct import Struct
from typing import ClassVar

import fastcrc

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.values import value
from igtl_gateway.wire.fields import decode_text, encode_text
from igtl_gateway.wire.layout import Field, Layout, compile_struct, offset_of

#: CRC-64/ECMA-182, as the header has it of the body.  The second argument continues the CRC of the bytes before.
crc64 = fastcrc.crc64.ecma_182

#: Header versions that exist: 1 for protocol versions 1 and 2, 2 for protocol version 3.
HEADER_VERSIONS = (1, 2)
#: The rules by which messages that deviate from the protocol are read; older recordings do not state them, which is 0.
#: 1: header version 2 without an extended header, header version 3 with the layout of version 2, and milliseconds in
#: place of the fraction of a second.
READING = 1

#: Sizes of the two names, in bytes.  C++ readers need a NUL at the end of the device name.
TYPE_SIZE, DEVICE_NAME_SIZE = 12, 20

_LAYOUT: Layout = (
    Field("version", "u16"),
    Field("type", "char", TYPE_SIZE),
    Field("device_name", "char", DEVICE_NAME_SIZE, "name of the stream; UTF-8"),
    Field("ticks", "u64", 1, "time stamp, see below; 0 = unset"),
    Field("body_size", "u64"),
    Field("crc", "u64", 1, "CRC-64/ECMA-182 of the body"),
)
_HEADER = compile_struct(_LAYOUT)

HEADER_SIZE = _HEADER.size
TYPE_AT = offset_of(_LAYOUT, "type")
DEVICE_NAME_AT = offset_of(_LAYOUT, "device_name")
TICKS_AT = offset_of(_LAYOUT, "ticks")
BODY_SIZE_AT = offset_of(_LAYOUT, "body_size")
CRC_AT = offset_of(_LAYOUT, "crc")

#: Largest body accepted, in bytes.  The largest messages of the field are volumes: 512 x 512 x 500 voxels of
#: 16 bits are 250 MiB.  A corrupt size field is above it with overwhelming probability.
DEFAULT_MAX_BODY = 256 * 2**20

#: Everything that names a stream: header version, type and device name.
NAMES = slice(0, TICKS_AT)
TYPE = slice(TYPE_AT, DEVICE_NAME_AT)
DEVICE_NAME = slice(DEVICE_NAME_AT, TICKS_AT)
TICKS = slice(TICKS_AT, BODY_SIZE_AT)
BODY_SIZE = slice(BODY_SIZE_AT, CRC_AT)
CRC = slice(CRC_AT, HEADER_SIZE)

#: One of the numbers at ``TICKS_AT``, ``BODY_SIZE_AT`` and ``CRC_AT``.
U64 = Struct(">Q")


@value(frozen=True, slots=True)
class Header:
    """The 58 bytes before every body.

    Attributes:
        version: header version (1 or 2).
        type: type name, at most 12 bytes.
        device_name: at most 20 bytes of UTF-8; see ``igtl_gateway.wire.fields`` for odd bytes.
        ticks: tick word of the time stamp; 0 = unset.
        body_size: bytes that follow.
        crc: CRC-64 of the body as announced.
    """

    LAYOUT: ClassVar[Layout] = _LAYOUT

    version: int
    type: str
    device_name: str
    ticks: int
    body_size: int
    crc: int

    @classmethod
    def unpack(cls, data: Buffer) -> Header:
        """Return the header at the start of ``data``.  Raises TruncatedMessage below 58 bytes."""
        if len(data) < HEADER_SIZE:
            raise TruncatedMessage("header", counted(len(data), "byte"), f"{HEADER_SIZE} bytes")
        version, kind, device, ticks, size, crc = _HEADER.unpack_from(data)
        return cls(version, decode_text(kind), decode_text(device), ticks, size, crc)

    def pack(self) -> bytes:
        """Return the 58 bytes.  Raises MalformedBody where a name does not fit its field."""
        return _HEADER.pack(
            self.version,
            encode_text(self.type, TYPE_SIZE, "header, type name"),
            encode_text(self.device_name, DEVICE_NAME_SIZE, "header, device name"),
            self.ticks,
            self.body_size,
            self.crc,
        )

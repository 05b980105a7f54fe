"""STRING and STATUS."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.long_text import decoded
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import SHORT, Traits

_ERROR_NAME_SIZE = 20

#: The length field of STRING has 16 bits.
MAX_STRING_BYTES = 65_535

#: IANA MIBenum of the encodings that the gateway sends.
US_ASCII, UTF_8 = 3, 106

#: IANA MIBenum → Python codec, for the encodings that a peer may name.
CODECS = {US_ASCII: "ascii", 4: "latin-1", UTF_8: "utf-8", 1013: "utf-16-be", 1014: "utf-16-le", 1015: "utf-16",
          17: "shift_jis", 18: "euc_jp", 113: "gbk", 2025: "gb2312", 2026: "big5", 2252: "cp1252"}  # fmt: skip


def text_of(data: bytes, encoding: int) -> str:
    """Bytes as text: in the encoding of that MIBenum, else as UTF-8; undecodable bytes are replaced."""
    codec = CODECS.get(encoding, "utf-8")
    try:
        return decoded(data, "utf-8" if codec == "ascii" else codec)
    except UnicodeDecodeError:
        return decoded(data, "utf-8", "replace")


def mib_of(text: str) -> int:
    """Return the MIBenum of a string that is sent as UTF-8: US-ASCII if it is."""
    return US_ASCII if text.isascii() else UTF_8


@dataclass(frozen=True, slots=True)
class String:
    """STRING: one string (``Protocol/string.md``).

    Accepted: any encoding; text that is invalid in the declared encoding is read as UTF-8.

    Sent: UTF-8, declared as US-ASCII (3) if that is correct, otherwise as UTF-8 (106).

    Attributes:
        data: the text, without NUL.
        encoding: IANA MIBenum; 106 is UTF-8; most peers declare 3 (US-ASCII) for every encoding.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(SHORT)
    LAYOUT: ClassVar[Layout] = (
        Field("encoding", "u16"),
        Field("length", "u16", 1, "bytes of the text"),
        Field("data", "char", "length"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    data: bytes
    encoding: int = US_ASCII

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "STRING content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        encoding, size = cls._HEAD.unpack_from(content)
        if content.nbytes != cls._HEAD.size + size:
            raise MalformedBody(
                "STRING, length", f"{size}", f"{content.nbytes - cls._HEAD.size}, the bytes that follow"
            )
        return cls(bytes(content[cls._HEAD.size :]), encoding)

    def pack(self) -> list[Buffer]:
        if len(self.data) > MAX_STRING_BYTES:
            raise MalformedBody("STRING", counted(len(self.data), "byte"), f"at most {MAX_STRING_BYTES} bytes")
        return [self._HEAD.pack(self.encoding, len(self.data)) + self.data]

    @classmethod
    def of(cls, text: str) -> Self:
        """Return a string, marked as US-ASCII if it is, else as UTF-8."""
        return cls(text.encode("utf-8", "surrogateescape"), mib_of(text))

    @property
    def text(self) -> str:
        """As text: in the named encoding, else as UTF-8 (what Slicer and PLUS send whatever they name)."""
        return text_of(self.data, self.encoding)

    def describe(self) -> dict[str, Any]:
        return {"encoding": self.encoding, "string": self.text, "string_hex": self.data.hex()}


@dataclass(frozen=True, slots=True)
class Status:
    """STATUS: state of the sender (``Protocol/status.md``).

    Accepted: a message without the final NUL, which the document omits.

    Sent: with the final NUL; the reference reader drops the message without it.

    Attributes:
        code: 1 = OK; see ``CODES``.
        subcode: free.
        error_name: free text, at most 20 bytes (19 for C++ readers).
        message: free text, ending in NUL.
        nul_terminated: whether the message ends in NUL on the wire.
    """

    PROTOCOL: ClassVar[str] = "1"
    TRAITS: ClassVar[Traits] = Traits(SHORT)
    LAYOUT: ClassVar[Layout] = (
        Field("code", "u16", 1, "1 = OK, others below"),
        Field("subcode", "i64"),
        Field("error_name", "char", _ERROR_NAME_SIZE),
        Field("message", "char", "the rest"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    code: int
    subcode: int = 0
    error_name: str = ""
    message: str = ""
    nul_terminated: bool = True

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "STATUS content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        code, subcode, name = cls._HEAD.unpack_from(content)
        text = bytes(content[cls._HEAD.size :])
        ends_in_nul = text.endswith(b"\x00")
        if ends_in_nul:
            text = text[:-1]
        return cls(code, subcode, decode_text(name), text.decode("utf-8", "surrogateescape"), ends_in_nul)

    def pack(self) -> list[Buffer]:
        try:
            head = self._HEAD.pack(
                self.code, self.subcode, encode_text(self.error_name, _ERROR_NAME_SIZE, "STATUS error name")
            )
        except struct.error as error:
            raise MalformedBody("STATUS", f"code {self.code}, sub-code {self.subcode}", str(error)) from None
        text = self.message.encode("utf-8", "surrogateescape")
        return [head + text + (b"\x00" if self.nul_terminated else b"")]

    def describe(self) -> dict[str, Any]:
        return {
            "code": self.code,
            "subcode": self.subcode,
            "error_name": visible(self.error_name),
            "status_string": visible(self.message),
            "nul_terminated": self.nul_terminated,
        }


#: Status codes of ``Protocol/status.md``.
CODES = (
    "invalid", "OK", "unknown error", "panic", "not found", "access denied", "busy", "time-out", "overflow",
    "checksum error", "configuration error", "out of resources", "not implemented", "not ready", "manual mode",
    "disabled", "not present", "unknown version", "hardware failure", "shutting down",
)  # fmt: skip

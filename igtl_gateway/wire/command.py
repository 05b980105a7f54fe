"""COMMAND and RTS_COMMAND: a named instruction with text, mostly XML, and its reply (``Protocol/command.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.long_text import encoded
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.text import US_ASCII, mib_of, text_of
from igtl_gateway.wire.traits import LIST, Traits

#: The document calls the width of the name IGT_COMMAND_SIZE and gives no number; the library's code does.
NAME_WIDTH = 128


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND and RTS_COMMAND: a named instruction with text, mostly XML, and its reply.

    Accepted: any encoding; text that is invalid in the declared encoding is read as UTF-8.

    Sent: names of at most 127 bytes.

    Attributes:
        command_id: number of the command; its reply has the same number.
        name: at most 128 bytes (127 for C++ readers).
        data: the text.
        encoding: IANA MIBenum of the text, as in STRING.
    """

    PROTOCOL: ClassVar[str] = "3.0"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=20)
    LAYOUT: ClassVar[Layout] = (
        Field("command_id", "u32"),
        Field("name", "char", NAME_WIDTH),
        Field("encoding", "u16"),
        Field("length", "u32", 1, "bytes of the text"),
        Field("data", "char", "length"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    command_id: int
    name: str
    data: bytes
    encoding: int = US_ASCII

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "COMMAND content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        command_id, name, encoding, size = cls._HEAD.unpack_from(content)
        follow = content.nbytes - cls._HEAD.size
        if size != follow:
            error = TruncatedMessage if size > follow else MalformedBody
            raise error("COMMAND content, offset 134, length", size, f"{follow}, the bytes that follow")
        return cls(command_id, decode_text(name), join([content[cls._HEAD.size :]]), encoding)

    def pack(self) -> list[Buffer]:
        name = encode_text(self.name, NAME_WIDTH, "COMMAND name")
        return [self._HEAD.pack(self.command_id, name, self.encoding, len(self.data)) + self.data]

    @classmethod
    def of(cls, command_id: int, name: str, text: str) -> Self:
        """Return a command with a string, marked as US-ASCII if it is, else as UTF-8."""
        return cls(command_id, name, join(encoded(text)), mib_of(text))

    @property
    def text(self) -> str:
        """The text: in the named encoding, else as UTF-8 (what Slicer and PLUS send whatever they name)."""
        return text_of(self.data, self.encoding)

    def describe(self) -> dict[str, Any]:
        return {
            "command_id": self.command_id,
            "command_name": visible(self.name),
            "encoding": self.encoding,
            "command": self.text,
            "command_hex": self.data.hex(),
        }

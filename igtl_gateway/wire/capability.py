"""CAPABILITY: the type names that a peer can receive (``Protocol/capability.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.header import TYPE_SIZE
from igtl_gateway.wire.layout import Field, Layout
from igtl_gateway.wire.traits import SHORT, Traits

#: Far more than there are types; a list of the largest body would take gigabytes as text.
MAX_TYPES = 65_535


@dataclass(frozen=True, slots=True)
class Capability:
    """CAPABILITY: the type names that a peer can receive.

    Accepted: at most 65,535 names.

    Attributes:
        types: type names; see ``igtl_gateway.wire.fields`` for odd bytes.
    """

    PROTOCOL: ClassVar[str] = "1"
    TRAITS: ClassVar[Traits] = Traits(SHORT, ns_per_byte=40)
    LAYOUT: ClassVar[Layout] = (Field("type", "char", TYPE_SIZE, "type name", per="type"),)
    MAY_BE_EMPTY: ClassVar[bool] = True
    types: tuple[str, ...]

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        count, rest = divmod(content.nbytes, TYPE_SIZE)
        if rest:
            raise MalformedBody("CAPABILITY content", counted(content.nbytes, "byte"), f"a multiple of {TYPE_SIZE}")
        _check(count)
        data = bytes(content)
        return cls(tuple(decode_text(data[at : at + TYPE_SIZE]) for at in range(0, len(data), TYPE_SIZE)))

    def pack(self) -> list[Buffer]:
        _check(len(self.types))
        data = b"".join(encode_text(name, TYPE_SIZE, "CAPABILITY type name") for name in self.types)
        return [data] if data else []

    def describe(self) -> dict[str, Any]:
        return {"types": [visible(name) for name in self.types]}


def _check(count: int) -> None:
    if count > MAX_TYPES:
        raise MalformedBody("CAPABILITY content", counted(count, "type name"), f"at most {MAX_TYPES}")

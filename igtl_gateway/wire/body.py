"""What every content codec offers, and the one for types that have none of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.header import crc64


class Body(Protocol):
    """The content of a message.

    An empty content is ``Raw``, whatever the type, except of classes with a class variable ``MAY_BE_EMPTY`` that is
    true: lists, and queries that are empty by design.

    ``unpack`` may keep views on its argument; ``pack`` is its mirror and gives buffers that are sent one after
    the other, small fields first.
    """

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Raises TruncatedMessage or MalformedBody."""
        ...

    def pack(self) -> list[Buffer]: ...

    def describe(self) -> dict[str, Any]:
        """As JSON values, with the keys of the reference corpus."""
        ...


#: How much of an undecoded content is shown as hex.
_SHOWN_BYTES = 64


@dataclass(frozen=True, slots=True)
class Raw:
    """Content that is carried as it is: every type without a codec, and empty bodies of types that have fields."""

    data: Buffer

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        return cls(content)

    def pack(self) -> list[Buffer]:
        return [self.data] if len(self.data) else []

    def describe(self) -> dict[str, Any]:
        if not len(self.data):
            return {}
        return {"raw_size": len(self.data), "raw_hex": bytes(self.data[:_SHOWN_BYTES]).hex()}


#: Up to this number, values are described one by one; more by count and CRC: the keys of the reference corpus.
_SHOWN_VALUES = 256


def describe_crc(data: Buffer) -> str:
    """CRC-64 of bytes, for ``describe``."""
    return f"{crc64(data):016x}"


def describe_values(values: npt.NDArray[Any]) -> list[Any] | dict[str, Any]:
    """A one-dimensional array for ``describe``: its values, or count and CRC of many; complex ones are two each.

    The CRC is that of the values as big-endian numbers: equal for equal values, whatever their byte order.
    """
    big = np.ascontiguousarray(values, values.dtype.newbyteorder(">"))
    if big.dtype.kind == "c":
        big = big.view(">f8")
    if len(big) > _SHOWN_VALUES:
        return {"count": len(big), "crc64": describe_crc(big.view(np.uint8).data)}
    shown: list[Any] = big.tolist()
    return shown

"""What the messages share that are lists of elements of one fixed size: POINT, TRAJ, TDATA, …

Strategy: the content is looked at as a numpy structured array, so a list of any length is read without a loop
and without a copy, and uninterpreted bytes (reserved, behind a NUL, payloads of NaN) are kept as received.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, visible
from igtl_gateway.wire.layout import Layout
from igtl_gateway.wire.transform import Transform

#: Bytes that the protocol leaves free: carried, not shown.
_RESERVED = "reserved"


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """Elements of ``DTYPE``, nothing else: their number is the size of the content over the size of one.

    Two lists are equal if they are of one type and their bytes are.  ``LAYOUT`` is that of one element.

    Attributes:
        elements: structured array of ``DTYPE``, a view on the received bytes.
    """

    #: Type name, for errors.
    NAME: ClassVar[str]
    DTYPE: ClassVar[np.dtype[np.void]]
    LAYOUT: ClassVar[Layout]
    PROTOCOL: ClassVar[str]
    MAY_BE_EMPTY: ClassVar[bool] = True
    #: Fields that are not described as they are: field → key and conversion of one value.
    SHOWN: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {}

    elements: npt.NDArray[np.void]

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes % cls.DTYPE.itemsize:
            expected = f"a multiple of {cls.DTYPE.itemsize}"
            raise MalformedBody(f"{cls.NAME} content", counted(content.nbytes, "byte"), expected)
        return cls(np.frombuffer(content, cls.DTYPE))

    def pack(self) -> list[Buffer]:
        return [self._bytes()] if len(self.elements) else []

    def _bytes(self) -> memoryview:
        """Return the bytes; copied only if the array has another layout."""
        return np.ascontiguousarray(self.elements, self.DTYPE).view(np.uint8).data

    def __len__(self) -> int:
        return len(self.elements)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self) or not isinstance(other, Elements):
            return NotImplemented
        return len(self) == len(other) and self._bytes() == other._bytes()

    # holds an array that its owner may change: no key of a dict
    __hash__ = None  # type: ignore[assignment]

    def describe(self) -> dict[str, Any]:
        columns: dict[str, list[Any]] = {}
        for name in self.DTYPE.names or ():
            if name == _RESERVED:
                continue
            values = self.elements[name].tolist()
            if name in self.SHOWN:
                key, show = self.SHOWN[name]
                columns[key] = [show(value) for value in values]
            elif self.DTYPE[name].kind == "S":
                columns[name] = [visible(decode_text(value)) for value in values]
            else:
                columns[name] = values
        return {"elements": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]}


def describe_matrix(wire_matrix: list[float]) -> list[list[float]]:
    """Twelve numbers in wire order as the rows of a 4 × 4 matrix."""
    return Transform(tuple(wire_matrix)).rows

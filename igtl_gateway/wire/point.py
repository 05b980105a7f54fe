"""POINT: named points of 136 bytes each (``Protocol/point.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import MalformedBody
from igtl_gateway.wire.fields import decode_text, visible

#: One element.  ``diameter`` in the document is called ``radius`` in the library: the same number.
POINT_DTYPE = np.dtype(
    [
        ("name", "S64"),
        ("group", "S32"),
        ("rgba", "u1", 4),
        ("position", ">f4", 3),
        ("diameter", ">f4"),
        ("owner", "S20"),
    ]
)


@dataclass(frozen=True, slots=True)
class Points:
    """POINT.

    Attributes:
        elements: structured array of ``POINT_DTYPE``, a view on the received bytes; positions and diameters
            in millimetres.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    elements: npt.NDArray[np.void]

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes % POINT_DTYPE.itemsize:
            raise MalformedBody("POINT content", f"{content.nbytes} bytes", f"a multiple of {POINT_DTYPE.itemsize}")
        return cls(np.frombuffer(content, POINT_DTYPE))

    def pack(self) -> list[Buffer]:
        return [self.elements.view(np.uint8).data] if len(self.elements) else []

    @classmethod
    def of(
        cls,
        positions: npt.NDArray[Any],
        rgba: npt.NDArray[Any] | None = None,
        diameters: npt.NDArray[Any] | float = 0.0,
    ) -> Self:
        """Nameless points at ``positions`` (n, 3) mm, with colours (n, 4) uint8 (default opaque white)."""
        elements = np.zeros(len(positions), POINT_DTYPE)
        elements["position"] = positions
        elements["rgba"] = 255 if rgba is None else rgba
        elements["diameter"] = diameters
        return cls(elements)

    def describe(self) -> dict[str, Any]:
        def text(value: bytes) -> str:
            return visible(decode_text(value))

        return {
            "elements": [
                {
                    "name": text(name),
                    "group": text(group),
                    "rgba": rgba,
                    "position": position,
                    "diameter": diameter,
                    "owner": text(owner),
                }
                for name, group, rgba, position, diameter, owner in zip(
                    *(self.elements[field].tolist() for field in POINT_DTYPE.names or ()), strict=True
                )
            ]
        }

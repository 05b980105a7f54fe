"""POINT: named points of 136 bytes each (``Protocol/point.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from igtl_gateway.wire.elements import Elements

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


@dataclass(frozen=True, slots=True, eq=False)
class Points(Elements):
    """POINT.

    Attributes:
        elements: structured array of ``POINT_DTYPE``, a view on the received bytes; positions and diameters
            in millimetres.
    """

    NAME: ClassVar[str] = "POINT"
    DTYPE: ClassVar[np.dtype[np.void]] = POINT_DTYPE

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

"""POINT: named points of 136 bytes each (``Protocol/point.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.versions import Self
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.layout import Layout, of_dtype
from igtl_gateway.wire.traits import LIST, Traits

#: One element.
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
    """POINT: named points, such as landmarks.

    Attributes:
        elements: structured array of ``POINT_DTYPE``, a view on the received bytes.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=50)
    NAME: ClassVar[str] = "POINT"
    DTYPE: ClassVar[np.dtype[np.void]] = POINT_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        POINT_DTYPE,
        group="such as Fiducial",
        position="x, y, z in millimetres",
        diameter="millimetres; the library calls the same number ``radius``",
        owner="device name of the image that it belongs to",
    )

    @classmethod
    def of(
        cls,
        positions: npt.NDArray[Any],
        rgba: npt.NDArray[Any] | None = None,
        diameters: npt.NDArray[Any] | float = 0.0,
    ) -> Self:
        """Nameless points at ``positions`` (n, 3) mm, with colours (n, 4) uint8 (default opaque white)."""
        elements = np.zeros(len(positions), POINT_DTYPE)
        blocks = elements.view(_BLOCKS)
        blocks["position"] = np.ascontiguousarray(positions, ">f4").view("V12").reshape(-1)
        blocks["rgba"] = _WHITE if rgba is None else np.ascontiguousarray(rgba, np.uint8).view(np.uint32).reshape(-1)
        elements["diameter"] = diameters
        return cls(elements)


#: The same element: what is set for many points at once costs half the time where it is one block.
_BLOCKS = np.dtype(
    {
        "names": ["rgba", "position"],
        "formats": [np.uint32, "V12"],
        "offsets": [POINT_DTYPE.fields[name][1] for name in ("rgba", "position")] if POINT_DTYPE.fields else [],
        "itemsize": POINT_DTYPE.itemsize,
    }
)
_WHITE = 0xFFFFFFFF

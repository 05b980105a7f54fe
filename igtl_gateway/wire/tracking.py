"""TDATA and QTDATA: the poses of all tools of one frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from igtl_gateway.wire.elements import Elements, describe_matrix
from igtl_gateway.wire.layout import Layout, of_dtype
from igtl_gateway.wire.traits import LIST, Traits

#: What a tool is: the tracker itself, a tool with six degrees of freedom, with three (its tip), with five.
TRACKER, TOOL_6D, TOOL_3D, TOOL_5D = 1, 2, 3, 4

#: One tool, 70 bytes.  ``matrix`` in the order of TRANSFORM: column by column.
TRACKING_DTYPE = np.dtype([("name", "S20"), ("type", "u1"), ("reserved", "u1"), ("matrix", ">f4", 12)])

#: One tool, 50 bytes.  ``quaternion`` is x, y, z, w.
QTRACKING_DTYPE = np.dtype(
    [
        ("name", "S20"),
        ("type", "u1"),
        ("reserved", "u1"),
        ("position", ">f4", 3),
        ("quaternion", ">f4", 4),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class TrackingData(Elements):
    """TDATA: the poses of all tools of one frame, as matrices (``Protocol/trackingdata.md``).

    Attributes:
        elements: structured array of ``TRACKING_DTYPE``; ``type`` is one of ``TRACKER`` … ``TOOL_5D``.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=300)
    NAME: ClassVar[str] = "TDATA"
    DTYPE: ClassVar[np.dtype[np.void]] = TRACKING_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        TRACKING_DTYPE,
        name="at most 19 bytes for C++ readers",
        type="1 tracker, 2 tool with six degrees of freedom, 3 with three (its tip), 4 with five",
        reserved="0",
        matrix="as in TRANSFORM; translation in millimetres",
    )
    SHOWN: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {"matrix": ("matrix", describe_matrix)}


@dataclass(frozen=True, slots=True, eq=False)
class QuaternionTrackingData(Elements):
    """QTDATA: the poses of all tools of one frame, as positions and quaternions (``Protocol/qtrackingdata.md``).

    Attributes:
        elements: structured array of ``QTRACKING_DTYPE``; ``type`` is one of ``TRACKER`` … ``TOOL_5D``.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=300)
    NAME: ClassVar[str] = "QTDATA"
    DTYPE: ClassVar[np.dtype[np.void]] = QTRACKING_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        QTRACKING_DTYPE,
        name="at most 19 bytes for C++ readers",
        type="1 tracker, 2 tool with six degrees of freedom, 3 with three (its tip), 4 with five",
        reserved="0",
        position="x, y, z in millimetres",
        quaternion="x, y, z, w (scalar last)",
    )

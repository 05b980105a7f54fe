"""TDATA and QTDATA: the poses of all tools of one frame (``Protocol/trackingdata.md``, ``qtrackingdata.md``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from igtl_gateway.wire.elements import Elements, show_matrix

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
    """TDATA: poses as matrices, translations in millimetres.

    Attributes:
        elements: structured array of ``TRACKING_DTYPE``; ``type`` is one of ``TRACKER`` … ``TOOL_5D``.
    """

    NAME: ClassVar[str] = "TDATA"
    DTYPE: ClassVar[np.dtype[np.void]] = TRACKING_DTYPE
    SHOWN: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {"matrix": ("matrix", show_matrix)}


@dataclass(frozen=True, slots=True, eq=False)
class QuaternionTrackingData(Elements):
    """QTDATA: poses as position (millimetres) and quaternion.

    Attributes:
        elements: structured array of ``QTRACKING_DTYPE``; ``type`` is one of ``TRACKER`` … ``TOOL_5D``.
    """

    NAME: ClassVar[str] = "QTDATA"
    DTYPE: ClassVar[np.dtype[np.void]] = QTRACKING_DTYPE

"""TRAJ: planned paths from an entry to a target, 150 bytes each (``Protocol/trajectory.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.layout import Layout, of_dtype
from igtl_gateway.wire.traits import LIST, Traits

#: ``type`` of a trajectory: which of its two points are meant.
ENTRY_ONLY, TARGET_ONLY, ENTRY_AND_TARGET = 1, 2, 3

#: One element.
TRAJECTORY_DTYPE = np.dtype(
    [
        ("name", "S64"),
        ("group", "S32"),
        ("type", "u1"),
        ("reserved", "u1"),
        ("rgba", "u1", 4),
        ("entry", ">f4", 3),
        ("target", ">f4", 3),
        ("diameter", ">f4"),
        ("owner", "S20"),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories(Elements):
    """TRAJ: planned paths from an entry to a target.

    Attributes:
        elements: structured array of ``TRAJECTORY_DTYPE``.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=50)
    NAME: ClassVar[str] = "TRAJ"
    DTYPE: ClassVar[np.dtype[np.void]] = TRAJECTORY_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        TRAJECTORY_DTYPE,
        type="1 entry only, 2 target only, 3 both",
        reserved="0",
        entry="x, y, z in millimetres",
        target="x, y, z in millimetres",
        diameter="millimetres; the library calls the same number ``radius``",
        owner="device name of the image that it belongs to",
    )

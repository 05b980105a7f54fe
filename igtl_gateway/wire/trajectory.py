"""TRAJ: planned paths from an entry to a target, 150 bytes each (``Protocol/trajectory.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from igtl_gateway.wire.elements import Elements

#: ``type`` of a trajectory: which of its two points are meant.
ENTRY_ONLY, TARGET_ONLY, ENTRY_AND_TARGET = 1, 2, 3

#: One element.  ``diameter`` in the document is called ``radius`` in the library: the same number.
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
    """TRAJ.

    Attributes:
        elements: structured array of ``TRAJECTORY_DTYPE``; points and diameters in millimetres.
    """

    NAME: ClassVar[str] = "TRAJ"
    DTYPE: ClassVar[np.dtype[np.void]] = TRAJECTORY_DTYPE

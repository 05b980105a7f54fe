"""The one place where lengths change their unit: metres in ROS, millimetres in OpenIGTLink, unless configured.

A factor is kept as a ratio of whole numbers, so that mm → m divides by 1000 instead of multiplying with an
inexact 0.001: every converted number is the correctly rounded one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

#: Length units by name, in micrometres.
UNITS = {"m": 1_000_000, "dm": 100_000, "cm": 10_000, "mm": 1_000, "um": 1}

Number = TypeVar("Number", float, npt.NDArray[Any])

#: Decorator for arithmetic on arrays: too large is infinity, as IEEE 754 has it for plain floats, and not a
#: warning of numpy's on the user's console.
ieee_754 = np.errstate(over="ignore", invalid="ignore")


@dataclass(frozen=True, slots=True)
class LengthUnits:
    """The length units of the two sides of one stream.

    Attributes:
        ros: unit of the ROS side, a key of ``UNITS``.
        igtl: unit of the OpenIGTLink side.
    """

    ros: str = "m"
    igtl: str = "mm"

    @property
    def ratio_to_igtl(self) -> tuple[int, int]:
        """OpenIGTLink units per ROS unit, as numerator and denominator."""
        ros, igtl = UNITS[self.ros], UNITS[self.igtl]
        return (ros // igtl, 1) if ros >= igtl else (1, igtl // ros)

    @property
    def ratio_to_ros(self) -> tuple[int, int]:
        """ROS units per OpenIGTLink unit, as numerator and denominator."""
        by, times = self.ratio_to_igtl
        return times, by

    def to_igtl(self, lengths: Number) -> Number:
        """Lengths of the ROS side (float or float64 array) in OpenIGTLink units."""
        times, by = self.ratio_to_igtl
        return _scaled(lengths, times, by)

    def to_ros(self, lengths: Number) -> Number:
        """Lengths of the OpenIGTLink side (float or array) in ROS units, as float64."""
        times, by = self.ratio_to_ros
        return _scaled(lengths, times, by)


def _scaled(lengths: Number, times: int, by: int) -> Number:
    if isinstance(lengths, np.ndarray):
        # float64 throughout: a float32 product would be rounded twice on its way
        values = lengths.astype(np.float64)
        if times != 1:
            values *= times
        elif by != 1:
            values /= by
        return values
    return lengths * times / by

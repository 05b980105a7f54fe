"""Conversion of length units: by default metres in ROS and millimetres in OpenIGTLink.

A factor is a ratio of integers, so mm → m divides by 1000 instead of multiplying by an inexact 0.001: every converted
number is correctly rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

#: Length units by name, in micrometres.
UNITS = {"m": 1_000_000, "dm": 100_000, "cm": 10_000, "mm": 1_000, "um": 1}

Number = TypeVar("Number", float, npt.NDArray[Any])

#: Decorator for arithmetic on arrays: an overflow gives infinity, as IEEE 754 defines it, without a warning of numpy on
#: the user's console.
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
        """Return lengths of the ROS side (float or float64 array) in OpenIGTLink units."""
        times, by = self.ratio_to_igtl
        return _scaled(lengths, times, by)

    def to_ros(self, lengths: Number) -> Number:
        """Return lengths of the OpenIGTLink side (float or array) in ROS units, as float64."""
        times, by = self.ratio_to_ros
        return _scaled(lengths, times, by)


def millimetres(unit: str) -> LengthUnits:
    """Return the units whose ``to_ros`` gives millimetres of lengths in ``unit``."""
    return LengthUnits("mm", unit)


def scale(unit: str, wanted: str) -> float:
    """Return how many ``wanted`` one ``unit`` is."""
    return LengthUnits(wanted, unit).to_ros(1.0)


def _scaled(lengths: Number, times: int, by: int) -> Number:
    if isinstance(lengths, np.ndarray):
        # in float64: a float32 product would be rounded twice
        values = lengths.astype(np.float64)
        if times != 1:
            values *= times
        elif by != 1:
            values /= by
        return values
    return lengths * times / by

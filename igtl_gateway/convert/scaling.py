"""Lengths of many points at once: scaled, rounded and put into another byte order in one pass over the memory."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.units import LengthUnits

Array = npt.NDArray[Any]

_SINGLE = np.dtype(np.float32).itemsize


def into_ros(lengths: LengthUnits, values: Array, out: Array) -> Array:
    """Lengths of the OpenIGTLink side in ROS units, written into ``out`` (of float32 or float64, in any byte order).

    The same numbers as ``LengthUnits.to_ros`` gives, rounded to what ``out`` holds.  Returns ``out``.
    """
    times, by = _factors(lengths.ros, lengths.igtl)
    return _scale(values, times, by, out)


def into_igtl(lengths: LengthUnits, values: Array, out: Array) -> Array:
    """The inverse, as ``LengthUnits.to_igtl``."""
    by, times = _factors(lengths.ros, lengths.igtl)
    return _scale(values, times, by, out)


@cache
def _factors(ros: str, igtl: str) -> tuple[float, float]:
    """ROS units per OpenIGTLink unit, and the other way round: one of the two is a whole number."""
    lengths = LengthUnits(ros, igtl)
    return lengths.to_ros(1.0), lengths.to_igtl(1.0)


def _scale(values: Array, times: float, by: float, out: Array) -> Array:
    # From float32 to float32 nothing is rounded twice: what float64 has more of bits
    # is more than twice as many and two, so that a float32 quotient or product is what a float64 one rounds to.
    single = values.dtype.kind == "f" and values.dtype.itemsize == out.dtype.itemsize == _SINGLE
    number = np.float32 if single else np.float64
    if times >= 1.0:
        return np.multiply(values, times, out=out, dtype=number, casting="same_kind")
    return np.divide(values, by, out=out, dtype=number, casting="same_kind")


def all_finite(values: Array) -> bool:
    """Whether every number is.  Large sums are infinite: for use within ``ieee_754``."""
    # one that is not finite makes no finite sum
    return math.isfinite(np.add.reduce(values, axis=None)) or bool(np.isfinite(values).all())

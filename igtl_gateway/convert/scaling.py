"""Conversion of the lengths of many points: scaling, rounding and byte order in one pass over the memory."""

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
    """Write lengths of the OpenIGTLink side in ROS units into ``out`` (float32 or float64, any byte order).

    The numbers are those of ``LengthUnits.to_ros``, rounded to the type of ``out``.  Returns ``out``.
    """
    times, by = _factors(lengths.ros, lengths.igtl)
    return _scale(values, times, by, out)


def into_igtl(lengths: LengthUnits, values: Array, out: Array) -> Array:
    """Write lengths of the ROS side in OpenIGTLink units into ``out``, as ``LengthUnits.to_igtl``.  Returns ``out``."""
    by, times = _factors(lengths.ros, lengths.igtl)
    return _scale(values, times, by, out)


@cache
def _factors(ros: str, igtl: str) -> tuple[float, float]:
    """Return ROS units per OpenIGTLink unit and the inverse; one of the two is an integer."""
    lengths = LengthUnits(ros, igtl)
    return lengths.to_ros(1.0), lengths.to_igtl(1.0)


def _scale(values: Array, times: float, by: float, out: Array) -> Array:
    # float32 arithmetic equals float64 arithmetic that is rounded to float32, without double rounding:
    # float64 has more than twice the bits of float32 plus two.
    single = values.dtype.kind == "f" and values.dtype.itemsize == out.dtype.itemsize == _SINGLE
    number = np.float32 if single else np.float64
    if times >= 1.0:
        return np.multiply(values, times, out=out, dtype=number, casting="same_kind")
    return np.divide(values, by, out=out, dtype=number, casting="same_kind")


def all_finite(values: Array) -> bool:
    """Return whether all numbers are finite.  Call it within ``ieee_754``, because large sums are infinite."""
    # NaN and infinity never give a finite sum
    return math.isfinite(np.add.reduce(values, axis=None)) or bool(np.isfinite(values).all())

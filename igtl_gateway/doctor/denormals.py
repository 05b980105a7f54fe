"""Numbers of float fields that are not measured: fields with the bytes of an integer.

A number below the least normal one (2e-308, as float32 1e-38) is a denormal one.  Measurements are never so small, but
the bytes of an integer in a float field are.  rclpy writes these where an int, a bool or a number of numpy other than
float64 is assigned to a float field, because it does not check assignments unless it is asked to.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.table import row_to_igtl

#: The least normal numbers.
LEAST_FLOAT32, LEAST_FLOAT64 = float(np.finfo(np.float32).tiny), float(np.finfo(np.float64).tiny)
#: Larger messages are pictures and clouds.
_MAX_BYTES = 65_536


def denormal_of(numbers: npt.NDArray[Any], least: float) -> float:
    """Return the first number that is not 0 and nearer to it than ``least``; 0.0 without one."""
    size = np.abs(numbers)
    found = numbers[(size > 0) & (size < least)]
    return float(found[0]) if len(found) else 0.0


def denormal_in_ros(ros_type: str, cdr: Buffer) -> tuple[str, float] | None:
    """Return path and value of the first denormal float64 field of a ROS message of a type that the gateway reads."""
    row = row_to_igtl(ros_type)
    if row is None or memoryview(cdr).nbytes > _MAX_BYTES:
        return None
    try:
        message = row.message.unpack(cdr)
    except ConversionError:
        return None
    return next(_denormals("", message), None)


def _denormals(path: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        if value and abs(value) < LEAST_FLOAT64:
            yield path, value
    elif isinstance(value, tuple):
        for one in value:
            yield from _denormals(path, one)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind == "f" and value.dtype.itemsize == 8 and (one := denormal_of(value, LEAST_FLOAT64)):
            yield path, one
    elif is_dataclass(value):
        for field in fields(value):
            yield from _denormals(f"{path}.{field.name}".lstrip("."), getattr(value, field.name))

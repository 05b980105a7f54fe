"""SENSOR and NDARRAY ⇄ igtl_msgs/Sensor, igtl_msgs/NdArray, std_msgs/*MultiArray and sensor_msgs/JointState.

Only the byte order of the numbers changes: it is big-endian in OpenIGTLink, little-endian in published std_msgs.
``igtl_msgs/NdArray`` contains the bytes unchanged and declares their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from igtl_gateway.base.errors import ConversionError, MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert import igtl_msgs
from igtl_gateway.convert.common_msgs import JointState, MultiArrayDimension, MultiArrayLayout
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS, MultiArray
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Array
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.sensor import MAX_VALUES, Sensor, parse_unit, unit_text

#: Maximum size of one dimension: NDARRAY has 16 bits for it.
MAX_SIZE = 65_535

_RADIANS = parse_unit("rad")
#: Cached, because a stream has one unit, and its text takes longer than the rest of the conversion.
_text_of_unit = lru_cache(maxsize=256)(unit_text)


def sensor_to_ros(content: Sensor, to: ToRosContext) -> igtl_msgs.Sensor:
    """Convert to Sensor with the values unchanged, and the unit as 64-bit word and as text."""
    return igtl_msgs.Sensor(
        Header(to.stamp_ns, to.frame_id),
        content.status,
        content.unit,
        _text_of_unit(content.unit),
        content.values,
        to.metadata,
    )


def sensor_to_igtl(message: igtl_msgs.Sensor, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to SENSOR; if ``unit`` is 0, ``unit_text`` is the unit.  Raises ConversionError for an invalid unit."""
    try:
        unit = message.unit or parse_unit(message.unit_text)
    except ValueError as error:
        raise ConversionError(
            f"igtl_msgs/Sensor: found unit_text {message.unit_text!r}, expected a unit such as mm/s^2 ({error})"
        ) from None
    content = _sensor(message.values, message.TYPE, unit, message.status)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def sensor_to_values(content: Sensor, _: ToRosContext) -> MultiArray:
    """Convert to Float64MultiArray: the values only, in one dimension."""
    return MULTI_ARRAYS["f8"](_layout((len(content.values),)), content.values)


def values_to_sensor(message: MultiArray, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to SENSOR with all values in one dimension, without unit."""
    values, _size = _elements_in_layout(message)
    return ConvertedMessage(_sensor(values, message.TYPE))


def joints_to_sensor(message: JointState, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to SENSOR with the positions in radians: the protocol has one unit for all values."""
    content = _sensor(message.position, message.TYPE, _RADIANS)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id)


def _sensor(values: Array, ros_type: str, unit: int = 0, status: int = 0) -> Sensor:
    if len(values) > MAX_VALUES:
        raise ConversionError(
            f"{ros_type}: found {counted(len(values), 'value')}, expected at most {MAX_VALUES}, the limit of SENSOR"
        )
    return Sensor(np.asarray(values, ">f8"), unit, status)


def array_to_ros(content: NdArray, to: ToRosContext) -> igtl_msgs.NdArray:
    """Convert to NdArray with the bytes unchanged, big-endian."""
    return igtl_msgs.NdArray(
        Header(to.stamp_ns, to.frame_id),
        content.scalar_type,
        np.array(content.size, np.uint16),
        True,
        content.data,
        to.metadata,
    )


def array_to_igtl(message: igtl_msgs.NdArray, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to NDARRAY.  Raises ConversionError for unknown scalar types and for data of the wrong size."""
    content = _checked(NdArray(message.scalar_type, tuple(message.size.tolist()), message.data), message.TYPE)
    code = _CODES[content.scalar_type]
    # a complex number consists of two numbers, which are swapped separately
    width = np.dtype(code).itemsize // (2 if code.startswith("c") else 1)
    if not message.is_bigendian and width > 1:
        swapped = np.frombuffer(message.data, f"u{width}").byteswap()
        content = replace(content, data=swapped.view(np.uint8).data)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def _checked(content: NdArray, ros_type: str) -> NdArray:
    try:
        content.check()
    except MalformedBody as error:
        raise ConversionError(f"{ros_type}: {error}") from None
    if any(count > MAX_SIZE for count in content.size):
        raise ConversionError(f"{ros_type}: found size {content.size}, expected at most {MAX_SIZE} in each dimension")
    return content


def is_array_of(code: str) -> Callable[[NdArray], bool]:
    """Return a function that returns whether an NDARRAY holds numbers of a numpy type, such as ``"f4"``."""
    return lambda content: _CODES[content.scalar_type] == code


def array_to_multi(content: NdArray, _: ToRosContext) -> MultiArray:
    """Convert to the std_msgs array of its type, with sizes and strides; std_msgs has none for complex numbers."""
    return MULTI_ARRAYS[_CODES[content.scalar_type]](_layout(content.size), content.flat)


def multi_to_array(message: MultiArray, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to NDARRAY with the sizes of the layout; without a layout it has one dimension.

    Raises ConversionError for a layout that contradicts the data or exceeds the limits of NDARRAY.
    """
    values, size = _elements_in_layout(message)
    data = np.ascontiguousarray(values, values.dtype.newbyteorder(">")).view(np.uint8).data
    return ConvertedMessage(_checked(NdArray(_SCALARS[values.dtype.str[1:]], size, data), message.TYPE))


#: Scalar type of the wire ⇄ numpy type without byte order.
_CODES = {scalar: np.dtype(code).str[1:] for scalar, code in NDARRAY_SCALARS.items()}
_SCALARS = {code: scalar for scalar, code in _CODES.items()}


def _layout(size: Sequence[int]) -> MultiArrayLayout:
    return MultiArrayLayout(
        tuple(MultiArrayDimension("", n, stride) for n, stride in zip(size, _strides(size), strict=True))
    )


def _strides(size: Sequence[int]) -> list[int]:
    """Return the number of elements of each dimension, inner dimensions included, without gaps."""
    return [math.prod(size[axis:]) for axis in range(len(size))]


def _elements_in_layout(message: MultiArray) -> tuple[Array, tuple[int, ...]]:
    """Return the elements that the layout selects, in one dimension, and their sizes.

    Strides can leave gaps, as std_msgs defines it.  If all strides are 0, they are unset.
    """
    layout = message.layout
    values = message.data[layout.data_offset :]
    if layout.data_offset > len(message.data):
        raise ConversionError(
            f"{message.TYPE}: found data_offset {layout.data_offset}, expected at most {len(message.data)}"
        )
    if not layout.dim:
        return values, (len(values),)
    size = tuple(dim.size for dim in layout.dim)
    strides = [dim.stride for dim in layout.dim]
    if not any(strides):
        strides = _strides(size)
    inner = [*strides[1:], 1]
    fits = all(stride >= n * below for stride, n, below in zip(strides, size, inner, strict=True))
    if not fits or strides[0] != len(values):
        raise ConversionError(
            f"{message.TYPE}: found {counted(len(values), 'element')} with sizes {size} and strides {strides}, "
            f"expected {counted(math.prod(size), 'element')} with strides {_strides(size)}"
        )
    rows = values.reshape(1, len(values))
    for n, below in zip(size, inner, strict=True):
        rows = rows[:, : n * below].reshape(len(rows) * n, below)
    return rows.reshape(-1), size

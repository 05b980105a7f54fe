"""Numbers: units, byte orders, layouts with and without gaps, limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import igtl_msgs, numbers
from igtl_gateway.convert.common_msgs import JointState, MultiArrayDimension, MultiArrayLayout
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.sensor import Sensor, parse_unit
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)
TO = ToRosContext("Device", 7, "base", "", metadata=ITEMS)
HEADER = Header(7, "base")
VALUES = np.array([1.5, -2.0, math.inf])
TORQUE = 0x02C4110000000000


def content_of(outgoing: ConvertedMessage, kind: type[Any]) -> Any:
    """The content as a peer reads it."""
    assert isinstance(outgoing.content, kind)
    return kind.unpack(memoryview(join(outgoing.content.pack())))


def told(outgoing: ConvertedMessage) -> tuple[int, str, object]:
    return outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata


# -- SENSOR ---------------------------------------------------------------------------------------------------------


def test_a_sensor_with_its_unit() -> None:
    message = numbers.sensor_to_ros(Sensor(VALUES, TORQUE, 9), TO)
    assert (message.header, message.metadata) == (HEADER, ITEMS)
    assert (message.status, message.unit, message.unit_text) == (9, TORQUE, "N.m")
    assert message.values.tolist() == VALUES.tolist()
    outgoing = numbers.sensor_to_igtl(igtl_msgs.Sensor.unpack(message.pack()), ToIgtlContext())
    assert told(outgoing) == (7, "base", ITEMS)
    assert content_of(outgoing, Sensor) == Sensor(VALUES, TORQUE, 9)


@pytest.mark.parametrize(
    ("unit", "text", "word"),
    [(0, "", 0), (0, "N.m", TORQUE), (TORQUE, "kg", TORQUE), (TORQUE, "nonsense", TORQUE), (0, "mV", parse_unit("mV"))],
)
def test_the_text_of_a_unit_is_read_where_there_is_no_word(unit: int, text: str, word: int) -> None:
    message = igtl_msgs.Sensor(HEADER, 0, unit, text, VALUES)
    assert content_of(numbers.sensor_to_igtl(message, ToIgtlContext()), Sensor).unit == word


def test_a_unit_that_is_none_is_refused() -> None:
    with pytest.raises(ConversionError, match="found unit_text 'furlong', expected"):
        numbers.sensor_to_igtl(igtl_msgs.Sensor(HEADER, 0, 0, "furlong", VALUES), ToIgtlContext())


def values_message(count: int) -> Any:
    return MULTI_ARRAYS["f8"](MultiArrayLayout(), np.arange(float(count)))


@table(
    ("convert", "make"),
    [
        (numbers.sensor_to_igtl, lambda count: igtl_msgs.Sensor(HEADER, 0, 0, "", np.arange(float(count)))),
        (numbers.joints_to_sensor, lambda count: JointState(HEADER, (), np.arange(float(count)))),
        (numbers.values_to_sensor, values_message),
    ],
)
@table("count", [0, 255, 256])
def test_a_sensor_has_at_most_255_values(convert: Any, make: Any, count: int) -> None:
    if count > 255:
        with pytest.raises(ConversionError, match="found 256 values, expected at most 255"):
            convert(make(count), ToIgtlContext())
    else:
        content = content_of(convert(make(count), ToIgtlContext()), Sensor)
        assert content.values.tolist() == list(range(count))


def test_joints_are_radians() -> None:
    message = JointState(HEADER, ("a", "b", "c"), VALUES, VALUES * 2, VALUES * 3)
    outgoing = numbers.joints_to_sensor(JointState.unpack(message.pack()), ToIgtlContext())
    assert (outgoing.stamp_ns, outgoing.frame_id) == (7, "base")
    assert content_of(outgoing, Sensor) == Sensor(VALUES, parse_unit("rad"))


def test_bare_values() -> None:
    message = numbers.sensor_to_values(Sensor(VALUES, TORQUE), TO)
    assert message.layout == MultiArrayLayout((MultiArrayDimension("", 3, 3),))
    assert content_of(
        numbers.values_to_sensor(type(message).unpack(message.pack()), ToIgtlContext()), Sensor
    ) == Sensor(VALUES)


# -- NDARRAY as our own message ------------------------------------------------------------------------------------


def test_the_bytes_of_an_array_are_not_copied() -> None:
    data = np.arange(6, dtype=">i2").tobytes()
    message = numbers.array_to_ros(NdArray(4, (2, 3), data), TO)
    assert (message.header, message.metadata) == (HEADER, ITEMS)
    assert (message.scalar_type, message.size.tolist(), message.is_bigendian) == (4, [2, 3], True)
    assert message.data is data
    outgoing = numbers.array_to_igtl(message, ToIgtlContext())
    assert told(outgoing) == (7, "base", ITEMS)
    assert isinstance(outgoing.content, NdArray)
    assert outgoing.content.data is data


@table("scalar", sorted(NDARRAY_SCALARS))
@table("big", [False, True])
def test_both_byte_orders_of_every_type(scalar: int, big: bool) -> None:
    kind = np.dtype(NDARRAY_SCALARS[scalar])
    values = (np.arange(6).reshape(3, 2) + (2j if kind.kind == "c" else 0)).astype(kind)
    data = values.astype(kind.newbyteorder(">" if big else "<")).tobytes()
    message = igtl_msgs.NdArray(HEADER, scalar, np.array([3, 2], np.uint16), big, data)
    content = content_of(numbers.array_to_igtl(igtl_msgs.NdArray.unpack(message.pack()), ToIgtlContext()), NdArray)
    assert content.size == (3, 2)
    assert content.array.tolist() == values.tolist()


def test_the_bits_of_no_numbers_survive_the_byte_order() -> None:
    """A signalling NaN, and NaNs with a payload."""
    words = [0x7FF0000000000001, 0x7FF8DEADBEEF0000, 0xFFF0000000000002]
    message = igtl_msgs.NdArray(HEADER, 11, np.array([3], np.uint16), False, np.array(words, "<u8").tobytes())
    outgoing = numbers.array_to_igtl(message, ToIgtlContext())
    assert np.frombuffer(join(outgoing.content.pack())[4:], ">u8").tolist() == words


@pytest.mark.parametrize(
    ("scalar", "size", "bytes_"),
    [(12, (1,), 8), (0, (1,), 1), (4, (3,), 5), (4, (3,), 8), (4, (), 2), (3, (1,) * 256, 1), (11, (65535, 65535), 8)],
)
def test_arrays_that_contradict_themselves_are_refused(scalar: int, size: tuple[int, ...], bytes_: int) -> None:
    message = igtl_msgs.NdArray(HEADER, scalar, np.array(size, np.uint16), False, bytes(bytes_))
    with pytest.raises(ConversionError, match=r"igtl_msgs/msg/NdArray: .*found .* expected"):
        numbers.array_to_igtl(message, ToIgtlContext())


# -- NDARRAY as std_msgs -------------------------------------------------------------------------------------------


@table("code", MULTI_ARRAYS)
def test_multi_arrays_there_and_back(code: str) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(code)
    message = MULTI_ARRAYS[code](
        MultiArrayLayout(tuple(MultiArrayDimension(f"d{n}", n, stride) for n, stride in ((2, 24), (3, 12), (4, 4)))),
        values.reshape(-1),
    )
    content = content_of(numbers.multi_to_array(type(message).unpack(message.pack()), ToIgtlContext()), NdArray)
    assert content.array.tolist() == values.tolist()
    assert [kind for kind in MULTI_ARRAYS if numbers.is_array_of(kind)(content)] == [code]
    back = numbers.array_to_multi(content, TO)
    assert [(dim.size, dim.stride) for dim in back.layout.dim] == [(2, 24), (3, 12), (4, 4)]
    assert back.data.tolist() == values.reshape(-1).tolist()
    assert back.pack() == type(back).unpack(back.pack()).pack()


def test_no_multi_array_holds_complex_numbers() -> None:
    content = NdArray(13, (1,), bytes(16))
    assert not any(numbers.is_array_of(code)(content) for code in MULTI_ARRAYS)


def multi(data: Any, *dims: tuple[int, int], offset: int = 0) -> Any:
    layout = MultiArrayLayout(tuple(MultiArrayDimension("", *dim) for dim in dims), offset)
    return MULTI_ARRAYS["i2"](layout, np.array(data, "<i2"))


@table(
    ("message", "size", "values"),
    [
        (multi([1, 2, 3]), (3,), [1, 2, 3]),
        (multi([]), (0,), []),
        (multi([9, 9, 1, 2], offset=2), (2,), [1, 2]),
        (multi([9, 9], offset=2), (0,), []),
        (multi([9, 1, 2, 3, 4], (2, 4), (2, 2), offset=1), (2, 2), [1, 2, 3, 4]),
        (multi([1, 2, 3, 4], (2, 0), (2, 0)), (2, 2), [1, 2, 3, 4]),
        (multi([1, 2, 9, 3, 4, 9], (2, 6), (2, 3)), (2, 2), [1, 2, 3, 4]),
        (multi([1, 9, 2, 9, 9, 3, 9, 4, 9, 9, 7], (2, 11), (2, 5), (1, 2)), (2, 2, 1), [1, 2, 3, 4]),
        (multi([], (0, 0), (5, 5)), (0, 5), []),
        (multi([], (3, 0), (0, 0)), (3, 0), []),
    ],
)
def test_layouts(message: Any, size: tuple[int, ...], values: list[int]) -> None:
    content = content_of(numbers.multi_to_array(message, ToIgtlContext()), NdArray)
    assert (content.size, content.flat.tolist()) == (size, values)


@table(
    "message",
    [
        multi([1, 2, 3], offset=4),
        multi([1, 2, 3], (2, 2)),
        multi([1, 2, 3], (4, 4)),
        multi([1, 2, 3, 4], (4, 4), offset=1),
        multi([1, 2, 3, 4], (2, 4), (2, 1)),
        multi([1, 2, 3, 4], (2, 4), (2, 3)),
        multi([1, 2, 3, 4], (2, 2), (2, 2)),
        multi([1, 2, 3, 4], (2, 4), (2, 0)),
        multi([1], (2**32 - 1, 2**32 - 1), (2**32 - 1, 2**32 - 1)),
        multi(np.zeros(65536)),
        multi([], (65536, 0), (0, 0)),
        multi([1], *[(1, 1)] * 256),
    ],
)
def test_layouts_that_contradict_the_data_or_the_protocol_are_refused(message: Any) -> None:
    with pytest.raises(ConversionError, match=r"std_msgs/msg/Int16MultiArray: .*found .* expected"):
        numbers.multi_to_array(message, ToIgtlContext())


def test_as_many_dimensions_as_the_protocol_has() -> None:
    """numpy has 64."""
    content = content_of(numbers.multi_to_array(multi([5], *[(1, 1)] * 255), ToIgtlContext()), NdArray)
    assert len(content.size) == 255
    assert len(numbers.array_to_multi(content, TO).layout.dim) == 255


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2)), min_size=1, max_size=4), st.integers(0, 3))
def test_any_layout_tells_the_element_that_std_msgs_says(dims: list[tuple[int, int]], offset: int) -> None:
    """multiarray(i, j, k) = data[data_offset + dim[1].stride * i + dim[2].stride * j + k]."""
    strides: list[int] = []
    for size, gap in reversed(dims):
        strides.insert(0, size * (strides[0] if strides else 1) + gap)
    sizes = [size for size, _ in dims]
    data = np.arange(offset + strides[0], dtype="<i2")
    content = content_of(
        numbers.multi_to_array(multi(data, *zip(sizes, strides, strict=True), offset=offset), ToIgtlContext()), NdArray
    )
    inner = [*strides[1:], 1]
    wanted = [
        offset + sum(index * step for index, step in zip(place, inner, strict=True)) for place in np.ndindex(*sizes)
    ]
    assert content.size == tuple(sizes)
    assert content.flat.tolist() == wanted

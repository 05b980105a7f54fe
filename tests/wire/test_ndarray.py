"""NDARRAY: types, sizes and numbers that contradict each other, complex numbers, shapes beyond numpy."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError, MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.ndarray import MAX_DIMENSIONS, NDARRAY_SCALARS, NdArray
from tests.tables import table
from tests.wire.contents import check_golden


def test_golden_bytes() -> None:
    described = check_golden(NdArray(4, (2, 1), b"\0\1\xff\xff"), b"\4\2\0\2\0\1\0\1\xff\xff")
    assert described == {"scalar_type": 4, "size": [2, 1], "data": [1, -1]}
    described = check_golden(NdArray(13, (1,), struct.pack(">2d", 1, -2)), b"\x0d\1\0\1" + struct.pack(">2d", 1, -2))
    assert described == {"scalar_type": 13, "size": [1], "data": [1.0, -2.0]}


@table(
    ("content", "error", "named"),
    [
        (b"\x03", TruncatedMessage, "NDARRAY content: found 1 byte, expected at least 2 bytes"),
        (b"\x03\x02\0\1\0", TruncatedMessage, "offset 2: found 3 bytes, expected 2 sizes of 2 bytes"),
        (b"\x03\xff", TruncatedMessage, "found 0 bytes, expected 255 sizes of 2 bytes"),
        (b"\x03\0", MalformedBody, "offset 1, dimensions: found 0, expected 1 … 255"),
        (b"\x03\0x", MalformedBody, "dimensions"),
        (
            b"\x01\1\0\0",
            MalformedBody,
            "offset 0, scalar type: found 1, expected one of [2, 3, 4, 5, 6, 7, 10, 11, 13]",
        ),
        (b"\x08\1\0\1x", MalformedBody, "scalar type: found 8"),
        (b"\x03\1\0\2x", MalformedBody, "NDARRAY data: found 1 byte, expected 2 bytes for (2,)"),
        (b"\x03\1\0\1xx", MalformedBody, "found 2 bytes, expected 1 byte"),
        (b"\x0d\1\0\1" + bytes(8), MalformedBody, "expected 16 bytes"),
        (b"\x0b\4" + b"\xff" * 8, MalformedBody, str(65535**4 * 8)),  # 2⁶⁷: no machine word holds it
    ],
)
def test_bad_contents(content: bytes, error: type[WireError], named: str) -> None:
    with pytest.raises(WireError) as raised:
        NdArray.unpack(memoryview(content))
    assert type(raised.value) is error
    assert named in str(raised.value)


@table(
    ("array", "named"),
    [
        (NdArray(1, (1,), b"x"), "scalar type: found 1"),
        (NdArray(3, (), b"x"), "dimensions: found 0"),
        (NdArray(3, (1,) * 256, b"x"), "dimensions: found 256, expected 1 … 255"),
        (NdArray(3, (2,), b"x"), "found 1 byte, expected 2 bytes"),
        (NdArray(3, (65536,), bytes(65536)), "size (65536,), expected 0 … 65535 each"),
        (NdArray(3, (-1, -1), b"x"), "size (-1, -1), expected 0 … 65535 each"),
    ],
)
def test_what_the_layout_cannot_hold(array: NdArray, named: str) -> None:
    with pytest.raises(MalformedBody) as raised:
        array.pack()
    assert named in str(raised.value)


@table("scalar", sorted(NDARRAY_SCALARS))
def test_arrays_in_rows(scalar: int) -> None:
    """Big-endian, the last index fastest."""
    values = np.arange(24).reshape(2, 3, 4).astype(NDARRAY_SCALARS[scalar])
    again = NdArray.unpack(memoryview(join(NdArray(scalar, (2, 3, 4), values.tobytes()).pack())))
    assert again.array[1, 2, 3] == 23
    assert again.array[0, 1].tolist() == [4, 5, 6, 7]
    assert again.array.dtype == NDARRAY_SCALARS[scalar]
    assert np.shares_memory(again.array, again.flat)


def test_numbers_are_not_copied() -> None:
    data = np.frombuffer(b"\3\1\0\4abcd", np.uint8)
    assert np.shares_memory(NdArray.unpack(data.data).array, data)


@pytest.mark.parametrize(("size", "count"), [((1,) * 255, 1), ((0,) + (65535,) * 9, 0)])
def test_shapes_beyond_numpy(size: tuple[int, ...], count: int) -> None:
    """Valid on the wire: carried and described, but numpy has no such array."""
    assert len(size) <= MAX_DIMENSIONS
    content = NdArray.unpack(memoryview(join(NdArray(3, size, bytes(count)).pack())))
    assert content.describe() == {"scalar_type": 3, "size": list(size), "data": [0] * count}
    with pytest.raises(ConversionError, match=r"NDARRAY: found size .*, expected a shape that numpy has"):
        _ = content.array


def test_complex_numbers() -> None:
    content = NdArray(13, (2,), struct.pack(">4d", 1, -2, 0.5, 0))
    assert content.array.tolist() == [1 - 2j, 0.5]
    assert content.describe()["data"] == [1.0, -2.0, 0.5, 0.0]
    long = NdArray(13, (129,), bytes(129 * 16))
    assert long.describe()["data"] == {"count": 258, "crc64": "0" * 16}

"""IMAGE: fields that contradict each other or the pixels, byte orders, parts of volumes, what other programs mean."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.image import HEAD_SIZE, SCALARS, Image
from tests.tables import table
from tests.wire.contents import check_golden, f32


def content(**changes: Any) -> memoryview:
    fields: dict[str, Any] = {"version": 1, "components": 1, "scalar": 3, "endian": 2, "coordinate": 1}
    fields |= {"dims": (2, 3, 4), "offset": (0, 0, 0), "size": (2, 3, 4), "pixels": bytes(24)} | changes
    return memoryview(
        struct.pack(">HBBBB3H", *list(fields.values())[:5], *fields["dims"])
        + f32(*[0] * 12)
        + struct.pack(">6H", *fields["offset"], *fields["size"])
        + bytes(fields["pixels"])
    )


def test_golden_bytes() -> None:
    described = check_golden(
        Image((2, 1, 1), 5, b"\x34\x12\x78\x56"),
        b"\0\1\1\5\2\1" + b"\0\2\0\1\0\1" + f32(1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0) + bytes(6) + b"\0\2\0\1\0\1"
        b"\x34\x12\x78\x56",
    )
    assert described == {
        "image_version": 1,
        "num_components": 1,
        "scalar_type": 5,
        "endian": 2,
        "coordinate": 1,
        "dimensions": [2, 1, 1],
        "wire_matrix": [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0],
        "subvol_offset": [0, 0, 0],
        "subvol_size": [2, 1, 1],
        "data_size": 4,
        "data": [0x1234, 0x5678],
        "data_crc64": "95eb3a99da5913fb",
    }


@table(
    ("changes", "place", "found"),
    [
        ({"components": 0}, "IMAGE content, offset 2, components", 0),
        ({"scalar": 0}, "IMAGE content, offset 3, scalar type", "0"),
        ({"scalar": 8}, "IMAGE content, offset 3, scalar type", "8 (VTK's long)"),
        ({"scalar": 13}, "IMAGE content, offset 3, scalar type", "13"),
        ({"endian": 0, "scalar": 5, "pixels": bytes(48)}, "IMAGE content, offset 4, endian", 0),
        ({"endian": 3}, "IMAGE content, offset 4, endian", 3),
        ({"coordinate": 3}, "IMAGE content, offset 5, coordinate system", 3),
        ({"offset": (1, 0, 0)}, "IMAGE content, sub-volume along i", "1 + 2"),
        ({"size": (2, 4, 4)}, "IMAGE content, sub-volume along j", "0 + 4"),
        ({"offset": (0, 0, 65535)}, "IMAGE content, sub-volume along k", "65535 + 4"),
        ({"size": (65535,) * 3, "dims": (65535,) * 3}, "IMAGE pixels", "24 bytes"),
        ({"size": (0, 3, 4)}, "IMAGE pixels", "24 bytes"),
        ({"components": 2}, "IMAGE pixels", "24 bytes"),
        ({"pixels": bytes(23)}, "IMAGE pixels", "23 bytes"),
        ({"pixels": bytes(25)}, "IMAGE pixels", "25 bytes"),
        ({"scalar": 11}, "IMAGE pixels", "24 bytes"),
    ],
)
def test_contradictions(changes: dict[str, Any], place: str, found: object) -> None:
    Image.unpack(content())
    with pytest.raises(MalformedBody) as error:
        Image.unpack(content(**changes))
    assert (error.value.place, error.value.found) == (place, found)


@table(
    "changes",
    [
        {"coordinate": 0},  # LPS before 2013 and in openigtlink4java; the C++ library takes any byte
        {"scalar": 15},  # VTK's signed char, from 3D Slicer
        {"endian": 0},  # of pixels of one byte, which have no order
        {"endian": 0, "scalar": 15},
    ],
)
def test_an_image_of_a_program_that_means_something_by_it_is_accepted(changes: dict[str, Any]) -> None:
    data = content(**changes, pixels=bytes(range(24)))
    image = Image.unpack(data)
    assert join(image.pack()) == data
    assert image.is_lps == ("coordinate" in changes)
    assert image.number_type == (2 if "scalar" in changes else 3)
    assert image.array.shape == (4, 3, 2, 1) and image.array[0, 0, 1, 0] == 1
    assert image.dtype.kind == ("i" if "scalar" in changes else "u")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"scalar": 8, "pixels": b""},
            "found 8 (VTK's long), expected one of [2, 3, 4, 5, 6, 7, 10, 11]: cast",
        ),
        ({"scalar": 16, "pixels": b""}, "found 16 (VTK's long long)"),
        (
            {"scalar": 15, "pixels": b""},
            "expected 24 bytes for (2, 3, 4): the C++ library knows no size",
        ),
        ({"scalar": 9}, "in 3D Slicer"),
    ],
)
def test_a_refused_type_of_slicer_is_named_as_slicer_does(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(MalformedBody) as caught:
        Image.unpack(content(**changes))
    assert reason in str(caught.value)


def test_advice_is_for_slicer_only() -> None:
    for changes in ({"scalar": 13}, {"pixels": bytes(23)}):
        with pytest.raises(MalformedBody) as error:
            Image.unpack(content(**changes))
        assert "Slicer" not in str(error.value)


@pytest.mark.parametrize("size", [0, 71])
def test_the_head_is_cut_off(size: int) -> None:
    assert HEAD_SIZE == 72
    with pytest.raises(TruncatedMessage, match=f"found {counted(size, 'byte')}, expected at least 72 bytes"):
        Image.unpack(content()[:size])


def test_a_volume_without_pixels_is_a_head() -> None:
    image = Image.unpack(content(dims=(2, 0, 4), size=(2, 0, 4), pixels=b""))
    assert image.array.shape == (4, 0, 2, 1) and image.expected_bytes == 0


def test_sub_volume() -> None:
    image = Image.unpack(content(offset=(1, 1, 2), size=(1, 2, 1), pixels=b"\5\6"))
    assert image.array[:, :, :, 0].tolist() == [[[5], [6]]]
    assert (image.dimensions, image.subvol_offset, image.sub_size) == ((2, 3, 4), (1, 1, 2), (1, 2, 1))


@table("scalar", sorted(SCALARS))
@table(("endian", "order"), [(1, ">"), (2, "<")])
def test_pixels_in_both_byte_orders(scalar: int, endian: int, order: str) -> None:
    """i runs fastest, then j, then k; components are interleaved."""
    values = np.arange(2 * 3 * 4 * 2).reshape(4, 3, 2, 2).astype(order + SCALARS[scalar])
    image = Image((2, 3, 4), scalar, values.tobytes(), 2, endian)
    again = Image.unpack(memoryview(join(image.pack())))
    assert again.array[3, 2, 1].tolist() == [46, 47]
    assert again.array[0, 0, 1].tolist() == [2, 3]
    assert (again.array == values).all()


def test_pixels_are_not_copied() -> None:
    data = np.frombuffer(content(), np.uint8)
    image = Image.unpack(data.data)
    assert np.shares_memory(image.array, data)
    assert np.shares_memory(np.frombuffer(image.pack()[1], np.uint8), data)


@pytest.mark.parametrize("dimensions", [(65536, 1, 1), (-1, 1, 1)])
def test_sizes_beyond_their_fields(dimensions: tuple[int, int, int]) -> None:
    with pytest.raises(MalformedBody):
        Image(dimensions, 3, bytes(max(dimensions[0], 0))).pack()


def test_a_matrix_that_float32_does_not_hold() -> None:
    with pytest.raises(MalformedBody, match=r"IMAGE matrix: found .*1e\+300.*, expected 12 float32 numbers"):
        Image((0, 0, 0), 3, b"", wire_matrix=(1e300,) * 12).pack()

"""IMAGE ⇄ igtl_msgs/Volume: every scalar type, byte order and coordinate system; slices as pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.geometry import IDENTITY
from igtl_gateway.convert.igtl_msgs import MetadataItem, Volume
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.volumes import (
    exceeds_picture,
    image_to_slices,
    image_to_volume,
    is_flat,
    volume_to_image,
)
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, RAS, SCALARS, Image
from tests.strategies import images
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)
#: 0.5 × 0.5 × 2 mm, centred at 10, 20, 30 mm.
MATRIX = (0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 2.0, 10.0, 20.0, 30.0)

RAS_IMAGE = Image((2, 3, 4), 3, bytes(24), 1, 2, RAS, MATRIX)


def to_ros() -> ToRosContext:
    return ToRosContext("CT", 5, "frame", "", metadata=ITEMS)


def there_and_back(content: Image) -> Image:
    message = image_to_volume(content, to_ros())
    assert (message.header, message.metadata) == (Header(5, "frame"), ITEMS)
    out = volume_to_image(Volume.unpack(message.pack()), ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.metadata) == (5, "frame", ITEMS)
    assert isinstance(out.content, Image)
    return out.content


def volume(**changes: Any) -> Volume:
    fields: dict[str, Any] = {
        "header": Header(7, "f"),
        "size": (2, 1, 2),
        "scalar_type": 3,
        "components": 1,
        "is_bigendian": False,
        "coordinate_system": 1,
        "direction": IDENTITY,
        "spacing": (0.001, 0.001, 0.001),
        "origin": (0.0, 0.0, 0.0),
        "data": b"abcd",
    }
    return Volume(**(fields | changes))


def test_a_volume_by_hand() -> None:
    message = image_to_volume(Image((3, 5, 2), 3, bytes(30), wire_matrix=MATRIX), to_ros())
    assert (message.size, message.scalar_type, message.components) == ((3, 5, 2), 3, 1)
    assert (message.direction, message.spacing) == (IDENTITY, (0.0005, 0.0005, 0.002))
    assert message.origin == pytest.approx((0.010 - 0.0005, 0.020 - 0.001, 0.030 - 0.001), abs=1e-15)
    assert message.coordinate_system == RAS


def test_numbers_are_ras_and_the_flag_keeps_what_the_wire_says() -> None:
    content = Image((3, 5, 2), 3, bytes(30), wire_matrix=MATRIX, coordinate=LPS)
    message = image_to_volume(content, to_ros())
    assert message.direction == (-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0)
    assert message.origin == pytest.approx((-0.010 + 0.0005, -0.020 + 0.001, 0.030 - 0.001), abs=1e-15)
    assert message.coordinate_system == LPS
    assert there_and_back(content) == replace(content, subvol_size=None)


@table("scalar", sorted(SCALARS))
@table("endian", [BIG_ENDIAN, LITTLE_ENDIAN])
@table("components", [1, 3, 254])
def test_pixels_of_every_kind_come_back(scalar: int, endian: int, components: int) -> None:
    size = 8 * components * np.dtype(SCALARS[scalar]).itemsize
    content = Image((2, 2, 2), scalar, bytes(i % 251 for i in range(size)), components, endian, wire_matrix=MATRIX)
    assert join(there_and_back(content).pack()) == join(content.pack())


def test_pixels_are_not_copied() -> None:
    pixels = np.zeros(24, np.uint8)
    message = image_to_volume(Image((4, 3, 2), 3, pixels.data), to_ros())
    assert np.shares_memory(np.frombuffer(message.data, np.uint8), pixels)
    content = volume_to_image(volume(size=(4, 3, 2), data=pixels.data), ToIgtlContext()).content
    assert isinstance(content, Image)
    assert np.shares_memory(np.frombuffer(content.pixels, np.uint8), pixels)
    for number, picture in enumerate(image_to_slices(Image((4, 3, 2), 3, pixels.data), to_ros())):
        assert isinstance(picture, rosmsg.Image)
        assert np.shares_memory(np.frombuffer(picture.data, np.uint8), pixels[12 * number : 12 * number + 12])


def completed(content: Image) -> Image:
    """All of the image that a part belongs to, of the one version that there is."""
    whole = replace(content, subvol_offset=(0, 0, 0), subvol_size=content.dimensions, image_version=1)
    return replace(whole, pixels=np.resize(np.arange(251, dtype=np.uint8), whole.expected_bytes).tobytes())


#: A nanometre to a kilometre.
lengths = st.floats(2.0**-20, 2.0**20, width=32).flatmap(lambda value: st.sampled_from([value, -value]))


@given(images(lengths).map(completed))
def test_any_image_comes_back(content: Image) -> None:
    extent = sum(map(abs, content.wire_matrix[:9])) * max(content.dimensions)
    assume(all(abs(value) > extent * 2.0**-27 for value in content.wire_matrix[9:]))
    assert join(there_and_back(content).pack()) == join(content.pack())


@given(images(st.sampled_from([0.25, -0.5, 1.0, 3.0, 0.0])).map(completed))
def test_zeros_come_back_as_zeros(content: Image) -> None:
    assert np.array(there_and_back(content).wire_matrix, np.float32).tolist() == list(content.wire_matrix)


def test_a_part_is_refused() -> None:
    with pytest.raises(ConversionError, match="expected the whole image"):
        image_to_volume(Image((2, 1, 2), 3, b"ab", subvol_size=(1, 1, 2)), to_ros())


def test_a_centre_at_zero_stays_there() -> None:
    matrix = (0.3, 0.1, 0.7, -0.2, 0.9, 0.4, 0.6, 0.05, 0.8, 0.0, 0.0, 0.0)
    content = Image((333, 77, 11), 3, bytes(333 * 77 * 11), wire_matrix=matrix)
    assert there_and_back(content).wire_matrix[9:] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_matrix_that_is_not_finite_does_not_cost_the_pixels(number: float) -> None:
    message = image_to_volume(Image((2, 1, 1), 3, b"ab", wire_matrix=(number, *Image.IDENTITY[1:])), to_ros())
    assert bytes(message.data) == b"ab"
    with pytest.raises(ConversionError, match="expected finite numbers"):
        volume_to_image(message, ToIgtlContext())


@table(
    ("content", "wanted"),
    [
        (Image((2, 1, 1), 3, b"ab"), False),
        (Image((1, 1, 1), 5, b"ab", endian=BIG_ENDIAN), False),
        (Image((2, 1, 1), 3, b"ab", coordinate=LPS), True),
        (Image((2, 1, 1), 3, b"ab", wire_matrix=MATRIX), True),
        (Image((2, 1, 1), 3, b"ab", wire_matrix=(*Image.IDENTITY[:9], 0.0, 0.0, 1.0)), True),
        (Image((1, 1, 1), 7, b"abcd"), True),
        (Image((1, 1, 2), 3, b"ab"), True),
        (Image((1, 1, 0), 3, b""), True),
    ],
)
def test_what_a_picture_does_not_hold(content: Image, wanted: bool) -> None:
    assert exceeds_picture(content) is wanted


@table(
    "changes",
    [
        {"size": (2, 2, 2)},
        {"size": (0, 1, 2)},
        {"data": b"abc"},
        {"scalar_type": 5},
        {"scalar_type": 13},
        {"scalar_type": 0},
        {"components": 0},
        {"components": 2},
        {"coordinate_system": 3},
        {"spacing": (math.nan, 1.0, 1.0)},
        {"spacing": (1e36, 1.0, 1.0)},
        {"origin": (0.0, math.inf, 0.0)},
        {"direction": (math.nan,) * 9},
    ],
)
def test_contradictions(changes: dict[str, Any]) -> None:
    volume_to_image(volume(), ToIgtlContext())
    with pytest.raises(ConversionError, match="igtl_msgs/msg/Volume"):
        volume_to_image(volume(**changes), ToIgtlContext())


def test_coordinate_system_zero_of_the_wire_is_the_lps_of_old_libraries_and_said() -> None:
    """VIDEO came later and never had it; 3D Slicer ignores the byte."""
    lps, old = (Image((2, 3, 4), 3, bytes(24), 1, 2, coordinate, MATRIX) for coordinate in (LPS, 0))
    expected, context = image_to_volume(lps, to_ros()), to_ros()
    message = image_to_volume(old, context)
    assert (message.origin, message.direction) == (expected.origin, expected.direction)
    assert message.coordinate_system == LPS and message.origin[0] < 0 < image_to_volume(RAS_IMAGE, to_ros()).origin[0]
    ((code, text),) = context.warnings
    assert code == "coordinate_zero" and "2013" in text and "openigtlink4java" in text and "write 1" in text
    assert exceeds_picture(replace(old, dimensions=(2, 12, 1), subvol_size=None, wire_matrix=Image.IDENTITY))


def test_the_signed_char_of_slicer_is_int8() -> None:
    message = image_to_volume(Image((2, 1, 2), 15, b"\x80\xff\0\x7f"), to_ros())
    assert message.scalar_type == 2 and bytes(message.data) == b"\x80\xff\0\x7f"
    slices = image_to_slices(Image((2, 1, 2), 15, b"\x80\xff\0\x7f"), to_ros())
    assert [one.encoding for one in slices if isinstance(one, rosmsg.Image)] == ["8SC1", "8SC1"]


def test_a_coordinate_system_not_filled_in_is_ras() -> None:
    assert volume_to_image(volume(coordinate_system=0), ToIgtlContext()) == volume_to_image(volume(), ToIgtlContext())


@pytest.mark.parametrize(
    ("direction", "codes"), [(IDENTITY, []), ((0.0,) * 9, ["direction_not_unit"]), ((1.0,) * 9, ["direction_not_unit"])]
)
def test_directions_that_are_no_units_are_told(direction: tuple[float, ...], codes: list[str]) -> None:
    to = ToIgtlContext()
    volume_to_image(volume(direction=direction), to)
    assert [code for code, _ in to.warnings] == codes


def test_slices_in_their_order() -> None:
    content = Image((2, 1, 3), 5, b"aabbccddeeff", endian=BIG_ENDIAN)
    pictures = image_to_slices(content, to_ros())
    assert pictures == [
        rosmsg.Image(Header(5, "frame"), 1, 2, "mono16", 1, 4, pixels) for pixels in (b"aabb", b"ccdd", b"eeff")
    ]


def test_slices_of_nothing() -> None:
    assert image_to_slices(Image((2, 2, 0), 3, b""), to_ros()) == []
    assert [memoryview(p.data).nbytes for p in image_to_slices(Image((0, 2, 2), 3, b""), to_ros())] == [0, 0]  # type: ignore[attr-defined]


def test_slices_say_once_what_they_bend() -> None:
    to = to_ros()
    assert len(image_to_slices(Image((1, 1, 3), 7, bytes(12)), to)) == 3
    assert [code for code, _ in to.warnings] == ["uint32_as_float64"]


def test_slices_of_a_part_are_refused() -> None:
    with pytest.raises(ConversionError):
        image_to_slices(Image((2, 1, 2), 3, b"ab", subvol_size=(1, 1, 2)), to_ros())


def test_flat_is_one_slice() -> None:
    assert [is_flat(Image((1, 1, count), 3, bytes(count))) for count in range(3)] == [False, True, False]

"""Volumes put together of their parts, against an array that is filled in the plain way."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import assembly
from igtl_gateway.convert.assembly import MAX_VOLUME_BYTES, VolumeAssembler
from igtl_gateway.wire.image import SCALARS, Image
from tests.tables import table

Extent = tuple[int, int, int]
_ORDER = {1: ">", 2: "<"}


def part(
    values: npt.NDArray[Any], offset: Extent, size: Extent, scalar: int = 5, endian: int = 2, **other: Any
) -> Image:
    """The part of ``values`` (k, j, i, components) as it is sent."""
    (x, y, z), (nx, ny, nz) = offset, size
    k, j, i, components = values.shape
    cut = values[z : z + nz, y : y + ny, x : x + nx].astype(_ORDER[endian] + SCALARS[scalar])
    return Image((i, j, k), scalar, cut.tobytes(), components, endian, subvol_offset=offset, subvol_size=size, **other)


def numbered(size: Extent, components: int = 1, start: int = 0) -> npt.NDArray[Any]:
    i, j, k = size
    return (np.arange(i * j * k * components) + start).reshape(k, j, i, components)


def test_a_whole_image_passes_as_it_is() -> None:
    assembler = VolumeAssembler()
    image = part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 2))
    assert assembler.update(image) is image
    assert assembler.missing == 0


def test_slice_by_slice() -> None:
    values = numbered((4, 3, 2))
    assembler = VolumeAssembler()
    assert assembler.update(part(values, (0, 0, 1), (4, 3, 1))) is None
    assert assembler.missing == 12
    assert assembler.update(part(values, (0, 0, 1), (4, 3, 1))) is None
    assert assembler.missing == 12
    whole = assembler.update(part(values, (0, 0, 0), (4, 3, 1)))
    assert whole is not None
    assert assembler.missing == 0
    assert (whole.array == values).all()
    assert whole.sub_size == whole.dimensions == (4, 3, 2)
    whole.check()


def test_an_update_of_a_whole_image_changes_nothing_handed_out() -> None:
    assembler = VolumeAssembler()
    first = part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 2))
    assembler.update(first)
    before = bytes(first.pixels)
    second = assembler.update(part(numbered((4, 3, 2), start=100), (1, 1, 0), (2, 2, 1)))
    assert second is not None
    kept = bytes(second.pixels)
    third = assembler.update(part(numbered((4, 3, 2), start=200), (0, 0, 0), (1, 1, 2)))
    assert third is not None
    assert bytes(first.pixels) == before
    assert bytes(second.pixels) == kept
    expected = numbered((4, 3, 2))
    expected[0, 1:3, 1:3] += 100
    assert (second.array == expected).all()
    expected[0:2, 0, 0] += 200
    assert (third.array == expected).all()


def test_geometry_is_that_of_the_newest_message() -> None:
    values = numbered((2, 2, 1))
    assembler = VolumeAssembler()
    moved = (2.0, *Image.IDENTITY[1:])
    assembler.update(part(values, (0, 0, 0), (2, 2, 1)))
    whole = assembler.update(part(values, (0, 0, 0), (1, 1, 1), coordinate=2, wire_matrix=moved))
    assert whole is not None
    assert (whole.coordinate, whole.wire_matrix) == (2, moved)


@table("scalar", sorted(SCALARS))
@table(("base", "update"), [(1, 2), (2, 1), (1, 1)])
def test_byte_orders_meet(scalar: int, base: int, update: int) -> None:
    values = numbered((3, 2, 2), 2)
    assembler = VolumeAssembler()
    assembler.update(part(values, (0, 0, 0), (3, 2, 2), scalar, base))
    whole = assembler.update(part(values + 50, (1, 0, 1), (2, 2, 1), scalar, update))
    assert whole is not None
    values[1:2, :, 1:3] += 50
    assert (whole.array == values).all()


def test_bits_of_floats_are_not_looked_at() -> None:
    """A signalling NaN stays one, in either byte order."""
    nan = bytes.fromhex("7fa00001")
    assembler = VolumeAssembler()
    assembler.update(Image((2, 1, 1), 10, bytes(8), endian=2))
    whole = assembler.update(Image((2, 1, 1), 10, nan, endian=1, subvol_offset=(1, 0, 0), subvol_size=(1, 1, 1)))
    assert whole is not None
    assert bytes(whole.pixels) == bytes(4) + nan[::-1]


@pytest.mark.parametrize(
    "other",
    [
        part(numbered((4, 3, 3)), (0, 0, 0), (4, 3, 1)),
        part(numbered((3, 4, 2)), (0, 0, 0), (3, 4, 1)),
        part(numbered((4, 3, 2), 2), (0, 0, 0), (4, 3, 1)),
        part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 1), scalar=4),
    ],
    ids=["slices", "turned", "components", "scalar type"],
)
def test_another_kind_of_volume_starts_anew(other: Image) -> None:
    assembler = VolumeAssembler()
    assembler.update(part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 2)))
    assert assembler.update(other) is None
    assert assembler.missing == 12 * (other.dimensions[2] - 1)
    # the first is forgotten
    assert assembler.update(part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 1))) is None


@pytest.mark.parametrize("size", [(0, 0, 0), (0, 2, 2), (2, 0, 2)])
def test_parts_of_nothing(size: Extent) -> None:
    assembler = VolumeAssembler()
    assert assembler.update(part(numbered((2, 2, 2)), (0, 0, 0), size)) is None
    assert assembler.missing == 8


def test_an_image_without_pixels_is_complete() -> None:
    whole = VolumeAssembler().update(part(numbered((0, 2, 2)), (0, 0, 0), (0, 1, 1)))
    assert whole is not None
    assert (whole.dimensions, bytes(whole.pixels)) == ((0, 2, 2), b"")


def test_a_volume_beyond_the_limit_is_refused_before_memory_is_taken() -> None:
    assembler = VolumeAssembler()
    image = part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 2))
    assembler.update(image)
    tracemalloc.start()
    huge = Image((65535, 65535, 65535), 11, bytes(8), subvol_size=(1, 1, 1))
    huge.check()
    with pytest.raises(ConversionError, match=f"expected {MAX_VOLUME_BYTES} at most"):
        assembler.update(huge)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()
    # and the volume that was there is still there
    whole = assembler.update(replace(image, pixels=b"\xff\xff", subvol_size=(1, 1, 1)))
    assert whole is not None
    assert whole.array[0, 0, 0, 0] == 0xFFFF
    assert bytes(whole.pixels)[2:] == bytes(image.pixels)[2:]


@st.composite
def regions(draw: st.DrawFn) -> tuple[Extent, Extent]:
    offset = (draw(st.integers(0, 2)), draw(st.integers(0, 1)), draw(st.integers(0, 1)))
    size = tuple(draw(st.integers(0, n - at)) for n, at in zip((3, 2, 2), offset, strict=True))
    return offset, (size[0], size[1], size[2])


@given(st.lists(st.tuples(regions(), st.sampled_from([1, 2])), max_size=12))
def test_as_an_array_that_is_filled(updates: list[tuple[tuple[Extent, Extent], int]]) -> None:
    assembler, ahead = VolumeAssembler(), VolumeAssembler()
    expected = np.full((2, 2, 3, 1), -1)
    handed_out: list[tuple[Image, bytes]] = []
    for start, ((offset, size), endian) in enumerate(updates):
        values = numbered((3, 2, 2), start=100 * start)
        (x, y, z), (nx, ny, nz) = offset, size
        where = (slice(z, z + nz), slice(y, y + ny), slice(x, x + nx))
        expected[where] = values[where]
        image = part(values, offset, size, 5, endian)
        whole = assembler.update(image)
        missing = np.count_nonzero(expected < 0)
        foreseen = ahead.foreseen(image)
        assert (foreseen is not None) == (not missing and size != (3, 2, 2)), "also of one that its last part completes"
        same = ahead.update(image, foreseen=foreseen)
        assert same == whole and (ahead.missing, ahead.held) == (assembler.missing, assembler.held)
        assert (
            assembler.missing <= missing
        )  # overlapping parts are only distinguished when the volume might be complete
        if missing:
            assert whole is None
        else:
            assert whole is not None
            assert (whole.array == expected).all()
            handed_out.append((whole, bytes(whole.pixels)))
    assert all(bytes(image.pixels) == pixels for image, pixels in handed_out)


@pytest.mark.parametrize(("more", "is_used"), [(-1, False), (0, True), (1, True)])
def test_what_was_made_ahead_is_used_where_its_room_is_there(more: int, is_used: bool) -> None:
    values = numbered((3, 2, 1))
    assembler = VolumeAssembler()
    assert assembler.update(part(values, (0, 0, 0), (3, 1, 1))) is None
    last = part(values, (0, 1, 0), (3, 1, 1))
    foreseen = assembler.foreseen(last)
    assert foreseen and foreseen.needs > 0
    try:
        found = assembler.update(last, foreseen.needs + more, foreseen)
    except ConversionError:
        assert not is_used
        return
    assert (found is foreseen.whole) is is_used
    assert found is not None and (found.array == values).all()


def test_what_is_announced_costs_nothing_and_what_is_kept_has_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by tools/fuzz_gateway.py: a few hundred parts of a voxel each made gigabytes resident."""
    huge = Image((1024, 1024, 1024), 3, b"\1", subvol_size=(1, 1, 1))
    assembler = VolumeAssembler()
    tracemalloc.start()
    for number in range(500):
        one = replace(huge, subvol_offset=(number, 2 * number, 2 * number))
        assert assembler.update(one) is None
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()
    assert assembler.held < 1_000_000
    with pytest.raises(ConversionError, match=r"found parts of a volume .* expected 500000 at most to keep"):
        assembler.update(huge, 500_000)
    assert assembler.held == 0

    # more parts than any volume has: from there on an array is kept, where there is room for it
    monkeypatch.setattr(assembly, "MAX_PARTS", 3)
    values = numbered((3, 2, 1))
    places = [(x, y, 0) for x in range(3) for y in range(2)]
    for place in places[:3]:
        assert assembler.update(part(values, place, (1, 1, 1))) is None
    assembler.held = 0
    with pytest.raises(ConversionError, match="volume of 12 bytes, expected 17"):
        assembler.update(part(values, places[3], (1, 1, 1)), 17)
    whole = [assembler.update(part(values, place, (1, 1, 1)), 1 << 20) for place in places]
    assert whole[:-1] == [None] * 5 and whole[-1] is not None
    assert (whole[-1].array == values).all()
    assert assembler.held == 12


def test_a_whole_image_for_which_there_is_no_room_passes_and_is_not_kept() -> None:
    assembler = VolumeAssembler()
    image = part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 2))
    assert assembler.update(image, 10) is image
    assert assembler.held == 0
    assert assembler.update(part(numbered((4, 3, 2)), (0, 0, 0), (4, 3, 1))) is None

"""Where images lie: worked out by hand, and there and back to the last bit."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.geometry import Placement, flip_lps_ras, join_axes, split_axes
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.image import LPS, RAS, Image
from tests.strategies import any32, finite32

METRES = LengthUnits()
#: 0.5 × 2 × 3 mm, turned by 90° about z, centred at 10, 20, 30 mm.
MATRIX = (0.0, 0.5, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, 3.0, 10.0, 20.0, 30.0)


def bits(values: Sequence[float]) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def test_a_matrix_by_hand() -> None:
    placement = Placement.of_wire(MATRIX, RAS, METRES)
    assert placement.direction == (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert placement.spacing == (0.0005, 0.002, 0.003)
    assert placement.center == (0.01, 0.02, 0.03)
    # centre minus 2 · i, 1 · j and 0.5 · k
    assert placement.origin((5, 3, 2)) == pytest.approx((0.01 + 0.002, 0.02 - 0.001, 0.03 - 0.0015), abs=1e-15)


def test_lps_is_turned_about_z() -> None:
    placement = Placement.of_wire(MATRIX, LPS, METRES)
    assert placement.direction == (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert placement.spacing == (0.0005, 0.002, 0.003)
    assert placement.center == (-0.01, -0.02, 0.03)


def test_voxels_stay_where_the_protocol_has_them() -> None:
    """p = P + T·(i − (ni−1)/2) + …, from the reference, against origin + direction · spacing · index."""
    size, index = (4, 7, 3), (3, 1, 2)
    placement = Placement.of_wire(MATRIX, RAS, METRES)
    origin = placement.origin(size)
    columns = [placement.direction[n : n + 3] for n in (0, 3, 6)]
    for row in range(3):
        wire = MATRIX[9 + row] + sum(MATRIX[3 * axis + row] * (index[axis] - (size[axis] - 1) / 2) for axis in range(3))
        ros = origin[row] + sum(columns[axis][row] * placement.spacing[axis] * index[axis] for axis in range(3))
        assert ros == pytest.approx(wire / 1000, abs=1e-15)


@given(st.lists(finite32, min_size=9, max_size=9))
def test_vectors_come_back_to_the_same_bits(nine: list[float]) -> None:
    direction, spacing = split_axes(nine)
    for start in (0, 3, 6):
        assert math.hypot(*direction[start : start + 3]) == pytest.approx(1.0, abs=1e-12)
        if not any(nine[start : start + 3]):
            nine[start : start + 3] = [0.0, 0.0, 0.0]  # the stated exception
    assert bits(join_axes(direction, spacing)) == bits(nine)


def test_a_vector_without_length_has_the_direction_of_its_axis() -> None:
    assert split_axes([0.0] * 9) == ((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


@given(
    st.tuples(*[finite32.filter(bool)] * 12),
    st.sampled_from([RAS, LPS]),
    st.sampled_from([METRES, LengthUnits("mm", "mm"), LengthUnits("m", "um")]),
)
def test_matrices_come_back_to_the_same_bits(matrix: tuple[float, ...], coordinate: int, lengths: LengthUnits) -> None:
    placement = Placement.of_wire(matrix, coordinate, lengths)
    assert bits(placement.to_wire(coordinate, lengths, "here")) == bits(matrix)


#: Voxels of a micrometre to a metre, as any scanner has them.
spacings = st.floats(2.0**-10, 2.0**10, width=32)
centers = st.floats(2.0**-4, 2.0**14, width=32).flatmap(lambda value: st.sampled_from([value, -value, 0.0]))


@given(st.tuples(*[spacings] * 9), st.tuples(*[centers] * 3), st.tuples(*[st.integers(0, 1024)] * 3))
def test_centers_come_back_by_way_of_the_origin(
    nine: tuple[float, ...], center: tuple[float, ...], size: tuple[int, int, int]
) -> None:
    placement = Placement.of_wire((*nine, *center), RAS, METRES)
    back = Placement.from_origin(placement.direction, placement.spacing, placement.origin(size), size)
    assert bits(back.to_wire(RAS, METRES, "here")) == bits((*nine, *center))


@given(st.tuples(*[any32] * 12))
def test_what_is_not_finite_is_shown_but_not_sent(matrix: tuple[float, ...]) -> None:
    placement = Placement.of_wire(matrix, RAS, METRES)
    placement.origin((1, 2, 3))
    if all(map(math.isfinite, matrix)):
        placement.to_wire(RAS, METRES, "here")
    else:
        with pytest.raises(ConversionError, match=r"here: .* expected finite numbers"):
            placement.to_wire(RAS, METRES, "here")


@pytest.mark.parametrize("spacing", [math.inf, math.nan, 1e36, 1e308])
def test_too_large_for_the_wire(spacing: float) -> None:
    direction, _ = split_axes(Image.IDENTITY[:9])
    with pytest.raises(ConversionError):
        Placement(direction, (spacing, 1.0, 1.0), (0.0, 0.0, 0.0)).to_wire(RAS, METRES, "here")


def test_the_largest_number_of_the_wire_can_be_sent() -> None:
    largest = float(np.finfo(np.float32).max)
    for matrix in ((largest,) * 12, (largest, -largest, 1.0) * 4):
        assert bits(Placement.of_wire(matrix, RAS, METRES).to_wire(RAS, METRES, "here")) == bits(matrix)


@given(st.tuples(*[finite32] * 12))
def test_flipped_twice_is_as_before(vectors: tuple[float, ...]) -> None:
    once = flip_lps_ras(vectors)
    assert once[2::3] == vectors[2::3]
    assert once[::3] == tuple(-value for value in vectors[::3])
    assert bits(flip_lps_ras(once)) == bits(vectors)

"""Lengths of many points: the same numbers as one by one, rounded once."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.convert.scaling import all_finite, into_igtl, into_ros
from igtl_gateway.convert.units import UNITS, LengthUnits, ieee_754

PAIRS = [(ros, igtl) for ros in UNITS for igtl in UNITS]
#: Every kind of float32: zeros, subnormal, largest, infinite and none at all.
_EDGES = [0, 1 << 31, 1, 0x7FFFFF, 0x800000, 0x7F7FFFFF, 0xFF7FFFFF, 0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC12345]


@pytest.mark.parametrize("source", ["<f4", ">f4", "<f8"])
@pytest.mark.parametrize("target", ["<f4", ">f4", "<f8"])
@ieee_754
def test_scaled_as_one_by_one(source: str, target: str) -> None:
    words = np.random.default_rng(7).integers(0, 1 << 32, 2_000, np.uint32)
    values = np.concatenate([np.array(_EDGES, np.uint32), words]).view(np.float32).astype(source)
    for pair in PAIRS:
        lengths = LengthUnits(*pair)
        for into, exact in ((into_ros, lengths.to_ros(values)), (into_igtl, lengths.to_igtl(values))):
            out = np.empty(len(values), target)
            assert into(lengths, values, out) is out
            assert out.tobytes() == exact.astype(target).tobytes()


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8"])
@ieee_754
def test_all_finite(dtype: str) -> None:
    assert all_finite(np.empty((0, 3), dtype))
    assert all_finite(np.full((4, 3), 3e38, dtype))  # their sum overflows float32
    for odd in (np.nan, np.inf, -np.inf):
        values = np.ones((4, 3), dtype)
        values[2, 1] = odd
        assert not all_finite(values)
        values[0, 0] = -odd
        assert not all_finite(values)

"""Lengths: every number is the correctly rounded one, between all pairs of units."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.units import UNITS, LengthUnits
from tests import strategies

PAIRS = [(ros, igtl) for ros in UNITS for igtl in UNITS]


def test_units() -> None:
    assert {name: size / UNITS["m"] for name, size in UNITS.items()} == {
        "m": 1, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6
    }  # fmt: skip


@given(st.sampled_from(PAIRS), st.floats(-1e9, 1e9, allow_subnormal=False))
def test_correctly_rounded(pair: tuple[str, str], value: float) -> None:
    lengths = LengthUnits(*pair)
    ratio = Fraction(UNITS[pair[0]], UNITS[pair[1]])
    array = np.array([value])
    for result, exact in (
        (lengths.to_igtl(value), Fraction(value) * ratio),
        (float(lengths.to_igtl(array)[0]), Fraction(value) * ratio),
        (lengths.to_ros(value), Fraction(value) / ratio),
        (float(lengths.to_ros(array)[0]), Fraction(value) / ratio),
    ):
        assert result == float(exact)


def test_a_factor_of_one_thousandth_would_be_wrong() -> None:
    assert LengthUnits().to_ros(3.0) == 0.003
    assert 3.0 * 1e-3 == 0.003
    assert LengthUnits().to_ros(5.0 * 1.1) == 0.0055
    wrong = [value for value in range(1000) if value * 1e-3 != value / 1000]
    assert wrong
    assert all(LengthUnits().to_ros(float(value)) == value / 1000 for value in wrong)


@given(st.sampled_from(PAIRS), strategies.finite32)
def test_float32_comes_back(pair: tuple[str, str], value: float) -> None:
    """What came from the wire goes back to the wire unchanged."""
    lengths = LengthUnits(*pair)
    assert np.float32(lengths.to_igtl(lengths.to_ros(value))) == np.float32(value)


@pytest.mark.parametrize("dtype", [">f4", "<f4", "f8", "i2"])
def test_arrays_are_not_changed_in_place(dtype: str) -> None:
    values = np.array([1, 2, 3], dtype)
    for result in (LengthUnits().to_igtl(values), LengthUnits().to_ros(values), LengthUnits("m", "m").to_ros(values)):
        assert result.dtype == np.float64
        assert not np.shares_memory(result, values)
    assert values.tolist() == [1, 2, 3]


def test_float32_arrays_are_rounded_once() -> None:
    values = np.array([0.1], ">f4")
    assert LengthUnits().to_ros(values)[0] == float(values[0]) / 1000

"""Time stamps: bit for bit what the reference library computes, and the identity from nanosecond to nanosecond."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.stamp import (
    NS_PER_S,
    fraction_to_ns,
    ns_to_fraction,
    ns_to_ros,
    ns_to_ticks,
    ros_to_ns,
    ticks_to_ns,
)

#: ``openigtlink-reference.md`` §4: ns, fraction by the library.
TABLE = [
    (0, 0x00000000),
    (1, 0x00000004),
    (100, 0x000001A8),
    (123456789, 0x1F9ADD24),
    (333333333, 0x55555544),
    (500000000, 0x80000000),
    (999999999, 0xFFFFFFD8),
]
_AROUND = {ns + step for bit in range(30) for ns in (1 << bit, NS_PER_S >> bit) for step in (-1, 0, 1)}
EDGES = sorted(ns for ns in _AROUND if 0 <= ns < NS_PER_S)


def library_ns(fraction: int) -> int:
    """``igtl_frac_to_nanosec`` as the reference describes it: bit by bit."""
    ns, step = 0, NS_PER_S
    for bit in range(31, -1, -1):
        step = (step + 1) >> 1
        if fraction & 1 << bit:
            ns += step
    return ns


def library_fraction(ns: int) -> int:
    """``igtl_nanosec_to_frac`` as the reference describes it."""
    fraction, step = 0, NS_PER_S
    for bit in range(31, -1, -1):
        step = (step + 1) >> 1
        if ns >= step:
            fraction |= 1 << bit
            ns -= step
    return fraction


@pytest.mark.parametrize(("ns", "fraction"), TABLE)
def test_table_of_the_reference(ns: int, fraction: int) -> None:
    assert ns_to_fraction(ns) == fraction
    assert fraction_to_ns(fraction) == ns


def test_there_and_back_is_the_identity() -> None:
    """Every nanosecond of the first and the last 20,000, all edges, and one in each 99,991 (a prime) between."""
    sample = [*range(20_000), *range(NS_PER_S - 20_000, NS_PER_S), *EDGES, *range(0, NS_PER_S, 99_991)]
    for ns in sample:
        fraction = ns_to_fraction(ns)
        assert fraction_to_ns(fraction) == ns
        assert fraction <= 0xFFFFFFD8
    assert ns_to_fraction(NS_PER_S - 1) == 0xFFFFFFD8


@given(st.integers(0, NS_PER_S - 1))
def test_ns_as_the_library(ns: int) -> None:
    assert ns_to_fraction(ns) == library_fraction(ns)


@given(st.integers(0, 2**32 - 1))
def test_fraction_as_the_library(fraction: int) -> None:
    ns = fraction_to_ns(fraction)
    assert ns == library_ns(fraction)
    exact = Fraction(fraction * NS_PER_S, 2**32)
    assert 0 <= ns - exact < Fraction(103, 10)  # never below, at most 10.3 ns above


def test_order_is_kept() -> None:
    fractions = [ns_to_fraction(ns) for ns in EDGES]
    assert fractions == sorted(set(fractions))


@pytest.mark.parametrize("fraction", [0xFFFFFFD9, 0xFFFFFFFF])
def test_a_fraction_of_a_whole_second_is_carried(fraction: int) -> None:
    assert fraction_to_ns(fraction) >= NS_PER_S
    assert 5 * NS_PER_S + NS_PER_S <= ticks_to_ns(5 << 32 | fraction) < 5 * NS_PER_S + NS_PER_S + 11


def test_zero_is_unset() -> None:
    assert ticks_to_ns(0) == 0
    assert ns_to_ticks(0) == 0
    assert ros_to_ns(0, 0) == 0
    assert ns_to_ros(0) == (0, 0)
    assert ns_to_ticks(-1) == 0  # before 1970: the field cannot express it


@given(st.integers(0, (1 << 32) * NS_PER_S - 1))
def test_tick_words(ns: int) -> None:
    ticks = ns_to_ticks(ns)
    assert ticks_to_ns(ticks) == ns
    assert 0 <= ticks < 1 << 64
    assert ticks & 0xFFFFFFFF <= 0xFFFFFFD8


def test_worked_example() -> None:
    """1,700,000,000.5 s, from the reference's §2."""
    assert ns_to_ticks(1_700_000_000_500_000_000) == 0x6553F100_80000000


@given(st.integers(-(1 << 31) * NS_PER_S, (1 << 31) * NS_PER_S - 1))
def test_ros_time(ns: int) -> None:
    sec, nanosec = ns_to_ros(ns)
    assert -(1 << 31) <= sec < 1 << 31
    assert 0 <= nanosec < NS_PER_S
    assert ros_to_ns(sec, nanosec) == ns


def test_ros_time_wraps_in_2038() -> None:
    assert ns_to_ros((1 << 31) * NS_PER_S + 7) == (-(1 << 31), 7)


def test_ros_nanoseconds_above_a_second_are_carried() -> None:
    assert ros_to_ns(1, 2**32 - 1) == NS_PER_S + 2**32 - 1

"""The unit of fractions: by the ages, whatever the rhythm of the sender is."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.doctor.fractions import FractionUnits

T0_NS = 1_790_000_000 * NS_PER_S
UNITS = {"ms": 1_000, "us": 1_000_000, "ns": NS_PER_S, "": 2**32}


def ticks(now_ns: int, per_second: int) -> int:
    return now_ns // NS_PER_S << 32 | now_ns % NS_PER_S * per_second // NS_PER_S


def seen(times_ns: list[int], per_second: int, late_ns: int = 0, jitter_ns: int = 0) -> FractionUnits:
    units = FractionUnits()
    for number, time_ns in enumerate(times_ns):
        units.add(ticks(time_ns, per_second), time_ns + late_ns + number % 3 * jitter_ns)
    return units


@given(st.sampled_from(sorted(UNITS)), st.lists(st.integers(0, 5_000), min_size=50, max_size=80, unique=True))
def test_any_times(unit: str, times_ms: list[int]) -> None:
    """Whatever the clocks differ by, and with jitter on the way."""
    times_ns = [T0_NS + one * NS_PER_MS for one in sorted(times_ms)]
    assert seen(times_ns, UNITS[unit], 3 * 3600 * NS_PER_S, 5 * NS_PER_MS).unit == unit


@pytest.mark.parametrize("phase_ms", [0, 10, 100, 200, 232])
@pytest.mark.parametrize("burst", [1, 5])
def test_a_rhythm_of_whole_seconds_is_no_unit(phase_ms: int, burst: int) -> None:
    """All fractions are below 10^9."""
    times_ns = [
        T0_NS + second * NS_PER_S + (phase_ms + step * (232 - phase_ms) // burst) * NS_PER_MS
        for second in range(40)
        for step in range(burst)
    ]
    assert seen(times_ns, 2**32, jitter_ns=2 * NS_PER_MS).unit == ""


def test_few_stamps_and_unset_ones_are_no_unit() -> None:
    times_ns = [T0_NS + step * 170 * NS_PER_MS for step in range(19)]
    assert seen(times_ns, NS_PER_S, jitter_ns=NS_PER_MS).unit == ""
    units = FractionUnits()
    for _ in range(100):
        units.add(0, T0_NS)
    assert (units.unit, units.stamped, units.is_low_word) == ("", 0, False)


def test_a_step_of_the_own_clock_forgets_the_ages() -> None:
    units = seen([T0_NS + step * 70 * NS_PER_MS for step in range(60)], 2**32, jitter_ns=NS_PER_MS)
    units.reset()
    for step in range(60):
        time_ns = T0_NS + step * 70 * NS_PER_MS
        units.add(ticks(time_ns, 2**32), time_ns - 3600 * NS_PER_S + step % 3 * NS_PER_MS)
    assert units.unit == ""

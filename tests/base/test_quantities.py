"""Numbers that a person reads: each in the unit of its magnitude."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.quantities import (
    clock_text,
    count_text,
    duration_text,
    few_text,
    moment_text,
    offset_text,
    rate_text,
    rough_text,
    seconds_text,
    size_text,
)
from tests.tables import table

S = 1_000_000_000
DAY = 86_400 * S


@table(
    ("ns", "text"),
    [
        (0, "0 s"),
        (812, "812 ns"),
        (12_340, "12.3 µs"),
        (999_960, "1 ms"),
        (1_250_000, "1.25 ms"),
        (119_200_000, "119.2 ms"),
        (999_996_000, "1 s"),
        (2_820_000_000, "2.82 s"),
        (59_970_000_000, "1 min"),
        (245 * S, "4 min 5 s"),
        (3_599 * S, "59 min 59 s"),
        (3_599.7 * S, "1 h"),
        (12_300 * S, "3 h 25 min"),
        (47 * 3600 * S, "47 h"),
        (3 * DAY, "3 days"),
        (28_659_063_224_700_000, "332 days"),
        (56 * 365.25 * DAY, "56 years"),
        (-5 * S, "5 s"),
    ],
)
def test_durations(ns: float, text: str) -> None:
    assert duration_text(ns) == text


@given(st.integers(1, 10**20))
def test_no_duration_has_more_than_four_digits_or_a_wrong_unit(ns: int) -> None:
    words = duration_text(ns).split()
    sizes = {
        "ns": 1, "µs": 1e3, "ms": 1e6, "s": 1e9, "min": 60e9, "h": 3600e9, "days": DAY, "years": 365.25 * DAY,
    }  # fmt: skip
    shown = sum(
        float(number.replace(",", "")) * sizes[unit] for number, unit in zip(words[::2], words[1::2], strict=True)
    )
    assert abs(shown - ns) <= 0.06 * ns
    assert all(len(number.replace(",", "").replace(".", "")) <= 4 for number in words[::2])


def test_the_offset_of_a_clock_has_its_microseconds() -> None:
    found = [clock_text(ns) for ns in (3_700_005_400, -119_200, 0, -5_000_123_006_000)]
    assert found == ["+3,700.005 ms", "-0.119 ms", "+0.000 ms", "-5,000.123006 s"]


def test_offsets_sizes_rates_and_counts() -> None:
    assert [offset_text(ns) for ns in (-119_200_000, 0, 5 * S)] == ["-119.2 ms", "0 s", "+5 s"]
    assert [seconds_text(each) for each in (0.4, 59.4, 3599, 90_000)] == ["0 s", "59 s", "59 min 59 s", "25 h"]
    assert [rough_text(each) for each in (59.4, 1797, 1000, 100_000, 800_000)] == [
        "59 s", "30 min", "17 min", "28 h", "9.2 days",
    ]  # fmt: skip
    assert [moment_text(ns) for ns in (0, 12_345_600_000, -S)] == ["0.000 s", "12.346 s", "-1.000 s"]
    assert [size_text(number) for number in (0, 812, 9_600_000, 2.5e13)] == ["0 B", "812 B", "9.6 MB", "25.0 TB"]
    assert [rate_text(hertz) for hertz in (0.0213, 29.97, 100, 1200)] == ["0.021 Hz", "30.0 Hz", "100.0 Hz", "1.2 kHz"]
    assert [count_text(number, "entry", "entries") for number in (0, 1, 1234)] == [
        "0 entries", "1 entry", "1,234 entries",
    ]  # fmt: skip


def test_the_first_few_of_a_list() -> None:
    assert few_text([], 2) == ""
    assert few_text(["a", 2], 2) == "a, 2"
    assert few_text(iter(range(1_235)), 1) == "0 and 1,234 more"

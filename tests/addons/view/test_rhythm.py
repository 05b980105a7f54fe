"""Gaps in plots: where a line breaks, and that it does not depend on how many values come at once."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.colours import line_colour
from igtl_gateway.addons.view.rhythm import Rhythm
from tests.tables import table

S = 1_000_000_000


def at(*seconds: float) -> np.ndarray:
    return np.array([round((1000 + each) * S) for each in seconds])


REGULAR = [number / 50 for number in range(100)]


@table(
    ("seconds", "gaps"),
    [
        ([*REGULAR, *(each + 10 for each in REGULAR)], [100]),  # eight seconds
        (range(20), []),
        ([*range(20), *range(28, 40)], [20]),
        ([*REGULAR, 5.0, 9.0, *(each + 12 for each in REGULAR)], [100, 101, 102]),
        ([0, 60, 61], []),  # too few to know
        ([*REGULAR, 2.4], []),  # half a second is short
        ([number * 10 for number in range(9)], []),
    ],
)
def test_where_a_line_breaks(seconds: list[float], gaps: list[int]) -> None:
    stamps = at(*seconds)
    assert Rhythm().gaps(stamps) == gaps
    one_by_one, found = Rhythm(), []
    for number, stamp in enumerate(stamps):
        found += [number] * len(one_by_one.gaps(np.array([stamp])))
    assert found == gaps
    in_parts = Rhythm()
    half = len(stamps) // 2
    assert in_parts.gaps(stamps[:half]) + [half + each for each in in_parts.gaps(stamps[half:])] == gaps


def test_lines_of_one_plot_have_different_colours() -> None:
    words = [line_colour(number) for number in range(32)]
    places = np.array([[word >> shift & 0xFF for shift in (24, 16, 8)] for word in words], float)
    apart = np.abs(places[:, None] - places[None]).sum(axis=2) + 1e9 * np.eye(len(words))
    assert apart[:16, :16].min() > 70 and apart.min() > 25
    assert all(word & 0xFF == 0xFF for word in words)

"""The rule by which streams are joined, against a search over all samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.log.joining import Rule, pick

TIMES = st.lists(st.integers(0, 200), max_size=12).map(sorted)
BASE = 1_700_000_000 * 10**9  # more than float64 holds in ns


def arrays(*lists: list[int]) -> list[Any]:
    return [np.array(each, np.int64) + BASE for each in lists]


@given(TIMES, st.lists(st.integers(-50, 250), min_size=1, max_size=8), st.none() | st.integers(0, 60),
       st.none() | st.integers(0, 60), st.sampled_from(["nearest", "hold", "interpolate"]), st.data())  # fmt: skip
def test_no_sample_is_further_than_stated_and_none_is_nearer(
    times: list[int], wanted: list[int], most: int | None, gap: int | None, rule: Rule, data: st.DataObject
) -> None:
    segments = data.draw(st.lists(st.integers(0, 1), min_size=len(times), max_size=len(times)))
    at, moments = arrays(times, wanted)
    found = pick(at, moments, rule, most_ns=most, gap_ns=gap, segments=np.array(segments, np.int64))
    far = 10**9 if most is None else most
    for row, moment in enumerate(wanted):
        before = [each for each in times if each <= moment]
        after = [each for each in times if each >= moment]
        one, two, share = int(found.before[row]), int(found.after[row]), float(found.share[row])
        good = bool(found.good[row])
        if rule == "hold":
            assert good == (bool(before) and moment - before[-1] <= far)
            assert not good or (times[one], one, share) == (before[-1], len(before) - 1, 0.0)
        elif rule == "nearest":
            distance = min((abs(moment - each) for each in times), default=10**9 + 1)
            assert good == (distance <= far)
            assert not good or (abs(times[one] - moment) == distance and one == two and share == 0.0)
            # of two at one distance, the earlier one
            assert not good or moment - distance not in times or times[one] == moment - distance
        elif moment in times:
            assert good and times[one] == moment and share == 0.0
        else:
            near = bool(before) and bool(after) and max(moment - before[-1], after[0] - moment) <= far
            near = near and after[0] - before[-1] <= (10**9 if gap is None else gap)
            near = near and segments[len(before) - 1] == segments[len(before)]
            assert good == near
            if good:
                assert (one, two) == (len(before) - 1, len(before))
                assert times[one] + share * (times[two] - times[one]) == pytest.approx(moment)


def test_the_ends_stand_for_moments_that_are_near() -> None:
    times, wanted = arrays([100, 200], [97, 98, 150, 202, 203])
    found = pick(times, wanted, "interpolate", end_ns=2)
    assert found.good.tolist() == [False, True, True, True, False]
    assert (found.before[[1, 3]].tolist(), found.share[[1, 3]].tolist()) == ([0, 1], [0.0, 0.0])


def test_a_stream_without_samples_has_nothing() -> None:
    times, wanted = arrays([], [1, 2])
    rules: tuple[Rule, ...] = ("nearest", "hold", "interpolate")
    for rule in rules:
        found = pick(times, wanted, rule)
        assert not found.good.any() and len(found.before) == len(found.share) == 2


def test_of_two_samples_at_one_distance_the_earlier_one_counts() -> None:
    times, wanted = arrays([100, 200], [149, 150, 151])
    found = pick(times, wanted, "nearest", most_ns=50)
    assert (found.before.tolist(), found.good.tolist()) == ([0, 0, 1], [True] * 3)
    assert not pick(times, wanted, "nearest", most_ns=49).good[1]


def test_between_two_samples_includes_both() -> None:
    times, wanted = arrays([10, 20, 30], [9, 10, 15, 30, 31])
    picks = pick(times, wanted, "interpolate")
    assert picks.good.tolist() == [False, True, True, True, False]
    assert pick(times, wanted, "interpolate", end_ns=1).good.tolist() == [True] * 5

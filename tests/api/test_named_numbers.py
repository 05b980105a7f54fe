"""Numbers go by the names in their message: any order, any part, and nothing is invented."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.api.named_numbers import NamedNumbers, by_name, completed

NEVER = (1 << 62) - 1
NAMES = tuple("abcdefg")


def found_in(names: list[list[str]], values: list[list[float]]) -> NamedNumbers:
    found = by_name(names, values)
    assert found is not None
    return found


@given(st.lists(st.lists(st.sampled_from(NAMES), unique=True, min_size=1), min_size=1, max_size=8))
def test_each_value_is_of_its_name(names: list[list[str]]) -> None:
    values = [[100.0 * row + ord(name) for name in own] for row, own in enumerate(names)]
    found = found_in(names, values)
    assert set(found.names) == {name for own in names for name in own} and found.unclear == 0
    for row, own in enumerate(names):
        for column, name in enumerate(found.names):
            assert found.known[row, column] == (name in own)
            if name in own:
                assert found.values[row, column] == 100.0 * row + ord(name)
            else:
                assert np.isnan(found.values[row, column])


@given(
    st.lists(st.lists(st.sampled_from(NAMES), unique=True, min_size=1), min_size=1, max_size=12),
    st.sampled_from(["hold", "nearest", "interpolate"]),
    st.randoms(use_true_random=False),
    st.integers(1, 50),
)
def test_what_is_missing_is_that_of_the_rule(names: list[list[str]], rule: str, random: object, most: int) -> None:
    times = np.array(random.sample(range(200), len(names)), np.int64)  # type: ignore[attr-defined]
    values = [[float(times[row]) * (ord(name) - 96) for name in own] for row, own in enumerate(names)]
    found = found_in(names, values)
    result = completed(found, times, rule, most)
    for column, name in enumerate(found.names):
        known = sorted(int(times[row]) for row, own in enumerate(names) if name in own)
        for row, at in enumerate(times.tolist()):
            before = max((one for one in known if one <= at), default=None)
            after = min((one for one in known if one >= at), default=None)
            near = [one for one in (before, after) if one is not None and abs(one - at) <= most]
            expected: set[float] = set()
            if at in known:
                expected = {float(at)}
            elif rule == "hold" and before is not None and at - before <= most:
                expected = {float(before)}
            elif rule == "nearest" and near:
                expected = {float(one) for one in near if abs(one - at) == min(abs(each - at) for each in near)}
            elif rule == "interpolate" and before is not None and after is not None and after - before <= most:
                expected = {float(at)}  # the values are a line over time
            value = result[row, column] / (ord(name) - 96)
            assert np.isnan(value) if not expected else any(value == pytest.approx(one) for one in expected)


def test_names_that_are_not_clear_have_no_values() -> None:
    found = found_in([["a", "a"], ["a", "b"], ["a"], [], ["b", "a"]], [[1, 2], [1, 2], [1, 2], [7, 8], [20, 10]])
    assert (found.names, found.unclear, found.orders) == (("a", "b"), 3, 2)
    np.testing.assert_array_equal(found.values[[1, 4]], [[1, 2], [10, 20]])
    assert np.isnan(found.values[[0, 2, 3]]).all() and not found.known[[0, 2, 3]].any()
    assert by_name([[], None], [[1.0], [2.0]]) is None
    assert by_name([["a"], ["b"]], [[], None]) is None


def test_a_value_that_is_no_number_is_not_replaced() -> None:
    found = found_in([["a"], ["a"], ["b"]], [[1.0], [float("nan")], [5.0]])
    result = completed(found, np.array([1, 2, 3]), "hold", NEVER)
    assert np.isnan(result[1, 0]) and np.isnan(result[2, 0]), "the last value is not finite"
    assert np.isnan(result[0, 1])


def test_of_two_values_at_one_distance_the_earlier_one_counts() -> None:
    found = found_in([["a"], ["b"], ["a"]], [[1.0], [7.0], [3.0]])
    assert completed(found, np.array([10, 20, 30]), "nearest", 10)[1, 0] == 1.0
    assert completed(found, np.array([10, 21, 30]), "nearest", 10)[1, 0] == 3.0
    assert np.isnan(completed(found, np.array([10, 20, 30]), "nearest", 9)[1, 0])

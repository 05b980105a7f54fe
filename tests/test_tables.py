"""The helper for tables: a row that fails is named, and hides no other."""

from __future__ import annotations

import pytest

from tests.tables import all_hold


def half(number: int) -> None:
    assert number % 2 == 0, f"found {number}, expected an even number"
    if number == 6:
        pytest.fail("six")
    if number == 8:
        raise ValueError("eight")


def test_rows_that_hold() -> None:
    all_hold([2, 4], half)
    all_hold({"two": 2}, half)


def test_every_row_that_fails_is_named_with_its_reason() -> None:
    with pytest.raises(pytest.fail.Exception) as caught:
        all_hold({"one": 1, "two": 2, "three": 3, "six": 6, "eight": 8}, half)
    text = str(caught.value)
    assert text.startswith("4 of 5 rows fail:")
    for line in ("--- one\n", "found 1, expected an even number", "--- three\n", "--- six\n", "ValueError: eight"):
        assert line in text
    assert "--- two" not in text
    assert "test_tables.py" in text and "in half" in text


def test_very_many_failures_are_counted() -> None:
    with pytest.raises(pytest.fail.Exception, match=r"50 of 50 rows fail(.|\n)*and 30 more"):
        all_hold(range(1, 100, 2), half)


def test_a_table_without_rows_is_a_failure() -> None:
    with pytest.raises(AssertionError, match="a table without rows"):
        all_hold([], half)

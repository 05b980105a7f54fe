"""The helper for tables: a row that fails is named, and hides no other."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.tables import all_hold, table


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


def test_rows_that_are_skipped_hide_no_other() -> None:
    def check(number: int) -> None:
        if number < 3:
            pytest.skip("too small")
        assert number != 4

    with pytest.raises(pytest.skip.Exception, match="too small"):
        all_hold([1, 2], check)
    with pytest.raises(pytest.fail.Exception, match=r"1 of 3 rows fail:\n--- 4"):
        all_hold([1, 3, 4], check)
    all_hold([1, 3], check)


def test_a_table_without_rows_is_a_failure() -> None:
    with pytest.raises(AssertionError, match="a table without rows"):
        all_hold([], half)


# -- instead of parametrize --------------------------------------------------------------------------------------------

seen: list[tuple[int, str]] = []


@table("number", [2, 4])
@table(("text", "length"), [("a", 1), ("bc", 2)])
def test_every_row_with_every_row(number: int, text: str, length: int) -> None:
    seen.append((number, text))
    assert len(text) == length


def test_all_of_them_were_called() -> None:
    assert sorted(seen) == [(2, "a"), (2, "bc"), (4, "a"), (4, "bc")]


@table("name", ["a", "b"])
def test_a_row_has_fixtures_of_its_own(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch(exist_ok=False)
    assert "ROW" not in os.environ
    monkeypatch.setenv("ROW", name)
    assert capsys.readouterr().out == ""
    sys.stdout.write(name)


def test_rows_are_named_by_their_values_or_by_ids() -> None:
    def check(number: int, text: str) -> None:
        pytest.fail(f"{number} {text}")

    rows = [(1, "a"), (1, "a"), (2, "b" * 100)]
    with pytest.raises(pytest.fail.Exception) as caught:
        table("number, text", rows)(check)()
    text = str(caught.value)
    assert "--- 1-'a'\n" in text and "--- 1-'a' (row 1)\n" in text and "--- 2-'bbb" in text and "…\n" in text
    with pytest.raises(pytest.fail.Exception, match="--- one\n"):
        table("number, text", rows[:1], ids=["one"])(check)()
    with pytest.raises(pytest.fail.Exception, match="--- <1>-<a>\n"):
        table("number, text", rows[:1], ids=lambda value: f"<{value}>")(check)()


def test_rows_of_pytest_keep_their_ids() -> None:
    with pytest.raises(pytest.fail.Exception, match="--- one\n"):
        table("number, text", [pytest.param(1, "a", id="one")])(lambda number, text: pytest.fail(f"{number} {text}"))()
    with pytest.raises(AssertionError, match="a row with marks"):
        table("number", [pytest.param(1, marks=pytest.mark.slow)])


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="argument 2"):
        table("number, text", [(1, "a", 2)])


@table("number", [1, 2, 3, 4], gate=lambda number: number > 2)
def test_the_gate_has_some_rows(number: int, request: pytest.FixtureRequest) -> None:
    """The other test has the rest, and the marks of the third tier."""
    is_long = request.node.get_closest_marker("long") is not None
    assert (number <= 2) == is_long == (request.node.get_closest_marker("slow") is not None)
    assert request.node.name.endswith("[rest]" if is_long else "[gate]")


def test_a_gate_of_all_rows_or_of_none_is_a_mistake() -> None:
    for chosen in (True, False):
        with pytest.raises(AssertionError, match="expected some and not all"):
            table("number", [1, 2], gate=lambda number, chosen=chosen: chosen)(half)

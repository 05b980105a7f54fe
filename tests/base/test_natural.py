"""Numbers in names are sorted by their value."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.natural import natural


def test_numbers_are_sorted_by_their_value() -> None:
    names = ["P10", "P2", "P1", "Probe", "P2b", "a/9", "a/10", "", "10", "9"]
    assert sorted(names, key=natural) == ["", "9", "10", "P1", "P2", "P2b", "P10", "Probe", "a/9", "a/10"]


@given(st.text(), st.text())
def test_any_names_have_an_order(one: str, other: str) -> None:
    assert (natural(one) < natural(other)) + (natural(other) < natural(one)) <= 1
    assert natural(one) == natural(one)

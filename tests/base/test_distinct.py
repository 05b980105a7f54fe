"""Names under which several things are written: all different, also where case does not count."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.distinct import distinct_names, numbered


def plain(name: str) -> str:
    return name.replace(" ", "")


_names = st.text(alphabet="aAbB 12", max_size=4)


@given(st.dictionaries(st.integers(0, 9), _names), st.lists(_names, max_size=3))
def test_all_are_different_also_where_case_does_not_count(names: dict[int, str], taken: list[str]) -> None:
    found = distinct_names(names, plain, taken)
    assert list(found) == list(names)
    written = [name.casefold() for name in found.values()]
    assert len(set(written)) == len(written)
    assert not set(written) & {name.casefold() for name in taken}
    for key, name in found.items():
        assert name.startswith(plain(names[key]))
        same = [other for other in names if names[other].casefold() == names[key].casefold()]
        if plain(names[key]) == names[key] and same == [key] and names[key].casefold() not in map(str.casefold, taken):
            assert name == names[key], "who has the name keeps it"


def test_who_has_the_name_keeps_it_whatever_comes_first() -> None:
    assert distinct_names({1: "Tool A", 2: "ToolA"}, plain) == {1: "ToolA2", 2: "ToolA"}
    assert distinct_names({1: "Tool A", 2: "To olA", 3: "toola"}, plain) == {1: "ToolA2", 2: "ToolA3", 3: "toola"}


def test_of_equal_names_the_first_keeps_it() -> None:
    assert distinct_names({"x": "a", "y": "a", "z": "A"}, plain) == {"x": "a", "y": "a2", "z": "A3"}


def test_a_number_that_is_taken_is_passed_over() -> None:
    assert distinct_names({1: "a", 2: "a", 3: "a2"}, plain) == {1: "a", 2: "a3", 3: "a2"}
    assert distinct_names({1: "a"}, plain, ["A", "a2"]) == {1: "a3"}


def test_other_ways_to_write_a_number() -> None:
    assert numbered("a", 2) == "a2"
    found = distinct_names({1: "a", 2: "a"}, plain, other=lambda name, number: f"{name}_{number:03}")
    assert found == {1: "a", 2: "a_002"}
    assert distinct_names({}, plain) == {}

"""What is forgotten of latched messages: as little as possible, the largest first."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.kept import beyond, forgotten_text, largest_first
from tests.tables import table


def size(item: tuple[str, int]) -> int:
    return item[1]


_items = st.lists(st.integers(0, 20)).map(lambda sizes: [(str(number), each) for number, each in enumerate(sizes)])


@given(_items, st.integers(0, 60))
def test_the_others_are_within_the_room(items: list[tuple[str, int]], room: int) -> None:
    found = beyond(room, items, size)
    rest = [item for item in items if item not in found]
    assert sum(map(size, rest)) <= room
    if found:
        assert sum(map(size, rest)) + size(found[-1]) > room, "no more than necessary"
    alone = [item for item in items if size(item) > room]
    assert found[: len(alone)] == alone, "those that alone exceed it go first"
    assert found[len(alone) :] == [item for item in items if item not in alone][: len(found) - len(alone)]


@table(
    ("room", "sizes", "gone"),
    [
        (10, [5, 5], []),
        (10, [5, 6], [5]),
        (10, [3, 20, 4], [20]),
        (10, [6, 20, 6], [20, 6]),
        (0, [0, 1], [1]),
        (None, [10**12], []),
        (10, [], []),
    ],
)
def test_what_goes(room: int | None, sizes: list[int], gone: list[int]) -> None:
    assert beyond(room, sizes, lambda each: each) == gone


def test_the_largest_first_and_equal_ones_in_their_order() -> None:
    items = [("a", 1), ("b", 5), ("c", 5), ("d", 3)]
    assert largest_first(items, size) == [("b", 5), ("c", 5), ("d", 3), ("a", 1)]


def test_the_note_has_both_sizes() -> None:
    assert forgotten_text("/map", 3 << 19, 64 << 20) == (
        "/map: 1.5 MiB of latched messages are forgotten, who joins gets none before the next: "
        "those of all topics exceed 64 MiB (latched_mib)"
    )
    assert "1,024.0 MiB" in forgotten_text("/map", 1 << 30, 1)

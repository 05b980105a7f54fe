"""Streams of several peers in turn, message by message and by columns."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.log.interleaving import Interleaving, is_mixed
from tests.tables import table

CASES = [
    ([], False),
    ([1], False),
    ([1, 1, 1], False),
    ([1, 1, 2, 2, 3], False),  # a peer that connects again
    ([1, 2, 1], True),
    ([1, 1, 2, 2, 1], True),
    ([1, 2, 3, 2], True),
    ([0, 0], False),
]


@table(("links", "mixed"), CASES)
def test_a_link_that_comes_again_after_another(links: list[int], mixed: bool) -> None:
    one = Interleaving()
    for link in links:
        one.add((link, 99))  # of several links, the first counts
    assert one.is_mixed == mixed == is_mixed(np.array(links, np.int64))
    assert one.links == set(links) - {0}


@given(st.lists(st.integers(1, 4)))
def test_columns_and_messages_agree(links: list[int]) -> None:
    one = Interleaving()
    for link in links:
        one.add((link,))
    assert one.is_mixed == is_mixed(np.array(links, np.int64))
    again = any(
        a == c and b != a for at, a in enumerate(links) for by, b in enumerate(links[at:], at) for c in links[by:]
    )
    assert one.is_mixed == again


def test_a_message_without_links_is_of_link_0() -> None:
    one = Interleaving()
    for links in ((), (5,), ()):
        one.add(links)
    assert one.links == {0, 5}


def test_a_stream_that_was_mixed_stays_so() -> None:
    one = Interleaving()
    for link in (1, 2, 1, 1, 1, 1):
        one.add((link,))
    assert one.is_mixed

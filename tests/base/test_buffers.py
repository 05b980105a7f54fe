"""Buffers as one: equal to a plain join, whatever their types, numbers and sizes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import MANY_BYTES, Buffer, join, join_in_steps, total_size
from tests.tables import table

_kinds = st.sampled_from([bytes, bytearray, memoryview])
_buffers = st.lists(st.tuples(_kinds, st.binary(max_size=30)).map(lambda pair: pair[0](pair[1])), max_size=6)


@given(_buffers)
def test_buffers_of_any_type_are_joined_and_measured(buffers: list[Buffer]) -> None:
    expected = b"".join(bytes(buffer) for buffer in buffers)
    for joined in (join(buffers), join_in_steps(buffers)):
        assert joined == expected and type(joined) is bytes
    assert total_size(buffers) == len(expected)


def test_one_object_of_bytes_is_not_copied() -> None:
    one = b"abc"
    assert join([one]) is one
    assert join([bytearray(one)]) == one and join([]) == b""


def test_sizes_are_of_bytes_also_of_views_of_numbers() -> None:
    numbers = np.arange(6, dtype=np.int32).reshape(2, 3).data
    assert total_size([numbers]) == total_size([numbers.cast("B")]) == 24
    assert join_in_steps([numbers, b"x"]) == np.arange(6, dtype=np.int32).tobytes() + b"x"
    empty = np.zeros((0, 3), np.int32).data
    assert total_size([empty]) == 0 and join_in_steps([empty, b"x"]) == b"x"


@table("size", [1 << 10, (1 << 10) + 1, 512 << 10, (512 << 10) + 1, MANY_BYTES - 1, MANY_BYTES, MANY_BYTES + 3])
def test_sizes_at_the_edges_of_the_steps(size: int) -> None:
    data = bytes(range(256)) * (size // 256 + 1)
    cases: list[list[Buffer]] = [[data[:size], b"end"], [b"begin", memoryview(data)[:size]], [bytearray(data[:size])]]
    for parts in cases:
        assert join(parts) == b"".join(parts) == join_in_steps(parts)


@pytest.mark.parametrize("count", [1023, 1024, 1025, 5000])
def test_many_small_buffers_stay_in_order(count: int) -> None:
    parts: list[Buffer] = [number.to_bytes(4, "big") for number in range(count)]
    parts[count // 2] = memoryview(b"large" * 1000)
    assert join_in_steps(parts) == b"".join(parts)

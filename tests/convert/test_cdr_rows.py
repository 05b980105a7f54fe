"""Many messages read at once: the numbers of each, and the bytes that all share."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.convert.cdr_rows import CdrRows
from igtl_gateway.convert.rosmsg import Header, TransformStamped


def tool(number: int) -> TransformStamped:
    place = (number / 1000, number / 9, 0.1)
    return TransformStamped(
        Header(1_767_225_600_000_000_007 * bool(number % 4) + number, "base"), "tool", place, (0.0, 0.0, 0.6, 0.8)
    )


@pytest.mark.parametrize("big_endian", [False, True])
def test_columns_are_the_numbers_of_the_messages(*, big_endian: bool) -> None:
    messages = [tool(number).pack() for number in range(5)]
    if big_endian:
        messages = [swapped(each) for each in messages]
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(5, -1)
    fixed = np.zeros(rows.shape[1], np.bool_)
    found = TransformStamped.read(CdrRows(rows, TransformStamped.TYPE, fixed))
    one_by_one = [TransformStamped.unpack(each) for each in messages]
    assert found.header.stamp_ns.tolist() == [each.header.stamp_ns for each in one_by_one]  # type: ignore[attr-defined]
    assert np.array(found.rotation).T.tolist() == [list(each.rotation) for each in one_by_one]
    assert found.child_frame_id == "tool"
    assert not fixed[4:12].any()
    assert fixed[:4].all()
    assert fixed[12:20].all()
    assert not fixed[-56:].any()


def swapped(cdr: bytes) -> bytes:
    """A TransformStamped in the other byte order."""
    out = bytearray(cdr)
    out[1] = 0
    for begin, size in [(4, 4), (8, 4), (12, 4), (24, 4), *((len(cdr) - 56 + 8 * each, 8) for each in range(7))]:
        out[begin : begin + size] = out[begin : begin + size][::-1]
    return bytes(out)

"""What an index holds, and the bounds that follow from the size of a file."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, work_of
from igtl_gateway.record.sessionfile.records import SCHEMA
from tools import mcap_build as build


def test_channels_and_message_indexes_of_a_chunk() -> None:
    chunk = ChunkEntry(0, 0, 8, 100, 200, bytes.fromhex("0100 6c00000000000000 0300 8000000000000000"))
    assert chunk.channels == [1, 3]
    assert chunk.message_indexes == {1: 0x6C, 3: 0x80}


def test_a_definition_is_kept_up_to_what_is_parsed() -> None:
    index = Index(0)
    index.define(SCHEMA, build.schema(1, "a/msg/A", "ros2msg", b"x" * 2_000_000))
    assert len(index.schemas[1].data) == 4 * limits.current_limits().definition + 1


def test_work_is_bounded_by_the_limit_of_time() -> None:
    chunk = ChunkEntry(0, 0, 8, 100, 1 << 29)
    with limits.limits_in_force(limits.FileLimits()):
        check_work(1000, work_of([chunk] * 3), "a")
        with pytest.raises(LimitExceeded, match="a: found 5368709120 bytes unpacked"):
            check_work(1000, work_of([chunk] * 10), "a")


@pytest.mark.parametrize(("size", "seconds"), [(0, 20), (999_999, 20), (1_000_000, 21), (5_500_000, 25)])
def test_the_bound_of_the_work_is_a_hundred_megabytes_a_second(size: int, seconds: int) -> None:
    """Of the limit, and of what each whole megabyte of the file adds to it."""
    with limits.limits_in_force(limits.FileLimits(seconds=20, seconds_per_mb=1)):
        check_work(size, seconds * 100_000_000, "a")
        with pytest.raises(LimitExceeded, match=f"expected at most {seconds}00000000 bytes"):
            check_work(size, seconds * 100_000_000 + 1, "a")

"""Numbering and accounts."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, numbered
from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.gateway.log.entry import Kind
from tests.files import CAPTURES
from tests.tables import table


def test_entries_strictly_increase() -> None:
    items = [ImportedItem(time_ns, Kind.ROS_IN, b"", "/a", "std_msgs/msg/Empty") for time_ns in (5, 5, 3, 9, 9)]
    assert [(entry.seq, entry.stamp_ns) for entry in numbered(items)] == [(1, 5), (2, 6), (3, 7), (4, 9), (5, 10)]


def test_all_that_is_declared_has_to_be_accounted_for() -> None:
    assert ImportedStream("a", 5, taken=3, left_out=2).good
    assert not ImportedStream("a", 5, taken=3, left_out=1).good
    assert not ImportedStream("a", 5, taken=6).good


@table("name, size", [("a.pcap", 24), ("a.igtl", 58)])
def test_the_holes_of_a_sparse_file_give_no_time(name: str, size: int, tmp_path: Path) -> None:
    """A terabyte of zeros, of which the disk has 4 kB, was read for days."""
    whole = min(CAPTURES.rglob(f"*{Path(name).suffix}"))
    with (tmp_path / name).open("wb") as file:
        file.write(whole.read_bytes()[:size])
        file.truncate(1 << 40)
    with (
        limits_in_force(FileLimits(seconds=1)),
        closing(open_source(tmp_path / name, None)) as source,
        pytest.raises(LimitExceeded, match="expected at most 1 s"),
    ):
        for _ in source.items():
            pass

"""Numbering and accounts."""

from __future__ import annotations

from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, numbered
from igtl_gateway.gateway.log.entry import Kind


def test_entries_strictly_increase() -> None:
    items = [ImportedItem(time_ns, Kind.ROS_IN, b"", "/a", "std_msgs/msg/Empty") for time_ns in (5, 5, 3, 9, 9)]
    assert [(entry.seq, entry.stamp_ns) for entry in numbered(items)] == [(1, 5), (2, 6), (3, 7), (4, 9), (5, 10)]


def test_all_that_is_declared_has_to_be_accounted_for() -> None:
    assert ImportedStream("a", 5, taken=3, left_out=2).good
    assert not ImportedStream("a", 5, taken=3, left_out=1).good
    assert not ImportedStream("a", 5, taken=6).good

"""How much of what is measured, before anything runs; real runs are in tests/cli/test_bench.py."""

from __future__ import annotations

from igtl_gateway_lab.bench.cases import FLOOD, BenchStream
from igtl_gateway_lab.bench.runner import Extent, warm


def test_messages_of_a_stream() -> None:
    assert Extent(seconds=10.0).messages(BenchStream("transform", 30.0)) == 300
    assert Extent(seconds=0.01).messages(BenchStream("transform", 30.0)) == 1
    assert Extent(seconds=10.0, count=50).messages(BenchStream("transform", 30.0)) == 50
    assert Extent(seconds=10.0).messages(BenchStream("transform", FLOOD)) == 0  # as many as go into the time


def test_what_warms_up() -> None:
    assert [warm(BenchStream("transform", rate)) for rate in (1.0, 30.0, 5000.0, FLOOD)] == [1, 15, 200, 20]

"""Clocks of several recorders: chains of offsets, the way with the narrowest interval, and what is stated of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from igtl_gateway.addons.merge.clock_graph import Clock, clocks_of, latency_facts
from igtl_gateway.addons.merge.offsets import ClockOffset, Piece
from igtl_gateway.record.sessionfile.merged import Method
from tests.tables import table

START_NS, SECOND = 1_700_000_000_000_000_000, 1_000_000_000


def offset(ns: int, low: float = 0.0, high: float = 0.0, method: Method = Method.BOTH_WAYS) -> ClockOffset:
    return ClockOffset(method, (Piece(START_NS, ns),), low, high)


def test_times_go_through_the_whole_chain() -> None:
    drifting = ClockOffset(Method.BOTH_WAYS, (Piece(START_NS, 500, 100.0),))
    clock = Clock((offset(2 * SECOND), drifting), ("b",))
    times = np.array([START_NS + 2 * SECOND, START_NS + 12 * SECOND], np.int64)
    expected = [START_NS - 500, START_NS + 10 * SECOND - 500 - 1_000]
    assert clock.all_to_reference(times).tolist() == expected
    assert [clock.to_reference(int(each)) for each in times] == expected
    assert Clock().to_reference(5) == 5


def test_what_is_stated_of_a_clock() -> None:
    one = ClockOffset(Method.BOTH_WAYS, (Piece(START_NS, 2 * SECOND, 1_500.0),), 3e6, 4e6, 1.0, 2.0)
    assert Clock((one,)).facts(START_NS) == {
        "offset_s": 2.0, "low_s": 1.997, "high_s": 2.004, "method": "both_ways", "via": [], "drift_ppm": 1.5,
        "drift_low_ppm": 1.0, "drift_high_ppm": 2.0, "is_drifting": True, "chain": [[[START_NS, 2 * SECOND, 1_500.0]]],
    }  # fmt: skip
    bound = Clock((one, offset(SECOND, math.inf, 1e6, Method.ONE_WAY)), ("b",))
    facts = bound.facts(START_NS)
    assert (facts["low_s"], facts["method"], facts["via"], facts["drift_ppm"]) == (None, "one_way", ["b"], None)
    assert facts["high_s"] == facts["offset_s"] + 0.005
    two = ClockOffset(Method.BOTH_WAYS, (Piece(START_NS, 0), Piece(START_NS + 5, 7)))
    assert Clock((two,)).facts(START_NS)["drift_ppm"] is None and not Clock((two,)).facts(START_NS)["is_drifting"]
    reference = Clock().facts(START_NS)
    assert (reference["method"], reference["offset_s"], reference["chain"]) == ("reference", 0.0, [])


#: Edges, by (one, other) → (offset, width), and the chain of offsets of "c".
GRAPHS: dict[str, tuple[Mapping[tuple[str, str], tuple[int, float]], list[int] | None, tuple[str, ...]]] = {
    "directly": ({("c", "a"): (5, 10)}, [5], ()),
    "the narrow way": ({("c", "a"): (5, 100), ("c", "b"): (2, 10), ("b", "a"): (3, 10)}, [2, 3], ("b",)),
    "the wide way": ({("c", "a"): (5, 15), ("c", "b"): (2, 10), ("b", "a"): (3, 10)}, [5], ()),
    "of equal ways the one with less parts": ({("c", "a"): (5, 20), ("c", "b"): (2, 10), ("b", "a"): (3, 10)}, [5], ()),
    "a bound is the last choice": (
        {("c", "a"): (5, math.inf), ("c", "b"): (2, 1e12), ("b", "a"): (3, 1e12)}, [2, 3], ("b",)
    ),
    "not joined": ({("b", "a"): (3, 10)}, None, ()),
    "in the other direction only": ({("a", "c"): (5, 10)}, None, ()),
}  # fmt: skip


@table("name", GRAPHS)
def test_each_clock_is_joined_on_the_best_way(name: str) -> None:
    edges, chain, via = GRAPHS[name]
    found = clocks_of("abc", {pair: Clock((offset(ns, width / 2, width / 2),)) for pair, (ns, width) in edges.items()})
    assert found["a"] == Clock()
    if chain is None:
        assert "c" not in found
        return
    assert [each.pieces[0].offset_ns for each in found["c"].chain] == chain
    assert found["c"].via == via


def test_a_chain_of_a_merged_session_keeps_its_parts() -> None:
    """An edge may be a chain itself, and names the parts between."""
    edges = {("c", "b"): Clock((offset(1), offset(2)), ("x",)), ("b", "a"): Clock((offset(3),))}
    clock = clocks_of("abc", edges)["c"]
    assert ([each.pieces[0].offset_ns for each in clock.chain], clock.via) == ([1, 2, 3], ("x", "b"))


@table(
    ("times", "expected"),
    [
        ([], {"messages": 0, "min_ms": None, "p50_ms": None, "p99_ms": None}),
        ([2_000_000], {"messages": 1, "min_ms": 2.0, "p50_ms": 2.0, "p99_ms": 2.0}),
        ([3e6, 1e6, 2e6, 4e6], {"messages": 4, "min_ms": 1.0, "p50_ms": 3.0, "p99_ms": 4.0}),
        ([1e6 * each for each in range(1, 201)], {"messages": 200, "min_ms": 1.0, "p50_ms": 101.0, "p99_ms": 199.0}),
    ],
)
def test_latencies_in_milliseconds(times: list[float], expected: dict[str, Any]) -> None:
    assert latency_facts(np.array(times, np.int64)) == expected

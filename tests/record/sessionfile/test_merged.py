"""What a merged session states about itself: facts that are refused by place, and the clocks of its parts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.sessionfile.merged import MERGE_KEY, Merge, offset_of_part, parse_merge
from tests.tables import table

S = 10**9
CLOCK = {"offset_s": 0.5, "low_s": None, "high_s": 1, "drift_ppm": 0.0, "method": "both_ways", "via": ["a"]}
PART = {
    "name": "a_1", "file": "a.mcap", "sha256": "", "digest": "", "profile": "", "library": "", "session": {"x": "y"},
    "ledger": {}, "messages": 3, "sealed_by": [], "clock": CLOCK,
}  # fmt: skip
LATENCY = {
    "from": "a",
    "to": "b",
    "stream": "s",
    "messages": 1,
    "min_ms": 1,
    "p50_ms": None,
    "p99_ms": 2.5,
    "error_ms": 0,
}
FACTS: dict[str, Any] = {"parts": [PART], "latencies": [LATENCY], "left_out": []}


def parsed(facts: object) -> Merge:
    return parse_merge({MERGE_KEY: json.dumps(facts)}, "m.mcap")


def test_what_is_stated_is_kept() -> None:
    merge = parsed(FACTS)
    assert (merge.names, merge.reported, merge.shared_topics) == (["a_1"], [], {})
    merge = parsed(FACTS | {"reported": ["slow"], "shared_topics": {"/tf": "TRANSFORM/A of a"}})
    assert (merge.reported, merge.shared_topics) == (["slow"], {"/tf": "TRANSFORM/A of a"})


@table(
    "change, place",
    [
        ({"parts": None}, "parts"),
        ({"left_out": [1]}, "left_out"),
        ({"reported": "x"}, "reported"),
        ({"shared_topics": {"/tf": 1}}, "shared_topics"),
        *(({"parts": [PART | {name: value}]}, name) for name, value in (
            ("name", "a/b"), ("name", ""), ("name", 1), ("file", None), ("messages", -1), ("messages", "3"),
            ("sealed_by", [1]), ("session", {"x": 1}), ("ledger", []),
        )),
        *(({"parts": [PART | {"clock": CLOCK | {name: value}}]}, name) for name, value in (
            ("offset_s", "0"), ("low_s", True), ("drift_ppm", float("inf")), ("method", "guess"), ("via", "a"),
        )),
        *(({"latencies": [LATENCY | {name: value}]}, name) for name, value in (
            ("from", 1), ("to", None), ("stream", []), ("messages", 1.5), ("p99_ms", float("nan")), ("error_ms", "0"),
        )),
    ],
)  # fmt: skip
def test_other_facts_are_refused_by_place(change: dict[str, Any], place: str) -> None:
    with pytest.raises(DamagedRecording, match=r"m\.mcap") as found:
        parsed(FACTS | change)
    assert place in str(found.value) or "NaN" in str(found.value) or "Infinity" in str(found.value)


@pytest.mark.parametrize("name", sorted(FACTS))
def test_what_lacks_is_named(name: str) -> None:
    with pytest.raises(DamagedRecording, match=name):
        parsed({key: value for key, value in FACTS.items() if key != name})


def offsets(chain: object, times: list[int]) -> list[int] | None:
    offset = offset_of_part(PART | {"clock": CLOCK | {"chain": chain}})
    return None if offset is None else offset(np.array(times, np.int64)).tolist()


@table(
    "chain, times, expected",
    [
        ([], [0], None),
        ([[[0, 0, 0.0]]], [0], None),
        ([[[0, 5 * S, 0.0]]], [0, 100 * S], [5 * S, 5 * S]),
        ([[[0, 5 * S, 0.0]], [[0, -2 * S, 0.0]]], [0, 100 * S], [3 * S, 3 * S]),
        ([[[0, 1 * S, 0.0], [50 * S, 2 * S, 0.0]]], [0, 40 * S, 60 * S], [S, S, 2 * S]),
        ([[[0, 0, 1000.0]]], [0, 1000 * S], [0, 1_000_001]),  # 1 ppm of the part's own time
    ],
)
def test_the_offset_of_a_part(chain: object, times: list[int], expected: list[int] | None) -> None:
    assert offsets(chain, times) == expected


@table(
    "chain, words",
    [
        ([[[0, 1 << 70, 0.0]]], "found numbers out of range, expected lines"),
        ([[[1 << 70, 1, 0.0]]], "found numbers out of range, expected lines"),
        ([[[0, 1, 1e18]]], "found numbers out of range, expected lines"),
        ([[[0, 1]]], "chain: "),
        ([[["a", 1, 0.0]]], "chain: "),
        (5, "chain: "),
    ],
)
def test_a_chain_of_anything_is_refused(chain: object, words: str) -> None:
    with pytest.raises(DamagedRecording, match="part a_1: clock: chain: ") as found:
        offsets(chain, [0])
    assert words in str(found.value)

"""Corpus, vectors and our own files through ``igtl-gateway decode -o``; ``-rP`` or ``-s`` shows the table."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.wire.query import QUERIES
from igtl_gateway.wire.registry import BODIES
from tests.wire import conformance
from tests.wire.conformance import Case, Result


@pytest.fixture(scope="module")
def results() -> list[Result]:
    return conformance.results()


def test_every_message_is_decoded_and_written_back(results: list[Result]) -> None:
    sys.stdout.write(f"\n{conformance.table(results)}\n")
    assert [result for result in results if not (result.decoded and result.reencoded)] == []


def test_every_type_is_there_in_its_header_versions(results: list[Result]) -> None:
    seen = {(result.type, result.header_version) for result in results}
    own = BODIES.keys() - QUERIES.keys() - {"QTRANS", "COLORTABLE", "CAPABIL"}
    assert {kind for kind, _ in seen} >= own
    assert {(kind, 2) for kind in own} <= seen


def test_the_table() -> None:
    rows = [
        Result("a", "IMAGE", 1, True, True),
        Result("b", "IMAGE", 1, True, False),
        Result("c", "BIND", 2, False, True),
    ]
    assert conformance.table(rows).splitlines() == [
        "| Type | v1 decoded | v1 re-encoded | v1 messages | v2 decoded | v2 re-encoded | v2 messages |",
        "|---|---:|---:|---:|---:|---:|---:|",
        "| `BIND` | – | – | – | 0 | 1 | 1 |",
        "| `IMAGE` | 2 | 1 | 2 | – | – | – |",
        "| all | 2 | 1 | 2 | 0 | 1 | 1 |",
    ]


def test_what_is_wrong_is_seen(tmp_path: Path) -> None:
    """A wrong value, a key too many, a missing message, damage: none of them counts as conforming."""
    (case,) = (case for case in conformance.cases() if case.name.endswith("/STATUS_v2_s1"))
    (row,) = case.expected

    def verdict(changed: Case) -> list[tuple[bool, bool]]:
        return [(result.decoded, result.reencoded) for result in conformance.run(changed, tmp_path)]

    assert verdict(case) == [(True, True)]
    assert verdict(replace(case, expected=({**row, "type": "STRING"},))) == [(False, True)]
    assert verdict(replace(case, expected=({**row, "more": 1},))) == [(False, True)]
    assert verdict(replace(case, expected=({key: row[key] for key in row if key != "crc"},))) == [(False, True)]
    assert verdict(replace(case, expected=({"type": "STATUS", "header_version": 2},), whole=False)) == [(True, True)]
    assert verdict(replace(case, expected=(row, row))) == [(True, False), (False, False)]
    bent = case.data[:-1] + bytes([case.data[-1] ^ 1])
    assert verdict(replace(case, data=bent))[0][0] is False
    short = case.data[:42] + bytes(8) + case.data[50:58]  # no body at all
    assert verdict(replace(case, data=short)) == [(False, False)]

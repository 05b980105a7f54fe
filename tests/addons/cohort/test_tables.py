"""The columns of the tables, in the code and in the document."""

from __future__ import annotations

import math
from typing import Any

import pytest

pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')

from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.tables import arrow_table, joined
from tests.places import ROOT

DOCUMENT = ROOT / "docs" / "how-to" / "cohort.md"


def test_the_document_has_every_table_and_column() -> None:
    text = DOCUMENT.read_text("utf-8")
    for table, columns in TABLES.items():
        cells = ", ".join(f"`{name}` {kind}" for name, kind in columns.items() if name not in ("task", "file"))
        assert f"| `{table}` | {cells} |" in text


def test_foreign_values_fit_the_columns() -> None:
    rows: list[dict[str, Any]] = [
        {"task": "1", "file": "\udcff", "verb": None, "seconds": math.nan},
        {"task": "0", "file": "a", "bytes": 3},
    ]
    table = joined("tasks", [arrow_table("tasks", rows), arrow_table("tasks", [])])
    assert table["file"].to_pylist() == ["\\udcff", "a"]
    assert table["seconds"].to_pylist() == [None, None]


def test_a_number_without_64_bits_is_null() -> None:
    """A file whose messages have times up to 2^64 - 1 ended the whole cohort."""
    table = arrow_table("recordings", [{"task": "0", "file": "a", "start": (1 << 64) - 1, "entries": 1 << 63}])
    assert table["start"].to_pylist() == table["entries"].to_pylist() == [None]

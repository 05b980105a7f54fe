"""Rows of a recording: its marks."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.jobs import _lint
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import marked


def test_a_cohort_has_a_table_of_marks(tmp_path: Path) -> None:
    recording = marked.write(tmp_path / "out.mcap", marked.entries(every=10)[0])
    with SessionFile.open(recording) as file:
        rows = _lint(file, {})["marks"]
    assert [(row["label"], row["end_time"] is None, row["is_open"]) for row in rows] == [
        ("suture-1", False, False),
        ("slip", True, False),
        ("suture-2", False, False),
        ("rest", False, True),
    ]
    assert {"task", "file", *rows[0]} == set(TABLES["marks"])

"""Retention beside a recording: what its thread reports, and which parts are those of the recording that runs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.config.notations import retention
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.retaining import DELETED, KEPT, RetentionThread
from tests.record.test_parts import record, session

DAY_NS = 86_400 * 10**9
NOW_NS = 1_800_000_000 * 10**9


def age(path: Path, days: float) -> Path:
    os.utime(path, ns=(NOW_NS - int(days * DAY_NS),) * 2)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A file, and the parts of ``run`` and ``other``: 40 days old, the last part of each one day."""
    record(tmp_path / "old.mcap", session(1))
    age(tmp_path / "old.mcap", 40)
    for name in ("run", "other"):
        record(tmp_path / f"{name}.mcap", session(3), split_s=1.0)
        parts = sorted((tmp_path / name).glob("*.mcap"))
        for number, part in enumerate(parts):
            age(part, 1 if part == parts[-1] else 40 - number)
    return tmp_path


def passed(path: Path, options: RecordOptions, files: frozenset[Path] = frozenset()) -> tuple[list[Note], bool]:
    """One pass: its notes, and whether parts of the recording that runs were deleted."""
    thread = RetentionThread(path, options, ManualClock(NOW_NS), files)
    thread.wake()
    thread.stop()
    found = thread.take(), thread.has_deleted_parts()
    assert not thread.has_deleted_parts(), "since the last call"
    return found


@pytest.mark.parametrize(
    ("name", "split_s", "own"),
    [("new", 0.0, False), ("new", 1.0, False), ("run", 1.0, True), ("run", 0.0, False)],
)
def test_the_recording_that_runs_has_lost_parts_only_if_they_are_its_own(
    name: str, split_s: float, own: bool, folder: Path
) -> None:
    notes, has_deleted = passed(folder / f"{name}.mcap", RecordOptions(retention=retention("30 d"), split_s=split_s))
    (note,) = notes
    assert (note.code, has_deleted) == (DELETED, own)
    assert "old.mcap" in note.data["files"] and note.data["count"] == len(note.data["files"]) >= 5
    assert sorted(each.name for each in folder.glob("*.mcap")) == []
    assert all(len(list((folder / each).glob("*.mcap"))) == 1 for each in ("run", "other"))


def test_of_others_parts_the_recording_that_runs_has_lost_none(folder: Path) -> None:
    for part in (folder / "run").glob("*.mcap"):
        age(part, 1)
    notes, has_deleted = passed(folder / "run.mcap", RecordOptions(retention=retention("30 d"), split_s=1.0))
    assert [note.code for note in notes] == [DELETED] and not has_deleted


def test_what_an_upload_has_not_confirmed_stays_and_is_named_once(folder: Path) -> None:
    options = RecordOptions(retention=retention("30 d"))
    notes, _ = passed(folder / "new.mcap", replace(options, uploaded=True))
    (note,) = notes
    assert note.code == KEPT and note.text.startswith("retention keeps ")
    assert (folder / "old.mcap").exists()

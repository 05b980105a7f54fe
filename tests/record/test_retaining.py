"""Retention beside a recording: what its thread reports, and which parts are those of the recording that runs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.config.notations import RetentionRule, retention
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.retaining import CLOCK, DELETED, FAILED, KEPT, RetentionThread
from igtl_gateway.record.retention.retention_log import LOG_NAME
from tests.record import samples
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


def recording(folder: Path, name: str, days: float) -> Path:
    folder.mkdir(exist_ok=True)
    path = samples.write(folder / name, samples.every_kind(3))
    time_ns = NOW_NS - int(days * DAY_NS)
    os.utime(path, ns=(time_ns, time_ns))
    return path


@contextmanager
def thread(
    folder: Path,
    rule: str | RetentionRule,
    clock_ns: int = NOW_NS,
    files: frozenset[Path] = frozenset(),
    **options: object,
) -> Iterator[RetentionThread]:
    made = RetentionThread(
        folder / "now.mcap",
        RecordOptions(retention=retention(rule) if isinstance(rule, str) else rule, **options),  # type: ignore[arg-type]
        ManualClock(clock_ns),
        files,
    )
    try:
        yield made
    finally:
        made.stop()


def notes(made: RetentionThread) -> list[Note]:
    """The notes of a last pass."""
    made.wake()
    made.stop()
    return made.take()


def test_what_is_old_is_deleted_and_named(tmp_path: Path) -> None:
    old, new = recording(tmp_path, "old.mcap", 40), recording(tmp_path, "new.mcap", 1)
    size = old.stat().st_size
    with thread(tmp_path, "30 d") as made:
        (note,) = notes(made)
    assert not old.exists() and new.exists()
    assert (note.level, note.code, note.text) == (Level.INFO, DELETED, f"retention deleted old.mcap ({size:,} bytes)")
    assert note.data == {"files": ["old.mcap"], "count": 1, "bytes_left": new.stat().st_size}
    assert made.take() == [] and not made.has_deleted_parts()
    assert [json.loads(line)["event"] for line in (tmp_path / LOG_NAME).read_text().splitlines()] == ["rule", "delete"]


def test_many_are_counted_and_some_are_named(tmp_path: Path) -> None:
    for number in range(23):
        recording(tmp_path, f"{number:02}.mcap", 40 + number)
    with thread(tmp_path, "30 d") as made:
        (note,) = notes(made)
    assert note.text.startswith("retention deleted 23 recordings (")
    assert note.data["count"] == 23 and len(note.data["files"]) == 20


def test_without_work_there_is_no_note_and_no_thread_before_the_first_pass(tmp_path: Path) -> None:
    recording(tmp_path, "new.mcap", 1)
    with thread(tmp_path, "30 d") as made:
        made.stop()
        assert made.take() == []
    with thread(tmp_path, "30 d") as made:
        assert notes(made) == []


def test_what_may_not_be_deleted_is_reported_with_its_reason(tmp_path: Path) -> None:
    old = recording(tmp_path, "old.mcap", 40)
    with thread(tmp_path, "30 d", seal=tmp_path / "key") as made:
        (note,) = notes(made)
    assert old.exists()
    assert (note.level, note.code) == (Level.WARN, KEPT)
    assert note.text == f"retention keeps old.mcap ({old.stat().st_size:,} bytes): it is not sealed"


@pytest.mark.parametrize(("is_begun", "gone"), [(True, "yesterday.mcap"), (False, "snapshot.mcap")])
def test_files_that_the_recorder_has_begun_are_of_its_session(is_begun: bool, gone: str, tmp_path: Path) -> None:
    """They have half of the size, also where they are the oldest."""
    begun, yesterday = recording(tmp_path, "snapshot.mcap", 40), recording(tmp_path, "yesterday.mcap", 1)
    rule = RetentionRule("", size=yesterday.stat().st_size * 3 // 2)
    with thread(tmp_path, rule, files=frozenset({begun} if is_begun else ())) as made:
        (note,) = notes(made)
    assert note.data["files"] == [gone] and not (tmp_path / gone).exists()


def test_a_wrong_clock_is_reported(tmp_path: Path) -> None:
    recording(tmp_path, "old.mcap", 40)
    with thread(tmp_path, "30 d", clock_ns=DAY_NS) as made:
        (note,) = notes(made)
    assert (note.level, note.code) == (Level.WARN, CLOCK) and note.text.startswith("ages do not count: ")


@pytest.mark.parametrize(("rule", "left"), [("1 GB", True), ("30 d", False)])
def test_how_much_may_still_come(rule: str, left: bool, tmp_path: Path) -> None:
    size = recording(tmp_path, "new.mcap", 1).stat().st_size
    with thread(tmp_path, rule) as made:
        notes(made)
        assert made.until_deleted == (10**9 - size if left else None)


def test_a_folder_without_its_log_is_an_error(tmp_path: Path) -> None:
    recording(tmp_path, "old.mcap", 40)
    (tmp_path / LOG_NAME).mkdir()
    with thread(tmp_path, "30 d, 1 GB") as made:
        found = {note.code: note for note in notes(made)}
        assert made.until_deleted is None
    assert found[FAILED].level is Level.ERROR and found[FAILED].text.startswith("no retention: ")
    assert DELETED not in found
    assert (tmp_path / "old.mcap").exists()


def test_an_open_file_that_alone_is_larger_than_the_size_is_reported(tmp_path: Path) -> None:
    path = recording(tmp_path, "open.mcap", 0)
    path.write_bytes(path.read_bytes()[:-200])
    size = path.stat().st_size
    with thread(tmp_path, RetentionRule("", size=size)) as made:
        assert notes(made) == []
    with thread(tmp_path, RetentionRule("", size=size - 1)) as made:
        (note,) = notes(made)
        assert made.until_deleted is None
    assert (note.level, note.code) == (Level.WARN, KEPT)
    assert note.text == (
        "the session that runs is larger than half of the size; older recordings do not give way to it"
    )

"""What the worker reports at its end."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from igtl_gateway.record.reports import RecordingSummary, WorkerState


def test_counters_are_those_of_file_and_queue() -> None:
    state = WorkerState(written_entries=9, dropped={"b": 1, "a": 2}, left_out={"d": 1, "c": 3}, failure="full")
    assert state.counters(Counter(a=4)) == {
        "written_entries": 9,
        "dropped_entries": 7,
        "dropped": {"a": 6, "b": 1},
        "left_out_entries": 4,
        "left_out": {"c": 3, "d": 1},
        "failure": "full",
        "taken_away": "",
    }


def test_a_recording_is_discarded_with_its_folder_but_not_with_foreign_files(tmp_path: Path) -> None:
    def summary() -> RecordingSummary:
        folder = tmp_path / "a"
        folder.mkdir(exist_ok=True)
        files = (folder / "a_0.mcap", folder / "a_1.mcap")
        files[0].touch()  # the other one is missing already
        return RecordingSummary(folder, 0, 0, {}, {}, files)

    summary().discard()
    assert not (tmp_path / "a").exists()
    before = summary()
    foreign = tmp_path / "a" / "notes.txt"
    foreign.touch()
    before.discard()
    assert [*(tmp_path / "a").iterdir()] == [foreign]

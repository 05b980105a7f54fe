"""The disk is reported to become full before it is."""

from __future__ import annotations

import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.gateway.diagnostics import DISK_LOW_S
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.space import ENOUGH, LOW, LOW_S, SpaceWatch, free_bytes
from tests.record import samples
from tests.record.notes import TimelessNotes
from tests.record.test_recorder import wait_until

NS = 1_000_000_000
_Usage = namedtuple("_Usage", "total used free")


def watch(free: list[int], *, written_a_second: int, seconds: int, room: int | None = None) -> list[tuple[int, Note]]:
    """The notes of some seconds; ``free``: of each, and the last one for all that follow."""
    left = iter(free)
    now = [free[0]]

    def of_disk() -> int:
        now[0] = next(left, now[0])
        return now[0]

    disk = SpaceWatch(of_disk, lambda: room)
    notes = [(second, disk.look(second * NS, second * written_a_second)) for second in range(seconds)]
    return [(second, note) for second, note in notes if note]


def test_the_time_that_is_left_is_said_at_30_and_at_5_minutes() -> None:
    size = 10**9
    notes = watch(
        [4_000 * size // 1000 - second * size // 1000 for second in range(4_000)], written_a_second=10**6, seconds=3_990
    )
    assert [(note.level, note.code) for _, note in notes] == [(Level.WARN, LOW)] * 2
    assert [4_000 - second for second, _ in notes] == pytest.approx(LOW_S, abs=5)
    assert "30 min at the present rate" in notes[0][1].text and LOW_S[0] == DISK_LOW_S


def test_what_others_write_counts_too() -> None:
    (first, _), *_ = watch([10**9 - second * 10**7 for second in range(99)], written_a_second=0, seconds=90)
    assert first < 10


def test_a_burst_is_no_rate_and_a_retention_that_makes_room_is_enough() -> None:
    assert watch([10**9], written_a_second=0, seconds=100) == []
    assert watch([10**9], written_a_second=10**7, seconds=100, room=5 * 10**8) == []
    assert watch([10**9], written_a_second=10**7, seconds=100, room=2 * 10**9) != []


def test_it_is_said_that_there_is_room_again() -> None:
    notes = watch([10**9] * 20 + [10**14], written_a_second=10**7, seconds=60)
    assert [note.code for _, note in notes] == [LOW, ENOUGH]


def test_where_it_is_not_known_nothing_is_said(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "nothing") is None and free_bytes(tmp_path)
    assert SpaceWatch(lambda: None).look(NS, 1) is None


def test_the_files_of_a_recording_count_together_once_a_second() -> None:
    free = 10**10
    disk = SpaceWatch(lambda: free)
    assert disk.is_due(2 * NS)
    for second, size in enumerate((0, 10**8, 2 * 10**8, 10**8, 2 * 10**8, 3 * 10**8), 2):
        disk.look_at(second * NS, size)
        assert not disk.is_due(second * NS + NS - 1) and disk.is_due(second * NS + NS)
    assert disk.left_s == pytest.approx(100), "5e8 bytes in 5 s: the second file began at 2e8"


def test_the_recorder_looks_at_the_disk_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: _Usage(10**9, 10**9 - 10**6, 10**6))
    notes = TimelessNotes()
    clock = ManualClock()
    recorder = Recorder(
        tmp_path / "a.mcap", samples.SESSION, qos_of=lambda *_: None, on_note=notes.append, clock=clock,
        host=in_thread, options=RecordOptions(compression="none"),
    )  # fmt: skip
    for second in range(12):
        recorder(samples.igtl(second + 1, body=bytes(100_000)))
        wait_until(lambda: not recorder.counters()["queued_entries"])
        clock.advance(NS)
        wait_until(lambda second=second: recorder.facts()["disk_free_bytes"] == 10**6)  # type: ignore[misc]
        recorder.wake()
    wait_until(lambda: any(note.code == LOW for note in notes))
    assert recorder.counters()["disk_left_s"] < 100
    recorder.close({"streams": {}})

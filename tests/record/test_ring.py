"""Snapshots: what is kept in memory, and the files that it becomes."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record import host
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import FAILED, SNAPSHOT
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.shared_queue import QueueReader
from igtl_gateway.replay.verify import DeclaredLosses, verify
from tests.record import samples
from tests.record.test_parts import RULE, healthy, session

DEADLINE_S = 30.0


class Bench:
    """A recorder that keeps the last seconds."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.notes: list[Note] = []
        self.recorder = Recorder(
            path,
            samples.SESSION,
            qos_of=lambda _topic, _type: None,
            on_note=self.notes.append,
            clock=ManualClock(samples.START_NS),
            host=in_thread,
            options=RecordOptions(**{"snapshot_s": 2.0, **options}),
            rule=RULE,
        )

    def feed(self, entries: list[Entry]) -> None:
        for entry in entries:
            self.recorder(entry)

    def snapshot(self) -> Path:
        return self.recorder.snapshot().result(DEADLINE_S)


def read(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "last.mcap"


@pytest.mark.slow
def test_a_snapshot_has_the_last_seconds_whole_and_verifies(path: Path) -> None:
    entries = session(5)
    bench = Bench(path)
    bench.feed(entries)
    file = bench.snapshot()
    assert file == path.with_name("last_20231114T221320Z.mcap")
    kept = read(file)
    assert kept == [samples.flat(entry) for entry in entries[-len(kept) :]]
    assert kept[0].kind.is_input
    assert 1.8e9 < kept[-1].stamp_ns - kept[0].stamp_ns <= 2e9
    with SessionFile.open(file) as snapshot:
        assert snapshot.session["snapshot_seconds"] == "2"
        assert snapshot.ledger is not None and snapshot.ledger["recorder"]["written_entries"] == len(kept)
        report = verify(
            snapshot.entries(),
            Config(),
            DeclaredLosses.of(snapshot.session, snapshot.ledger),
            before=snapshot.prologue(),
        )
    assert report.good and report.equal > 0
    summary = bench.recorder.close({})
    assert [note.code for note in bench.notes] == [SNAPSHOT]
    assert bench.notes[0].data == {"path": str(file)}
    assert (summary.files, summary.entries, summary.size) == ((file,), len(kept), file.stat().st_size)
    assert sorted(path.parent.iterdir()) == [file], "nothing else is written"
    assert healthy(file)


def test_a_snapshot_asked_for_between_an_input_and_its_outputs_has_them_too(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = threading.Event()

    class Late(QueueReader):
        def get(self) -> Entry | tuple[Any, ...] | None:
            assert begin.wait(DEADLINE_S)
            return super().get()

    monkeypatch.setattr(host, "QueueReader", Late)
    bench, entries = Bench(path), session(1)
    inputs = [at for at, entry in enumerate(entries) if entry.kind.is_input]
    middle = next(at for at, after in zip(inputs, [*inputs[1:], len(entries)], strict=True) if after - at > 1) + 1
    bench.feed(entries[:middle])
    first = bench.recorder.snapshot()
    bench.feed(entries[middle:])
    last = bench.recorder.snapshot()  # behind the outputs of the last input, which no other one follows
    begin.set()
    after = next(at for at in inputs if at >= middle)
    assert middle < after
    for asked, count in ((first, after), (last, len(entries))):
        assert read(asked.result(DEADLINE_S)) == [samples.flat(entry) for entry in entries[:count]]
    bench.recorder.close({})


def test_a_snapshot_that_was_asked_for_before_the_end_is_written(path: Path) -> None:
    bench = Bench(path)
    bench.feed(session(1))
    asked = bench.recorder.snapshot()
    assert not asked.cancel()
    bench.recorder.close({})
    assert read(asked.result(DEADLINE_S)) == [samples.flat(entry) for entry in session(1)]


def test_snapshots_of_one_second_get_names_of_their_own(path: Path) -> None:
    bench = Bench(path)
    bench.feed(session(1))
    first, second = bench.snapshot(), bench.snapshot()
    assert second.name == f"{first.stem}_2.mcap"
    assert read(first) == read(second)


def test_the_bound_in_bytes(path: Path) -> None:
    bench = Bench(path, snapshot_bytes=100_000)
    bench.feed([samples.igtl(seq, body=bytes(20_000)) for seq in range(1, 20)])
    assert [entry.seq for entry in read(bench.snapshot())] == [16, 17, 18, 19]


def test_one_entry_larger_than_the_bound_is_kept(path: Path) -> None:
    bench = Bench(path, snapshot_bytes=1_000)
    bench.feed([samples.igtl(1, body=bytes(20_000))])
    assert [entry.seq for entry in read(bench.snapshot())] == [1]


def test_a_snapshot_of_nothing_is_a_whole_file(path: Path) -> None:
    assert read(Bench(path).snapshot()) == []


def test_an_entry_that_the_format_cannot_hold_costs_only_itself(path: Path) -> None:
    bench = Bench(path)
    bench.feed([samples.ros(1), Entry(2, samples.START_NS + 2, samples.igtl(1).kind, "no slash", "IMAGE")])
    assert [entry.seq for entry in read(bench.snapshot())] == [1]


def test_a_snapshot_that_fails_is_told_and_the_next_one_works(tmp_path: Path) -> None:
    folder = tmp_path / "there"
    folder.mkdir()
    bench = Bench(folder / "last.mcap")
    bench.feed(session(1))
    shutil.rmtree(folder)
    with pytest.raises(RecordingError, match="there is no folder"):
        bench.snapshot()
    assert [note.code for note in bench.notes] == [FAILED]
    folder.mkdir()
    assert len(read(bench.snapshot())) == len(session(1))


def test_without_a_folder_it_does_not_begin(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="there is no folder"):
        Bench(tmp_path / "none" / "last.mcap")


def test_after_the_end_there_are_no_snapshots(path: Path) -> None:
    bench = Bench(path)
    bench.recorder.close({})
    with pytest.raises(RecordingError, match="has ended"):
        bench.snapshot()
    assert list(path.parent.iterdir()) == []

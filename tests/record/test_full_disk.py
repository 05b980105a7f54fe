"""A disk that is full: the file gets its end when there is room, and the recording goes on in the next one.

The disk is a limit of the size of files (RLIMIT_FSIZE) for this process, which the system itself enforces.
"""

from __future__ import annotations

import random
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.app.sealing import verify_seal
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record import reports
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.sealing import Sealer, SealSeries
from igtl_gateway.record.sessionfile.side_file import files_of
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.space import SpaceWatch
from tests.record import samples
from tests.record.notes import TimelessNotes
from tests.tables import table
from tests.timing import WAIT_S

_CHANCE = random.Random(4)
LEDGER = {layout.CUT_OFF_KEY: True, "recorder": {"failure": "full"}}


def noise(seq: int, size: int = 3_000) -> Entry:
    return samples.igtl(seq, body=_CHANCE.randbytes(size))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def check(path: Path, expected: list[Entry]) -> None:
    """The file opens, and another program's library finds its index."""
    with SessionFile.open(path) as file:
        assert list(file.entries()) == expected
        assert file.ledger == LEDGER
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary and summary.statistics
        assert summary.statistics.message_count == len(expected)
        stream.seek(0)
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == len(expected)


def failed_writer(path: Path, flushed: int, room: int, sealer: Sealer | None) -> tuple[SessionWriter, list[Entry]]:
    """A writer whose file may have ``room`` bytes more, after some entries that were flushed."""
    out = SessionWriter(path, samples.SESSION, counted=True, sealer=sealer)
    entries = [noise(seq) for seq in range(1, flushed + 1)]
    for entry in entries:
        out.write(entry)
    out.flush()
    with files_of_at_most(path.stat().st_size + room), pytest.raises(RecordingError, match="File too large"):
        for seq in range(flushed + 1, flushed + 1_000):
            out.write(replace(noise(seq), channel=f"TRANSFORM/{seq}"))
            out.flush()
    return out, entries


@table("flushed, sealed", [(0, False), (1, False), (40, False), (0, True), (40, True)])
def test_a_file_in_the_middle_of_a_chunk_gets_its_end_when_there_is_room(
    flushed: int, sealed: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("full") / "a.mcap"
    sealer = SealSeries(SigningKey.generate(), lambda: 5).next_file(path) if sealed else None
    out, entries = failed_writer(path, flushed, 100, sealer)
    size = path.stat().st_size
    with files_of_at_most(size + 100):
        assert not out.finish_after_failure(LEDGER)
        assert path.stat().st_size == size
    assert out.finish_after_failure(LEDGER)
    assert not out.finish_after_failure(LEDGER), "it is closed"
    check(path, entries)
    assert out.entries == flushed
    if sealed:
        assert verify_seal(path).good


def test_a_file_has_its_end_at_once_where_the_begin_of_a_chunk_makes_room(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    out = SessionWriter(path, samples.SESSION)
    entries = [noise(1)]
    out.write(entries[0])
    out.flush()
    with files_of_at_most(path.stat().st_size + 40_000):
        with pytest.raises(RecordingError):
            for seq in range(2, 999):
                out.write(noise(seq, 90_000))
                out.flush()
        assert out.finish_after_failure(LEDGER)
    check(path, entries)


def test_a_file_that_was_taken_away_or_has_not_failed_gets_no_end(tmp_path: Path) -> None:
    out = SessionWriter(tmp_path / "a.mcap", samples.SESSION)
    assert not out.finish_after_failure(LEDGER)
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(RecordingError, match="removed"):
        out.flush()
    assert not out.finish_after_failure(LEDGER)


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("cryptography")
    path = tmp_path_factory.mktemp("keys") / "key"
    path.touch(0o600)
    path.write_bytes(SigningKey.generate().private_pem())
    return path


@table("split_bytes, sealed", [(0, False), (1 << 20, False), (0, True), (1 << 20, True)])
def test_the_recording_goes_on_by_itself_when_the_disk_has_room_again(
    split_bytes: int, sealed: bool, key: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    tmp_path = tmp_path_factory.mktemp("full")
    notes, clock, path = TimelessNotes(), ManualClock(), tmp_path / "a.mcap"
    options = RecordOptions(split_bytes=split_bytes, flush_s=0.01, seal=key if sealed else None)
    recorder = Recorder(
        path, samples.SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, clock=clock,
        host=in_thread, options=options,
    )  # fmt: skip
    given, pause = 0, threading.Event()

    def give_until(code: str) -> None:
        nonlocal given
        for _ in range(int(WAIT_S * 100)):
            if any(note.code == code for note in notes):
                return
            given += 1
            recorder(noise(given))
            clock.advance(NS_PER_S // 10)
            recorder.wake()
            pause.wait(0.01)
        raise AssertionError([note.code for note in notes])

    with files_of_at_most(200_000):
        give_until(reports.FAILED)
    give_until(reports.AGAIN)
    given += 1
    recorder(noise(given))
    summary = recorder.close({})
    files = files_of(summary.path) if split_bytes else sorted(tmp_path.glob("*.mcap"))
    parts = [each for each in files if each.suffix == ".mcap"]
    assert len(parts) == 2
    numbers = []
    for part in parts:
        with SessionFile.open(part) as file:
            numbers.append([entry.seq for entry in file.entries()])
    assert numbers[0][0] == 1
    assert numbers[0][-1] + 1 < numbers[1][0], "what came in between is not there"
    assert numbers[1][-1] == given
    assert sum(map(len, numbers)) + sum(summary.dropped.values()) == given
    with SessionFile.open(parts[0]) as file:
        assert file.ledger and "File too large" in file.ledger["recorder"]["failure"]
    if split_bytes:
        with SessionFile.open(summary.path) as whole:
            assert [entry.seq for entry in whole.entries()] == [*numbers[0], *numbers[1]]
    if sealed:  # and so do the parts, as one recording if it is split
        for each in (summary.path,) if split_bytes else parts:
            found = verify_seal(each)
            assert found.good, (found.state, found.problem, found.side_file)


def test_a_disk_has_room_when_it_has_some_seconds_of_the_recording() -> None:
    free, written = 500_000_000, 0
    watch = SpaceWatch(lambda: free)
    for second in range(1, 10):
        written, free = written + 1_000_000, free - 1_000_000
        watch.look(second * NS_PER_S, written)
    full, free = 0, 7_000_000
    watch.look(11 * NS_PER_S, written)
    assert not watch.has_more_than(full)
    free = 10_000_000
    watch.look(12 * NS_PER_S, written)
    assert watch.has_more_than(full)

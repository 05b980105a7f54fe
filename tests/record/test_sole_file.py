"""A recording that is started and stopped: every file verifies, and has all between its start and its stop."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import pytest

from igtl_gateway.app import recording
from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record import parts, prologue
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import AGAIN, FAILED, STARTED, STOPPED
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile import new_file, stream, writer
from igtl_gateway.record.sessionfile.new_file import cannot_begin
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.seals import stated_seals
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import Message, encode
from igtl_gateway.wire.query import EmptyQuery
from tests.record import samples
from tests.record.notes import LATENESS
from tests.record.test_parts import RULE, session, wait_until


def recorder_of(path: Path, notes: list[Note], clock: ManualClock | None = None, **options: Any) -> Recorder:
    return Recorder(
        path,
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=lambda note: None if note.code in LATENESS else notes.append(note),
        clock=clock or ManualClock(),
        host=in_thread,
        options=RecordOptions(**options),
        rule=RULE,
    )


def _is(recorder: Recorder, *, rests: bool) -> bool:
    return recorder.rests is rests


def numbers_of(path: Path) -> list[int]:
    """Return the numbers of the entries of a file that verifies."""
    with SessionFile.open(path) as file:
        entries = list(file.entries())
        report = verify(entries, Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue())
    assert report.good, report.differences[:3]
    return [entry.seq for entry in entries]


@pytest.mark.parametrize("options", [{}, {"split_s": 1e3}], ids=["one file", "parts"])
@pytest.mark.parametrize("waits", [False, True], ids=["", "waits"])
@pytest.mark.parametrize("seed", range(4))
def test_each_file_has_all_between_start_and_stop(
    tmp_path: Path, options: dict[str, Any], waits: bool, seed: int
) -> None:
    chosen, notes, entries = Random(seed), list[Note](), session(3)
    inputs = [at for at, entry in enumerate(entries) if entry.kind.is_input]
    turns = sorted(chosen.sample(inputs[1:], 5))
    recorder = recorder_of(tmp_path / "a.mcap", notes, waits=waits, **options)
    runs, expected, current = not waits, list[list[int]](), list[int]()
    for at, entry in enumerate(entries):
        if at in turns:
            wait_until(partial(_is, recorder, rests=not runs))
            done, _ = (recording.stop if runs else recording.start)(recorder)
            assert done
            if runs:
                expected.append(current)
            runs, current = not runs, []
        recorder(entry)
        if runs:
            current.append(entry.seq)
    summary = recorder.close({"streams": {}})
    expected += [current] * runs
    files = [path for path in summary.files if path.suffix == ".mcap"]
    assert [numbers_of(path) for path in files] == [found for found in expected if found]
    assert summary.entries == sum(map(len, expected)) and not summary.dropped and not summary.failure
    assert summary.entries + sum(summary.left_out.values()) == len(entries)
    assert {note.code for note in notes} == {STARTED, STOPPED}
    if options:
        with SessionFile.open(summary.path) as file:
            assert file.entry_count == summary.entries and not file.missing_parts


@pytest.mark.parametrize("side", [300, 3_000])
def test_a_file_that_begins_after_large_pictures_verifies(tmp_path: Path, side: int) -> None:
    """Their first one is noted, and a query after the start is answered with the last one before it."""
    size = side * side
    gateway, notes, entries = Session(Gateway(Config())), list[Note](), list[Entry]()

    def take(kind: Kind, *payload: Buffer, **fields: Any) -> None:
        now_ns = samples.START_NS + len(entries)
        entries.extend(gateway.input(now_ns, kind, payload, **fields or {"links": (1,)}))

    take(Kind.LINK, Note(Level.INFO, LINK_UP, "a peer", data={"address": "127.0.0.1:1"}).pack())
    for value in (1, 2):
        take(Kind.IGTL_IN, b"".join(encode(Message("IMAGE", "CT", Image((side, side, 1), 3, bytes([value]) * size)))))
        picture = rosmsg.Image(Header(samples.START_NS, "probe"), side, side, "mono8", 0, side, bytes([value]) * size)
        take(Kind.ROS_IN, picture.pack(), channel="/igtl/out/US", type_name=picture.TYPE)
    begin = len(entries)
    take(Kind.IGTL_IN, b"".join(encode(Message("GET_IMAGE", "US", EmptyQuery()))))
    take(Kind.IGTL_IN, b"".join(encode(Message("IMAGE", "CT", Image((side, side, 1), 3, bytes(size))))))
    assert [entry.type for entry in entries[begin:] if entry.kind is Kind.IGTL_OUT] == ["IMAGE"]
    recorder = recorder_of(tmp_path / "a.mcap", notes, waits=True)
    for entry in entries[:begin]:
        recorder(entry)
    assert recording.start(recorder)[0]
    for entry in entries[begin:]:
        recorder(entry)
    (path,) = recorder.close({"streams": {}}).files
    assert numbers_of(path) == [entry.seq for entry in entries[begin:]]
    assert not [note for note in notes if note.level > Level.INFO]


def test_a_file_that_begins_without_the_largest_inputs_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prologue, "LARGEST_BYTES", 8_500_000)
    notes = list[Note]()
    recorder = recorder_of(tmp_path / "a.mcap", notes, waits=True)
    recorder(samples.igtl(1, device="CT", body=bytes(9_000_000)))
    assert recording.start(recorder)[0]
    recorder.close({})
    (found,) = [note for note in notes if note.code == "prologue_incomplete"]
    assert found.text.startswith("the file begins without the last message of TRANSFORM/CT (9.0 MB)")


def test_nothing_else_is_done_to_a_recording_that_is_stopped(tmp_path: Path) -> None:
    notes: list[Note] = []
    recorder = recorder_of(tmp_path / "a.mcap", notes, waits=True)
    assert recording.stop(recorder) == (False, "the recording is stopped; start it first")
    for action in (recording.pause, recording.resume):
        assert action(recorder) == (False, "the recording is stopped; start it first")
    assert recording.start(recorder)[0]
    wait_until(lambda: not recorder.rests)
    assert recording.start(recorder) == (False, "the recording runs already")
    assert recorder.close({}).files == (tmp_path / "a.mcap",)
    kept = recorder_of(tmp_path / "b.mcap", notes, snapshot_s=5.0)
    assert not recording.start(kept)[0] and not recording.stop(kept)[0]
    kept.close({})


def test_an_obstacle_is_reported_and_the_next_start_succeeds(tmp_path: Path) -> None:
    folder, notes, entries = tmp_path / "folder", list[Note](), session(1)
    folder.mkdir()
    recorder = recorder_of(folder / "a.mcap", notes, waits=True)
    folder.rename(tmp_path / "elsewhere")
    recorder.start()
    wait_until(lambda: bool(notes))
    assert notes[0].text.startswith("the recording is not started: ") and recorder.rests
    assert recorder.failure in notes[0].text
    (tmp_path / "elsewhere").rename(folder)
    recorder.start()
    wait_until(lambda: not recorder.rests)
    entry: Entry
    for entry in entries:
        recorder(entry)
    assert recorder.close({}).entries == len(entries)


class Disk:
    """A disk that refuses while it is to."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.refuses = False
        for module, name in ((stream.McapStream, "flush"), (writer, "create_file"), (new_file, "open_new")):
            patch.setattr(module, name, self._guarded(getattr(module, name)))
        patch.setattr(parts, "make_folder", self._guarded(new_file.make_folder))

    def _guarded(self, work: Callable[..., Any]) -> Callable[..., Any]:
        def guarded(*words: Any, **more: Any) -> Any:
            if self.refuses:
                error = OSError(errno.EROFS, os.strerror(errno.EROFS))
                raise cannot_begin(words[0], error) if work.__name__ == "create_file" else error
            return work(*words, **more)

        return guarded


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


@pytest.mark.parametrize("options", [{}, {"split_s": 1e3}], ids=["one file", "parts"])
@pytest.mark.parametrize("waits", [False, True], ids=["", "waits"])
def test_a_disk_that_refuses_from_the_start_is_tried_again_at_each_start(
    tmp_path: Path, disk: Disk, options: dict[str, Any], waits: bool
) -> None:
    notes, entries = list[Note](), session(1)
    disk.refuses = True
    recorder = recorder_of(tmp_path / "a.mcap", notes, waits=waits, **options)
    wait_until(lambda: bool(recorder.failure))
    assert "Read-only file system" in recorder.failure and recorder.rests
    done, why = recording.start(recorder)
    assert not done and "Read-only file system" in why
    assert [note.code for note in notes] == [FAILED, FAILED]
    assert recording.stop(recorder) == (False, recorder.failure)
    disk.refuses = False
    done, text = recording.start(recorder)
    assert done and text.startswith("the recording begins: ") and not recorder.failure
    for entry in entries:
        recorder(entry)
    summary = recorder.close({"streams": {}})
    assert (summary.entries, summary.dropped) == (len(entries), {})
    assert "Read-only file system" in summary.failure, "a file that was asked for is missing: exit code 1"
    assert numbers_of(next(path for path in summary.files if path.suffix == ".mcap")) == [e.seq for e in entries]


@pytest.mark.parametrize("options", [{}, {"split_s": 1e3}], ids=["one file", "parts"])
def test_a_recording_that_has_failed_begins_again_with_what_is_known(
    tmp_path: Path, disk: Disk, options: dict[str, Any]
) -> None:
    notes, entries = list[Note](), session(3)
    thirds = [at for at, entry in enumerate(entries) if entry.kind.is_input][20:110:40]
    recorder = recorder_of(tmp_path / "a.mcap", notes, flush_s=0.01, **options)
    for at, entry in enumerate(entries):
        if at == thirds[0]:
            disk.refuses = True
            recorder._clock.advance(10**9)  # type: ignore[attr-defined]
        if at == thirds[1]:
            wait_until(lambda: bool(recorder.failure))
            disk.refuses = False
            assert recording.start(recorder)[0]
        recorder(entry)
        if at == thirds[0]:
            wait_until(lambda: bool(recorder.failure))
    summary = recorder.close({"streams": {}})
    assert [note.code for note in notes] == [FAILED, STARTED]
    last = max(path for path in summary.files if path.suffix == ".mcap")
    assert numbers_of(last) == [entry.seq for entry in entries[thirds[1] :]]
    assert summary.entries + sum(summary.dropped.values()) == len(entries) and "Read-only" in summary.failure
    assert recorder.facts()["dropped_since_start"] == 0


@pytest.mark.parametrize("options", [{}, {"split_s": 1e3}], ids=["one file", "parts"])
@pytest.mark.parametrize("from_start", [False, True], ids=["", "from the start"])
def test_after_an_error_of_the_disk_the_recording_goes_on_by_itself_in_a_new_file(
    tmp_path: Path, disk: Disk, options: dict[str, Any], from_start: bool
) -> None:
    notes, entries = list[Note](), session(3)
    disk.refuses = from_start
    recorder = recorder_of(tmp_path / "a.mcap", notes, flush_s=0.01, **options)
    clock = recorder._clock
    thirds = [at for at, entry in enumerate(entries) if entry.kind.is_input][20:110:40]
    for at, entry in enumerate(entries):
        if at == thirds[0]:
            disk.refuses = True
            clock.advance(10**9)  # type: ignore[attr-defined]
        if at == thirds[1]:
            wait_until(lambda: not recorder.counters()["queued_entries"])
            disk.refuses = False
            clock.advance(10**9)  # type: ignore[attr-defined]
            wait_until(lambda: not recorder.failure)
        recorder(entry)
        if at == thirds[0]:
            wait_until(lambda: bool(recorder.failure))
    summary = recorder.close({"streams": {}})
    assert [note.code for note in notes] == [FAILED, AGAIN]
    assert "the disk is tried again" in notes[0].text and "goes on in" in notes[1].text
    last = max(path for path in summary.files if path.suffix == ".mcap")
    assert numbers_of(last) == [entry.seq for entry in entries[thirds[1] :]]
    assert summary.entries + sum(summary.dropped.values()) == len(entries)
    assert "Read-only" in summary.failure, "exit code 1: something is lost"


def test_a_disk_that_stays_away_is_tried_ever_less_often_and_leaves_no_files(tmp_path: Path, disk: Disk) -> None:
    notes = list[Note]()
    recorder = recorder_of(tmp_path / "a.mcap", notes, flush_s=0.01)
    disk.refuses = True
    recorder(session(1)[0])
    recorder._clock.advance(10**9)  # type: ignore[attr-defined]
    wait_until(lambda: bool(recorder.failure))
    for _ in range(300):
        recorder._clock.advance(10**9)  # type: ignore[attr-defined]
        recorder.wake()
    recorder.stop().result(30)
    disk.refuses = False
    recorder._clock.advance(100 * 10**9)  # type: ignore[attr-defined]
    summary = recorder.close({"streams": {}})
    assert [note.code for note in notes] == [FAILED], "not after the stop"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"] and summary.failure


def test_an_earlier_recording_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"of yesterday")
    recorder = recorder_of(tmp_path / "a.mcap", [], waits=True)
    recorder.start()
    assert recorder.close({}).files == (tmp_path / "a_1.mcap",)
    assert (tmp_path / "a.mcap").read_bytes() == b"of yesterday"


def test_each_file_has_a_seal_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "key.pem").write_bytes(SigningKey.generate().private_pem())
    (tmp_path / "key.pem").chmod(0o600)
    recorder = recorder_of(tmp_path / "a.mcap", [], seal=tmp_path / "key.pem")
    entries = session(1)
    for entry in entries[:-1]:
        recorder(entry)
    recorder.stop()
    wait_until(lambda: recorder.rests)
    recorder.start()
    wait_until(lambda: not recorder.rests)
    recorder(entries[-1])
    files = recorder.close({}).files
    assert len(files) == 2 and all(map(stated_seals, files))
    for path in files:
        assert main(["verify", str(path), "--seal"]) == 0


def test_each_file_has_the_time_of_its_own_start(tmp_path: Path) -> None:
    clock = ManualClock(1_700_000_000 * NS_PER_S)
    named = tmp_path / "s_{time}.mcap"
    recorder = recorder_of(tmp_path / "s_0.mcap", [], clock=clock, waits=True, named=named)
    for wait_s in (10, 0, 60):
        clock.advance(wait_s * NS_PER_S)
        recorder.start()
        wait_until(lambda: not recorder.rests)
        recorder.stop()
        wait_until(lambda: recorder.rests)
    names = [path.name for path in recorder.close({}).files]
    assert names == ["s_20231114T221330Z.mcap", "s_20231114T221330Z_2.mcap", "s_20231114T221430Z.mcap"]

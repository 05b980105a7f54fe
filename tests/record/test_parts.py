"""Split recordings, compared with rosbags, pymcap-cli and our own reader."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import Reader

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import DamagedRecording, RecordingError, UnsupportedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.parts import MAX_PER_MINUTE, PartsWriter
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import RecordingSummary
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.verify import DeclaredLosses, verify
from tests.record import samples
from tests.record.notes import TimelessNotes
from tests.timing import WAIT_S

NS = SECOND_NS = 1_000_000_000
RULE = StateInputRule(frozenset({LINKS_TOPIC}))


def session(seconds: int = 5, hz: int = 20) -> list[Entry]:
    """What a gateway makes of a peer that sends, and of a topic that goes to it."""
    gateway = Session(Gateway(Config()))
    up = Note(Level.INFO, LINK_UP, "a peer", data={"address": "127.0.0.1:1"}).pack()
    entries = gateway.input(samples.START_NS, Kind.LINK, (up,), links=(1,))
    for number in range(seconds * hz):
        now_ns = samples.START_NS + (number + 1) * SECOND_NS // hz
        message = samples.igtl_bytes("TRANSFORM", f"Tool{number % 2}", now_ns, bytes(48))
        entries += gateway.input(now_ns, Kind.IGTL_IN, (message,), links=(1,))
        entries += gateway.input(
            now_ns,
            Kind.ROS_IN,
            (samples.string_cdr(f"message {number}"),),
            channel="/igtl/out/Chat",
            type_name="std_msgs/msg/String",
        )
    return entries


def _unexpected(note: Note) -> None:
    pytest.fail(note.text)


def record(
    path: Path, entries: list[Entry], on_note: Callable[[Note], None] = _unexpected, **options: Any
) -> RecordingSummary:
    recorder = Recorder(
        path,
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=on_note,
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(**options),
        rule=RULE,
    )
    for entry in entries:
        recorder(entry)
    return recorder.close({"streams": {}})


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "long.mcap"


def test_parts_by_duration(path: Path) -> None:
    entries = session()
    summary = record(path, entries, split_s=1.0)
    folder = path.with_suffix("")
    names = [f"long_{number}.mcap" for number in range(len(summary.files) - 1)]
    assert 5 <= len(names) <= 6
    assert sorted(file.name for file in folder.iterdir()) == sorted([*names, "metadata.yaml"])
    assert (summary.path, summary.entries, summary.failure) == (folder, len(entries), "")
    assert summary.size == sum(file.stat().st_size for file in folder.iterdir())
    with SessionFile.open(folder) as whole:
        assert list(whole.entries()) == [samples.flat(entry) for entry in entries]
        assert (whole.entry_count, whole.start_ns, whole.end_ns) == (
            len(entries),
            entries[0].stamp_ns,
            entries[-1].stamp_ns,
        )
        assert whole.ledger is not None and whole.ledger["recorder"]["written_entries"] == len(entries)
        assert whole.session == {**samples.SESSION, "format_version": "1"}
    for number, name in enumerate(names):
        with SessionFile.open(folder / name) as part:
            assert part.session["part"] == str(number)
            assert part.session.get("previous_part") == (names[number - 1] if number else None)
            first = next(iter(part.entries()))
            assert first.kind.is_input, "outputs lie in the part of their cause"


def test_every_part_verifies_alone_and_the_folder_as_a_whole(path: Path) -> None:
    entries = session()
    assert any(entry.kind is Kind.IGTL_OUT for entry in entries)
    summary = record(path, entries, split_s=1.0)
    parts = [file for file in summary.files if file.suffix == ".mcap"]
    outputs = 0
    for part in parts:
        with SessionFile.open(part) as file:
            report = verify(
                file.entries(), Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue()
            )
        assert report.good and report.equal == report.outputs > 0, (part, report.differences[:1])
        outputs += report.outputs
    with SessionFile.open(summary.path) as file:
        report = verify(file.entries(), Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue())
    assert report.good and report.outputs == outputs
    with SessionFile.open(parts[-1]) as file:
        assert not verify(file.entries(), Config()).good, "the prologue is what makes it verify"


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"split_s": 1e3}], ids=["one file", "parts"])
@pytest.mark.parametrize("cut", [1, 37, 150, 151, 152, 153])
def test_what_follows_a_file_that_was_truncated_verifies(path: Path, cut: int, options: dict[str, Any]) -> None:
    entries, clock, notes = session(), ManualClock(), TimelessNotes()
    recorder = Recorder(
        path,
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=notes.append,
        clock=clock,
        host=in_thread,
        options=RecordOptions(**options),
        rule=RULE,
    )
    first, second = (path.with_suffix("") / f"long_{number}.mcap" for number in range(2))
    if not options:
        first, second = path, path.with_name("long_1.mcap")
    for entry in entries[:cut]:
        recorder(entry)
    wait_until(lambda: recorder.counters()["written_entries"] == cut)
    os.truncate(first, 0)
    clock.advance(SECOND_NS)
    wait_until(lambda: len(notes) > 0)
    for entry in entries[cut:]:
        recorder(entry)
    summary = recorder.close({"streams": {}})
    assert (summary.entries, sum(summary.dropped.values())) == (len(entries) - cut, cut)
    with SessionFile.open(second) as file:
        assert list(file.entries()) == [samples.flat(entry) for entry in entries[cut:]]
        report = verify(file.entries(), Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue())
    assert report.good and report.equal > 0, report.differences[:3]


def test_parts_by_size(path: Path) -> None:
    entries = [samples.igtl(seq, body=bytes(100_000)) for seq in range(1, 41)]
    summary = record(path, entries, split_bytes=1 << 20, compression="none", chunk_bytes=200_000)
    sizes = [file.stat().st_size for file in summary.files if file.suffix == ".mcap"]
    assert len(sizes) == 4
    assert all(1 << 20 <= size < (1 << 20) + 500_000 for size in sizes[:-1])


def streams(seconds: float, hz: int, *, picture_bytes: int, poses: int = 1) -> list[Entry]:
    """A picture, then messages of ``poses`` other streams in turn."""
    picture = samples.igtl(1, message_type="IMAGE", device="CT", body=os.urandom(picture_bytes))
    return [picture] + [
        replace(samples.igtl(2 + number, device=f"Tool{number % poses}"), stamp_ns=samples.START_NS + number * NS // hz)
        for number in range(1, int(seconds * hz) + 1)
    ]


@pytest.mark.parametrize("options", [{"split_bytes": 1 << 20}, {"split_bytes": 1 << 14, "split_s": 100.0}])
def test_the_prologue_does_not_count_towards_the_size(path: Path, options: dict[str, Any]) -> None:
    entries = streams(2, 500, picture_bytes=3 << 20)
    notes: list[Note] = []
    summary = record(path, entries, notes.append, compression="none", chunk_bytes=8 << 10, **options)
    assert len([file for file in summary.files if file.suffix == ".mcap"]) <= 2
    assert summary.size < 9 << 20
    with SessionFile.open(summary.path) as file:
        assert list(file.entries()) == [samples.flat(entry) for entry in entries]


def test_a_part_with_a_large_prologue_goes_on_until_it_has_as_much_of_its_own_or_for_a_minute(path: Path) -> None:
    entries = streams(200, 10, picture_bytes=3 << 20)
    notes: list[Note] = []
    summary = record(path, entries, notes.append, split_s=1.0, compression="none")
    starts = []
    for file in summary.files[:-1]:
        with SessionFile.open(file) as part:
            starts.append(part.start_ns)
    assert all(59 * NS < two - one < 62 * NS for one, two in pairwise(starts[1:-1])), "a minute each"
    assert len(starts) == 5
    assert [note.code for note in notes] == ["record_split_held"], "once, not at each part"
    assert "3.1 MB" in notes[0].text


def test_no_more_parts_begin_in_a_minute_than_the_bound_says(path: Path) -> None:
    entries = streams(100, 50, picture_bytes=10)
    notes: list[Note] = []
    summary = record(path, entries, notes.append, split_s=0.1)
    starts = []
    for file in summary.files[:-1]:
        with SessionFile.open(file) as part:
            starts.append(part.start_ns)
    for at, start_ns in enumerate(starts):
        assert sum(start_ns <= each < start_ns + 60 * NS for each in starts[at:]) <= MAX_PER_MINUTE + 1
    assert MAX_PER_MINUTE < len(starts) <= 2 * MAX_PER_MINUTE + 2
    assert {note.code for note in notes} == {"record_split_held"} and len(notes) <= 3
    assert "60 parts" in notes[0].text
    with SessionFile.open(summary.path) as whole:
        assert list(whole.entries()) == [samples.flat(entry) for entry in entries]


def test_rosbags_reads_the_folder_by_its_side_file(path: Path) -> None:
    entries = session()
    summary = record(path, entries, split_s=1.0)
    with Reader(summary.path) as bag:
        assert bag.message_count == len(entries)
        assert (bag.start_time, bag.end_time) == (entries[0].stamp_ns, entries[-1].stamp_ns + 1)
        counts = Counter(connection.topic for connection, _, _ in bag.messages())
        assert counts.total() == len(entries)
        assert {topic: info.msgcount for topic, info in bag.topics.items()} == counts
        stamps = [stamp for _, stamp, _ in bag.messages()]
        assert stamps == sorted(stamps)
        assert {"/igtl/links", "/igtl/out/Chat", "/igtl_gateway/notes"} <= counts.keys()


def healthy(file: Path) -> bool:
    """What pymcap-cli thinks of it."""
    doctor = [str(Path(sys.executable).with_name("pymcap-cli")), "doctor", str(file)]
    done = subprocess.run(doctor, check=False, capture_output=True, text=True)
    return done.returncode == 0 and re.search(r"^OK|\b0\s+errors", done.stdout) is not None


@pytest.mark.slow
def test_the_doctor_finds_nothing(path: Path) -> None:
    files = record(path, session(2), split_s=1.0).files
    assert all(healthy(file) for file in files if file.suffix == ".mcap")


def test_a_recording_in_the_way(path: Path) -> None:
    first = record(path, session(3), split_s=1.0)
    before = {file: file.read_bytes() for file in first.files}
    with pytest.raises(RecordingError, match="holds a recording already"):
        record(path, session(1), split_s=1.0)
    assert {file: file.read_bytes() for file in first.files} == before
    stranger = first.path / "notes.txt"
    stranger.write_text("mine")
    second = record(path, session(1), split_s=1.0, overwrite=True)
    assert sorted(second.path.iterdir()) == sorted([*second.files, stranger])
    second.discard()
    assert list(second.path.iterdir()) == [stranger]


@pytest.mark.parametrize(("made", "words"), [("file", "not a folder"), ("nothing above", "there is no folder")])
def test_a_folder_that_cannot_be_made(tmp_path: Path, made: str, words: str) -> None:
    path = tmp_path / "long.mcap"
    if made == "file":
        path.with_suffix("").write_text("in the way")
    else:
        path = tmp_path / "none" / "long.mcap"
    with pytest.raises(RecordingError, match=words):
        record(path, [], split_s=1.0)


def test_nothing_recorded_is_one_empty_part(path: Path) -> None:
    summary = record(path, [], split_s=1.0)
    with SessionFile.open(summary.path) as file:
        assert list(file.entries()) == []
    summary.discard()
    assert not summary.path.exists()


def test_a_part_that_is_missing_is_named(path: Path) -> None:
    summary = record(path, session(3), split_s=1.0)
    summary.files[1].unlink()
    with pytest.raises(DamagedRecording, match="part 1 of the recording is missing"):
        SessionFile.open(summary.path)


def test_other_folders_are_not_taken_for_a_recording(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording, match="found a directory"):
        SessionFile.open(tmp_path)
    recorder = record(tmp_path / "one.mcap", session(1))
    assert recorder.files == (tmp_path / "one.mcap",)
    with pytest.raises(UnsupportedRecording, match=r"found a directory with one\.mcap"):
        SessionFile.open(tmp_path)


@pytest.mark.parametrize("kind", ["folder", "FIFO", "link", "file"])
def test_names_of_coming_parts_that_are_taken_leave_no_gap(path: Path, kind: str) -> None:
    entries = session()
    taken = [path.with_suffix("") / f"long_{number}.mcap" for number in (2, 3)]
    make: dict[str, Callable[[Path], object]] = {
        "folder": Path.mkdir,
        "FIFO": os.mkfifo,
        "link": lambda place: place.symlink_to("nothing"),
        "file": Path.touch,
    }
    done = False

    def on_note(note: Note) -> None:
        pytest.fail(note.text)

    recorder = Recorder(
        path, samples.SESSION, qos_of=lambda _topic, _type: None, on_note=on_note, clock=ManualClock(),
        host=in_thread, options=RecordOptions(split_s=1.0), rule=RULE,
    )  # fmt: skip
    for entry in entries:
        recorder(entry)
        if not done:
            done = True
            for place in taken:
                make[kind](place)
    summary = recorder.close({"streams": {}})
    names = [file.name for file in summary.files if file.suffix == ".mcap"]
    assert names[:3] == ["long_0.mcap", "long_1.mcap", "long_4.mcap"]
    if kind == "file":
        for place in taken:
            place.unlink()
    with SessionFile.open(summary.path) as whole:
        assert list(whole.entries()) == [samples.flat(entry) for entry in entries]
        assert not whole.missing_parts


def written_by_hand(path: Path, **options: Any) -> PartsWriter:
    def open_part(place: Path, facts: dict[str, str], prologue: Sequence[Entry]) -> SessionWriter:
        words = samples.SESSION | facts
        return SessionWriter(
            place, words, qos_of=lambda _topic, _type: None, prologue=prologue, types=RosTypes(), overwrite=True
        )

    return PartsWriter(path, open_part, Prologue(RULE), max_bytes=0, max_s=1.0, counters=dict, **options)


@pytest.mark.parametrize("waits", [True, False])
def test_the_recording_before_stays_until_the_new_one_begins_and_is_gone_then(path: Path, waits: bool) -> None:
    record(path, session(4), split_s=1.0)
    folder = path.with_suffix("")
    before = {file.name for file in folder.iterdir()}
    assert len(before) > 4
    parts = written_by_hand(path, overwrite=True, waits=waits)
    if waits:
        assert {file.name for file in folder.iterdir()} == before and parts.present is None
        assert parts.begin() == folder / "long_1.mcap"
    name = "long_1.mcap" if waits else "long_0.mcap"
    assert {file.name for file in folder.iterdir() if file.suffix == ".mcap"} == {name}
    entries = session(1)[:10]
    for entry in entries:
        parts.write(entry)
    parts.close({})
    with SessionFile.open(folder) as whole:
        assert list(whole.entries()) == [samples.flat(entry) for entry in entries]


def test_the_ledger_of_a_folder_is_that_of_its_last_part(path: Path) -> None:
    """Those before it state that the recording goes on."""
    summary = record(path, session(3), split_s=1.0)
    *others, last = [each for each in summary.files if each.suffix == ".mcap"]
    for each in others:
        with SessionFile.open(each) as file:
            assert file.ledger and file.ledger[layout.GOES_ON_KEY] is True
    with SessionFile.open(last) as file, SessionFile.open(path.with_suffix("")) as whole:
        assert file.ledger and layout.GOES_ON_KEY not in file.ledger
        assert (whole.ledger, whole.recorded_ledger) == (file.ledger, file.recorded_ledger)

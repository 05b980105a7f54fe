"""The recorder with real files, real processes killed for real, and a real disk limit.

Waiting is on conditions, with a deadline that only a failure reaches.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from igtl_gateway.base.clock import Clock, ManualClock, SystemClock
from igtl_gateway.base.errors import DamagedRecording, RecordingError
from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record import host, reports
from igtl_gateway.record import recorder as recorder_module
from igtl_gateway.record.host import WorkerHost, in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.retention.retention_log import RetentionLog
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.selection import Selection
from igtl_gateway.record.sessionfile import layout, messages, writer
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.seal_check import SEALED, check_seal
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.shared_queue import QueueReader
from igtl_gateway.record.worker import WorkerSettings
from tests.places import ROOT
from tests.processes import kill
from tests.record import samples
from tests.record.notes import LATENESS, TimelessNotes

DEADLINE_S = 30.0


def wait_until(condition: Callable[[], bool]) -> None:
    clock, tick = SystemClock(), threading.Event()
    deadline_ns = clock.monotonic_ns() + int(DEADLINE_S * 1e9)
    while not condition():
        assert clock.monotonic_ns() < deadline_ns
        tick.wait(0.001)


class Bench:
    """A recorder, its messages, and a way to stop its thread: inside the query for the QoS of a topic."""

    def __init__(self, path: Path, **options: object) -> None:
        self.clock = ManualClock()
        self.notes: list[Note] = []
        #: Notes that the file is behind, and that it is not any more: each step of the clock may cause one.
        self.lateness: list[Note] = []
        self.asked = threading.Event()
        self.go_on = threading.Event()
        self.go_on.set()
        self._changed = threading.Condition()
        self.recorder = Recorder(
            path,
            samples.SESSION,
            qos_of=self._qos_of,
            on_note=self._on_note,
            clock=self.clock,
            host=in_thread,
            options=RecordOptions(**options),  # type: ignore[arg-type]
        )

    def hold(self, seq: int) -> None:
        """Make the thread stop at an entry, and return when it does."""
        self.wait_drained()
        self.asked.clear()
        self.go_on.clear()
        self.recorder(samples.ros(seq, topic=f"/hold_{seq}"))
        assert self.asked.wait(DEADLINE_S)

    def _qos_of(self, _topic: str, _type: str) -> Qos | None:
        self.asked.set()
        assert self.go_on.wait(DEADLINE_S)
        return None

    def _on_note(self, note: Note) -> None:
        with self._changed:
            (self.lateness if note.code in LATENESS else self.notes).append(note)
            self._changed.notify_all()

    def wait_drained(self) -> None:
        wait_until(lambda: not self.recorder.counters()["queued_entries"])

    def wait_notes(self, number: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.notes) >= number, DEADLINE_S)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "session.mcap"


def read(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


# --- what is recorded ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["auto", "lz4", "zstd", "none"])
def test_what_went_in_is_in_the_file(path: Path, compression: str) -> None:
    bench = Bench(path, compression=compression)
    entries = samples.every_kind(100)
    for entry in entries:
        bench.recorder(entry)
    summary = bench.recorder.close({"streams": {"a": {}}})
    assert (summary.path, summary.entries, summary.dropped, summary.failure) == (path, len(entries), {}, "")
    assert summary.size == path.stat().st_size
    assert read(path) == [samples.flat(entry) for entry in entries]
    with SessionFile.open(path) as file:
        assert file.session == {**samples.SESSION, "format_version": "1"}
        assert file.ledger is not None
        assert file.ledger["streams"] == {"a": {}}
        assert file.ledger["recorder"]["written_entries"] == len(entries)
        assert file.ledger["recorder"]["dropped_entries"] == 0
    assert bench.notes == []


def test_closing_twice_gives_the_same_summary(path: Path) -> None:
    bench = Bench(path)
    bench.recorder(samples.ros(1))
    first = bench.recorder.close({"first": True})
    before = path.read_bytes()
    assert bench.recorder.close({"second": True}) == first
    assert path.read_bytes() == before


def test_entries_after_the_end_are_counted_as_dropped(path: Path) -> None:
    bench = Bench(path)
    bench.recorder.close({})
    bench.recorder(samples.ros(1))
    assert bench.recorder.counters()["dropped"] == {"/chatter": 1}


@pytest.mark.parametrize("compression", ["auto", "lz4", "zstd", "none"])
def test_equal_entries_give_equal_files(tmp_path: Path, compression: Compression) -> None:
    files = []
    for name in ("a", "b"):
        writer = SessionWriter(tmp_path / name, samples.SESSION, compression=compression, chunk_bytes=4096)
        for entry in samples.every_kind(50):
            writer.write(entry)
        writer.close({})
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]


def test_a_session_without_entries_is_a_whole_file(path: Path) -> None:
    Bench(path).recorder.close({})
    assert read(path) == []


# --- the file cannot be created --------------------------------------------------------------------------------


def _in_missing_folder(tmp_path: Path) -> Path:
    return tmp_path / "no" / "such" / "session.mcap"


def _directory(tmp_path: Path) -> Path:
    return tmp_path


def _existing(tmp_path: Path) -> Path:
    path = tmp_path / "session.mcap"
    path.write_bytes(b"precious")
    return path


def _under_a_file(tmp_path: Path) -> Path:
    return _existing(tmp_path) / "session.mcap"


def _too_long(tmp_path: Path) -> Path:
    return tmp_path / ("x" * 300)


def _device(_tmp_path: Path) -> Path:
    return Path("/dev/full")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_in_missing_folder, "there is no folder"),
        (_directory, "it is a folder, expected a file or a new name"),
        (_existing, "exists already"),
        (_under_a_file, "is a file, expected a folder"),
        (_too_long, "File name too long: 300 bytes"),
        (_device, "it is a device"),
    ],
)
def test_a_file_that_cannot_be_created(tmp_path: Path, make: Callable[[Path], Path], words: str) -> None:
    path = make(tmp_path)
    with pytest.raises(RecordingError, match=words) as caught:
        Bench(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_existing_file_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    path = _existing(tmp_path)
    with pytest.raises(RecordingError):
        Bench(path)
    assert path.read_bytes() == b"precious"
    bench = Bench(path, overwrite=True)
    bench.recorder(samples.ros(1))
    bench.recorder.close({})
    assert read(path) == [samples.ros(1)]


def test_two_at_once_do_not_write_to_the_same_file(path: Path) -> None:
    first = Bench(path)
    first.recorder(samples.ros(1))
    with pytest.raises(RecordingError, match="another process is recording to it"):
        Bench(path, overwrite=True)
    assert first.recorder.close({}).failure == ""
    assert read(path) == [samples.ros(1)]
    Bench(path, overwrite=True).recorder.close({})
    assert read(path) == []


# --- drops -----------------------------------------------------------------------------------------------------


def test_beyond_the_bound_entries_are_dropped_counted_and_noted(path: Path) -> None:
    bench = Bench(path, queue_entries=10)
    bench.hold(1)
    for seq in range(2, 32):
        bench.recorder(samples.igtl(seq, device="a" if seq % 2 else "b"))
    # the held one counts, so nine of thirty found a place
    dropped = {"TRANSFORM/a": 11, "TRANSFORM/b": 10}
    counters = bench.recorder.counters()
    assert (counters["dropped"], counters["dropped_entries"], counters["queued_entries"]) == (dropped, 21, 10)
    bench.go_on.set()
    bench.wait_notes(1)
    (note,) = bench.notes
    assert (note.level, note.code, note.data) == (Level.WARN, reports.DROPPED, {"dropped": dropped})
    told = Entry(40, samples.START_NS + 40, Kind.EDGE_NOTE, payload=(note.pack(),))
    bench.recorder(told)
    summary = bench.recorder.close({})
    assert (summary.entries, summary.dropped) == (11, dropped)
    entries = read(path)
    assert [entry.seq for entry in entries] == [*range(1, 11), 40]
    assert entries[-1] == told
    with SessionFile.open(path) as file:
        assert file.ledger is not None
        assert file.ledger["recorder"]["dropped_entries"] == 21


def test_the_bound_in_bytes(path: Path) -> None:
    bench = Bench(path, queue_bytes=1_000_000)
    bench.hold(1)
    for seq in range(2, 12):
        bench.recorder(samples.igtl(seq, body=bytes(200_000)))
    assert bench.recorder.counters()["dropped_entries"] == 6
    bench.go_on.set()
    assert bench.recorder.close({}).entries == 5


def test_one_entry_larger_than_the_bound_is_recorded(path: Path) -> None:
    bench = Bench(path, queue_bytes=1000)
    bench.recorder(samples.igtl(1, body=bytes(100_000)))
    assert bench.recorder.close({}).entries == 1


def test_drops_are_noted_at_most_once_a_second_but_all_of_them(path: Path) -> None:
    bench = Bench(path, queue_entries=1)
    bench.hold(1)
    bench.recorder(samples.igtl(2))
    bench.go_on.set()
    bench.wait_notes(1)
    bench.hold(3)
    bench.recorder(samples.igtl(4))
    bench.go_on.set()
    bench.hold(5)  # the thread has been through its round of the first second: no second note
    assert len(bench.notes) == 1
    bench.clock.advance(1_000_000_000)
    bench.recorder(samples.igtl(6))
    bench.go_on.set()
    bench.wait_notes(2)
    assert [note.data for note in bench.notes] == [{"dropped": {"TRANSFORM/ProbeToTracker": n}} for n in (1, 2)]
    assert bench.recorder.close({}).dropped == {"TRANSFORM/ProbeToTracker": 3}


def test_drops_are_told_while_the_queue_is_never_empty(path: Path) -> None:
    turns, told = threading.Semaphore(0), threading.Event()
    notes: list[Note] = []

    def qos_of(_topic: str, _type: str) -> Qos | None:
        assert turns.acquire(timeout=DEADLINE_S)
        return None

    def on_note(note: Note) -> None:
        notes.append(note)
        told.set()

    recorder = Recorder(
        path, {}, qos_of=qos_of, on_note=on_note, clock=ManualClock(), host=in_thread,
        options=RecordOptions(queue_entries=3),
    )  # fmt: skip
    for seq in range(1, 11):
        recorder(samples.ros(seq, topic=f"/hold_{seq}"))
    turns.release()  # for one of the three: the next one waits
    assert told.wait(DEADLINE_S)
    counters = recorder.counters()
    assert (counters["written_entries"], counters["queued_entries"]) == (1, 2)
    assert [note.data for note in notes] == [{"dropped": {f"/hold_{seq}": 1 for seq in range(4, 11)}}]
    turns.release(2)
    assert recorder.close({}).entries == 3


def test_what_is_no_entry_counts_as_dropped(path: Path) -> None:
    bench = Bench(path)
    bad: Entry = Entry(1, 1, Kind.ROS_IN, 5, "std_msgs/msg/String")  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        bench.recorder(bad)
    bench.recorder(samples.ros(2))
    summary = bench.recorder.close({})
    assert (summary.entries, summary.dropped, summary.failure) == (1, {"5": 1}, "")


def test_streams_of_drops_are_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "MAX_STREAMS", 2)
    bench = Bench(path)
    bench.recorder.close({})
    for number in range(5):
        bench.recorder(samples.igtl(number, device=f"n{number}"))
    assert bench.recorder.counters()["dropped"] == {"TRANSFORM/n0": 1, "TRANSFORM/n1": 1, "(others)": 3}


# --- entries that do not fit -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad",
    [
        Entry(2, 2, Kind.IGTL_IN, "no slash", "IMAGE"),
        Entry(2, -1, Kind.ROS_IN, "/chatter", "std_msgs/msg/String", (b"",)),
        Entry(2, 2, Kind.ROS_IN, "/chatter", "std_msgs/msg/String", (b"",), source_ns=2**64),
        Entry(2, 2, Kind.IGTL_OUT, "IMAGE/a", "IMAGE", (b"",), links=(2**32,)),
    ],
    ids=["channel", "stamp", "source stamp", "link"],
)
def test_an_entry_that_the_format_cannot_hold_costs_only_itself(path: Path, bad: Entry) -> None:
    bench = Bench(path)
    for entry in (samples.ros(1), bad, bad, samples.ros(3)):
        bench.recorder(entry)
    summary = bench.recorder.close({})
    assert summary.dropped == {bad.channel: 2}
    assert [(note.level, note.code, note.stream) for note in bench.notes] == [
        (Level.ERROR, reports.REFUSED, bad.channel)
    ]
    assert read(path) == [samples.ros(1), samples.ros(3)]


def test_a_type_without_definition_is_recorded_and_noted_once(path: Path) -> None:
    entries = [Entry(seq, seq, Kind.ROS_IN, f"/t{seq}", "unheard_of/msg/Thing", (b"\0\1\0\0x",)) for seq in (1, 2)]
    bench = Bench(path)
    for entry in entries:
        bench.recorder(entry)
    bench.recorder.close({})
    assert [note.code for note in bench.notes] == [reports.UNDEFINED]
    assert read(path) == entries


# --- kill −9 ---------------------------------------------------------------------------------------------------

RECORDING_CHILD = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import Selection
from tests.record import samples
path, clock = Path(sys.argv[1]), SystemClock()
recorder = Recorder(path, samples.SESSION, qos_of=lambda topic, type: None, on_note=print, clock=clock)
for seq in range(1, 1001):
    recorder(samples.igtl(seq))
print("given", flush=True)
seq = 1000
while True:
    threading.Event().wait(0.001)
    if sys.argv[2] == "busy":
        seq += 1
        recorder(samples.igtl(seq))
"""


def scanned(path: Path) -> Iterator[Entry]:
    """Entries of a file without index, as far as it can be read."""
    kinds = {}
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    kinds[record.id] = record.metadata[layout.KIND_KEY]
                elif isinstance(record, Message):
                    assert kinds[record.channel_id] == Kind.IGTL_IN.value
                    yield messages.unpack_raw(record.data, record.sequence, record.log_time, record.publish_time)
        except (McapError, ValueError, RuntimeError):
            return


def workers(process: int) -> list[int]:
    """The processes of its recorders, without other children that tests of this process have left."""
    tasks = Path(f"/proc/{process}/task").iterdir()
    children = [int(word) for task in tasks for word in (task / "children").read_text().split()]
    return [child for child in children if host.__name__.encode() in Path(f"/proc/{child}/cmdline").read_bytes()]


def closed(path: Path) -> SessionFile:
    """The recording, as soon as its worker has closed it."""
    clock, tick = SystemClock(), threading.Event()
    deadline_ns = clock.monotonic_ns() + int(DEADLINE_S * 1e9)
    while True:
        try:
            return SessionFile.open(path)
        except DamagedRecording:
            assert clock.monotonic_ns() < deadline_ns
            tick.wait(0.01)


def test_when_the_process_is_killed_all_that_it_gave_is_there(path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", RECORDING_CHILD, str(path), "busy"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "given\n"
        child.kill()
        assert child.wait() == -signal.SIGKILL
    with closed(path) as file:
        entries = list(file.entries())
        assert file.ledger is not None and file.ledger["cut_off"] is True
        assert file.ledger["recorder"]["written_entries"] == len(entries) >= 1000
        assert entries == [samples.flat(samples.igtl(seq)) for seq in range(1, len(entries) + 1)]


def test_when_the_worker_is_killed_it_is_told_and_the_process_goes_on(path: Path) -> None:
    notes = TimelessNotes()
    recorder = Recorder(path, {}, qos_of=lambda *_: None, on_note=notes.append, clock=SystemClock())
    for seq in range(1, 101):
        recorder(samples.igtl(seq))
    (worker,) = workers(os.getpid())
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: bool(notes))
    recorder(samples.igtl(101))
    assert [note.code for note in notes] == [reports.FAILED]
    assert "the recorder's process has ended: killed by signal 9; the bridge goes on" in notes[0].text
    summary = recorder.close({})
    assert "killed by signal 9" in summary.failure
    assert (summary.files, summary.entries + sum(summary.dropped.values())) == ((path,), 101)
    with pytest.raises(RecordingError, match="has ended"):
        recorder.snapshot().result(DEADLINE_S)


def _resident(name: str) -> int:
    """Return the resident bytes of the mappings of this process whose name contains this one."""
    found, counts = 0, False
    for line in Path("/proc/self/smaps").read_text("ascii").splitlines():
        if not line.split()[0].endswith(":"):
            counts = name in line
        elif counts and line.startswith("Rss:"):
            found += int(line.split()[1]) << 10
    return found


def test_the_memory_of_the_queue_is_given_back_when_the_worker_is_killed(path: Path) -> None:
    """Before, the bridge kept for its life what waited for the recorder then."""
    notes = TimelessNotes()
    recorder = Recorder(path, {}, qos_of=lambda *_: None, on_note=notes.append, clock=SystemClock())
    (worker,) = workers(os.getpid())
    os.kill(worker, signal.SIGSTOP)
    for seq in range(1, 101):
        recorder(replace(samples.igtl(seq), payload=(bytes(1 << 20),)))
    assert _resident("igtl-gateway recorder") > 80 << 20
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: bool(notes))
    assert _resident("igtl-gateway recorder") < 20 << 20
    assert sum(recorder.close({}).dropped.values()) + recorder.counters()["written_entries"] == 100


def test_signals_to_all_processes_of_a_service_leave_the_end_to_the_bridge(path: Path) -> None:
    notes = TimelessNotes()
    recorder = Recorder(path, {}, qos_of=lambda *_: None, on_note=notes.append, clock=SystemClock())
    (worker,) = workers(os.getpid())
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGABRT, signal.SIGQUIT):
        os.kill(worker, number)
    recorder(samples.igtl(1))
    summary = recorder.close({})
    assert (summary.entries, summary.failure, notes) == (1, "", [])


DROPPING_CHILD = """
import os, signal, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from tests.record import samples
from tests.record.test_recorder import workers
options = RecordOptions(queue_entries=10)
recorder = Recorder(
    Path(sys.argv[1]), {}, qos_of=lambda *_: None, on_note=print, clock=SystemClock(), options=options
)
(worker,) = workers(os.getpid())
os.kill(worker, signal.SIGSTOP)
for seq in range(1, 1001):
    recorder(samples.igtl(seq))
print(worker, flush=True)
signal.pause()
"""


def test_when_the_process_is_killed_while_it_drops_the_counts_close(path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", DROPPING_CHILD, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        worker = int(child.stdout.readline())
        child.kill()
        child.wait()
        os.kill(worker, signal.SIGCONT)
    with closed(path) as file:
        assert file.ledger is not None
        told = file.ledger["recorder"]
        assert told["written_entries"] == sum(1 for _ in file.entries()) >= 10
        assert told["written_entries"] + told["dropped_entries"] == 1000


FORKING_CHILD = """
import os, signal, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.recorder import Recorder
from tests.record import samples
recorder = Recorder(Path(sys.argv[1]), {}, qos_of=lambda *_: None, on_note=print, clock=SystemClock())
forked = os.fork()
if forked:
    recorder(samples.igtl(1))
    print(forked, flush=True)
signal.pause()
"""


FILLING_CHILD = """
import signal, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.recorder import Recorder
from tests.record import samples
recorder = Recorder(Path(sys.argv[1]), {}, qos_of=lambda *_: None, on_note=print, clock=SystemClock())
recorder(samples.igtl(1))
copies = [recorder.reserve(samples.igtl(seq, body=bytes(100_000))) for seq in (2, 3)]
recorder(samples.igtl(4))
copies[1]()
print("given", flush=True)
signal.pause()
"""


def test_when_the_process_is_killed_only_the_payload_that_it_copies_is_lost(path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FILLING_CHILD, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "given\n"
        child.kill()
        child.wait()
    with closed(path) as file:
        assert [entry.seq for entry in file.entries()] == [1, 3, 4]
        assert file.ledger is not None
        assert file.ledger["recorder"]["dropped"] == {"TRANSFORM/ProbeToTracker": 1}


def test_the_end_waits_for_a_payload_that_is_being_copied(path: Path) -> None:
    lock = threading.Lock()
    recorder = Recorder(path, {}, qos_of=lambda *_: None, on_note=print, clock=SystemClock(), lock=lock)
    large = samples.igtl(2, body=bytes(100_000))
    assert recorder.reserve(samples.igtl(1)) is None
    copy = recorder.reserve(large)
    assert copy is not None and not lock.locked()
    with ThreadPoolExecutor() as pool:
        end = pool.submit(recorder.close, {})
        with pytest.raises(TimeoutError):
            end.result(0.3)
        copy()
        assert end.result(DEADLINE_S).entries == 2
    assert recorder.reserve(large) is None
    assert recorder.counters()["dropped_entries"] == 1
    with SessionFile.open(path) as file:
        assert [entry.data() for entry in file.entries()] == [samples.igtl(1).data(), large.data()]


def test_when_the_process_is_killed_and_one_that_it_forked_is_not(path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FORKING_CHILD, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        forked = int(child.stdout.readline())
        try:
            child.kill()
            child.wait()
            with closed(path) as file:
                assert len(list(file.entries())) == 1
        finally:
            os.kill(forked, signal.SIGKILL)


def test_where_no_process_is_to_be_had_it_is_a_thread_and_says_so(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    notes = TimelessNotes()
    recorder = Recorder(path, {}, qos_of=lambda *_: None, on_note=notes.append, clock=SystemClock())
    recorder(samples.igtl(1))
    assert recorder.close({}).entries == 1
    assert [(note.code, note.text) for note in notes] == [
        (
            reports.THREAD,
            "no process of the recorder's own (Resource temporarily unavailable): it is a thread of the bridge",
        )
    ]


def test_modules_are_found_where_the_process_finds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "here", "/there"])
    assert host._python_path() == [str(tmp_path), str(tmp_path / "here"), "/there"]


@pytest.mark.slow
@pytest.mark.parametrize("work", ["idle", "busy"])
def test_after_kill_9_of_both_everything_flushed_is_there(path: Path, work: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", RECORDING_CHILD, str(path), work], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "given\n"
            clock, tick = SystemClock(), threading.Event()
            deadline_ns = clock.monotonic_ns() + int(DEADLINE_S * 1e9)
            # nothing closes the file: that all thousand come to be read is the flush's work
            while sum(1 for _ in scanned(path)) < 1000:
                assert clock.monotonic_ns() < deadline_ns
                tick.wait(0.05)
        finally:
            kill(*workers(child.pid), child.pid)
        assert child.wait() == -signal.SIGKILL
    entries = list(scanned(path))
    assert len(entries) >= 1000
    assert entries == [samples.flat(samples.igtl(seq)) for seq in range(1, len(entries) + 1)]
    with pytest.raises(DamagedRecording, match=r"was cut off .* run: igtl-gateway recover"):
        SessionFile.open(path)
    mended = path.with_name("mended.mcap")
    subprocess.run(
        [Path(sys.executable).with_name("pymcap-cli"), "recover", path, mended], check=False, capture_output=True
    )
    with SessionFile.open(mended) as file:
        assert (file.foreign, file.session["config"], file.ledger) == (False, samples.SESSION["config"], None)
        assert list(file.entries()) == entries


# --- disk full -------------------------------------------------------------------------------------------------

FULL_DISK_CHILD = """
import json, os, resource, sys, threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import Selection
from tests.record import samples
from tests.record.notes import LATENESS
from tests.record.test_recorder import noise, workers
notes, failed = [], threading.Event()
def on_note(note):
    if note.code not in LATENESS:
        notes.append(note.code)
        failed.set()
path, clock = Path(sys.argv[1]), SystemClock()
given = dict(on_note=on_note, clock=clock, options=RecordOptions(flush_s=0.001))  # what was flushed stays
recorder = Recorder(path, samples.SESSION, qos_of=lambda topic, type: None, **given)
(worker,) = workers(os.getpid())
resource.prlimit(worker, resource.RLIMIT_FSIZE, (4_000_000, 4_000_000))
seq = 0
while not failed.is_set():
    seq += 1
    recorder(samples.igtl(seq, body=noise(seq)))
    while recorder.counters()["queued_entries"] > 100 and not failed.is_set():
        failed.wait(0.001)  # the file is to be the limit, not the queue
recorder(samples.igtl(seq + 1))
summary = recorder.close({})
print(json.dumps({"given": seq + 1, "notes": notes, "entries": summary.entries, "dropped": summary.dropped,
                  "failure": summary.failure}))
"""


def noise(seed: int) -> bytes:
    """What no compression makes smaller."""
    return random.Random(seed).randbytes(50_000)


@pytest.mark.slow
def test_when_the_disk_is_full_the_recording_ends_and_the_process_goes_on(path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK_CHILD, str(path)],
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    assert done.stderr == ""
    told = json.loads(done.stdout)
    assert told["notes"] == [reports.FAILED]
    assert str(path) in told["failure"]
    assert sum(told["dropped"].values()) + told["entries"] == told["given"]
    entries = list(scanned(path))
    assert entries
    assert entries == [samples.flat(samples.igtl(n, body=noise(n))) for n in range(1, len(entries) + 1)]


def test_a_full_disk_at_the_start_is_told_and_leaves_nothing(path: Path) -> None:
    code = f"""
import resource
import shutil
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.record.sessionfile.writer import SessionWriter
try:
    SessionWriter(Path({str(path)!r}), {{}})
except RecordingError as error:
    print(error)
"""
    # -B: Python would keep the first 100 bytes of modules that it compiles, and does not notice
    done = subprocess.run([sys.executable, "-B", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"cannot record to {path}: ")
    assert done.stdout.count("\n") == 1
    assert not path.exists()


def test_a_writer_that_failed_says_so_again_and_closes_quietly(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = SessionWriter(path, samples.SESSION)
    writer.write(samples.ros(1))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer._mcap, "flush", full)
    for _ in range(2):
        with pytest.raises(RecordingError, match="No space left on device"):
            writer.flush()
    writer.close({})


def test_a_defect_in_the_thread_ends_the_recording_not_the_process(path: Path) -> None:
    notes = TimelessNotes()

    def broken(_topic: str, _type: str) -> Qos | None:
        raise KeyError("defect")

    recorder = Recorder(path, {}, qos_of=broken, on_note=notes.append, clock=SystemClock())
    recorder(samples.igtl(1))
    for seq in range(2, 6):
        recorder(samples.ros(seq))
    summary = recorder.close({})
    assert "KeyError" in summary.failure
    assert [note.code for note in notes] == [reports.FAILED]
    assert summary.entries + sum(summary.dropped.values()) == 5
    assert len(read(path)) == summary.entries  # closed all the same


def test_a_disk_that_does_not_answer_is_reported_while_it_does_not(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, go_on, write = Bench(path), threading.Event(), SessionWriter.write

    def slow(file: SessionWriter, entry: Entry) -> None:
        assert go_on.wait(DEADLINE_S)
        write(file, entry)

    monkeypatch.setattr(SessionWriter, "write", slow)
    bench.recorder(samples.ros(1))
    while not (stalled := [note for note in bench.notes if note.code == recorder_module.STALLED]):
        bench.clock.advance(1_000_000_000)
        threading.Event().wait(0.05)
    (note,) = stalled
    assert note.level is Level.WARN
    assert "the disk does not answer" in note.text and bench.recorder.facts()["stalled_s"] > 0
    go_on.set()
    wait_until(lambda: any(note.code == recorder_module.MOVES for note in bench.notes))
    assert bench.recorder.facts()["stalled_s"] == 0
    assert bench.recorder.close({}).entries == 1


# --- what is taken away ----------------------------------------------------------------------------------------


def _remove(path: Path) -> None:
    path.unlink()


def _remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


def _replace(path: Path) -> None:
    path.unlink()
    path.write_bytes(b"somebody else's")


def _truncate(path: Path) -> None:
    os.truncate(path, 0)


def _truncate_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"somebody else's")


_TAKEN = [
    (_truncate, "the file was truncated"),
    (_truncate_in_half, "the file was truncated"),
    (_append, "another program wrote to the file"),
    (_remove, "the file was removed"),
    (_replace, "another file took its place"),
]


@pytest.mark.parametrize(("take_away", "words"), [*_TAKEN, (_remove_folder, "the file was removed")])
def test_a_file_that_is_taken_away_ends_the_recording_if_that_is_to_stop(
    tmp_path: Path, take_away: Callable[[Path], None], words: str
) -> None:
    path = tmp_path / "folder" / "session.mcap"
    path.parent.mkdir()
    bench = Bench(path, stop_on_failure=True)
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    take_away(path)
    bench.clock.advance(1_000_000_000)
    bench.recorder(samples.ros(2))
    bench.wait_notes(1)
    (note,) = bench.notes
    assert (note.level, note.code) == (Level.ERROR, reports.FAILED)
    assert words in note.text and "the bridge stops" in note.text
    assert words in bench.recorder.failure
    summary = bench.recorder.close({})
    assert words in summary.failure
    assert (summary.entries, summary.dropped, summary.files) == (0, {reports.TAKEN: 2}, ())


def test_a_folder_that_is_taken_away_ends_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "session.mcap"
    path.parent.mkdir()
    bench = Bench(path)
    empty = path.stat().st_size
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    bench.clock.advance(1_000_000_000)
    wait_until(lambda: path.stat().st_size > empty)
    _remove_folder(path)
    bench.clock.advance(1_000_000_000)
    bench.recorder(samples.ros(2))
    bench.wait_notes(1)
    (note,) = bench.notes
    assert note.code == reports.FAILED
    assert "the file was removed" in note.text and "the bridge goes on without recording" in note.text
    summary = bench.recorder.close({})
    assert "there is no folder" in summary.failure
    assert (summary.entries, summary.dropped, summary.files) == (0, {reports.TAKEN: 2}, ())


@pytest.mark.parametrize("split", [False, True], ids=["one file", "parts"])
def test_the_next_start_after_a_file_was_taken_away_names_it(tmp_path: Path, split: bool) -> None:
    place = tmp_path / "folder"
    place.mkdir()
    bench = Bench(place / "session.mcap", split_bytes=(1 << 30) * split)
    folder = place / "session" if split else place
    first = folder / ("session_0.mcap" if split else "session.mcap")
    empty = first.stat().st_size
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    bench.clock.advance(1_000_000_000)
    wait_until(lambda: first.stat().st_size > empty)
    _remove_folder(place / "session.mcap")
    bench.clock.advance(1_000_000_000)
    bench.wait_notes(1)
    place.mkdir()
    bench.recorder.start()
    wait_until(lambda: not bench.recorder.rests)
    bench.recorder(samples.ros(2))
    summary = bench.recorder.close({})
    (second,) = [path for path in summary.files if path.suffix == ".mcap"]
    assert (summary.entries, summary.dropped) == (1, {reports.TAKEN: 1})
    with SessionFile.open(second) as file:
        assert file.session["previous_part"] == first.name


@pytest.mark.parametrize("sealed", [False, True], ids=["not sealed", "sealed"])
@pytest.mark.parametrize("split", [False, True], ids=["one file", "parts"])
@pytest.mark.parametrize(("take_away", "words"), _TAKEN)
def test_where_a_file_is_taken_away_the_recording_goes_on_in_the_next(
    tmp_path: Path, take_away: Callable[[Path], None], words: str, split: bool, sealed: bool
) -> None:
    options: dict[str, object] = {"split_bytes": 1 << 30} if split else {}
    if sealed:
        (tmp_path / "key").touch(0o600)
        (tmp_path / "key").write_bytes(SigningKey.generate().private_pem())
        options["seal"] = tmp_path / "key"
    folder = tmp_path / "session" if split else tmp_path
    first = folder / ("session_0.mcap" if split else "session.mcap")
    bench = Bench(tmp_path / "session.mcap", **options)
    before = samples.every_kind(2)
    entries = [replace(entry, seq=100 + entry.seq) for entry in samples.every_kind(40)]
    empty = first.stat().st_size
    for entry in before:
        bench.recorder(entry)
    bench.wait_drained()
    bench.clock.advance(1_000_000_000)
    wait_until(lambda: first.stat().st_size > empty)
    take_away(first)
    bench.clock.advance(1_000_000_000)
    bench.wait_notes(1)
    for entry in entries:
        bench.recorder(entry)
    (note,) = bench.notes
    second, lost = folder / "session_1.mcap", len(before)
    assert (note.level, note.code) == (Level.ERROR, reports.CONTINUED)
    assert note.data == {"lost": lost, "path": str(second)}
    told = f"recording to {first} failed: {words}; the recording goes on in {second}"
    assert note.text == f"{told}; {lost} entries were in the file"
    assert (bench.recorder.failure, bench.recorder.counters()["taken_away"]) == ("", told)
    summary = bench.recorder.close({"streams": {}})
    put = [samples.flat(entry) for entry in entries]
    assert (summary.failure, summary.entries, summary.dropped) == (told, len(put), {reports.TAKEN: lost})
    assert second in summary.files and first not in summary.files
    with SessionFile.open(second) as file:
        assert list(file.entries()) == put
        assert (file.session["part"], file.session["previous_part"]) == ("1", first.name)
        assert file.ledger is not None and file.ledger["recorder"]["taken_away"] == told
        assert Kind.LINK in {entry.kind for entry in file.prologue()}
    if sealed:
        assert check_seal(second).state == SEALED


@pytest.mark.parametrize("split", [False, True], ids=["one file", "parts"])
def test_a_file_that_is_taken_away_before_the_end_has_its_ledger_in_the_next(tmp_path: Path, split: bool) -> None:
    bench = Bench(tmp_path / "session.mcap", split_bytes=(1 << 30) * split)
    folder = tmp_path / "session" if split else tmp_path
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    os.truncate(folder / ("session_0.mcap" if split else "session.mcap"), 0)
    summary = bench.recorder.close({"streams": {"a": {}}})
    assert "the file was truncated" in summary.failure
    assert (summary.entries, summary.dropped) == (0, {reports.TAKEN: 1})
    with SessionFile.open(folder / "session_1.mcap") as file:
        assert file.ledger is not None and file.ledger["streams"] == {"a": {}}
        assert file.ledger["recorder"]["dropped"] == {reports.TAKEN: 1}


def test_a_folder_of_parts_that_is_taken_away_is_made_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "session.mcap", split_s=1e-6)
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    shutil.rmtree(tmp_path / "session")
    bench.recorder(samples.ros(10_000))
    bench.wait_notes(1)
    second = tmp_path / "session" / "session_1.mcap"
    assert f"was removed; the recording goes on in {second}" in bench.notes[0].text
    assert bench.recorder.close({}).dropped == {reports.TAKEN: 1}
    with SessionFile.open(second) as file:
        assert len(list(file.entries())) == 1


# --- flush and fsync -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fsync", "while_open", "in_all"), [("never", 0, 0), ("close", 0, 1), ("flush", 1, 2)])
def test_the_disk_is_asked_to_have_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, fsync: str, while_open: int, in_all: int
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(writer, "_DATASYNC", asked.append)
    bench = Bench(path, fsync=fsync, flush_s=0.5)
    bench.clock.advance(600_000_000)
    bench.recorder(samples.ros(1))
    bench.wait_drained()
    bench.hold(2)  # behind the flush that was due with the first entry
    assert len(asked) == while_open
    bench.go_on.set()
    bench.recorder.close({})
    assert len(asked) == in_all


@pytest.mark.parametrize(("flush_s", "passed_s"), [(0.5, 0.4), (0.1, 0.08), (2.0, 1.9)])
def test_it_is_flushed_before_the_interval_ends(path: Path, flush_s: float, passed_s: float) -> None:
    """Looking for entries and writing them takes time, too: what is older than the interval is in the file."""
    bench = Bench(path, flush_s=flush_s, compression="none")
    empty = path.stat().st_size
    bench.recorder(samples.igtl(1, body=bytes(5000)))
    bench.wait_drained()
    bench.clock.advance(int(passed_s * 1e9))
    wait_until(lambda: path.stat().st_size > empty + 5000)
    bench.recorder.close({})


def test_a_recorder_that_is_late_flushes_earlier(path: Path) -> None:
    """Without processor time for 0.3 s of an interval of 0.5 s, another 0.1 s might be another 0.3 s."""
    bench = Bench(path, compression="none")
    empty = path.stat().st_size
    bench.recorder(samples.igtl(1, body=bytes(5000)))
    bench.wait_drained()
    bench.clock.advance(300_000_000)
    wait_until(lambda: path.stat().st_size > empty + 5000)
    bench.recorder.close({})


# --- pause -----------------------------------------------------------------------------------------------------


def test_a_pause_leaves_out_and_says_how_much(path: Path) -> None:
    bench = Bench(path)
    bench.recorder(samples.ros(1))
    bench.recorder.pause()
    bench.recorder.pause()
    for seq in range(2, 7):
        bench.recorder(samples.ros(seq))
    bench.recorder(samples.note(7, Kind.LINK))
    bench.recorder.resume()
    bench.recorder(samples.ros(8))
    bench.wait_notes(2)
    states = [bench.recorder.paused]
    bench.recorder.pause()
    bench.wait_notes(3)
    states.append(bench.recorder.paused)
    assert states == [False, True]
    summary = bench.recorder.close({})
    assert [(note.code, note.data) for note in bench.notes] == [
        (reports.PAUSED, {}),
        (reports.RESUMED, {"left_out": 5}),
        (reports.PAUSED, {}),
    ]
    assert [entry.seq for entry in read(path)] == [1, 7, 8]
    assert (summary.dropped, summary.left_out) == ({}, {"/chatter": 5})
    with SessionFile.open(path) as file:
        assert file.ledger is not None
        assert file.ledger["recorder"]["left_out"] == {"/chatter": 5}


def test_what_is_asked_for_too_late_spoils_nothing(path: Path) -> None:
    bench = Bench(path)
    bench.hold(1)
    early = bench.recorder.snapshot()
    ending = threading.Thread(target=bench.recorder.close, args=({},))
    ending.start()
    late = bench.recorder.snapshot()
    while not late.done():  # until the end has begun
        late = bench.recorder.snapshot()
    bench.go_on.set()
    ending.join(DEADLINE_S)
    assert not ending.is_alive()
    for asked, words in ((early, "everything is recorded"), (late, "has ended")):
        with pytest.raises(RecordingError, match=words):
            asked.result(DEADLINE_S)
    summary = bench.recorder.close({})
    assert (summary.entries, summary.failure) == (1, "")


def test_streams_that_are_left_out_are_named_in_the_file(path: Path) -> None:
    bench = Bench(path, selection=Selection(exclude=("/camera/**",)))
    bench.recorder(samples.ros(1, topic="/camera/image"))
    bench.recorder(samples.ros(2))
    bench.recorder.close({})
    assert [entry.seq for entry in read(path)] == [2]
    with SessionFile.open(path) as file:
        assert file.session["record_exclude"] == '["/camera/**"]'


def test_what_is_all_recorded_has_no_snapshots(path: Path) -> None:
    bench = Bench(path)
    with pytest.raises(RecordingError, match="everything is recorded"):
        bench.recorder.snapshot().result(DEADLINE_S)
    assert bench.recorder.failure == ""
    bench.recorder.close({})
    with pytest.raises(RecordingError, match="has ended"):
        bench.recorder.snapshot().result(DEADLINE_S)


@pytest.mark.parametrize("by", ["removed", "truncated", "retention"])
def test_a_closed_part_that_is_taken_away_is_reported(tmp_path: Path, by: str) -> None:
    """Not one that the retention has deleted: its log names it."""
    bench = Bench(tmp_path / "session.mcap", split_bytes=1 << 30)
    folder = tmp_path / "session"
    first, entries = folder / "session_0.mcap", samples.every_kind(2)
    for entry in entries:
        bench.recorder(entry)
    bench.wait_drained()
    bench.recorder.split()
    for entry in [replace(entry, seq=100 + entry.seq) for entry in samples.every_kind(20)]:
        bench.recorder(entry)
    bench.wait_drained()
    wait_until((folder / "session_1.mcap").exists)
    if by == "retention":
        RetentionLog(tmp_path).add(1, "delete", file="session/session_0.mcap")
    first.unlink() if by != "truncated" else os.truncate(first, 100)
    bench.clock.advance(1_000_000_000)
    if by != "retention":
        bench.wait_notes(1)
    summary = bench.recorder.close({"streams": {}})
    assert "session_0" not in (folder / "metadata.yaml").read_text() or by == "truncated"
    if by == "retention":
        assert (bench.notes, summary.failure, summary.dropped) == ([], "", {})
        return
    (note,) = bench.notes
    told = f"{first}, a closed part, was {by} by another program"
    assert note.code == reports.LOST_PART and note.text.startswith(told)
    if by == "removed":  # to another place, perhaps
        assert (note.level, summary.failure, summary.dropped) == (Level.WARN, "", {})
    else:
        assert (note.level, summary.failure) == (Level.ERROR, told)
        assert summary.dropped == {reports.TAKEN: note.data["lost"]}
    assert first not in summary.files


def test_a_file_that_is_behind_is_said_while_it_is(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as slow:
        slow.setattr(QueueReader, "flushed", lambda _queue: None)  # as if it never got to a flush
        bench = Bench(path)
        for seq in range(1, 12):
            bench.recorder(samples.igtl(seq))
        wait_until(lambda: len(bench.recorder._put) > 0)
        bench.clock.advance(1_400_000_000)
        wait_until(lambda: bench.recorder._behind_since_ns is not None)
        bench.clock.advance(100_000_000)
        wait_until(lambda: any(note.code == recorder_module.LATE for note in bench.lateness))
        assert bench.recorder.counters()["behind_s"] == 1.5
        (note,) = (note for note in bench.lateness if note.code == recorder_module.LATE)
        assert "1.50 s behind" in note.text and "entries wait" in note.text
    bench.clock.advance(1_000_000_000)
    wait_until(lambda: bench.recorder.counters()["behind_s"] == 0)
    bench.clock.advance(11_000_000_000)
    wait_until(lambda: any(note.code == recorder_module.ON_TIME for note in bench.lateness))
    bench.recorder.close({"streams": {}})


def test_one_that_takes_nothing_for_half_the_interval_gets_its_share_before_the_file_is_late(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised: list[int] = []

    def raise_priority() -> bool:
        raised.append(bench.clock.monotonic_ns())
        return len(raised) > 1  # the system refuses it at first

    def place(settings: WorkerSettings, clock: Clock) -> WorkerHost:
        return replace(host.in_thread(settings, clock), raise_priority=raise_priority)

    monkeypatch.setattr(sys.modules[__name__], "in_thread", place)
    with monkeypatch.context() as stopped:
        stopped.setattr(QueueReader, "get", lambda _queue: None)  # as if it got no processor
        stopped.setattr(QueueReader, "rows", lambda _queue: (memoryview(b""), 0, 0))
        bench = Bench(path)
        for seq in range(1, 200):
            bench.recorder(samples.igtl(seq))
        wait_until(lambda: len(bench.recorder._put) > 0)
        bench.clock.advance(260_000_000)
        wait_until(lambda: len(raised) == 2)
        assert not bench.lateness
        bench.clock.advance(160_000_000)
        wait_until(lambda: bench.recorder._behind_since_ns is not None)
        bench.clock.advance(85_000_000)
        wait_until(lambda: bool(bench.lateness))  # as soon as the interval is over
        assert bench.lateness[0].code == recorder_module.LATE
        assert len(raised) == 2, "once in a while"
    bench.recorder.close({"streams": {}})

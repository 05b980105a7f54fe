"""The worker goes behind others as long as it keeps up; files with and without rows are equal."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from igtl_gateway.base.clock import Clock, ManualClock, SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record import host, shared_queue, worker
from igtl_gateway.record.failures import Failures
from igtl_gateway.record.host import WorkerHost, in_process, in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile import stream
from igtl_gateway.record.sessionfile.chunk_rows import add_rows
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.shared_queue import QueueReader, QueueWriter, memory
from igtl_gateway.record.worker import WorkerSettings, run_worker
from tests.base.systems.sessions import knows_sessions
from tests.record import samples

DEADLINE_S = 60
QUEUE_BYTES = 1 << 20


def wait_until(condition: Callable[[], bool]) -> None:
    rest, looks = threading.Event(), 0
    while not condition():
        assert looks < DEADLINE_S * 20
        rest.wait(0.05)
        looks += 1


class Hasty:
    """A clock by which so much time passes between two looks that all is due."""

    def __init__(self) -> None:
        self._now = count(1)

    def monotonic_ns(self) -> int:
        return next(self._now) * 35_000_000

    def utc_ns(self) -> int:
        return samples.START_NS


def test_it_is_in_a_hurry_while_much_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.record.priority._RAISED_NS", 0)  # it was late only once
    told: list[tuple[bool, int]] = []
    calm = threading.Event()

    def host(settings: WorkerSettings, clock: Clock) -> WorkerHost:
        ours, theirs = Pipe()
        place = memory(QUEUE_BYTES, QUEUE_BYTES)
        getter, putter = QueueReader(place), QueueWriter(place, 1000, QUEUE_BYTES)

        def rank(hurried: bool) -> bool:
            told.append((hurried, putter.waiting[1]))
            if told[1:] == []:
                return False  # try again
            if len(told) == 2:
                for seq in range(1, 41):
                    assert putter.put(samples.igtl(seq, body=bytes(10_000)))
            elif not hurried:
                calm.set()
            return True

        thread = threading.Thread(target=run_worker, args=(settings, getter, theirs, clock, lambda: False, rank))
        thread.start()

        def wait() -> str:
            thread.join(DEADLINE_S)
            theirs.close()
            return "its end"

        return WorkerHost(ours, putter, wait)

    recorder = Recorder(
        tmp_path / "a.mcap",
        samples.SESSION,
        qos_of=lambda *_: None,
        on_note=lambda note: None,
        clock=Hasty(),
        options=RecordOptions(queue_bytes=QUEUE_BYTES, flush_s=0.6),
        host=host,
    )
    assert calm.wait(DEADLINE_S)
    assert recorder.close({}).entries == 40
    assert [hurried for hurried, _ in told] == [False, False, True, False, True]
    assert told[2][1] > QUEUE_BYTES // 8 > 20_000 > told[3][1]


def never_late(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Its process does not look whether it is late, as it is beside other tests, and soon takes back a rank it lost."""
    lines = "from igtl_gateway.record import priority\npriority._LATE_NS, priority._LOWER_NS = 1 << 62, 0\n"
    (folder / "sitecustomize.py").write_text(lines)
    patch.syspath_prepend(str(folder))


@pytest.mark.skipif(not knows_sessions(), reason="this system does not know sessions' niceness")
def test_its_session_goes_behind_others(tmp_path: Path) -> None:
    def sessions() -> dict[int, str]:
        found = {}
        for path in Path("/proc").glob("[0-9]*/autogroup"):
            try:
                if f"{tmp_path}" in path.with_name("environ").read_text(errors="replace"):
                    found[int(path.parent.name)] = path.read_text().split()[-1]
            except OSError:  # it has ended
                pass
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(tmp_path))  # to find the process by
        never_late(patch, tmp_path)
        recorder = Recorder(
            tmp_path / "a.mcap",
            samples.SESSION,
            qos_of=lambda *_: None,
            on_note=lambda note: None,
            clock=SystemClock(),
            host=in_process,
        )
    rest, looks = threading.Event(), 0
    while list(sessions().values()) != ["10"] and looks < DEADLINE_S * 20:
        rest.wait(0.05)
        looks += 1
    assert list(sessions().values()) == ["10"]
    recorder.close({})


def recorded(path: Path, entries: list[Entry], *, rows: bool, chunk_bytes: int = 1 << 20) -> bytes:
    """The file of these entries; ``rows``: with the compiled part for small entries."""
    with pytest.MonkeyPatch.context() as patch:
        if not rows:
            patch.setattr(stream, "add_rows", None)
        recorder = Recorder(
            path,
            samples.SESSION,
            qos_of=lambda *_: None,
            on_note=lambda note: None,
            clock=ManualClock(),
            options=RecordOptions(overwrite=True, chunk_bytes=chunk_bytes),
            host=in_thread,
        )
        for entry in entries:
            recorder(entry)
        summary = recorder.close({})
    assert summary.entries + sum(summary.dropped.values()) == len(entries)
    return path.read_bytes()


def repeated(entries: list[Entry], times: int) -> list[Entry]:
    """The same again and again, with other numbers and stamps."""
    return [
        replace(entry, seq=1 + place + time * len(entries), stamp_ns=entry.stamp_ns + place + time * len(entries))
        for time in range(times)
        for place, entry in enumerate(entries)
    ]


@pytest.mark.slow
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None, max_examples=40
)
@given(entries=samples.sessions())
def test_files_with_rows_are_equal(tmp_path: Path, entries: list[Entry]) -> None:
    entries = repeated(entries, 4)
    assert recorded(tmp_path / "a", entries, rows=True) == recorded(tmp_path / "a", entries, rows=False)


@pytest.mark.slow
def test_a_file_of_many_chunks_with_rows_is_equal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = add_rows
    if compiled is None:
        pytest.skip("installed without the C part")
    taken = []

    def counted(*arguments: Any) -> tuple[int, int, int, int, int]:
        told = compiled(*arguments)
        taken.append(told[1])
        return told

    monkeypatch.setattr(stream, "add_rows", counted)
    monkeypatch.setattr(shared_queue, "_MAX_STREAMS", 20)
    chance = random.Random(3)
    entries = [
        samples.igtl(
            seq, device=f"device {chance.randrange(30)}", links=(chance.randrange(2),),
            body=chance.randbytes(chance.choice((0, 20, 48, 1000, 63_000, 70_000, 200_000))),
        )
        for seq in range(1, 400)
    ]  # fmt: skip
    entries = repeated([*entries, *samples.every_kind(300)], 2)
    entries = [replace(entry, stamp_ns=samples.START_NS + entry.seq) for entry in entries]
    files = [recorded(tmp_path / "a", entries, rows=rows, chunk_bytes=600_000) for rows in (True, False)]
    assert files[0] == files[1]
    assert sum(taken) > len(entries) // 3
    with SessionFile.open(tmp_path / "a") as file:
        assert list(file.entries()) == [samples.flat(entry) for entry in entries]


@pytest.mark.parametrize("sealed", [False, True])
def test_pictures_around_the_end_of_the_ring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sealed: bool) -> None:
    """A backlog of large and small entries, again and again, in a ring that some of them fill."""
    monkeypatch.setattr(host, "LARGEST_BYTES", 200_000)
    monkeypatch.setattr(shared_queue, "_SLACK_BYTES", 100_000)
    monkeypatch.setattr(shared_queue, "_ENOUGH_BYTES", 100_000)
    monkeypatch.setattr(shared_queue, "_FREE_BYTES", 10_000)
    options = RecordOptions(queue_bytes=800_000, chunk_bytes=600_000)
    if sealed:
        pytest.importorskip("cryptography")
        (tmp_path / "key").touch(0o600)
        (tmp_path / "key").write_bytes(SigningKey.generate().private_pem())
        options = replace(options, seal=tmp_path / "key")
    chance, put = random.Random(5), list[Entry]()
    recorder = Recorder(
        tmp_path / "a.mcap",
        samples.SESSION,
        qos_of=lambda *_: None,
        on_note=lambda note: None,
        clock=ManualClock(),
        options=options,
        host=in_thread,
    )
    for seq in range(1, 1500):
        size = chance.choice((0, 48, 1000, 70_000, 150_000))
        entry = samples.igtl(seq, device=f"device {chance.randrange(5)}", body=chance.randbytes(8) * (size // 8))
        dropped = recorder.counters()["dropped_entries"]
        recorder(entry)
        if recorder.counters()["dropped_entries"] == dropped:
            put.append(samples.flat(entry))
    summary = recorder.close({})
    assert (summary.failure, summary.entries) == ("", len(put))
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert list(file.entries()) == put


class Bridge:
    """The worker's end of the pipe to a bridge.  It waits in the time of a clock, to which no load adds anything.

    Args:
        put: called after two seconds; after three the bridge is gone.
    """

    def __init__(self, clock: ManualClock, put: Callable[[], object]) -> None:
        self.polls: list[int] = []
        self.written: list[int] = []  # when the worker has reported it
        self._clock = clock
        self._put = put

    def send(self, words: Any) -> None:
        if words and words[0] == "state" and words[1].written_entries:
            self.written.append(self._clock.monotonic_ns())

    def poll(self, timeout: float | None = 0.0) -> bool:
        before_ns = self._clock.monotonic_ns()
        self.polls.append(before_ns)
        self._clock.advance(round((timeout or 0.0) * NS_PER_S))
        if before_ns < 2 * NS_PER_S <= self._clock.monotonic_ns():
            self._put()
        return self._clock.monotonic_ns() >= 3 * NS_PER_S

    def recv(self) -> None:
        raise EOFError


def test_a_queue_in_which_nothing_comes_is_polled_once_in_a_flush_interval(tmp_path: Path) -> None:
    clock, place = ManualClock(samples.START_NS), memory(QUEUE_BYTES, QUEUE_BYTES)
    writer = QueueWriter(place, 1000, QUEUE_BYTES)
    bridge: Any = Bridge(clock, lambda: writer.put(samples.igtl(1)))
    settings = WorkerSettings(tmp_path / "a.mcap", samples.SESSION, RecordOptions(flush_s=0.5), StateInputRule())
    run_worker(settings, QueueReader(place), bridge, clock)
    idle = [at_ns for at_ns in bridge.polls if at_ns < 2 * NS_PER_S]
    assert len(idle) <= 8, "twenty times a second at first, then twice"
    assert bridge.written[0] - 2 * NS_PER_S <= NS_PER_S // 2, "within the interval"


def test_its_process_imports_no_gateway_and_no_numpy() -> None:
    """Each recording starts one: what only a black box or the retention needs is imported for these."""
    ask = "import sys, igtl_gateway.record.host; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "igtl_gateway.gateway.core", "igtl_gateway.record.sessionfile.reader"} & {*loaded}


@pytest.mark.skipif(not knows_sessions(), reason="this system does not know sessions' niceness")
def test_the_bridge_raises_one_that_gets_no_processor(tmp_path: Path) -> None:
    """Behind all others it does not get to see that it is late; a stopped process is the worst of these."""
    notes: list[Note] = []
    children: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def started(*words: Any, **more: Any) -> subprocess.Popen[bytes]:
        children.append(start(*words, **more))
        return children[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "Popen", started)
        never_late(patch, tmp_path)
        recorder = Recorder(
            tmp_path / "a.mcap",
            samples.SESSION,
            qos_of=lambda *_: None,
            on_note=notes.append,
            clock=SystemClock(),
            host=in_process,
        )
    (child,) = children
    place = Path(f"/proc/{child.pid}/autogroup")
    wait_until(lambda: place.read_text().split()[-1] == "10")
    child.send_signal(signal.SIGSTOP)
    try:
        for seq in range(1, 200):
            recorder(samples.igtl(seq))
        wait_until(lambda: place.read_text().split()[-1] == "0")
        wait_until(lambda: any(note.code == "record_late" for note in notes))
    finally:
        child.send_signal(signal.SIGCONT)
    assert recorder.close({}).entries == 199


@pytest.mark.parametrize(
    ("waiting", "again_in_ns", "expected"),
    [
        ([], 0, ["again"]),
        ([], -1, ["again"]),
        ([], 1, []),
        ([], None, []),
        (["snapshot"], 0, ["snapshot", "again"]),
        (["again"], 0, ["again"]),
        (["again", "stop"], 0, ["again", "stop"]),
    ],
)
def test_a_disk_is_tried_again_once_at_its_time(
    waiting: list[str], again_in_ns: int | None, expected: list[str]
) -> None:
    """Whatever else was asked for meanwhile: each attempt is one more file."""
    found = object.__new__(worker._RecorderWorker)
    now_ns = 5_000_000_000
    found._requests = [(command, 0, 1) for command in waiting]
    found._clock, found._failures = ManualClock(), Failures()
    found._failures.again_ns = None if again_in_ns is None else now_ns + again_in_ns
    found._space = SimpleNamespace(is_due=lambda _now_ns: False)  # type: ignore[assignment]
    found._look_at_disk(now_ns)
    assert [command for command, _, _ in found._requests] == expected

"""The recorder: a sink for entries that never blocks and never raises.

Entries wait in a bounded queue; one thread of the recorder's own writes them and flushes the file.  The thread
wakes twenty times a second rather than for each entry, because a wake-up in the middle of the bridge's work would
take the interpreter from it just when the next message is due.

What is recorded is chosen by a gate (``selection``) and goes into one file, into parts (``parts``) or into a ring in
memory that is written when asked to (``ring``).  Requests wait in the same queue, so they act between the entries
before and after them.

At the bound the entry is dropped.  Every drop is counted by stream; at most once a second a note tells of those
since the last one.  Notes are given from the recorder's thread, so that the one who drops has nothing to wait for.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.clock import Clock
from igtl_gateway.errors import RecordingError
from igtl_gateway.record.mcap_writer import QosOf, SessionWriter
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.parts import PartsWriter
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.ring import Ring
from igtl_gateway.record.rostypes import RosTypes
from igtl_gateway.record.selection import MAX_STREAMS, OTHERS, Gate, StateRule
from igtl_gateway.session.entry import Entry
from igtl_gateway.session.layout import LayoutError
from igtl_gateway.session.note import Level, Note

#: Codes of the recorder's notes.
DROPPED, FAILED, REFUSED, UNDEFINED = "record_drop", "record_failed", "record_refused", "record_undefined"
PAUSED, RESUMED, SNAPSHOT = "record_paused", "record_resumed", "record_snapshot"

_WAKE_S = 0.05
#: The thread is woken before its time when so much waits.
_WAKE_BYTES = 8 << 20
_WAKE_ENTRIES = 2_000
_NOTE_NS = 1_000_000_000
_ENTRY_BYTES = 500  # what an entry costs in the queue beside its payload


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """How a recording ended.

    Attributes:
        path: the file; the folder of a split recording; the name that snapshots are called after.
        size: size of all files, in bytes.
        entries: entries in them.
        dropped: entries that are not there though they should be, by stream.
        left_out: entries that were not to be there, by stream.
        files: what was written.
        failure: why it ended before its time, or ``""``.
    """

    path: Path
    size: int
    entries: int
    dropped: dict[str, int]
    left_out: dict[str, int]
    files: tuple[Path, ...]
    failure: str = ""

    def discard(self) -> None:
        """Remove what was written."""
        for path in self.files:
            path.unlink(missing_ok=True)
        if self.path.is_dir():
            with suppress(OSError):  # something else is in it
                self.path.rmdir()


class Recorder:
    """Records entries; see the module.

    Args:
        path: the file to create, or what the parts or snapshots are called after.
        session: what the recording says of itself.
        qos_of: QoS of a ROS topic (name, type), None where it is not known; called in the recorder's thread.
        on_note: takes what the recorder has to say; called in the recorder's thread.
        clock: paces flushes and notes, names snapshots.
        options: how to record.
        rule: which inputs later outputs depend on; for what is left out, and for files that begin midway.

    Raises RecordingError when the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        session: dict[str, str],
        *,
        qos_of: QosOf,
        on_note: Callable[[Note], None],
        clock: Clock,
        options: RecordOptions | None = None,
        rule: StateRule | None = None,
    ) -> None:
        self.options = options or RecordOptions()
        self._session = dict(session)
        for key, globs in self.options.selection.facts().items():
            self._session[key] = globs
        self._qos_of = qos_of
        self._on_note = on_note
        self._clock = clock
        self._flush_ns = int(self.options.flush_s * 1_000_000_000)
        self._types = RosTypes()
        self._gate = Gate(self.options.selection, rule or StateRule())

        self._lock = threading.Lock()  # held for a few operations at a time; guards all up to the empty line
        self._queue: deque[tuple[Entry | Callable[[], None], int]] = deque()
        self._taken_bytes = 0  # of all entries that ever entered the queue …
        self._taken_entries = 0
        self._dropped: Counter[str] = Counter()
        self._untold: Counter[str] = Counter()  # drops at the bound that no note has told of yet
        self._closing = False

        self._batch: deque[tuple[Entry | Callable[[], None], int]] = deque()  # what the thread is writing
        self._done_bytes = 0  # … and of those that left it; only the thread changes these
        self._done_entries = 0
        self._failure = ""
        self._told_ns: int | None = None
        self._told_undefined: set[str] = set()
        self._told_refused: set[str] = set()
        self._left_out_before = 0  # of the pause that is on
        self._flushed_ns = 0
        self._ledger: dict[str, Any] = {}
        self._summary: RecordingSummary | None = None
        self._wake = threading.Event()
        self._writer = self._open(path, rule or StateRule())
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def _open(self, path: Path, rule: StateRule) -> SessionWriter | PartsWriter | Ring:
        """What writes, as the options say."""
        options = self.options
        if options.snapshot_s:
            return Ring(
                path,
                self._open_file,
                Prologue(rule),
                seconds=options.snapshot_s,
                max_bytes=options.snapshot_bytes,
            )
        if options.split_bytes or options.split_s:
            return PartsWriter(
                path,
                self._open_file,
                Prologue(rule),
                max_bytes=options.split_bytes,
                max_s=options.split_s,
                overwrite=options.overwrite,
                counters=self.counters,
            )
        return self._open_file(path, {}, ())

    def _open_file(self, path: Path, facts: dict[str, str], prologue: Sequence[Entry]) -> SessionWriter:
        return SessionWriter(
            path,
            self._session | facts,
            qos_of=self._qos_of,
            compression=self.options.compression,
            chunk_bytes=self.options.chunk_bytes,
            fsync=self.options.fsync,
            overwrite=self.options.overwrite,
            prologue=prologue,
            types=self._types,
        )

    def __call__(self, entry: Entry) -> None:
        """Record an entry, soon.  Its buffers must not change any more."""
        size = entry.size + _ENTRY_BYTES
        with self._lock:
            waiting_bytes = self._taken_bytes - self._done_bytes + size
            waiting = self._taken_entries - self._done_entries + 1
            # one entry alone always fits, however large
            full = waiting > self.options.queue_entries or (waiting_bytes > self.options.queue_bytes and waiting > 1)
            if full or self._failure or self._closing:
                self._count_drop(entry)
                return
            self._taken_bytes += size
            self._taken_entries += 1
            self._queue.append((entry, size))
        if (waiting_bytes > _WAKE_BYTES or waiting > _WAKE_ENTRIES) and not self._wake.is_set():
            self._wake.set()

    def counters(self) -> dict[str, Any]:
        """What was written, waits, was dropped and was left out, so far."""
        with self._lock:
            return {
                "written_entries": self._writer.entries,
                "queued_entries": self._taken_entries - self._done_entries,
                "queued_bytes": self._taken_bytes - self._done_bytes,
                "dropped_entries": self._dropped.total(),
                "dropped": dict(sorted(self._dropped.items())),
                "left_out_entries": self._gate.left_out.total(),
                "left_out": dict(sorted(self._gate.left_out.items())),
                "failure": self._failure,
            }

    @property
    def failure(self) -> str:
        """Why the recording ended before its time, or ``""``."""
        return self._failure

    @property
    def paused(self) -> bool:
        """Whether only links, notes and what the gateway learns is recorded."""
        return self._gate.paused

    def pause(self) -> None:
        """From the next input on, record no more than what later outputs depend on."""
        self._command(lambda: self._set_paused(True))

    def resume(self) -> None:
        """From the next input on, record everything again; a note tells what was left out meanwhile."""
        self._command(lambda: self._set_paused(False))

    def snapshot(self) -> Future[Path]:
        """Write the last seconds into a file; the result is its path, or a RecordingError."""
        done: Future[Path] = Future()
        if not self._command(lambda: self._take(done)):
            done.set_exception(RecordingError("the recording has ended"))
        return done

    def _command(self, action: Callable[[], None]) -> bool:
        """Have something done by the thread behind what waits already; False at the end of the recording."""
        with self._lock:
            if self._closing or not self._thread.is_alive():
                return False
            self._queue.append((action, 0))
        self._wake.set()
        return True

    def close(self, ledger: dict[str, Any]) -> RecordingSummary:
        """Write what waits, the ledger and the index.  A second call returns the same summary.

        ``ledger`` goes into the file together with the recorder's own counters (key ``recorder``).
        """
        with self._lock:
            if not self._closing:
                self._ledger = ledger
            self._closing = True
        self._wake.set()
        self._thread.join()
        if self._summary is None:
            self._summary = self._finish()
        return self._summary

    def _count_drop(self, entry: Entry, *, tell: bool = True) -> None:
        """The caller holds the lock."""
        stream = entry.channel or entry.kind.value
        if stream not in self._dropped and len(self._dropped) >= MAX_STREAMS:
            stream = OTHERS
        self._dropped[stream] += 1
        if tell:
            self._untold[stream] += 1

    # -- the recorder's thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._loop()
        except Exception as error:  # a defect here, or in on_note, must not end the recording without a word
            self._fail(f"recording to {self._writer.path} failed: {type(error).__name__}: {error}")

    def _loop(self) -> None:
        self._flushed_ns = self._clock.monotonic_ns()
        closing = False
        while not closing:
            self._wake.wait(_WAKE_S)
            self._wake.clear()
            with self._lock:
                # whatever comes after `closing` is dropped, so this is all there will be
                self._batch, self._queue, closing = self._queue, self._batch, self._closing
            while self._batch:
                # out of the batch first: what is written must not be held in memory any longer
                item, size = self._batch.popleft()
                if isinstance(item, Entry):
                    self._take_in(item, size)
                else:
                    item()
                del item
                self._flush_if_due()
            self._flush_if_due()
            self._tell_drops()

    def _take_in(self, entry: Entry, size: int) -> None:
        try:
            for passed in self._gate.take(entry):
                self._write(passed)
        finally:
            self._done_bytes += size
            self._done_entries += 1

    def _write(self, entry: Entry) -> None:
        written = False
        try:
            if not self._failure:
                self._writer.write(entry)
                written = True
        except LayoutError as error:
            self._refused(entry, error)
        except RecordingError as error:
            self._fail(str(error))
        finally:
            if not written:
                with self._lock:
                    self._count_drop(entry, tell=False)
        if self._writer.undefined and entry.type in self._writer.undefined and entry.type not in self._told_undefined:
            self._told_undefined.add(entry.type)
            text = f"no definition of {entry.type} found: {entry.channel} is recorded, but other tools cannot decode it"
            self._on_note(Note(Level.WARN, UNDEFINED, text, entry.channel))

    def _set_paused(self, paused: bool) -> None:
        if paused == self._gate.paused:
            return
        self._gate.paused = paused
        left_out = self._gate.left_out.total()
        if paused:
            self._left_out_before = left_out
            self._on_note(Note(Level.INFO, PAUSED, "the recording is paused"))
            return
        missed = left_out - self._left_out_before
        text = f"the recording goes on; {missed:,} entries were left out"
        self._on_note(Note(Level.INFO, RESUMED, text, data={"left_out": missed}))

    def _take(self, done: Future[Path]) -> None:
        """Write a snapshot.  That one fails does not end the recording: the ring is still there."""
        try:
            if not isinstance(self._writer, Ring):
                raise RecordingError("no snapshots: everything is recorded (--snapshot SECONDS keeps the last ones)")
            path = self._writer.take(self.counters(), self._clock.utc_ns())
        except (RecordingError, OSError) as error:
            self._on_note(Note(Level.ERROR, FAILED, f"no snapshot: {error}"))
            done.set_exception(error)
            return
        seconds = f"{self.options.snapshot_s:g}"
        self._on_note(Note(Level.INFO, SNAPSHOT, f"the last {seconds} s are in {path}", data={"path": str(path)}))
        done.set_result(path)

    def _refused(self, entry: Entry, error: LayoutError) -> None:
        """Tell once per stream of entries that the format cannot hold."""
        stream = entry.channel or entry.kind.value
        if stream not in self._told_refused and len(self._told_refused) < MAX_STREAMS:
            self._told_refused.add(stream)
            self._on_note(Note(Level.ERROR, REFUSED, f"not recorded: {error}", stream))

    def _flush_if_due(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._flushed_ns < self._flush_ns or self._failure:
            return
        self._flushed_ns = now_ns
        try:
            self._writer.flush()
        except RecordingError as error:
            self._fail(str(error))

    def _tell_drops(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if self._failure or (self._told_ns is not None and now_ns - self._told_ns < _NOTE_NS):
            return
        with self._lock:
            untold, self._untold = self._untold, Counter()
        if not untold:
            return
        self._told_ns = now_ns
        text = f"the disk is too slow: {untold.total()} entries of {len(untold)} streams are not in the recording"
        self._on_note(Note(Level.WARN, DROPPED, text, data={"dropped": dict(sorted(untold.items()))}))

    def _fail(self, text: str) -> None:
        """The end of the recording, not of the bridge."""
        if not self._failure:
            self._failure = text
            then = "the bridge stops" if self.options.stop_on_failure else "the bridge goes on without recording"
            self._on_note(Note(Level.ERROR, FAILED, f"{text}; {then}"))

    # -- the end ----------------------------------------------------------------------------------------------

    def _finish(self) -> RecordingSummary:
        self._gate.end()
        with self._lock:
            # a thread that died of a defect left them behind
            for item, _ in (*self._batch, *self._queue):
                if isinstance(item, Entry):
                    self._count_drop(item)
        counters = self.counters()
        try:
            self._writer.close({**self._ledger, "recorder": counters})
        except RecordingError as error:
            self._fail(str(error))
        files = self._writer.files
        return RecordingSummary(
            self._writer.path,
            sum(map(_size, files)),
            self._writer.entries,
            counters["dropped"],
            counters["left_out"],
            tuple(files),
            self._failure,
        )


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # somebody took the file away

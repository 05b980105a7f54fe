"""The recorder: a sink for entries that never blocks and never raises.

Entries wait in a bounded queue; one thread of the recorder's own writes them and flushes the file.  The thread
wakes twenty times a second rather than for each entry, because a wake-up in the middle of the bridge's work would
take the interpreter from it just when the next message is due.

At the bound the entry is dropped.  Every drop is counted by stream; at most once a second a note tells of those
since the last one.  Notes are given from the recorder's thread, so that the one who drops has nothing to wait for.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.clock import Clock
from igtl_gateway.errors import RecordingError
from igtl_gateway.record.mcap_writer import CHUNK_BYTES, Compression, QosOf, SessionWriter
from igtl_gateway.session.entry import Entry
from igtl_gateway.session.layout import LayoutError
from igtl_gateway.session.note import Level, Note

#: Bounds of the queue: a second of Full HD video at 40 Hz, and ten seconds of small messages at 20 kHz.
QUEUE_BYTES = 256 << 20
QUEUE_ENTRIES = 200_000
#: Interval at which the file is flushed: what a kill −9 may cost.
FLUSH_S = 0.5

#: Codes of the recorder's notes.
DROPPED, FAILED, REFUSED, UNDEFINED = "record_drop", "record_failed", "record_refused", "record_undefined"

_WAKE_S = 0.05
#: The thread is woken before its time when so much waits.
_WAKE_BYTES = 8 << 20
_WAKE_ENTRIES = 2_000
_NOTE_NS = 1_000_000_000
#: Streams whose drops are counted one by one; the rest together.
_MAX_STREAMS = 1_000
_OTHERS = "(others)"
_ENTRY_BYTES = 500  # what an entry costs in the queue beside its payload


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """How a recording ended.

    Attributes:
        path: the file.
        size: its size in bytes.
        entries: entries in it.
        dropped: entries that are not in it, by stream.
        failure: why it ended before its time, or ``""``.
    """

    path: Path
    size: int
    entries: int
    dropped: dict[str, int]
    failure: str = ""


class Recorder:
    """Records entries into a file; see the module.

    Args:
        path: the file to create.
        session: what the recording says of itself.
        qos_of: QoS of a ROS topic (name, type), None where it is not known; called in the recorder's thread.
        on_note: takes what the recorder has to say; called in the recorder's thread.
        clock: paces flushes and notes.
        compression: of the chunks.
        chunk_bytes: size of a chunk before compression.
        flush_s: everything older is in the file, come what may.
        queue_bytes, queue_entries: bounds of the queue.
        overwrite: replace an existing file instead of refusing it.

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
        compression: Compression = "lz4",
        chunk_bytes: int = CHUNK_BYTES,
        flush_s: float = FLUSH_S,
        queue_bytes: int = QUEUE_BYTES,
        queue_entries: int = QUEUE_ENTRIES,
        overwrite: bool = False,
    ) -> None:
        self._writer = SessionWriter(
            path, session, qos_of=qos_of, compression=compression, chunk_bytes=chunk_bytes, overwrite=overwrite
        )
        self._on_note = on_note
        self._clock = clock
        self._flush_ns = int(flush_s * 1_000_000_000)
        self._queue_bytes = queue_bytes
        self._queue_entries = queue_entries

        self._lock = threading.Lock()  # held for a few operations at a time; guards all up to the empty line
        self._queue: deque[tuple[Entry, int]] = deque()
        self._taken_bytes = 0  # of all entries that ever entered the queue …
        self._taken_entries = 0
        self._dropped: Counter[str] = Counter()
        self._untold: Counter[str] = Counter()  # drops at the bound that no note has told of yet
        self._closing = False

        self._batch: deque[tuple[Entry, int]] = deque()  # what the thread is writing
        self._done_bytes = 0  # … and of those that left it; only the thread changes these
        self._done_entries = 0
        self._failure = ""
        self._told_ns: int | None = None
        self._told_undefined = 0
        self._told_refused: set[str] = set()
        self._flushed_ns = 0
        self._ledger: dict[str, Any] = {}
        self._summary: RecordingSummary | None = None
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __call__(self, entry: Entry) -> None:
        """Record an entry, soon.  Its buffers must not change any more."""
        size = entry.size + _ENTRY_BYTES
        with self._lock:
            waiting_bytes = self._taken_bytes - self._done_bytes + size
            waiting = self._taken_entries - self._done_entries + 1
            # one entry alone always fits, however large
            full = waiting > self._queue_entries or (waiting_bytes > self._queue_bytes and waiting > 1)
            if full or self._failure or self._closing:
                self._count_drop(entry)
                return
            self._taken_bytes += size
            self._taken_entries += 1
            self._queue.append((entry, size))
        if (waiting_bytes > _WAKE_BYTES or waiting > _WAKE_ENTRIES) and not self._wake.is_set():
            self._wake.set()

    def counters(self) -> dict[str, Any]:
        """What was written, waits and was dropped, so far."""
        with self._lock:
            return {
                "written_entries": self._writer.entries,
                "queued_entries": self._taken_entries - self._done_entries,
                "queued_bytes": self._taken_bytes - self._done_bytes,
                "dropped_entries": self._dropped.total(),
                "dropped": dict(sorted(self._dropped.items())),
                "failure": self._failure,
            }

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
        if stream not in self._dropped and len(self._dropped) >= _MAX_STREAMS:
            stream = _OTHERS
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
                self._write(*self._batch.popleft())
                self._flush_if_due()
            self._flush_if_due()
            self._tell_drops()

    def _write(self, entry: Entry, size: int) -> None:
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
            self._done_bytes += size
            self._done_entries += 1
        if len(self._writer.undefined) > self._told_undefined:
            self._told_undefined = len(self._writer.undefined)
            text = f"no definition of {entry.type} found: {entry.channel} is recorded, but other tools cannot decode it"
            self._on_note(Note(Level.WARN, UNDEFINED, text, entry.channel))

    def _refused(self, entry: Entry, error: LayoutError) -> None:
        """Tell once per stream of entries that the format cannot hold."""
        stream = entry.channel or entry.kind.value
        if stream not in self._told_refused and len(self._told_refused) < _MAX_STREAMS:
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
            self._on_note(Note(Level.ERROR, FAILED, f"{text}; the bridge goes on without recording"))

    # -- the end ----------------------------------------------------------------------------------------------

    def _finish(self) -> RecordingSummary:
        with self._lock:
            # a thread that died of a defect left them behind
            for entry, _ in (*self._batch, *self._queue):
                self._count_drop(entry)
        counters = self.counters()
        try:
            self._writer.close({**self._ledger, "recorder": counters})
        except RecordingError as error:
            self._fail(str(error))
        try:
            size = self._writer.path.stat().st_size
        except OSError:
            size = 0  # somebody took the file away
        return RecordingSummary(self._writer.path, size, self._writer.entries, counters["dropped"], self._failure)

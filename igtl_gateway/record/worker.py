"""The worker: takes entries out of the queue and writes them.

What is recorded is chosen by a gate (``selection``) and goes into one file, into parts (``parts``) or into a ring in
memory that is written on request (``ring``).  The worker polls the queue twenty times a second; only once in each flush
interval while few entries come, because they cannot be in the file earlier.  It is woken when much waits.

If the bridge ends without closing the recording, the worker writes all queued entries and closes the file, or writes
the entries of the ring; the ledger states it.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, DamagedRecording, DiskRefused, FileTaken, RecordingError, Unavailable
from igtl_gateway.base.once import Once
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.versions import Self
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.options import RecordOptions, path_at
from igtl_gateway.record.pace import Pace, Times
from igtl_gateway.record.parts import REMOVED, PartsWriter
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.ring import Ring
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.selection import MAX_STREAMS, OTHERS, SelectionFilter, StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.new_file import files_with_mode, try_file
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.shared_queue import LARGE_BYTES, QueueReader
from igtl_gateway.record.sole_file import SoleFile
from igtl_gateway.record.space import LOOK_NS, SpaceWatch, free_bytes

if TYPE_CHECKING:
    from igtl_gateway.gateway.acceptance import Acceptance
    from igtl_gateway.record.black_box import BlackBox
    from igtl_gateway.record.retaining import RetentionThread

#: Codes of the recorder's notes.
DROPPED, FAILED, REFUSED, UNDEFINED = "record_drop", "record_failed", "record_refused", "record_undefined"
THREAD = "record_thread"
CONTINUED, LOST_PART, HELD = "record_continued", "record_part_lost", "record_split_held"
PAUSED, RESUMED, SNAPSHOT = "record_paused", "record_resumed", "record_snapshot"
STARTED, STOPPED = "record_started", "record_stopped"
#: After a failure, the recording goes on in a new file.
AGAIN = "record_again"
#: A file begins without large inputs that its outputs may depend on.
INCOMPLETE_BEGIN = "prologue_incomplete"

#: Streams by which entries count as dropped that were in a file that was taken away, or were not flushed when the disk
#: failed.
TAKEN, UNFLUSHED = "(in a file that was taken away)", "(not flushed when the disk failed)"

_LOOK_S = 0.05
#: A poll that finds no more entries than this is followed by a longer pause.
_FEW = 32
#: Until it looks again whether the bridge has copied the next payload.
_FILLING_S = 0.002
_LOOK_NS = 50_000_000
#: Closed parts that it looks at with each flush.
_PARTS_AT_ONCE = 64
_NOTE_NS = 1_000_000_000
#: A disk that has failed is tried again after this time, ns, doubled at each attempt up to the second one; from the
#: first one again when it has worked for the third one.
_AGAIN_NS, _LONGEST_NS, _WORKS_NS = 1_000_000_000, 60_000_000_000, 30_000_000_000
#: It flushes this much before the interval ends: looking, compressing and writing take time, too.
_EARLY_NS = 100_000_000
#: The worker has raised priority from when the first part of the queue's bound waits until the second part does.
_HURRY_PART, _CALM_PART = 8, 64
#: Also where that took longer which should take less than two looks: others leave it too little time.  Then it stays
#: raised for some time: a machine that is busy stays busy.
_LATE_NS, _RAISED_NS = 150_000_000, 30_000_000_000
#: It lowers its priority again at this interval, ns: the bridge may have raised it.
_LOWER_NS = 60_000_000_000
#: Of the greatest lateness, which flushes expect again, this part is forgotten at each look: half of it in 18 s.
_FORGOTTEN_PART = 512


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
        failure: why it ended before its time, or why a file that was asked for is missing; or ``""``.
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


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """What the worker is started with; fields as the arguments of ``Recorder``."""

    path: Path
    session: dict[str, str]
    options: RecordOptions
    rule: StateInputRule


@dataclass(frozen=True, slots=True)
class WorkerState:
    """The state of the worker.

    Attributes:
        written_entries: entries in the file.
        dropped: entries that the file could not take, by stream.
        left_out: entries that are not to be there, by stream.
        failure: why nothing can be written, or ``""``.
        paused: whether it is.
        file: the file that is being written; "": there is none, before a start, after a stop, and of a snapshot.
        taken_away: the last file that was removed or changed while it was written, and where it goes on; or ``""``.
        before: entries that were written, left out and dropped before the last start.
        saved: snapshots and files of the black box: their number and bytes.
        window: the file of the black box that is being written, or "".
        free_bytes: free bytes of the disk; None: not known.
        left_s: how long it lasts at the present rate, s; None: not known, or it does not fill.
    """

    written_entries: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    failure: str = ""
    paused: bool = False
    file: str = ""
    taken_away: str = ""
    before: tuple[int, int, int] = (0, 0, 0)
    saved: tuple[int, int] = (0, 0)
    window: str = ""
    free_bytes: int | None = None
    left_s: int | None = None

    def counters(self, not_queued: Counter[str]) -> dict[str, Any]:
        """As they go into the ledger, with what the queue did not take."""
        dropped = not_queued + Counter(self.dropped)
        return {
            "written_entries": self.written_entries,
            "dropped_entries": dropped.total(),
            "dropped": dict(sorted(dropped.items())),
            "left_out_entries": sum(self.left_out.values()),
            "left_out": dict(sorted(self.left_out.items())),
            "failure": self.failure,
            "taken_away": self.taken_away,
        }


class WorkerPipe(Protocol):
    """One end of the pipe between bridge and worker: of file descriptors, or of handles on Windows."""

    def send(self, words: Any, /) -> None: ...
    def recv(self) -> Any: ...
    def poll(self, timeout: float | None = ..., /) -> bool: ...
    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, kind: Any, error: Any, place: Any, /) -> None: ...


def run_worker(
    settings: WorkerSettings,
    queue: QueueReader,
    pipe: WorkerPipe,
    clock: Clock,
    orphaned: Callable[[], bool] = lambda: False,
    rank: Callable[[bool], bool] = lambda hurried: True,
    times: Times = lambda: None,
) -> None:
    """Record until the other end requests the end, or has ended.

    Reports first why the file could not be created, or "", and which files were begun.

    ``orphaned``: whether the bridge has ended though the pipe is open: its forked processes have the pipe, too.
    ``times``: of this thread.
    ``rank`` sets the priority of the worker, raised at first; it is called at each change, and again where it failed.
    """
    with files_with_mode(settings.options.file_mode, umask=False):
        _run_worker(settings, queue, pipe, clock, orphaned, rank, times)


def _run_worker(
    settings: WorkerSettings,
    queue: QueueReader,
    pipe: WorkerPipe,
    clock: Clock,
    orphaned: Callable[[], bool],
    rank: Callable[[bool], bool],
    times: Times,
) -> None:
    worker, refused = None, ""
    try:
        worker = _RecorderWorker(settings, queue, pipe, clock, orphaned, rank, times)
    except RecordingError as error:
        refused = str(error)
    with suppress(OSError):  # gone already: the file is closed like any other
        pipe.send((refused, worker.take_begun() if worker else []))
    if worker:
        worker.run()


class _BridgeGone(Exception):
    """The bridge is no longer there to be asked."""


class _RecorderWorker:
    def __init__(
        self,
        settings: WorkerSettings,
        queue: QueueReader,
        pipe: WorkerPipe,
        clock: Clock,
        orphaned: Callable[[], bool],
        rank: Callable[[bool], bool],
        times: Times,
    ) -> None:
        self._settings = settings
        self._pace = Pace(times)
        self._orphaned = orphaned
        self._rank = rank
        self._hurried = True
        self._empty_ns = clock.monotonic_ns()  # when the queue was empty
        self._late_ns = 0  # since it was so before
        self._raised_ns: int | None = None  # when it was late last
        self._ranked_ns = clock.monotonic_ns()
        self._taken = 0  # entries and commands at the last poll
        self.options = settings.options
        self._session = dict(settings.session) | settings.options.selection.facts()
        if self.options.custom:
            self._session[layout.CUSTOM_KEY] = json.dumps(dict(self.options.custom), sort_keys=True)
        self._queue = queue
        # written at once, or not at all: what keeps entries, or has a gate hold them, has to own them
        queue.lends = not (self.options.snapshot_s or self.options.split_bytes or self.options.split_s)
        self._pipe = pipe
        self._clock = clock
        flush_ns = int(self.options.flush_s * 1_000_000_000)
        self._interval_ns = flush_ns
        self._flush_ns = flush_ns - min(_EARLY_NS, flush_ns // 4)
        self._expected_late_ns = 0
        self._types = RosTypes()
        self._seals = _seal_series(self.options, clock)
        self._gate = SelectionFilter(self.options.selection, settings.rule)
        self._dropped: Counter[str] = Counter()  # by the file; what the queue did not take is known to the recorder
        self._not_queued: Counter[str] = Counter()  # when it was last asked
        self._failure = ""
        self._missing = ""  # the first failure: a file that was asked for is missing, or has an end too early
        self._taken_away = ""
        self._gone = False
        self._ledger: dict[str, Any] | None = None  # from the moment on at which the recording is to end
        self._drops_reported_ns: int | None = None
        self._noted = Once()  # types without a definition
        self._reported_refused: set[str] = set()
        self._sent_state = WorkerState()
        self._begun: list[str] = []  # files that the other end does not know yet
        self._files: set[Path] = set()  # all that were begun
        self._runs = False  # the first message states whether the first file could be created
        self._is_cut = False  # the next file follows one that was taken away
        self._left_out_before = 0  # of the pause that is on
        self._before_start = 0, 0, 0
        self._flushed_ns = self._stated_ns = self._due_ns = clock.monotonic_ns()
        self._seen_refused = 0
        self._requests: list[tuple[str, int, int]] = []  # start, stop, snapshot or again; its number; UTC ns
        self._again_ns: int | None = None  # when a disk that has failed is tried again, monotonic
        self._attempts = 0
        self._failed_ns = self._begun_ns = 0  # the disk; the file after that, monotonic
        self._box: BlackBox | None = None
        self._refused_text = ""  # what the disk has refused at the start
        try:
            self._writer = self._open(settings.path, settings.rule)
        except DiskRefused as error:
            if self.options.stop_on_failure:
                raise
            self._refused_text = str(error)
            self._writer = self._open(settings.path, settings.rule, later=True)
        self._retention: RetentionThread | None = None
        if self.options.retention:
            from igtl_gateway.record.retaining import RetentionThread  # here: it imports readers and numpy

            self._retention = RetentionThread(settings.path, self.options, clock, self._files)
        self._rests = self.options.waits
        self._spaced_ns = 0
        self._closed_bytes, self._present_bytes = 0, 0  # of files before the present one, and of that
        self._space = SpaceWatch(lambda: free_bytes(settings.path.absolute().parent), self._until_deleted)
        self._row_writer = self._writer_of_rows()

    def _writer_of_rows(self) -> SoleFile | None:
        """Return the writer if it takes entries as rows."""
        writer = self._writer
        return writer if isinstance(writer, SoleFile) and writer.file and writer.file.takes_rows(LARGE_BYTES) else None

    def _open(self, path: Path, rule: StateInputRule, *, later: bool = False) -> SoleFile | PartsWriter | Ring:
        """The writer for these options.

        Args:
            later: create nothing before it is asked for.
        """
        options = self.options
        if options.snapshot_s:
            ring = self._open_ring(path, rule)
            if not later:
                ring.try_place()
            return ring
        if options.split_bytes or options.split_s:
            return PartsWriter(
                path,
                self._open_file,
                Prologue(rule),
                max_bytes=options.split_bytes,
                max_s=options.split_s,
                overwrite=options.overwrite,
                waits=options.waits,
                later=later,
                counters=self._counters,
                on_closed=self._apply_retention,
                on_held=self._report_held,
            )
        if options.waits and not later:
            try_file(path, path.with_name(f".{path.name}.trial"))
        named = options.named or path
        return SoleFile(
            path,
            self._open_file,
            Prologue(rule),
            waits=options.waits or later,
            next_path=lambda: path_at(named, self._clock.utc_ns()),
        )

    def _open_ring(self, path: Path, rule: StateInputRule) -> Ring:
        """The memory for snapshots."""
        options = self.options
        if options.triggers:
            self._box = self._open_box(path, rule)
            return self._box
        return Ring(
            path,
            self._open_file,
            Prologue(rule),
            seconds=options.snapshot_s,
            max_bytes=options.snapshot_bytes,
        )

    def _acceptance(self) -> Acceptance:
        """Which bytes the session accepts as messages."""
        # here: only a black box looks into messages
        from igtl_gateway.config.configuration import Config
        from igtl_gateway.gateway.acceptance import Acceptance
        from igtl_gateway.record.sessionfile import facts

        try:
            return Acceptance.of(Config.from_dict(facts.configuration(self._session)))
        except (ConfigError, DamagedRecording):  # tests have sessions without one
            return Acceptance()

    def _open_box(self, path: Path, rule: StateInputRule) -> BlackBox:
        """The writer of a black box."""
        # here: they import most of the gateway, which no other recorder needs
        from igtl_gateway.record.black_box import BlackBox
        from igtl_gateway.record.triggers import TRIGGERED, Triggers

        def on_note(note: Note) -> None:
            """Pass it on; a file may be new to the retention."""
            self._note(note)
            if note.code != TRIGGERED:
                self._apply_retention()

        def on_obstacle(why: str, is_missing: bool) -> None:
            """Have it shown while it lasts."""
            self._failure = why
            if is_missing:
                self._missing = self._missing or why

        return BlackBox(
            path,
            self._open_file,
            Prologue(rule),
            seconds=self.options.snapshot_s,
            max_bytes=self.options.snapshot_bytes,
            rules=self.options.triggers,
            triggers=Triggers(self.options.triggers, self._types, self._acceptance(), self._note),
            clock=self._clock,
            counters=self._counters,
            on_note=on_note,
            on_obstacle=on_obstacle,
        )

    def _open_file(self, path: Path, more: dict[str, str], prologue: Sequence[Entry]) -> SessionWriter:
        alone = self.options.snapshot_s > 0 or self._is_cut  # the seal of a file that was taken away is not at its end
        writer = SessionWriter(
            path,
            self._session | more,
            qos_of=self._qos_of,
            compression=self.options.compression,
            chunk_bytes=self.options.chunk_bytes,
            fsync=self.options.fsync,
            overwrite=self.options.overwrite,
            prologue=prologue,
            types=self._types,
            sealer=self._seals.next_file(path, alone=alone) if self._seals else None,
        )
        self._begun.append(str(path))
        self._files.add(path.absolute())
        if self._runs:  # if this process is killed, the other end knows them
            self._send("files", self.take_begun())
        return writer

    def take_begun(self) -> list[str]:
        """Return the files that were begun and not named yet."""
        begun, self._begun = self._begun, []
        return begun

    def run(self) -> None:
        """Write what comes, until the end."""
        self._runs = True
        if self._refused_text:
            self._fail(self._refused_text)
        self._apply_retention()
        while self._ledger is None and not self._gone:
            self._guarded(self._run_once)
        self._set_hurried(True)
        if self._ledger is None:  # what it left behind
            self._queue.abandoned = True
            self._guarded(self._drain)
        self._finish()

    def _guarded(self, step: Callable[[], object]) -> None:
        """Report unexpected errors instead of ending the recording silently."""
        try:
            step()
        except Exception as error:
            if not self._failure:
                self._fail(f"recording to {self._writer.path} failed: {type(error).__name__}: {error}")

    # -- the bridge -------------------------------------------------------------------------------------------

    def _wait(self, pause_s: float) -> bool:
        """Wait until the next poll is due, or the bridge signals; True for the former."""
        rested = False
        try:
            if self._pipe.poll(_FILLING_S if self._queue.filling else pause_s):
                self._pipe.recv()
            else:
                rested = not self._queue.filling  # no output can follow after such a time
                self._gone = self._gone or self._orphaned()
        except (EOFError, OSError):
            self._gone = True
        self._queue.clear_signal()
        return rested

    def _pause_ns(self) -> int:
        """Return the time until the next poll: until the next flush, unless something has to be soon."""
        due_ns = self._flushed_ns + self._flush_ns - self._clock.monotonic_ns()
        if self._taken > _FEW or self._requests or self._hurried:
            return min(_LOOK_NS, due_ns) if due_ns > 0 else _LOOK_NS
        return max(_LOOK_NS, due_ns)

    def _send(self, *words: Any) -> None:
        if self._gone:
            return
        try:
            self._pipe.send(words)
        except OSError:
            self._gone = True

    def _ask(self, *words: Any) -> Any:
        """Ask something and wait for the answer.  Raises _BridgeGone."""
        self._send(*words)
        try:
            while not self._gone:
                if not self._pipe.poll(_LOOK_S):
                    self._gone = self._orphaned()
                elif (answer := self._pipe.recv()) != "wake":
                    return answer
        except (EOFError, OSError):
            self._gone = True
        raise _BridgeGone

    def _note(self, note: Note) -> None:
        self._send_state()
        self._send("note", note)

    def _send_state(self) -> None:
        state = self._state()
        if state != self._sent_state:
            self._sent_state = state
            self._send("state", state)

    def _state(self) -> WorkerState:
        return WorkerState(
            self._writer.entries,
            dict(self._dropped + self._queue.lost),
            dict(self._gate.left_out),
            self._failure,
            self._gate.paused,
            self._present(),
            self._taken_away,
            self._before_start,
            (len(self._writer.files), self._writer.size) if isinstance(self._writer, Ring) else (0, 0),
            str(self._box.present or "") if self._box else "",
            self._space.free_bytes,
            None if self._space.left_s is None else round(self._space.left_s),
        )

    def _present(self) -> str:
        """Return the file that is being written."""
        writer = self._writer
        return str(writer.present or "") if isinstance(writer, SoleFile | PartsWriter) else ""

    def _qos_of(self, topic: str, ros_type: str) -> Qos | None:
        try:
            answer: Qos | str | None = self._ask("qos", topic, ros_type)
        except _BridgeGone:
            return None
        if isinstance(answer, str):
            raise RuntimeError(answer)
        return answer

    def _counters(self) -> dict[str, Any]:
        self._ask_drops()
        return self._state().counters(self._not_queued)

    def _ask_drops(self) -> None:
        """What the queue did not take, by stream."""
        try:
            self._not_queued = Counter(self._ask("drops"))
        except _BridgeGone:  # how many there were is known here, too
            self._not_queued[OTHERS] += max(0, self._queue.refused - self._not_queued.total())

    # -- the work ---------------------------------------------------------------------------------------------

    def _run_once(self) -> None:
        pause_ns, begun_ns = self._pause_ns(), self._clock.monotonic_ns()
        rested = self._wait(pause_ns / 1_000_000_000)
        now_ns = self._clock.monotonic_ns()
        # what it rested as planned is no lateness
        self._empty_ns += max(0, min(pause_ns, now_ns - begun_ns) - _LOOK_NS)
        if not self._queue.filling:
            self._pace.begin(now_ns, self._queue.done_bytes)
        self._taken = self._drain()
        if not self._taken and rested:
            self._answer_requests()
            if self._box:
                self._box.tick()
        self._run_periodic()
        self._send_state()

    def _drain(self) -> int:
        """All that waits, up to the end of the recording: what comes behind that is not of it.  Return how many."""
        taken = 0
        queue, monotonic_ns = self._queue, self._clock.monotonic_ns
        while self._ledger is None and (step := self._add_rows() or self._take_next()):
            taken += step
            # what time brings, between any two entries: if the disk is too slow, there is always another one
            if monotonic_ns() >= self._due_ns or queue.refused != self._seen_refused:
                self._run_periodic()
        now_ns = monotonic_ns()
        self._late_ns, self._empty_ns = now_ns - self._empty_ns, now_ns
        return taken

    def _add_rows(self) -> int:
        """Write the small entries that are next, of streams that were written before; return how many.

        Nothing depends on what they are: everything is recorded, and into one file.
        """
        writer = self._row_writer
        if writer is None or self._failure or not self._gate.passes_all or self._requests:
            return 0
        room, begin, end = self._queue.rows()
        if begin == end:
            return 0
        try:
            place, rows, size = writer.add_rows(room, begin, end, self._queue.row_streams)
            if rows:
                self._queue.take_rows(place, rows, size)
                writer.end_full_chunk()
        except RecordingError as error:
            self._fail(str(error))
            return 0
        return rows

    def _take_next(self) -> bool:
        """Write the next entry, or apply the next command; False: nothing waits."""
        queue = self._queue
        item = queue.get()
        if item is None:
            return False
        try:
            if isinstance(item, Entry):
                if item.kind.is_input and self._requests:
                    self._answer_requests()
                if self._box:
                    self._box.saw(item)
                for passed in self._gate.take(item):
                    self._write(passed)
                if self._row_writer and queue.stream >= 0 and queue.row_streams[queue.stream] is None:
                    queue.row_streams[queue.stream] = self._row_writer.row_stream(item)
            else:
                self._apply_command(*item)
        finally:
            queue.done()
        return True

    def _run_periodic(self) -> None:
        """What time brings."""
        now_ns = self._clock.monotonic_ns()
        self._seen_refused = self._queue.refused
        late_ns = max(self._late_ns, now_ns - self._empty_ns)
        looks = now_ns - self._stated_ns >= _LOOK_NS
        if looks:
            self._expect_late(late_ns)
        self._flush_if_due(now_ns)
        self._report_drops(now_ns)
        self._report_retention()
        self._look_at_disk(now_ns)
        if looks:
            self._stated_ns = now_ns
            self._send_state()
            if self._ledger is None:
                part = _CALM_PART if self._hurried else _HURRY_PART
                if late_ns > _LATE_NS:
                    self._raised_ns = now_ns
                is_late = self._raised_ns is not None and now_ns - self._raised_ns < _RAISED_NS
                self._set_hurried(is_late or self._queue.waiting_bytes > self.options.queue_bytes // part)
        self._due_ns = min(self._flushed_ns + self._flush_ns, self._stated_ns + _LOOK_NS)

    def _expect_late(self, late_ns: int) -> None:
        """Flush so early that the interval holds where the next look is as late as the latest ones were.

        At least a quarter of the interval remains: more flushes would take the time that is missing.
        """
        kept_ns = self._expected_late_ns - self._expected_late_ns // _FORGOTTEN_PART
        self._expected_late_ns = late_ns = max(late_ns, kept_ns)
        interval_ns = self._interval_ns
        self._flush_ns = interval_ns - max(min(_EARLY_NS, interval_ns // 4), min(late_ns, interval_ns * 3 // 4))

    def _set_hurried(self, hurried: bool) -> None:
        """Go behind all others, as long as that does not cost entries.

        Once in a while again: the bridge raises it where it does not get to look.
        """
        now_ns = self._clock.monotonic_ns()
        again = not hurried and now_ns - self._ranked_ns > _LOWER_NS
        if (hurried != self._hurried or again) and self._rank(hurried):
            self._hurried, self._ranked_ns = hurried, now_ns

    def _apply_command(self, command: str, *words: Any) -> None:
        match command:
            case "pause":
                self._set_paused(True)
            case "resume":
                self._set_paused(False)
            case "start" | "stop" | "snapshot":
                self._requests.append((command, *words, self._clock.utc_ns()))
            case "split":
                if isinstance(self._writer, PartsWriter):
                    self._writer.split()
            case "fail":
                self._fail(*words)
            case "close":
                self._answer_requests()
                self._ledger = json.loads(*words)

    def _write(self, entry: Entry) -> None:
        writer, written = self._writer, False
        try:
            if not self._failure or self._rests or isinstance(writer, Ring):
                self._put(entry)
                written = True
            else:
                writer.write(entry)  # it has no file: the next one begins with what is known
        except LayoutError as error:
            self._refused(entry, error)
        except RecordingError as error:
            self._fail(str(error))
        finally:
            if not written:
                self._count_drop(entry)
        if writer.undefined and entry.type in writer.undefined and self._noted.first(entry.type):
            text = f"no definition of {entry.type} found: {entry.channel} is recorded, but other tools cannot decode it"
            self._note(Note(Level.WARN, UNDEFINED, text, entry.channel))

    def _put(self, entry: Entry) -> None:
        if self._rests:
            self._gate.leave_out(entry)
        try:
            self._writer.write(entry)
        except FileTaken as error:  # found at the end of a part
            self._go_on(error)
            self._writer.write(entry)

    def _count_drop(self, entry: Entry) -> None:
        stream = entry.channel or entry.kind.value
        if stream not in self._dropped and len(self._dropped) >= MAX_STREAMS:
            stream = OTHERS
        self._dropped[stream] += 1

    def _go_on_or_fail(self, error: FileTaken) -> None:
        try:
            self._go_on(error)
        except RecordingError as obstacle:
            self._fail(str(obstacle))

    def _go_on(self, error: FileTaken) -> None:
        """Continue in the next file.  Raises RecordingError where that is not wanted or not possible."""
        writer = self._writer
        if self.options.stop_on_failure or not isinstance(writer, SoleFile | PartsWriter):
            raise error
        self._is_cut = True
        try:
            path, lost = writer.go_on()
        except RecordingError as obstacle:
            raise RecordingError(f"{error}; {obstacle}") from None
        finally:
            self._is_cut = False
        self._queue.row_streams[:] = [None] * len(self._queue.row_streams)  # of the channels of the file before
        self._dropped[TAKEN] += lost
        self._taken_away = f"{error}; the recording goes on in {path}"
        text = f"{self._taken_away}; {lost:,} entries were in the file"
        self._note(Note(Level.ERROR, CONTINUED, text, data={"lost": lost, "path": str(path)}))

    def _set_paused(self, paused: bool) -> None:
        if paused == self._gate.paused or self._rests:
            return
        self._gate.paused = paused
        left_out = self._gate.left_out.total()
        if paused:
            self._left_out_before = left_out
            self._note(Note(Level.INFO, PAUSED, "the recording is paused"))
            return
        missed = left_out - self._left_out_before
        text = f"the recording goes on; {missed:,} entries were left out"
        self._note(Note(Level.INFO, RESUMED, text, data={"left_out": missed}))

    def _answer_requests(self) -> None:
        """Do what was asked for: before an input, or when no output can follow the last one.

        It is asked for from another thread than that which gives an input and its outputs, so perhaps in between.
        """
        requests, self._requests = self._requests, []
        for what, number, utc_ns in requests:
            if what == "again":
                self._go_on_after_failure()
                continue
            try:
                path = self._take_snapshot(utc_ns) if what == "snapshot" else self._start_or_stop(what == "start")
            except (RecordingError, OSError) as error:
                self._send("answer", number, None, str(error))
            else:
                self._send("answer", number, path, "")

    def _start_or_stop(self, start: bool) -> Path:
        """Begin a file or close it; return its path.  Raises RecordingError, OSError.

        What comes in between is as in a pause: what later outputs depend on is kept for the next file.
        """
        writer = self._writer
        if not isinstance(writer, SoleFile | PartsWriter):
            raise RecordingError("found a snapshot buffer, expected a recording")
        present = writer.present
        if not start and self._again_ns is not None:  # it was stopped
            self._again_ns, self._rests = None, True
        if start == bool(present):
            return present or writer.path
        try:
            path = self._begin(writer) if start else self._close_present(writer)
        except (RecordingError, OSError) as error:
            self._fail(f"the recording is not {'started' if start else 'closed'}: {error}")
            raise
        self._failure, self._again_ns = "", None
        self._gate.paused, self._rests = False, not start
        self._queue.row_streams[:] = [None] * len(self._queue.row_streams)  # of the channels of the file before
        self._row_writer = self._writer_of_rows()
        self._apply_retention()
        if start and isinstance(writer, SoleFile) and writer.forgotten:
            self._note(_without(writer.forgotten))
        code, text = (STARTED, "the recording begins") if start else (STOPPED, "the recording is closed")
        self._note(Note(Level.INFO, code, f"{text}: {path}"))
        return path

    def _begin(self, writer: SoleFile | PartsWriter) -> Path:
        """Begin the next file."""
        self._is_cut = isinstance(writer, SoleFile) or bool(self._failure)
        try:
            path = writer.begin()
        finally:
            self._is_cut = False
        dropped: int = self._counters()["dropped_entries"]
        self._before_start = writer.entries, self._gate.left_out.total(), dropped
        return path

    def _close_present(self, writer: SoleFile | PartsWriter) -> Path:
        """Close the present file."""
        path = writer.present
        assert path
        writer.rest({"recorder": self._counters()})
        return path

    def _take_snapshot(self, utc_ns: int) -> Path:
        """Write a snapshot.  That one fails does not end the recording: the ring is still there."""
        if not isinstance(self._writer, Ring):
            raise RecordingError("no snapshots: everything is recorded (--snapshot SECONDS keeps the last ones)")
        try:
            path = self._writer.take({"recorder": self._counters()}, utc_ns)
        except (RecordingError, OSError) as error:
            self._failure = f"no snapshot: {error}"
            self._missing = self._missing or self._failure
            self._note(Note(Level.ERROR, FAILED, self._failure))
            raise
        self._failure = ""
        seconds = f"{self.options.snapshot_s:g}"
        self._apply_retention()
        self._note(Note(Level.INFO, SNAPSHOT, f"the last {seconds} s are in {path}", data={"path": str(path)}))
        return path

    def _refused(self, entry: Entry, error: LayoutError) -> None:
        """Report once per stream that entries do not fit the format."""
        stream = entry.channel or entry.kind.value
        if stream not in self._reported_refused and len(self._reported_refused) < MAX_STREAMS:
            self._reported_refused.add(stream)
            self._note(Note(Level.ERROR, REFUSED, f"not recorded: {error}", stream))

    def _flush_if_due(self, now_ns: int) -> None:
        if now_ns - self._flushed_ns < self._flush_ns or self._failure:
            return
        self._flushed_ns = now_ns
        self._flush()

    def _flush(self) -> None:
        """Flush the file; go on in the next one where it was taken away."""
        try:
            if not self._failure:
                self._writer.flush()
        except FileTaken as error:
            self._go_on_or_fail(error)
        except RecordingError as error:
            self._fail(str(error))
        self._queue.flushed()  # or counted as lost
        self._report_missing(_PARTS_AT_ONCE)

    def _report_missing(self, at_most: int = sys.maxsize) -> None:
        """Report closed parts that another program has taken away, after a look at some of them.

        Who moves closed parts to another place loses nothing.
        """
        for part, what in self._writer.take_missing(at_most) if isinstance(self._writer, PartsWriter) else ():
            text, level = f"{part.path}, a closed part, {what} by another program", Level.WARN
            if what != REMOVED:
                level = Level.ERROR
                self._dropped[TAKEN] += part.entries
                self._missing = self._missing or text
            text += f"; {part.entries:,} entries were in the file"
            self._note(Note(level, LOST_PART, text, data={"lost": part.entries, "path": str(part.path)}))

    def _report_held(self, why: str) -> None:
        self._note(Note(Level.WARN, HELD, f"{self._writer.path}: the part goes on, the next one begins later: {why}"))

    def _report_drops(self, now_ns: int) -> None:
        """At most once a second, of what the queue did not take since the last time."""
        if self._failure or (self._drops_reported_ns is not None and now_ns - self._drops_reported_ns < _NOTE_NS):
            return
        if self._queue.refused == self._not_queued.total():
            return
        before = Counter(self._not_queued)
        self._ask_drops()
        unnoted = self._not_queued - before
        self._drops_reported_ns = now_ns
        done_bytes = self._queue.done_bytes
        cause, figures = self._pace.describe(now_ns, done_bytes)
        self._pace.begin(now_ns, done_bytes)
        text = f"{cause}: {unnoted.total():,} entries of {len(unnoted)} streams are not in the recording"
        text += f" ({figures})" if figures else ""
        self._note(Note(Level.WARN, DROPPED, text, data={"dropped": dict(sorted(unnoted.items()))}))

    def _apply_retention(self) -> None:
        """Have the retention make a pass now, in its thread."""
        if self._retention:
            self._retention.wake()

    def _report_retention(self) -> None:
        for note in self._retention.take() if self._retention else ():
            self._note(note)
        if self._retention and self._retention.has_deleted_parts() and isinstance(self._writer, PartsWriter):
            with suppress(OSError):  # the next part writes it again
                self._writer.update_side_file()

    def _fail(self, text: str) -> None:
        """The end of the present file, not of the bridge; a start begins the next one."""
        self._missing = self._missing or text
        if self._failure == text:
            return
        self._failure = text
        writer = self._writer
        if isinstance(writer, SoleFile | PartsWriter):
            self._abandon(writer)
            if self.options.stop_on_failure:
                then = "the bridge stops"
            elif self._rests or self._ledger is not None:
                then = "the bridge goes on without recording until the next start"
            else:
                self._try_later()
                then = "the bridge goes on without recording; the disk is tried again, in a new file"
        else:
            then = "it is tried again when a file is due"
        self._note(Note(Level.ERROR, FAILED, f"{text}; {then}"))

    def _abandon(self, writer: SoleFile | PartsWriter) -> None:
        """Leave a file that cannot be written further."""
        self._row_writer = None
        lost, was_taken = writer.abandon()
        if lost:
            self._dropped[TAKEN if was_taken else UNFLUSHED] += lost

    def _try_later(self) -> None:
        """Have a file begun later: after a second, then after longer times, as long as the disk does not work."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._begun_ns > _WORKS_NS and not self._again_ns:
            self._attempts = 0
        if not self._attempts:
            self._failed_ns = now_ns
        self._again_ns = now_ns + min(_AGAIN_NS << self._attempts // 4, _LONGEST_NS)  # four times each
        self._attempts += 1

    def _go_on_after_failure(self) -> None:
        """Begin the next file after a failure of the disk; before an input.  If that fails, it is tried later."""
        writer = self._writer
        if self._again_ns is None or not isinstance(writer, SoleFile | PartsWriter):
            return
        self._is_cut = True
        try:
            path = writer.begin()
        except (RecordingError, OSError):
            self._try_later()
            return
        finally:
            self._is_cut = False
        now_ns = self._begun_ns = self._clock.monotonic_ns()
        self._failure, self._again_ns = "", None
        self._queue.row_streams[:] = [None] * len(self._queue.row_streams)  # of the channels of the file before
        self._row_writer = self._writer_of_rows()
        if isinstance(writer, SoleFile) and writer.forgotten:
            self._note(_without(writer.forgotten))
        missing_s = (now_ns - self._failed_ns) / 1_000_000_000
        text = f"the disk works again after {missing_s:.1f} s; the recording goes on in {path}"
        self._note(Note(Level.WARN, AGAIN, text, data={"path": str(path), "missing_s": round(missing_s, 1)}))

    def _look_at_disk(self, now_ns: int) -> None:
        """Try a disk again that has failed, and look how much room it has."""
        if (
            self._again_ns is not None
            and now_ns >= self._again_ns
            and not any(each[0] == "again" for each in self._requests)
        ):
            self._requests.append(("again", 0, self._clock.utc_ns()))
        if now_ns - self._spaced_ns < LOOK_NS:
            return
        self._spaced_ns = now_ns
        size = self._writer.size
        if size < self._present_bytes:
            self._closed_bytes += self._present_bytes
        self._present_bytes = size
        if note := self._space.look(now_ns, self._closed_bytes + size):
            self._note(note)

    def _until_deleted(self) -> int | None:
        return self._retention.until_deleted if self._retention else None

    # -- the end ----------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        self._gate.end()
        self._guarded(self._report_missing)
        counters = self._counters()
        ledger = {**({layout.CUT_OFF_KEY: True} if self._ledger is None else self._ledger), "recorder": counters}
        try:
            if self._ledger is None and isinstance(self._writer, Ring):
                self._writer.take(ledger, self._clock.utc_ns())
            self._close(ledger)
        except (RecordingError, OSError) as error:
            self._fail(str(error))
        if self._retention:
            self._retention.stop()
            self._report_retention()
            if isinstance(self._writer, PartsWriter):
                from igtl_gateway.record.retention.side_files import update_side_file

                update_side_file(self._writer.path)
        files = [path for path in self._writer.files if path.exists()]
        summary = RecordingSummary(
            self._writer.path,
            sum(map(_size, files)),
            self._writer.entries,
            self._state().counters(self._not_queued)["dropped"],
            counters["left_out"],
            tuple(files),
            self._missing or self._taken_away,
        )
        self._send("closed", self._state(), summary)

    def _close(self, ledger: dict[str, Any]) -> None:
        """Close the file, or the next one where it was taken away.  Raises RecordingError."""
        try:
            self._writer.close(ledger)
        except FileTaken as error:
            self._go_on(error)
            self._writer.close(ledger | {"recorder": self._state().counters(self._not_queued)})


def _without(forgotten: Mapping[str, int]) -> Note:
    """The note of a file that begins without large inputs."""
    names = ", ".join(f"{stream} ({size / 1e6:,.0f} MB)" for stream, size in forgotten.items())
    text = f"the file begins without the last message of {names}: verify of it may find differences"
    return Note(Level.WARN, INCOMPLETE_BEGIN, text, data={"streams": dict(forgotten)})


def _seal_series(options: RecordOptions, clock: Clock) -> SealSeries | None:
    """The seals of the recording, if there are any.  Raises RecordingError for a key that cannot be used."""
    if options.seal is None:
        return None
    try:
        return SealSeries(SigningKey.load(options.seal), clock.utc_ns)
    except (ConfigError, Unavailable) as error:
        raise RecordingError(f"cannot seal the recording: {error}") from None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # the file was removed

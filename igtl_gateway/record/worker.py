"""The worker: takes entries out of the queue and writes them.

What is recorded is chosen by a gate (``selection``) and goes into one file, into parts (``parts``) or into a ring in
memory that is written on request (``ring``); ``output`` has these.  When it looks and flushes, ``flush_times`` knows.

If the bridge ends without closing the recording, the worker writes all queued entries and closes the file, or writes
the entries of the ring; the ledger states it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import FileTaken, RecordingError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import by_count, count_text, duration_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.account import Account
from igtl_gateway.record.bridge_end import BridgeEnd, BridgeGone, WorkerPipe
from igtl_gateway.record.failures import Failures
from igtl_gateway.record.flush_times import FlushTimes
from igtl_gateway.record.new_files import NewFiles
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.output import Hooks, Output
from igtl_gateway.record.pace import Pace, Times
from igtl_gateway.record.parts import REMOVED, PartsWriter
from igtl_gateway.record.priority import Priority
from igtl_gateway.record.rate import RateWatch
from igtl_gateway.record.reports import (
    AGAIN,
    CONTINUED,
    DROPPED,
    FAILED,
    INCOMPLETE_BEGIN,
    LOST_PART,
    PAUSED,
    REFUSED,
    RESUMED,
    SNAPSHOT,
    STARTED,
    STOPPED,
    TAKEN,
    UNDEFINED,
    UNFLUSHED,
    RecordingSummary,
    WorkerState,
)
from igtl_gateway.record.ring import Ring
from igtl_gateway.record.selection import SelectionFilter, StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.new_file import files_with_mode
from igtl_gateway.record.shared_queue import LARGE_BYTES, QueueReader
from igtl_gateway.record.sole_file import SoleFile
from igtl_gateway.record.space import SpaceWatch, free_bytes

if TYPE_CHECKING:
    from igtl_gateway.record.retaining import RetentionThread

#: Until it looks again whether the bridge has copied the next payload.
_FILLING_S = 0.002
#: Closed parts that it looks at with each flush.
_PARTS_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """What the worker is started with; fields as the arguments of ``Recorder``."""

    path: Path
    session: dict[str, str]
    options: RecordOptions
    rule: StateInputRule


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
        pipe.send((refused, worker.files.take_begun() if worker else []))
    if worker:
        worker.run()


class _RecorderWorker:
    """Attributes: files: those of the recording."""

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
        self._options = options = settings.options
        self._clock = clock
        self._queue = queue
        # written at once, or not at all: what keeps entries, or has a gate hold them, has to own them
        queue.lends = not (options.snapshot_s or options.has_parts)
        now_ns = clock.monotonic_ns()
        self._bridge = BridgeEnd(pipe, orphaned)
        self._pace = Pace(times)
        self._times = FlushTimes(options.flush_s, now_ns)
        self._priority = Priority(rank, options.queue_bytes, now_ns)
        self._account = Account()
        self._failures = Failures()
        self._gate = SelectionFilter(options.selection, settings.rule)
        self._space = SpaceWatch(lambda: free_bytes(settings.path.absolute().parent), self._until_deleted)
        self._rate = RateWatch()
        self._full_bytes: int | None = None  # free bytes of a disk that has failed
        self._taken = 0  # entries and commands at the last poll
        self._seen_refused = 0
        self._requests: list[tuple[str, int, int]] = []  # start, stop, snapshot or again; its number; UTC ns
        self._ledger: dict[str, Any] | None = None  # from the moment on at which the recording is to end
        self._rests = options.waits
        self._retention: RetentionThread | None = None
        self.files = NewFiles(settings.session, options, clock, self._qos_of)
        hooks = Hooks(self._counters, self._note, self._apply_retention, self._on_obstacle)
        self._output = Output(settings.path, settings.rule, options, self.files, clock, queue.row_streams, hooks)
        if options.retention:
            from igtl_gateway.record.retaining import RetentionThread  # here: it imports readers and numpy

            self._retention = RetentionThread(settings.path, options, clock, self.files.all)

    def run(self) -> None:
        """Write what comes, until the end."""
        self.files.announce_by(lambda begun: self._bridge.send("files", begun))
        if self._output.refused:
            self._fail(self._output.refused)
        self._apply_retention()
        while self._ledger is None and not self._bridge.gone:
            self._guarded(self._run_once)
        self._priority.set(True, self._clock.monotonic_ns())
        if self._ledger is None:  # what it left behind
            self._queue.abandoned = True
            self._guarded(self._drain)
        self._finish()

    def _guarded(self, step: Callable[[], object]) -> None:
        """Report unexpected errors instead of ending the recording silently."""
        try:
            step()
        except Exception as error:
            if not self._failures.present:
                self._fail(f"recording to {self._output.writer.path} failed: {type(error).__name__}: {error}")

    # -- the bridge -------------------------------------------------------------------------------------------

    def _note(self, note: Note) -> None:
        self._bridge.send_note(note, self._state())

    def _state(self) -> WorkerState:
        output, space = self._output, self._space
        return WorkerState(
            output.writer.entries,
            dict(self._account.dropped + self._queue.lost),
            dict(self._gate.left_out + self.files.outputs.left_out),
            self._failures.present,
            self._gate.paused,
            output.present,
            self._failures.taken_away,
            self._account.before_start,
            output.saved,
            output.window,
            space.free_bytes,
            None if space.left_s is None else round(space.left_s),
        )

    def _qos_of(self, topic: str, ros_type: str) -> Qos | None:
        try:
            answer: Qos | str | None = self._bridge.ask("qos", topic, ros_type)
        except BridgeGone:
            return None
        if isinstance(answer, str):
            raise RuntimeError(answer)
        return answer

    def _counters(self) -> dict[str, Any]:
        self._account.ask(self._bridge.ask, self._queue.refused)
        return self._state().counters(self._account.not_queued)

    # -- the work ---------------------------------------------------------------------------------------------

    def _run_once(self) -> None:
        begun_ns = self._clock.monotonic_ns()
        waits = bool(self._requests) or self._priority.is_raised
        pause_ns = self._times.pause_ns(self._taken, begun_ns, waits=waits)
        rested = self._wait(pause_ns)
        now_ns = self._clock.monotonic_ns()
        self._times.rested(pause_ns, now_ns - begun_ns)
        if not self._queue.filling:
            self._pace.begin(now_ns, self._queue.done_bytes)
        self._taken = self._drain()
        if not self._taken and rested:
            self._answer_requests()
            if self._output.box:
                self._output.box.tick()
        self._run_periodic()
        self._bridge.send_state(self._state())

    def _wait(self, pause_ns: int) -> bool:
        """Wait until the next poll is due, or the bridge signals; True: no output can follow after such a time."""
        signalled = self._bridge.wait(_FILLING_S if self._queue.filling else pause_ns / NS_PER_S)
        rested = not signalled and not self._queue.filling
        self._queue.clear_signal()
        return rested

    def _drain(self) -> int:
        """All that waits, up to the end of the recording: what comes behind that is not of it.  Return how many."""
        taken = 0
        queue, times, monotonic_ns = self._queue, self._times, self._clock.monotonic_ns
        while self._ledger is None and (step := self._add_rows() or self._take_next()):
            taken += step
            # what time brings, between any two entries: if the disk is too slow, there is always another one
            if monotonic_ns() >= times.due_ns or queue.refused != self._seen_refused:
                self._run_periodic()
        times.emptied(monotonic_ns())
        return taken

    def _add_rows(self) -> int:
        """Write the small entries that are next, of streams that were written before; return how many.

        Nothing depends on what they are: everything is recorded, and into one file.
        """
        writer = self._output.rows
        if writer is None or self._failures.present or not self._gate.passes_all or self._requests:
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
                if self._output.box:
                    self._output.box.saw(item)
                for passed in self._gate.take(item):
                    self._write(passed)
                rows = self._output.rows
                if rows and queue.stream >= 0 and queue.row_streams[queue.stream] is None:
                    queue.row_streams[queue.stream] = rows.row_stream(item)
            else:
                self._apply_command(*item)
        finally:
            queue.done()
        return True

    def _run_periodic(self) -> None:
        """What time brings."""
        now_ns, times = self._clock.monotonic_ns(), self._times
        self._seen_refused = self._queue.refused
        late_ns, looks = times.late_ns(now_ns), times.is_look_due(now_ns)
        if looks:
            times.expect_late(late_ns)
        if times.is_flush_due(now_ns) and not self._failures.present:
            times.flushed(now_ns)
            self._flush()
        self._report_drops(now_ns)
        self._report_retention()
        self._look_at_disk(now_ns)
        if looks:
            times.looked(now_ns)
            self._bridge.send_state(self._state())
            if self._ledger is None:
                self._priority.look(late_ns, self._queue.waiting_bytes, now_ns)
        times.plan()

    def _apply_command(self, command: str, *words: Any) -> None:
        match command:
            case "pause":
                self._set_paused(True)
            case "resume":
                self._set_paused(False)
            case "start" | "stop" | "snapshot":
                self._requests.append((command, *words, self._clock.utc_ns()))
            case "split":
                if isinstance(self._output.writer, PartsWriter):
                    self._output.writer.split()
            case "fail":
                self._fail(*words)
            case "close":
                self._answer_requests()
                self._ledger = json.loads(*words)

    def _write(self, entry: Entry) -> None:
        writer, written = self._output.writer, False
        if entry.size >= LARGE_BYTES:
            self._observe_losses()
        try:
            if not self._failures.present or self._rests or isinstance(writer, Ring):
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
                self._account.count(entry)
        if writer.undefined and entry.type in writer.undefined and self._account.is_first_undefined(entry.type):
            text = f"no definition of {entry.type} found: {entry.channel} is recorded, but other tools cannot decode it"
            self._note(Note(Level.WARN, UNDEFINED, text, entry.channel))

    def _observe_losses(self) -> None:
        """Large outputs are written in full where it is not certain that the recording has what they follow from."""
        outputs, queue = self.files.outputs, self._queue
        outputs.lacks_inputs = outputs.lacks_inputs or queue.refused > 0 or bool(queue.lost)
        outputs.lacks_parts = outputs.lacks_parts or bool(self._gate.left_out)

    def _put(self, entry: Entry) -> None:
        if self._rests:
            self._gate.leave_out(entry)
        try:
            self._output.writer.write(entry)
        except FileTaken as error:  # found at the end of a part
            self._go_on(error)
            self._output.writer.write(entry)

    def _go_on(self, error: FileTaken) -> None:
        """Continue in the next file.  Raises RecordingError where that is not wanted or not possible."""
        if self._options.stop_on_failure or isinstance(self._output.writer, Ring):
            raise error
        try:
            path, lost = self._output.go_on()
        except RecordingError as obstacle:
            raise RecordingError(f"{error}; {obstacle}") from None
        self._account.dropped[TAKEN] += lost
        self._failures.taken_away = f"{error}; the recording goes on in {path}"
        text = (
            f"{self._failures.taken_away}; {count_text(lost, 'entry', 'entries')} {by_count(lost, 'was', 'were')} "
            f"in the file"
        )
        self._note(Note(Level.ERROR, CONTINUED, text, data={"lost": lost, "path": str(path)}))

    def _set_paused(self, paused: bool) -> None:
        if paused == self._gate.paused or self._rests:
            return
        self._gate.paused = paused
        left_out = self._gate.left_out.total()
        if paused:
            self._account.pause(left_out)
            self._note(Note(Level.INFO, PAUSED, "the recording is paused"))
            return
        missed = self._account.left_out_since_pause(left_out)
        text = (
            f"the recording goes on; {count_text(missed, 'entry', 'entries')} {by_count(missed, 'was', 'were')} "
            f"left out"
        )
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
                self._bridge.send("answer", number, None, str(error))
            else:
                self._bridge.send("answer", number, path, "")

    def _start_or_stop(self, start: bool) -> Path:
        """Begin a file or close it; return its path.  Raises RecordingError, OSError.

        What comes in between is as in a pause: what later outputs depend on is kept for the next file.
        """
        writer, failures = self._output.in_files(), self._failures
        present = writer.present
        if not start and failures.again_ns is not None:  # it was stopped
            failures.again_ns, self._rests = None, True
        if start == bool(present):
            return present or writer.path
        try:
            path = self._begin(writer) if start else self._output.close_present()
        except (RecordingError, OSError) as error:
            self._fail(f"the recording is not {'started' if start else 'closed'}: {error}")
            raise
        failures.clear()
        self._gate.paused, self._rests = False, not start
        self._output.changed()
        self._apply_retention()
        if start:
            self._report_forgotten()
        code, text = (STARTED, "the recording begins") if start else (STOPPED, "the recording is closed")
        self._note(Note(Level.INFO, code, f"{text}: {path}"))
        return path

    def _begin(self, writer: SoleFile | PartsWriter) -> Path:
        """Begin the next file."""
        path = self._output.begin()
        dropped: int = self._counters()["dropped_entries"]
        self._account.before_start = writer.entries, self._gate.left_out.total(), dropped
        return path

    def _report_forgotten(self) -> None:
        if self._output.forgotten:
            self._note(_without(self._output.forgotten))

    def _take_snapshot(self, utc_ns: int) -> Path:
        """Write a snapshot.  That one fails does not end the recording: the ring is still there."""
        ring = self._output.writer
        if not isinstance(ring, Ring):
            raise RecordingError("no snapshots: everything is recorded (--snapshot SECONDS keeps the last ones)")
        try:
            path = ring.take({"recorder": self._counters()}, utc_ns)
        except (RecordingError, OSError) as error:
            self._on_obstacle(f"no snapshot: {error}", True)
            self._note(Note(Level.ERROR, FAILED, self._failures.present))
            raise
        self._failures.present = ""
        seconds = f"{self._options.snapshot_s:g}"
        self._apply_retention()
        self._note(Note(Level.INFO, SNAPSHOT, f"the last {seconds} s are in {path}", data={"path": str(path)}))
        return path

    def _on_obstacle(self, why: str, is_missing: bool) -> None:
        """Have it shown while it lasts."""
        self._failures.present = why
        if is_missing:
            self._failures.miss(why)

    def _refused(self, entry: Entry, error: LayoutError) -> None:
        """Report once per stream that entries do not fit the format."""
        stream = entry.channel or entry.kind.value
        if self._account.is_first_refused(stream):
            self._note(Note(Level.ERROR, REFUSED, f"not recorded: {error}", stream))

    def _flush(self) -> None:
        """Flush the file; go on in the next one where it was taken away."""
        try:
            self._output.writer.flush()
        except FileTaken as error:
            try:
                self._go_on(error)
            except RecordingError as obstacle:
                self._fail(str(obstacle))
        except RecordingError as error:
            self._fail(str(error))
        self._queue.flushed()  # or counted as lost
        self._report_missing(_PARTS_AT_ONCE)

    def _report_missing(self, at_most: int = sys.maxsize) -> None:
        """Report closed parts that another program has taken away, after a look at some of them.

        Who moves closed parts to another place loses nothing.
        """
        writer = self._output.writer
        for part, what in writer.take_missing(at_most) if isinstance(writer, PartsWriter) else ():
            text, level = f"{part.path}, a closed part, {what} by another program", Level.WARN
            if what != REMOVED:
                level = Level.ERROR
                self._account.dropped[TAKEN] += part.entries
                self._failures.miss(text)
            text += (
                f"; {count_text(part.entries, 'entry', 'entries')} {by_count(part.entries, 'was', 'were')} in the file"
            )
            self._note(Note(level, LOST_PART, text, data={"lost": part.entries, "path": str(part.path)}))

    def _report_drops(self, now_ns: int) -> None:
        """At most once a second, of what the queue did not take since the last time."""
        if self._failures.present or not self._account.is_note_due(self._queue.refused, now_ns):
            return
        unnoted = self._account.take_unnoted(self._bridge.ask, self._queue.refused, now_ns)
        done_bytes = self._queue.done_bytes
        cause, figures = self._pace.describe(now_ns, done_bytes)
        self._pace.begin(now_ns, done_bytes)
        text = (
            f"{cause}: {count_text(unnoted.total(), 'entry', 'entries')} of {count_text(len(unnoted), 'stream')} "
            f"{by_count(unnoted.total(), 'is', 'are')} not in the recording"
        )
        text += f" ({figures})" if figures else ""
        self._note(Note(Level.WARN, DROPPED, text, data={"dropped": dict(sorted(unnoted.items()))}))

    def _apply_retention(self) -> None:
        """Have the retention make a pass now, in its thread."""
        if self._retention:
            self._retention.wake()

    def _report_retention(self) -> None:
        for note in self._retention.take() if self._retention else ():
            self._note(note)
        writer = self._output.writer
        if self._retention and self._retention.has_deleted_parts() and isinstance(writer, PartsWriter):
            with suppress(OSError):  # the next part writes it again
                writer.update_side_file()

    def _fail(self, text: str) -> None:
        """The end of the present file, not of the bridge; a start begins the next one."""
        if not self._failures.fail(text):
            return
        if isinstance(self._output.writer, Ring):
            then = "it is tried again when a file is due"
        else:
            lost, was_taken = self._output.abandon()
            if lost:
                self._account.dropped[TAKEN if was_taken else UNFLUSHED] += lost
            self._finish_abandoned(goes_on=self._ledger is None and not self._options.stop_on_failure)
            if self._options.stop_on_failure:
                then = "the bridge stops"
            elif self._rests or self._ledger is not None:
                then = "the bridge goes on without recording until the next start"
            else:
                self._failures.try_later(self._clock.monotonic_ns())
                then = "the bridge goes on without recording; the disk is tried again, in a new file"
        self._note(Note(Level.ERROR, FAILED, f"{text}; {then}"))

    def _finish_abandoned(self, *, goes_on: bool = False) -> None:
        """Give the file that the disk has refused its end: at once, when the disk works again, or at the end."""
        counters = self._state().counters(self._account.not_queued)
        self._output.finish_abandoned({layout.CUT_OFF_KEY: True, "recorder": counters}, goes_on=goes_on)

    def _go_on_after_failure(self) -> None:
        """Begin the next file after a failure of the disk; before an input.  If that fails, it is tried later."""
        if self._failures.again_ns is None or isinstance(self._output.writer, Ring):
            return
        self._finish_abandoned(goes_on=True)
        try:
            path = self._output.begin()
        except (RecordingError, OSError):
            self._failures.try_later(self._clock.monotonic_ns())
            return
        missing_s = self._failures.works_again(self._clock.monotonic_ns())
        self._output.changed()
        self._report_forgotten()
        text = f"the disk works again after {duration_text(missing_s * NS_PER_S)}; the recording goes on in {path}"
        self._note(Note(Level.WARN, AGAIN, text, data={"path": str(path), "missing_s": round(missing_s, 1)}))

    def _look_at_disk(self, now_ns: int) -> None:
        """Look how much room the disk has, and try one again that has failed: after a while, or when it has more."""
        if self._space.is_due(now_ns):
            note = self._space.look_at(now_ns, self._output.writer.size)
            if self._failures.again_ns is None:
                self._full_bytes = None
            elif self._full_bytes is None:
                self._full_bytes = self._space.free_bytes
            elif self._space.has_more_than(self._full_bytes):
                self._failures.again_ns = now_ns
            rate = self._rate.look(now_ns, self._space.written, self._space.free_bytes)
            for each in (note, rate) if self._failures.again_ns is None else ():
                if each:
                    self._note(each)
        if self._failures.is_due(now_ns) and not any(each[0] == "again" for each in self._requests):
            self._requests.append(("again", 0, self._clock.utc_ns()))

    def _until_deleted(self) -> int | None:
        return self._retention.until_deleted if self._retention else None

    # -- the end ----------------------------------------------------------------------------------------------

    def _finish(self) -> None:
        self._gate.end()
        self._guarded(self._finish_abandoned)
        self._guarded(self._report_missing)
        counters = self._counters()
        ledger = {**({layout.CUT_OFF_KEY: True} if self._ledger is None else self._ledger), "recorder": counters}
        writer = self._output.writer
        try:
            if self._ledger is None and isinstance(writer, Ring):
                writer.take(ledger, self._clock.utc_ns())
            self._close(ledger)
        except (RecordingError, OSError) as error:
            self._fail(str(error))
        if self._retention:
            self._retention.stop()
            self._report_retention()
            if isinstance(writer, PartsWriter):
                from igtl_gateway.record.retention.side_files import update_side_file

                update_side_file(writer.path)
        files = [path for path in writer.files if path.exists()]
        summary = RecordingSummary(
            writer.path,
            sum(map(_size, files)),
            writer.entries,
            self._state().counters(self._account.not_queued)["dropped"],
            counters["left_out"],
            tuple(files),
            self._failures.summary,
        )
        self._bridge.send("closed", self._state(), summary)

    def _close(self, ledger: dict[str, Any]) -> None:
        """Close the file, or the next one where it was taken away.  Raises RecordingError."""
        writer = self._output.writer
        try:
            writer.close(ledger)
        except FileTaken as error:
            self._go_on(error)
            writer.close(ledger | {"recorder": self._state().counters(self._account.not_queued)})


def _without(forgotten: Mapping[str, int]) -> Note:
    """The note of a file that begins without large inputs."""
    names = ", ".join(f"{stream} ({size_text(size)})" for stream, size in forgotten.items())
    text = f"the file begins without the last message of {names}: verify of it may find differences"
    return Note(Level.WARN, INCOMPLETE_BEGIN, text, data={"streams": dict(forgotten)})


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # the file was removed

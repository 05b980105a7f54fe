"""The recorder: a sink for entries that never blocks and never raises.

What is written is written by a process of its own (``worker``), so that neither a slow disk nor the work of
compressing takes the interpreter from the bridge, and so that what the bridge has handed over is in the file
whatever happens to the bridge: if it is killed, the other process writes what waits and closes the file.  Only a large
payload that the bridge was still copying is lost then, and counts as dropped.  Entries go
there through memory that both share (``shared_queue``); requests wait in the same queue, so they act between the
entries before and after them.  Questions and notes come back through a pipe.

At the bound of the queue the entry is dropped.  Every drop is counted by stream; at most once a second a note reports
those since the last note.  A thread of the recorder delivers notes, so that the caller never waits.
"""

from __future__ import annotations

import json
import threading
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.quantities import by_count, count_text, duration_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.host import Host, in_process
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.pace import DISK, Pace
from igtl_gateway.record.reports import FAILED, THREAD, RecordingSummary, WorkerState
from igtl_gateway.record.selection import MAX_STREAMS, OTHERS, StateInputRule
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE, parts_folder
from igtl_gateway.record.sessionfile.writer import QosOf
from igtl_gateway.record.shared_queue import QueueSlot, QueueWriter
from igtl_gateway.record.worker import WorkerSettings

_ENDED = "the recording has ended"
#: Codes of the notes about a worker that does not come on with what waits, and that does again.
STALLED, MOVES = "record_stalled", "record_moves"
#: And about a file that is behind what came by more than the flush interval, and that is not any more.
LATE, ON_TIME = "record_late", "record_on_time"
#: The listening thread looks at this interval, s; a worker that took nothing for the second time, ns, is stalled.
_LOOK_S, _STILL_NS = 0.04, 3_000_000_000
#: A file that is behind by the flush interval (or the third time, which the worker's looks need) for the first time is
#: late, ns: with the looks here, that is known 0.15 s after the interval.  It is on time after the second one without.
_LATE_NS, _CALM_NS, _LEAST_NS = 80_000_000, 10_000_000_000, 200_000_000
#: So is one whose worker has taken nothing for this part of the interval, in which it should look several times.
_STARVED = 0.8
#: A worker for which more entries than this wait looks again within 0.05 s, if it gets a processor.
_MANY = 64


class Recorder:
    """Records entries; see the module.

    Args:
        path: the file to create, or the name of the parts or snapshots.
        session: the session metadata.
        qos_of: QoS of a ROS topic (name, type), None where it is not known; called in the recorder's thread.
        on_note: takes the notes of the recorder; called in the recorder's thread.
        clock: paces flushes and notes, names snapshots, where the worker is not another process.
        options: how to record.
        rule: which inputs later outputs depend on; for what is left out, and for files that begin midway.
        host: where the worker works.
        lock: for the queue; a native writer that uses the queue, too, holds the same one.

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
        rule: StateInputRule | None = None,
        host: Host = in_process,
        lock: AbstractContextManager[object] | None = None,
    ) -> None:
        self.options = options or RecordOptions()
        self._path = path
        self._qos_of = qos_of
        self._on_note = on_note

        self._lock = lock or threading.Lock()  # held for a few operations at a time; guards all up to the empty line
        self._dropped: Counter[str] = Counter()
        self._closing = False
        self._requests: dict[int, Future[Path]] = {}  # starts, stops and snapshots
        self._requested = 0

        self._state = WorkerState(file="" if self.options.waits or self.options.snapshot_s else str(path))
        self._ended = False
        self._clock = clock
        self._done, self._done_ns = 0, clock.monotonic_ns()  # what the worker had taken, and since when
        self._stalled = self._is_blocked = False
        self._put: deque[tuple[int, int]] = deque()  # when which number of entries had come, as far as not flushed
        self._behind_ns = self._most_behind_ns = 0  # how old the oldest entry is that a kill would lose, if it is late
        self._late_ns: int | None = None  # when it was late last
        self._behind_since_ns: int | None = None  # by the flush interval
        self._starved_ns = 0  # for how long the worker has taken nothing of many entries
        self._raised_ns: int | None = None  # when the worker got its share from here
        self._summary: RecordingSummary | None = None
        self._sending = threading.Lock()  # of the pipe
        settings = WorkerSettings(path, dict(session), self.options, rule or StateInputRule())
        try:
            self._place = host(settings, clock)
        except OSError as error:
            raise RecordingError(f"cannot record to {path}: no queue for the recorder: {error.strerror}") from error
        self._pipe, self._queue = self._place.pipe, self._place.queue
        self._pace = Pace(self._place.times)
        try:
            refused, begun = self._pipe.recv()
        except (EOFError, OSError):
            refused, begun = f"cannot record to {path}: the recorder did not start: {self._place.wait()}", []
        if refused:
            self._pipe.close()
            self._place.wait()
            raise RecordingError(refused)
        self._files: list[Path] = list(map(Path, begun))
        self._thread = threading.Thread(target=self._listen, name="recorder", daemon=True)
        self._thread.start()

    @property
    def queue(self) -> QueueWriter:
        """The queue, for a native writer: to be used under the lock only."""
        return self._queue

    @property
    def is_taking(self) -> bool:
        """Whether the worker comes on with what waits."""
        return not (self._closing or self._ended or self._is_blocked)

    def __call__(self, entry: Entry) -> None:
        """Record an entry.  Its buffers may change as soon as this returns.

        Raises TypeError or the like for what is no entry, which counts as dropped.
        """
        copy = self.reserve(entry)
        if copy:
            copy()

    def reserve(self, entry: Entry) -> Callable[[], None] | None:
        """Record an entry, but leave the copy of a large payload to the function that is returned.

        This takes microseconds, so the caller may have a lock that gives entries their order.  It calls the function
        once, without that lock; the buffers must not change before.  None: nothing is to be done.  Raises as a call.
        """
        with self._lock:
            taken: bool | QueueSlot = False
            try:
                taken = not (self._closing or self._ended) and self._queue.reserve(entry)
            finally:
                if taken is False and not self._tells_end():
                    self._count_drop(entry)
        if self._queue.pressing:
            self.wake()
        return taken if isinstance(taken, QueueSlot) else None

    def attend(self, room: int) -> None:
        """Have room for the next entries of the native writer, and the worker look at what waits."""
        with self._lock:
            pressing = not (self._closing or self._ended) and self._queue.look_ahead(room)
        if pressing:
            self.wake()

    def counters(self) -> dict[str, Any]:
        """What was written, waits, was dropped and was left out, so far."""
        with self._lock:
            state, dropped = self._state, Counter(self._dropped)
            entries, waiting = self._queue.waiting
        behind_s = round(self._behind_ns / NS_PER_S, 1)
        more = {"behind_s": behind_s, "queued_entries": entries, "queued_bytes": waiting, "disk_left_s": state.left_s}
        return state.counters(dropped) | more

    def facts(self) -> dict[str, Any]:
        """The counters, whether and to which file it records, and the entries since the last start."""
        counters, (written, left_out, dropped) = self.counters(), self._state.before
        return counters | {
            "paused": self.paused,
            "rests": self.rests,
            "file": self.file,
            "disk_free_bytes": self._state.free_bytes,
            "saved_files": self._state.saved[0],
            "saved_bytes": self._state.saved[1],
            "stalled_s": (self._clock.monotonic_ns() - self._done_ns) / NS_PER_S if self._stalled else 0.0,
            "entries_since_start": counters["written_entries"] - written,
            "left_out_since_start": counters["left_out_entries"] - left_out,
            "dropped_since_start": counters["dropped_entries"] - dropped,
        }

    @property
    def failure(self) -> str:
        """Why nothing can be written to a file, or ``""``."""
        return self._state.failure

    @property
    def paused(self) -> bool:
        """Whether only links, notes and what the gateway learns is recorded."""
        return self._state.paused

    @property
    def rests(self) -> bool:
        """Whether no file is open: before the start of a recording that waits, after a stop and after a failure."""
        return not (self._state.file or self.options.snapshot_s)

    @property
    def file(self) -> str:
        """The file that is being written; "": there is none."""
        return self._state.file

    def start(self) -> Future[Path]:
        """Begin the next file with the next input, after a stop, a failure or in a recording that waits.

        The result is its path, or a RecordingError.
        """
        return self._request("start")

    def stop(self) -> Future[Path]:
        """Close the file before the next input, and write nothing until the next start; the result as of ``start``."""
        return self._request("stop")

    def pause(self) -> None:
        """From the next input on, record no more than what later outputs depend on."""
        self._command("pause")

    def resume(self) -> None:
        """From the next input on, record everything again; a note reports what was left out meanwhile."""
        self._command("resume")

    def split(self) -> None:
        """Begin the next part with the next input; nothing where the recording has no parts."""
        self._command("split")

    def snapshot(self) -> Future[Path]:
        """Write the last seconds into a file; the result is its path, or a RecordingError."""
        return self._request("snapshot")

    def _request(self, what: str) -> Future[Path]:
        done: Future[Path] = Future()
        done.set_running_or_notify_cancel()  # what is under way cannot be cancelled
        with self._lock:
            self._requested += 1
            number = self._requested
            self._requests[number] = done
        if not self._command(what, number):
            self._answer(number, None, self._state.failure or _ENDED)
        return done

    def close(self, ledger: dict[str, Any]) -> RecordingSummary:
        """Write what waits, the ledger and the index.  A second call returns the same summary.

        ``ledger`` goes into the file together with the recorder's own counters (key ``recorder``).
        """
        words = "close", json.dumps(ledger)
        with self._lock:  # at once: an entry between the two would neither be written nor count as dropped
            if not (self._closing or self._ended):
                self._queue.command(*words)
            self._closing = True
            self._queue.close()
        self.wake()
        self._thread.join()
        if self._summary is None:
            self._summary = self._summary_of_lost()
        return self._summary

    def _command(self, *words: Any) -> bool:
        """Have something done by the worker behind what waits already; False at the end of the recording."""
        with self._lock:
            if self._closing or self._ended or not self._queue.command(*words):
                return False
        self.wake()
        return True

    def wake(self) -> None:
        """Have the worker look at what waits now."""
        if self._queue.signal():
            self._send("wake")

    def _send(self, answer: Any) -> None:
        try:
            with self._sending:
                self._pipe.send(answer)
        except OSError:
            pass  # the listening thread detects its end

    def _tells_end(self) -> bool:
        """Whether an entry that comes now is a note of this recorder about its end, which no file can have."""
        return self._closing and threading.current_thread() is self._thread

    def _count_drop(self, entry: Entry) -> None:
        """The caller holds the lock."""
        stream = str(entry.channel or entry.kind.value)
        if stream not in self._dropped and len(self._dropped) >= MAX_STREAMS:
            stream = OTHERS
        self._dropped[stream] += 1

    # -- the recorder's thread --------------------------------------------------------------------------------

    def _listen(self) -> None:
        """Answer the worker's questions and forward its messages, until its end."""
        if self._place.warning:
            self._on_message("note", [Note(Level.WARN, THREAD, self._place.warning)])
        while not self._ended:
            try:
                self._watch_progress()
                self._watch_flushes()
                if not self._pipe.poll(_LOOK_S):
                    continue
                topic, *values = self._pipe.recv()
            except (EOFError, OSError):
                self._on_worker_death()
                return
            self._on_message(topic, values)
        self._place.wait()
        self._on_worker_end()

    def _on_message(self, topic: str, values: list[Any]) -> None:
        match topic:
            case "note":
                try:
                    self._on_note(*values)
                except Exception as error:  # a defect elsewhere must not end the recording silently
                    self._command("fail", f"recording to {self._path} failed: {type(error).__name__}: {error}")
            case "state":
                self._state = values[0]
            case "files":
                self._files += map(Path, values[0])
            case "qos":
                self._send(self._qos(*values))
            case "drops":
                with self._lock:
                    dropped = dict(self._dropped)
                self._send(dropped)
            case "answer":
                self._answer(*values)
            case "closed":
                with self._lock:
                    self._state, self._summary = values
                    self._ended = True
                    self._queue.close()

    def _watch_progress(self) -> None:
        """Report that the worker does not come on with what waits, once, and when it does again."""
        entries, size = self._queue.waiting
        done, now_ns = self._queue.entries_put - entries, self._clock.monotonic_ns()
        if done != self._done or not entries:
            if self._stalled:
                who = "the disk answers" if self._is_blocked else "the recorder writes"
                text = f"{who} again, after {duration_text(now_ns - self._done_ns)}"
                self._on_message("note", [Note(Level.INFO, MOVES, text)])
            self._done, self._done_ns, self._stalled, self._is_blocked = done, now_ns, False, False
            self._pace.begin(now_ns, 0)
            self._starved_ns = 0
            return
        still_ns = now_ns - self._done_ns
        self._starved_ns = still_ns if entries > _MANY else 0
        if self._starved_ns >= self.options.flush_s * NS_PER_S / 2:
            self._raise_priority(now_ns)
        if not self._stalled and still_ns >= _STILL_NS:
            self._stalled = True
            shares = self._pace.shares(now_ns)
            self._is_blocked = not self._queue.is_awaited and (shares is None or shares.cause == DISK)
            cause = "the disk does not answer" if self._is_blocked else "the recorder has no processor"
            text = (
                f"{cause}: nothing was written for {_STILL_NS / NS_PER_S:g} s; "
                f"{count_text(entries, 'entry', 'entries')} "
                f"({size_text(size)}) wait in memory, and what it has no room for is dropped"
            )
            self._on_message("note", [Note(Level.WARN, STALLED, text)])

    def _raise_priority(self, now_ns: int) -> None:
        """Give the worker its share, once in a while: one behind all others cannot see that it is late."""
        if (self._raised_ns is None or now_ns - self._raised_ns > _CALM_NS) and self._place.raise_priority():
            self._raised_ns = now_ns

    def _watch_flushes(self) -> None:
        """Report that a kill of both processes would lose more than the flush interval, once until it does not."""
        now_ns, put, flushed = self._clock.monotonic_ns(), self._queue.entries_put, self._queue.entries_flushed
        if self.rests or self._state.failure or self.options.snapshot_s:
            self._put.clear()
            self._behind_ns = 0
            return
        if not self._put or put > self._put[-1][1]:
            self._put.append((now_ns, put))
        while self._put and self._put[0][1] <= flushed:
            self._put.popleft()
        behind_ns = now_ns - self._put[0][0] if self._put else 0  # at least
        interval_ns = max(self.options.flush_s * NS_PER_S, _LEAST_NS)
        if behind_ns <= interval_ns and self._starved_ns < _STARVED * interval_ns:
            self._behind_since_ns = None
        elif self._behind_since_ns is None:
            self._behind_since_ns = now_ns
            self._raise_priority(now_ns)
        is_late = self._behind_since_ns is not None and now_ns - self._behind_since_ns >= _LATE_NS
        self._behind_ns = behind_ns if is_late else 0
        self._most_behind_ns = max(self._most_behind_ns, self._behind_ns)
        if is_late:
            begins, self._late_ns = self._late_ns is None, now_ns
            if begins:
                text = (
                    f"the file is {duration_text(behind_ns)} behind: a kill of both processes would lose that now "
                    f"(--flush-interval {self.options.flush_s:g}); {count_text(put - flushed, 'entry', 'entries')} "
                    f"{by_count(put - flushed, 'waits', 'wait')}"
                )
                self._on_message("note", [Note(Level.WARN, LATE, text, data={"behind_s": behind_ns / NS_PER_S})])
        elif self._late_ns is not None and now_ns - self._late_ns > _CALM_NS:
            text = f"the file is on time again; it was {duration_text(self._most_behind_ns)} behind"
            self._late_ns, self._most_behind_ns = None, 0
            self._on_message("note", [Note(Level.INFO, ON_TIME, text)])

    def _qos(self, topic: str, ros_type: str) -> Any:
        """The QoS, or the words of a defect."""
        try:
            return self._qos_of(topic, ros_type)
        except Exception as error:
            return f"{type(error).__name__}: {error}"

    def _on_worker_death(self) -> None:
        """The worker ended without a message: it was killed."""
        failure = f"recording to {self._path} failed: the recorder's process has ended: {self._place.wait()}"
        with self._lock:
            values = self._state
            if self.options.snapshot_s:
                lost, _ = self._queue.waiting
            else:  # entries that it took and did not report may be in the file, or not
                accounted = values.written_entries + sum(values.dropped.values()) + sum(values.left_out.values())
                lost = self._queue.entries_put - accounted
            self._dropped["(with the recorder's process)"] += lost
            self._state = replace(values, failure=failure)
            self._ended = True
            self._queue.close()
        self._on_worker_end()
        then = "the bridge stops" if self.options.stop_on_failure else "the bridge goes on without recording"
        left = f"igtl-gateway recover repairs {values.window or 'the file'}"
        if self.options.snapshot_s and not values.window:
            left = "what was in memory is lost"
        self._on_note(Note(Level.ERROR, FAILED, f"{failure}; {then}; {left}"))

    def _summary_of_lost(self) -> RecordingSummary:
        """As far as this end knows."""
        values, path, begun = self.counters(), self._path, self._files
        if self.options.has_parts:
            path = parts_folder(path)
            begun = [*begun, path / SIDE_FILE]
        files = tuple(each for each in begun if each.is_file())
        return RecordingSummary(
            path,
            sum(each.stat().st_size for each in files),
            values["written_entries"],
            values["dropped"],
            values["left_out"],
            files,
            values["failure"],
        )

    def _answer(self, number: int, path: Path | None, why: str) -> None:
        with self._lock:
            done = self._requests.pop(number, None)
        if done and path:
            done.set_result(path)
        elif done:
            done.set_exception(RecordingError(why))

    def _on_worker_end(self) -> None:
        """There is no worker any more."""
        self._queue.release()
        with self._lock:
            waiting = list(self._requests)
        for number in waiting:
            self._answer(number, None, self._state.failure or _ENDED)
        with self._sending:  # no thread may write to the next file with this number
            self._pipe.close()

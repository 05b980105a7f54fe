"""The black box: the last seconds in memory, and rules that write them to a file.

A trigger opens a file with what memory has of the window before it, and what follows goes to the file as it comes,
until the window after the trigger ends.  A mark that comes late has its window around the moment that it marks, as far
as memory has it, and its file goes on to the mark.  A trigger within the window, or whose own window begins in it,
extends it: overlapping windows are one file, which is written again if a later trigger's window begins before it.  So
the file stays open for the longest window before a trigger, and only then gets its ledger, in which each trigger has a
row.  No more than `MAX_PER_MINUTE` windows have files of their own within a minute: each file has the last message of
each stream, which may be much more than its window.  Of more, those that follow each other are one file.

Memory has the bound of the ring, also while the disk is slow or full: if a file cannot be written, it is tried again
while memory has the window; then a note names the triggers that have none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.quantities import count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.triggers import Trigger
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.ring import Open, Ring
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.triggers import INCOMPLETE, SAVED, TRIGGERED, Cause, Triggers

#: Triggers of one rule within this time are one row, with their count, and one note.
_TOGETHER_NS = NS_PER_S
#: Windows that have files of their own within a minute; the others continue the file before them.
MAX_PER_MINUTE = 60
_MINUTE_NS = 60 * NS_PER_S
#: Rows of one file; further triggers count in the last row of their rule.
MAX_ROWS = 10_000
#: Rows that a note has.
_IN_NOTE = 100
#: Gaps that are known one by one; further ones are joined.
_MAX_GAPS = 1_000
#: A file that cannot be written is tried again after this time.
_AGAIN_NS = NS_PER_S
#: Least time that a file stays open after its window, for entries that are under way.
_LEAST_LINGER_NS = NS_PER_S


@dataclass(slots=True)
class _Row:
    """Triggers of one rule within a second: begin of their window, the first and the last, UTC ns, and how many."""

    rule: Trigger
    why: str
    begin_ns: int
    first_ns: int
    last_ns: int
    count: int = 1

    @property
    def until_ns(self) -> int:
        """End of the window of the last one."""
        return self.last_ns + round(self.rule.after_s * NS_PER_S)


@dataclass(slots=True)
class _Window:
    """A window that is open.

    Attributes:
        end_ns: what is written: inputs up to here, with their outputs.
        begin_ns: inputs from here on.
        first: number of the first entry in the file that is not of its prologue.
        rows: its triggers.
        writer: its file; None: there is none yet.
        why_not: why there is none.
        failed: what was left of files that could not be written to their end.
        forgotten_ns: the newest input before those of the file, which memory may forget; 0: there is none.
        is_rewritten: whether it was written again for a window that begins earlier.
        written: number of the last entry in the file.
        is_open: whether the last input is in the file, and so its outputs are.
        skipped: entries that the format cannot hold.
        again_ns: when the next attempt is due, monotonic.
    """

    end_ns: int
    begin_ns: int
    first: int = 0
    rows: list[_Row] = field(default_factory=list)
    writer: SessionWriter | None = None
    why_not: str = ""
    failed: list[Path] = field(default_factory=list)
    forgotten_ns: int = 0
    is_rewritten: bool = False
    written: int = 0
    is_open: bool = True
    skipped: int = 0
    again_ns: int = 0


class BlackBox(Ring):
    """As ``Ring``, with rules.

    Args:
        path, open_file, prologue, seconds, max_bytes: see ``Ring``.
        rules: what triggers.
        triggers: looks for them.
        clock: paces attempts, and ends windows in which nothing comes.
        counters: returns those of the recorder, for the ledger.
        on_note: takes notes.
        on_obstacle: called with what is in the way of files, and whether one is missing for that; "": nothing is.
    """

    def __init__(
        self,
        path: Path,
        open_file: Open,
        prologue: Prologue,
        *,
        seconds: float,
        max_bytes: int,
        rules: Sequence[Trigger],
        triggers: Triggers,
        clock: Clock,
        counters: Callable[[], dict[str, Any]],
        on_note: Callable[[Note], None],
        on_obstacle: Callable[[str, bool], None] = lambda _why, _is_missing: None,
    ) -> None:
        super().__init__(path, open_file, prologue, seconds=seconds, max_bytes=max_bytes)
        self._triggers = triggers
        self._clock = clock
        self._counters = counters
        self._on_note = on_note
        self._on_obstacle = on_obstacle
        self._linger_ns = max(_LEAST_LINGER_NS, *(self._before_ns(rule) for rule in rules))
        self._window: _Window | None = None
        self._ended: _Window | None = None  # closed since nothing came, until the next input comes
        self._last_ns = 0  # of the last entry
        self._came_ns = clock.monotonic_ns()  # when it came
        self._last_seq = 0
        self._gaps: list[tuple[int, int, int]] = []  # between two entries, UTC ns, and how many are missing
        self._opened_ns: deque[int] = deque(maxlen=MAX_PER_MINUTE)  # stamps of triggers that opened windows
        self._unnoted: dict[Trigger, tuple[int, int]] = {}  # → when the last note was, and triggers since then

    @property
    def present(self) -> Path | None:
        """The file that is being written."""
        writer = self._window.writer if self._window else None
        return writer.path if writer else None

    def saw(self, entry: Entry) -> None:
        """Take notice of the number of each entry, also of those that are not recorded: a gap is a loss."""
        missing = entry.seq - self._last_seq - 1
        if self._last_seq and missing > 0:
            self._gaps.append((self._last_ns, entry.stamp_ns, missing))
            if len(self._gaps) > _MAX_GAPS:
                (begin, _, one), (_, end, two), *rest = self._gaps
                self._gaps = [(begin, end, one + two), *rest]
        self._last_seq = entry.seq
        window = self._window
        if window and entry.kind.is_input and entry.stamp_ns > window.end_ns + self._linger_ns:
            window.is_open = False
            self._finish()

    def write(self, entry: Entry) -> None:
        """Keep an entry, write it to an open window, and look whether it triggers."""
        self._last_ns, self._came_ns = entry.stamp_ns, self._clock.monotonic_ns()
        super().write(entry)
        if self._ended and entry.kind.is_input:
            ended, self._ended = self._ended, None
            if ended.writer and entry.stamp_ns <= ended.end_ns:
                self._report_late(ended, ended.writer)
        window = self._window
        if window:
            if entry.kind.is_input and entry.stamp_ns > window.end_ns:
                window.is_open = False
            if window.is_open and window.writer:
                self._add(window, (entry,))
        for cause in self._triggers.look(entry):
            self._take_cause(cause)
        if self._window and not self._window.writer:
            self._try_again(self._window)

    def tick(self) -> None:
        """Take notice of the time, where nothing waits: a window also ends if nothing comes."""
        window = self._window
        if window is None:
            return
        now_ns = self._last_ns + self._clock.monotonic_ns() - self._came_ns
        if now_ns > window.end_ns + self._linger_ns:
            self._last_ns = max(self._last_ns, window.end_ns + 1)
            self._finish()
            self._ended = window
        elif not window.writer:
            self._try_again(window)

    def flush(self) -> None:
        """Hand what the open file has to the operating system."""
        window = self._window
        if window and window.writer:
            with self._obstacles(window):
                window.writer.flush()

    def close(self, ledger: dict[str, Any]) -> None:
        """Finish the open window."""
        if self._window:
            if not self._window.writer:
                self._open_window(self._window)
            self._finish(ledger)
        super().close(ledger)

    # -- triggers ---------------------------------------------------------------------------------------------

    def _before_ns(self, rule: Trigger) -> int:
        return self._max_ns if rule.before_s is None else min(self._max_ns, round(rule.before_s * NS_PER_S))

    def _begin_ns(self, cause: Cause) -> int:
        """Return the begin of the window of a trigger: all that memory has, if no time is given."""
        if cause.rule.before_s is None:
            return min(cause.at_ns, cause.noted_ns - self._max_ns)
        return cause.at_ns - self._before_ns(cause.rule)

    def _take_cause(self, cause: Cause) -> None:
        window, rule, at_ns = self._window, cause.rule, cause.at_ns
        begin_ns = self._begin_ns(cause)
        end_ns = max(at_ns + round(rule.after_s * NS_PER_S), cause.noted_ns)
        if window and not self._can_extend(window, begin_ns, cause.noted_ns):
            self._finish()
            window = None
        if window is None:
            self._opened_ns.append(cause.noted_ns)
            window = self._window = _Window(end_ns, begin_ns)
            _count(window.rows, cause, begin_ns)
            self._open_window(window)
        else:
            _count(window.rows, cause, begin_ns)
            window.end_ns = max(window.end_ns, end_ns)
            if begin_ns < window.begin_ns:
                window.begin_ns = begin_ns
                if window.writer and self._first_seq(begin_ns) < window.first:
                    self._open_earlier(window, window.writer)
            if not window.is_open:
                window.is_open = True
                self._catch_up(window)
        self._report(cause)

    def _can_extend(self, window: _Window, begin_ns: int, now_ns: int) -> bool:
        """Return whether a window that begins here continues an open one, of whose time memory has the rest."""
        if window.is_open or not window.writer:
            return True
        opened = self._opened_ns
        are_many = len(opened) == MAX_PER_MINUTE and now_ns - opened[0] < _MINUTE_NS
        return (begin_ns <= window.end_ns or are_many) and self._entries[0].seq <= window.written + 1

    def _report(self, cause: Cause) -> None:
        """Write a note of the trigger: at most one a second of each rule, with the count of those before it."""
        noted_ns, unnoted = self._unnoted.get(cause.rule, (0, 0))
        if noted_ns and cause.noted_ns - noted_ns < _TOGETHER_NS:
            self._unnoted[cause.rule] = noted_ns, unnoted + 1
            return
        self._unnoted[cause.rule] = cause.noted_ns, 0
        more = f"; {unnoted:,} more before it" if unnoted else ""
        data = {"rule": str(cause.rule), "at_ns": cause.at_ns, "before": unnoted}
        self._on_note(Note(Level.INFO, TRIGGERED, f"black box, {cause.rule}: {cause.why}{more}", data=data))

    def _first_seq(self, begin_ns: int) -> int:
        """Return the number of the first input in memory that is not before this time, or else of the last one."""
        inputs = [entry for entry in self._entries if entry.kind.is_input]
        return next((entry for entry in inputs if entry.stamp_ns >= begin_ns), (inputs or self._entries)[-1]).seq

    # -- files ------------------------------------------------------------------------------------------------

    def _open_window(self, window: _Window) -> None:
        """Open the file of a window, with what memory has of it; if that fails, it is tried again later."""
        window.again_ns = self._clock.monotonic_ns() + _AGAIN_NS
        window.forgotten_ns = self.forgotten_ns
        first = window.rows[0]
        facts = {
            layout.SNAPSHOT_KEY: f"{self._seconds:g}",
            layout.TRIGGER_KEY: f"{first.rule}: {first.why}",
        }
        with self._obstacles(window):
            prologue, window.first = self._prologue.copy(), self._first_seq(window.begin_ns)
            for entry in self._entries:
                if entry.seq < window.first:
                    prologue.observe(entry)
                    window.forgotten_ns = max(window.forgotten_ns, entry.stamp_ns if entry.kind.is_input else 0)
            window.written = window.first - 1
            window.writer = self._open_file(self._path(first.first_ns), facts, prologue.entries())
            self.files.append(window.writer.path)
            self._catch_up(window)
        if window.writer:
            for path in window.failed:  # the new file has all that these have
                path.unlink(missing_ok=True)
                with suppress(ValueError):
                    self.files.remove(path)
            window.failed.clear()
            if window.why_not:
                window.why_not = ""
                self._on_obstacle("", False)

    def _open_earlier(self, window: _Window, writer: SessionWriter) -> None:
        """Write the file of a window again, with what memory has before it; the second time all, and no third time."""
        if window.is_rewritten:
            window.begin_ns = min(window.begin_ns, self._entries[0].stamp_ns)
        window.is_rewritten = True
        window.failed.append(writer.path)
        window.writer = None
        self._open_window(window)

    def _try_again(self, window: _Window) -> None:
        if self._clock.monotonic_ns() >= window.again_ns:
            self._open_window(window)

    def _catch_up(self, window: _Window) -> None:
        """Write what memory has behind the last entry of the file, up to the end of the window."""
        waiting = list(takewhile(lambda entry: entry.seq > window.written, reversed(self._entries)))
        waiting.reverse()
        later = (at for at, entry in enumerate(waiting) if entry.kind.is_input and entry.stamp_ns > window.end_ns)
        end = next(later, None)
        window.is_open = end is None
        self._add(window, waiting[:end])

    def _add(self, window: _Window, entries: Sequence[Entry]) -> None:
        with self._obstacles(window):
            for entry in entries:
                if window.writer is None:
                    return
                try:
                    window.writer.write(entry)
                except LayoutError:  # what the format cannot hold costs only itself
                    window.skipped += 1
                window.written = entry.seq

    def _obstacles(self, window: _Window) -> _Obstacles:
        return _Obstacles(self, window)

    def lose_file(self, window: _Window, why: str) -> None:
        """Take notice that the file of a window cannot be written (further)."""
        if not window.why_not:
            text = f"black box, {_names(window.rows)}: {why}"
            self._on_obstacle(text, False)
            self._on_note(Note(Level.WARN, INCOMPLETE, f"{text}; it is tried again while memory has the window"))
        window.why_not = why
        if window.writer:
            path, window.writer = window.writer.path, None
            if window.failed:
                path.unlink(missing_ok=True)  # one part is enough on a disk that is full
                self.files.remove(path)
            else:
                window.failed.append(path)

    def _finish(self, ledger: dict[str, Any] | None = None) -> None:
        """Close the file of the window, and report it."""
        window, self._window = self._window, None
        assert window
        rows = [self._judged(row, window) for row in window.rows]
        writer = window.writer
        if writer:
            counters = (ledger or {}).get("recorder") or self._counters()
            facts = {"recorder": counters | {"written_entries": writer.entries}, layout.TRIGGERS_KEY: rows}
            with self._obstacles(window):
                writer.close((ledger or {}) | facts)
        if window.writer is None:
            rows = [self._judged(row, window) for row in window.rows]
            text = f"black box, {_names(window.rows)}: no file: {window.why_not}"
            if window.failed:
                text += f"; igtl-gateway recover repairs {' and '.join(map(str, window.failed))}"
            self._on_obstacle(text, True)
            self._on_note(Note(Level.ERROR, INCOMPLETE, text, data={"triggers": rows[:_IN_NOTE]}))
            return
        self._on_obstacle("", False)
        self.entries += window.writer.entries
        self.undefined += [name for name in window.writer.undefined if name not in self.undefined]
        self.size += window.writer.path.stat().st_size
        text = f"black box, {_names(window.rows)}: {window.writer.path}"
        missing = [row for row in rows if row["missing"]]
        if missing:
            text += f"; incomplete: {missing[0]['missing']}"
        code, level = (INCOMPLETE, Level.WARN) if missing else (SAVED, Level.INFO)
        data = {"path": str(window.writer.path), "rows": len(rows), "incomplete": len(missing)}
        self._on_note(Note(level, code, text, data=data))

    def _report_late(self, window: _Window, writer: SessionWriter) -> None:
        """Write a note of a file that was closed before all of its window came, as the bridge had no processor."""
        why = "entries that came after the file was closed"
        text = f"black box, {_names(window.rows)}: {writer.path}; incomplete: {why}"
        rows = [self._judged(row, window) | {"missing": why} for row in window.rows[:_IN_NOTE]]
        self._on_note(Note(Level.WARN, INCOMPLETE, text, data={"path": str(writer.path), "triggers": rows}))

    def _judged(self, row: _Row, window: _Window) -> dict[str, Any]:
        """Return the row of the ledger, with what its windows lack, or ""."""
        begin_ns, lacks = row.begin_ns, []
        if window.writer is None:
            lacks.append(f"no file: {window.why_not}")
        if window.forgotten_ns >= begin_ns:
            lost_ns = min(window.forgotten_ns, row.until_ns) - begin_ns
            lacks.append(f"{duration_text(lost_ns)} of its window: memory had them no more")
        if row.until_ns > max(self._last_ns, window.end_ns if not window.is_open else 0):
            lacks.append(f"{duration_text(row.until_ns - self._last_ns)} after it: the recording ended")
        lost = sum(count for begin, end, count in self._gaps if end >= begin_ns and begin <= row.until_ns)
        if lost:
            lacks.append(f"{count_text(lost, 'entry', 'entries')}: the disk or the machine was too slow")
        if window.skipped:
            lacks.append(f"{count_text(window.skipped, 'entry', 'entries')} that the format cannot hold")
        return {
            "rule": str(row.rule),
            "why": row.why,
            "at_ns": row.first_ns,
            "last_ns": row.last_ns,
            "count": row.count,
            "before_s": self._before_ns(row.rule) / NS_PER_S,
            "after_s": row.rule.after_s,
            "missing": "; ".join(lacks),
        }


class _Obstacles:
    """Context manager: an error of the disk costs the file of a window, and nothing else."""

    def __init__(self, box: BlackBox, window: _Window) -> None:
        self._box, self._window = box, window

    def __enter__(self) -> None:
        """Nothing to do."""

    def __exit__(self, _kind: object, error: BaseException | None, _place: object) -> bool:
        if isinstance(error, RecordingError | OSError):
            self._box.lose_file(self._window, str(error))
            return True
        return False


def _count(rows: list[_Row], cause: Cause, begin_ns: int) -> None:
    """Add a trigger to rows: to the last one of its rule if that is recent, or there is no room."""
    last = next((row for row in reversed(rows) if row.rule == cause.rule), None)
    if last and (abs(cause.at_ns - last.last_ns) < _TOGETHER_NS or len(rows) >= MAX_ROWS):
        last.begin_ns = min(last.begin_ns, begin_ns)
        last.first_ns, last.last_ns = min(last.first_ns, cause.at_ns), max(last.last_ns, cause.at_ns)
        last.count += 1
    else:
        rows.append(_Row(cause.rule, cause.why, begin_ns, cause.at_ns, cause.at_ns))


def _names(rows: Sequence[_Row]) -> str:
    number = sum(row.count for row in rows)
    return f"{rows[0].rule}" + (f" and {number - 1:,} more" if number > 1 else "")

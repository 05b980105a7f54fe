"""The pen: writes to a rerun recording stream, with time lines, and with columns for frequent rows.

A call of ``rerun.log`` costs about 100 µs: little for a cloud, too much for a pose.  Poses, numbers and trails are
collected and sent as columns, which costs a hundredth.  Of many messages at once (``at_rows``) a number is a column.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import NS_PER_S, ConversionError
from igtl_gateway.addon.live import NoteEvent, NoteRate
from igtl_gateway.addon.reading import Entry, Level, Note
from igtl_gateway.addon.terminal import moment_text
from igtl_gateway.addons.view.colours import ERROR, INFO, WARN
from igtl_gateway.addons.view.columns import LINES, NUMBERS, POSES, SIZES, Collected, RowKind, Rows, times_of
from igtl_gateway.addons.view.contents import LOG, PLACES
from igtl_gateway.addons.view.rhythm import Rhythm

#: Colour of a line.
LEVELS = {Level.INFO: INFO, Level.WARN: WARN, Level.ERROR: ERROR}

#: The time lines: gateway time, the source stamp (if the sender set one), and the entry number.
GATEWAY_TIME, SENDER_TIME, ENTRY = "gateway_time", "sender_time", "entry"

#: The largest time on a time line, UTC nanoseconds: in the year 2116.
LAST_NS = 1 << 62

MAX_ENTITIES = 20_000

Xyz = Sequence[float]
Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose of a frame.

    Attributes:
        parent: the parent frame.
        child: the frame, which labels the axes; "" = the implicit frame of the entity, without a label.
        numbers: position in metres, quaternion x, y, z, w; columns for many rows.
        axis_m: length of the axes in metres; 0 = no axes.
        labelled: show the name of ``child`` at the axes.
    """

    parent: str
    child: str
    numbers: Sequence[Any]
    axis_m: float
    labelled: bool = True

    @property
    def look(self) -> tuple[str, str, float, bool]:
        """All but the numbers."""
        return self.parent, self.child, self.axis_m, self.labelled


#: Characters that the built-in font of the rerun viewer does not have: all but Latin, Greek, Cyrillic and some signs.
_STRANGE = re.compile(r"[^\n\t\x20-\u024f\u0370-\u052f\u2010-\u2026\u20ac\u2190-\u2193\u2212\u2260\u2264\u2265]")

#: Surrogates: how Python represents bytes that are not UTF-8.
_NO_TEXT = re.compile("[\ud800-\udfff]")


class Pen:
    """Draws into one recording; each row has the times of the entry that was last passed to ``at``.

    Between ``at_rows`` and the next ``at``, a call of ``pose``, ``numbers`` or ``sizes`` adds a row for each message.
    """

    def __init__(self, recording: rr.RecordingStream, *, plain: bool = False) -> None:
        self.recording = recording
        self._plain = plain
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        self.number = self.stamp_ns = self.source_ns = 0
        self.begin_ns = 0  # gateway time of the first entry, UTC ns
        self.owners: dict[str, str] = {}  # frame → topic that publishes its pose
        self.link_axes: dict[str, float] = {}  # link of a robot → length of its axes in metres
        self.cameras: set[str] = set()  # frames with a pinhole
        self.rows: Rows | None = None
        self.changes = 0  # of what frames are of, and of how they look
        self._times_set: tuple[int, int, int] | None = None
        self._waiting: dict[tuple[str, str], Collected] = {}
        self._table: tuple[Any, str, Array] = ((), "", np.empty(0))
        self._paths: set[str] = set()
        self._numbers: dict[str, int] = {}  # path → the number that was not tried yet
        self._placed: set[str] = set()
        self._rhythms: dict[tuple[str, str], Rhythm] = {}
        self._notes, self._words = NoteRate(), NoteRate(limited=False)
        self._looked_ns = 0

    def unique_path(self, path: str) -> str:
        """Return ``path`` for a new entity, or ``<path>_2`` and so on if it is taken.

        Raises ConversionError above the maximum number of entities: a sender that invents names must not exhaust
        the memory of the viewer.
        """
        if len(self._paths) >= MAX_ENTITIES:
            raise ConversionError(f"found more than {MAX_ENTITIES:,} entities, expected fewer names")
        free, number = path, self._numbers.get(path, 2)
        while free in self._paths:
            free, number = f"{path}_{number}", number + 1
        self._numbers[path] = number
        self._paths.add(free)
        return free

    def set_default_frame(self, path: str, frame: str) -> None:
        """On the first call, log statically that the entity is in ``frame``; its rows replace that later.

        A view reports an error for an entity that no transform connects with the frame of the view, even before its
        first row.  Static data hides all rows of the same component, so it must not be at the entity itself: another
        entity places its implicit frame (rerun allows that a child frame is first mentioned statically at one entity
        and later temporally at another: ``Transform3D.child_frame``).
        """
        if path not in self._placed:
            self._placed.add(path)
            self.static(f"{PLACES}/{path}", rr.Transform3D(parent_frame=frame, child_frame=f"tf#/{path}"))

    def begin(self, path: str, pose: Pose) -> None:
        """On the first call, log the first pose of a frame for all earlier times, too: its contents need one."""
        place = f"{PLACES}/{path}/frame"
        if place not in self._placed:
            self._placed.add(place)
            first = [each[0] for each in pose.numbers] if self.rows else pose.numbers
            self.static(place, _transform(replace(pose, numbers=first)))

    def has_begun(self, path: str) -> bool:
        """Return whether ``begin`` was called: static data of the frame at its own entity would be an error."""
        return f"{PLACES}/{path}/frame" in self._placed

    def at(self, entry: Entry) -> None:
        """Set the times of the following rows from this entry; a ``timeless`` stamp is left out."""
        self.rows = None
        self.number = entry.seq
        self.stamp_ns = 0 if timeless(entry.stamp_ns) else entry.stamp_ns
        self.begin_ns = self.begin_ns or self.stamp_ns
        self.source_ns = 0 if timeless(entry.source_ns) else entry.source_ns

    def at_rows(self, rows: Rows) -> None:
        """Set the times of the following rows from many messages; none of their stamps is ``timeless``."""
        self.rows = rows

    def at_row(self, rows: Rows, row: int) -> None:
        """Set the times of the following rows from one of many messages."""
        self.rows = None
        self.number, self.stamp_ns, self.source_ns = (
            int(each[row]) for each in (rows.numbers, rows.stamps, rows.sources)
        )

    def moment(self, time_ns: int) -> None:
        """Set the times of the following rows to a moment of the gateway's time, UTC ns."""
        self.stamp_ns = 0 if timeless(time_ns) else time_ns
        self.source_ns = 0

    def log(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Send one row immediately, with all its components."""
        self._set_time()
        self.recording.log(path, *archetypes)

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Send static data."""
        self.recording.log(path, *archetypes, static=True)

    def pose(self, path: str, pose: Pose) -> None:
        """Add a row with axes."""
        self._wait((path, "named" if pose.child else ""), POSES, pose.look, pose.numbers)

    def static_pose(self, path: str, pose: Pose) -> None:
        """Send static axes."""
        axes = rr.TransformAxes3D(pose.axis_m, show_frame=pose.labelled)
        self.static(path, rr.CoordinateFrame(pose.child), axes, _transform(pose))

    def numbers(self, path: str, values: Sequence[Any], *, is_dense: bool = False) -> None:
        """Add one value to each of several series, NaN for none; a line breaks at a gap.

        Args:
            path: the entity.
            values: a number for each series; columns for many rows.
            is_dense: there are no gaps: each value stands for the time until the next one.
        """
        key = (path, f"numbers {len(values)}")
        if not is_dense and key not in self._rhythms:
            self._rhythms[key] = Rhythm()
        self._wait(key, NUMBERS, (), values)

    def curve(self, path: str, name: str, colour: int) -> None:
        """Set the name and the colour of a series in the legend of its plot."""
        self.static(path, rr.SeriesLines(names=[self.displayable(name)], colors=[colour]))

    def sizes(self, path: str, size: int) -> None:
        """Add a row with the size of a message in bytes for the selection panel, without a drawing."""
        self._wait((path, "size"), SIZES, (), (size,))

    def trail(self, path: str, frame: str, colour: int, lines: Sequence[Array]) -> None:
        """Add a row for each line through (n, 3) places in a frame, metres."""
        self._wait((path, "trail"), LINES, (frame, colour), lines if self.rows else lines[0])

    def series(self, path: str, times_ns: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> None:
        """Send (N,) values at (N,) gateway times, UTC ns; those outside the time lines are left out."""
        on = (times_ns > 0) & (times_ns <= LAST_NS)
        if on.any():
            stamps = np.ascontiguousarray(times_ns[on])
            times = [rr.TimeColumn(GATEWAY_TIME, timestamp=stamps.view("datetime64[ns]"))]
            self.recording.send_columns(path, times, rr.Scalars.columns(scalars=values[on]))

    def text(self, path: str, text: str, level: str, colour: int | None = None) -> None:
        """Write a line to a log, after the time since the first entry."""
        # the log of rerun cuts a column of times after the date, so the line has the time of the session
        time = f"{moment_text(self.stamp_ns - self.begin_ns):>11}" if self.stamp_ns else ""
        line = f"{time:11}  {text}"
        # rerun gives a line without a colour that of the previous line
        self.log(path, rr.TextLog(self.displayable(line), level=level, color=INFO if colour is None else colour))

    def report(self, event: NoteEvent, *, is_words: bool = False) -> None:
        """Write a line to the log of the session, unless it has come before and is no news (`NoteRate`).

        ``is_words``: of a message, so that each other one is written, however many there are.
        """
        if event.stamp_ns - self._looked_ns >= NS_PER_S:
            self._looked_ns = event.stamp_ns
            self._report_due(event.stamp_ns)
        if shown := (self._words if is_words else self._notes).take(event):
            self._line(shown)

    def report_rest(self) -> None:
        """Write what was held back."""
        self._report_due(None)

    def _report_due(self, now_ns: int | None) -> None:
        times = self.stamp_ns, self.source_ns
        for event in (*self._notes.due(now_ns), *self._words.due(now_ns)):
            self.moment(event.stamp_ns)
            self._line(event)
        self.stamp_ns, self.source_ns = times

    def _line(self, event: NoteEvent) -> None:
        note, more = event.note, f" ({event.more:,} more like it)" if event.more else ""
        self.text(LOG, f"{line_of(note, event.links)}{more}", note.level.name, LEVELS[note.level])

    def displayable(self, text: str) -> str:
        """Return the text; a ``plain`` pen escapes the characters that a headless viewer cannot draw."""
        text = valid(text)
        return _STRANGE.sub(lambda found: found[0].encode("unicode_escape").decode(), text) if self._plain else text

    def fields(self, path: str, **values: Any) -> None:
        """Add a row with fields for the selection panel, without a drawing."""
        self.log(path, rr.AnyValues(**values))

    def flush(self) -> None:
        """Send the collected rows."""
        for key, collected in self._waiting.items():
            if collected.count:
                self._send(key, collected)

    def _set_time(self) -> None:
        times = (self.number, self.stamp_ns, self.source_ns)
        if times == self._times_set:
            return
        self._times_set = times
        self.recording.set_time(ENTRY, sequence=self.number)
        for line, time_ns in ((GATEWAY_TIME, self.stamp_ns), (SENDER_TIME, self.source_ns)):
            if time_ns:
                self.recording.set_time(line, timestamp=np.datetime64(time_ns, "ns"))
            else:
                self.recording.disable_timeline(line)

    def _wait(self, key: tuple[str, str], kind: RowKind, look: Any, numbers: Any) -> None:
        collected = self._waiting.get(key)
        if collected is None:
            collected = self._waiting[key] = Collected(kind)
        if self.rows is None:
            collected.add((self.number, self.stamp_ns, self.source_ns), look, numbers)
        else:
            table = self._tabled(numbers, kind.dtype, len(self.rows)) if kind.dtype else numbers
            collected.add_rows(self.rows, look, table)
        if collected.count >= kind.most:
            self._send(key, collected)

    def _tabled(self, numbers: Sequence[Any], dtype: str, count: int) -> Array:
        """Columns, or numbers that are the same in all rows, as a table (rows, numbers)."""
        known, kind, table = self._table
        if known is not numbers or kind != dtype or len(table) != count:
            table = np.empty((count, len(numbers)), dtype)
            for place, values in enumerate(numbers):
                table[:, place] = values
            self._table = numbers, dtype, table
        return table

    def _send(self, key: tuple[str, str], collected: Collected) -> None:
        path, rhythm = key[0], self._rhythms.get(key)
        for rows, columns in collected.take(rhythm.gaps if rhythm else None):
            times = [times_of(ENTRY, rows.numbers, is_number=True)]
            lines = ((GATEWAY_TIME, rows.stamps), (SENDER_TIME, rows.sources))
            times += [times_of(line, stamps) for line, stamps in lines if stamps[0]]
            self.recording.send_columns(path, times, columns)


def _transform(pose: Pose) -> rr.Transform3D:
    x, y, z, w = pose.numbers[3:]
    return rr.Transform3D(
        translation=pose.numbers[:3],
        quaternion=rr.Quaternion(xyzw=(x, y, z, w)),
        parent_frame=pose.parent,
        child_frame=pose.child or None,
    )


def valid(text: str) -> str:
    """Replace bytes that are not UTF-8: rerun would reject the whole column."""
    return text if text.isascii() else _NO_TEXT.sub("\ufffd", text)


def timeless(time_ns: int) -> bool:
    """Return whether a UTC stamp in nanoseconds is unset or outside the time lines (1970 to 2116)."""
    return not 0 < time_ns <= LAST_NS


def line_of(note: Note, links: tuple[int, ...]) -> str:
    """Return the line of a note in the log, with its stream and its links."""
    stream = f"{note.stream}: " if note.stream and note.stream not in note.text else ""
    which = f" [link {', '.join(map(str, links))}]" if links else ""
    return f"{stream}{note.text}{which}"

"""The view of a session: entries in, rows of a rerun recording out; ``SessionContents`` has the contents.

Each ROS message is one row at the entity of its topic, drawn by its row of ``table``.  An OpenIGTLink message is drawn
as the ROS messages that it was converted to.  Only trails of a few seconds and collected columns are kept in memory,
whatever the size of the session.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from igtl_gateway.addon import NS_PER_S, ConversionError
from igtl_gateway.addon.messages import ieee_754
from igtl_gateway.addon.reading import Entry, Kind, Level, Mark, MarkNote, Note
from igtl_gateway.addon.streams import StreamTimes, one_clock
from igtl_gateway.addon.untrusted import read_bytes
from igtl_gateway.addons.view.blueprints import is_camera, target_frame
from igtl_gateway.addons.view.canvas import Canvas, Options
from igtl_gateway.addons.view.colours import ERROR, INFO, WARN
from igtl_gateway.addons.view.contents import (
    DROPS,
    FRAMES,
    LAG,
    LATENCIES,
    LINKS,
    LOG,
    MARKS,
    PLACES,
    RATES,
    REVIEW,
    EntityKind,
    SessionContents,
    ShownTopic,
    path_of,
)
from igtl_gateway.addons.view.eye import eye_of
from igtl_gateway.addons.view.pen import GATEWAY_TIME, LAST_NS, SENDER_TIME, Pen, timeless
from igtl_gateway.addons.view.robots import Robots
from igtl_gateway.addons.view.ruler import draw_ruler, ruler_of
from igtl_gateway.addons.view.table import PICTURES, Picture

if TYPE_CHECKING:
    from igtl_gateway.addons.review import Review
    from igtl_gateway.addons.sync.lag import Lag
    from igtl_gateway.addons.sync.signal import Signal

_ROS = frozenset((Kind.ROS_IN, Kind.ROS_OUT))
_NOTES = frozenset((Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE))
_RESERVED = frozenset((LOG.partition("/")[0], RATES.partition("/")[0], FRAMES, LAG, PLACES, REVIEW))
_COLOURS = {Level.INFO: INFO, Level.WARN: WARN, Level.ERROR: ERROR}
_DROP_WORDS = ("drop", "lost", "full", "missed", "left_out")

#: A gap in a stream, as in ``info``: a pause of more than this many mean intervals and of more than a second.
_GAP_FACTOR, _RHYTHM = 10, 20
_NS_PER_MS = 1e6
#: Maximum number of streams with plots of rate and latency, in case a peer invents names.
_MAX_PLOTS = 300


@dataclass(slots=True)
class _DrawnTopic:
    canvas: Canvas
    picture: Picture | None


@dataclass(slots=True)
class _StreamRate:
    """Times of the messages of a stream, UTC ns of the gateway."""

    path: str
    first_ns: int = 0
    last_ns: int = 0
    messages: int = 0
    this_second: int = 0
    stamped: int = 0
    least_ns: int = 0


@dataclass(slots=True)
class _Sibling:
    """A message that was converted from the current input."""

    base: str
    fullness: int
    shown: ShownTopic
    outdone: bool = False


@dataclass(slots=True)
class DrawnCounts:
    """Counts of what was drawn.

    Attributes:
        messages: number of messages by topic; those that are not drawn have a row, too.
        drawn: number of messages that have a drawing.
        without_picture: number of messages without a drawing by ROS type.
        refused: number of messages that could not be drawn by topic.
        timeless: number of entries that are missing on a time line, by time line: their stamp is 0 or beyond 2116.
    """

    messages: Counter[str] = field(default_factory=Counter)
    drawn: int = 0
    without_picture: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    timeless: Counter[str] = field(default_factory=Counter)


class SessionView:
    """Draws a session into a recording stream, entry by entry.

    Args:
        recording: the stream to draw into; the caller sets its sink.
        base_frame: frame of messages that name none.
        options: options for drawing.
    """

    def __init__(self, recording: rr.RecordingStream, base_frame: str = "igtl", options: Options | None = None) -> None:
        self.seen = SessionContents(base_frame)
        self.counts = DrawnCounts()
        self._options = options or Options()
        self._pen = Pen(recording, plain=self._options.plain)
        self._topics: dict[tuple[str, str], _DrawnTopic] = {}
        self._robots = Robots()
        self._siblings: list[_Sibling] = []
        self._rhythms: dict[tuple[Kind, str], _StreamRate] = {}
        self._begin_ns = self._second = 0
        self._last_number = 0
        self._pen.static(DROPS, rr.SeriesPoints(markers=["cross"], names=["drops and gaps"]))

    @ieee_754
    def take(self, entry: Entry) -> None:
        """Draw one entry; the caller passes entries in the order of the session."""
        self._pen.at(entry)
        if self._pen.stamp_ns:
            self.seen.first_ns = self.seen.first_ns or entry.stamp_ns
            self.seen.last_ns = max(self.seen.last_ns, entry.stamp_ns)
        self._timeless(entry)
        missing = entry.seq - self._last_number - 1
        if self._last_number and missing > 0:
            self._drop(missing, f"{missing:,} entries are missing")
        self._last_number = entry.seq
        if entry.kind.is_input:
            self._siblings.clear()
        if entry.kind in _NOTES:
            self._note(entry)
        else:
            self._count_rate(entry)
            if entry.kind in _ROS:
                self._message(entry)

    @ieee_754
    def flush(self) -> None:
        """Send the collected rows; a live view calls this several times a second."""
        self._pen.flush()

    @ieee_754
    def finish(self) -> None:
        """Send the collected rows and rulers.  The last, incomplete second gets no rate: it would look like a drop."""
        self._pen.flush()
        for number, tree in enumerate(self.seen.trees().values()):
            frame = target_frame(self.seen, tree)
            eye = eye_of(self.seen, tree, frame, camera=is_camera(self.seen, frame))
            if ruler := eye and ruler_of(eye, number):
                draw_ruler(ruler, frame, self._pen)

    def clocks(self) -> tuple[str, ...]:
        """Return sentences on streams whose stamps are of another clock than those of the others."""
        stamped = [(channel, rhythm) for (_, channel), rhythm in self._rhythms.items() if rhythm.stamped]
        streams = []
        for channel, rhythm in stamped:
            # as many messages as make its least age count, each with this age
            stamps = np.full(min(rhythm.stamped, 3), LAST_NS // 2, np.int64)
            streams.append(StreamTimes(channel, stamps + rhythm.least_ns, stamps))
        found = one_clock(streams)
        return tuple(
            f"on the time line {SENDER_TIME}, {stream.name} is {abs(shift_ns) / _NS_PER_MS:,.0f} ms "
            f"{'before' if shift_ns > 0 else 'after'} the others: its stamps are of another clock"
            for stream, shift_ns in zip(streams, found.shifts, strict=True)
            if shift_ns
        )

    def end(self, why: str) -> None:
        """Log that the session ends here because the rest of it cannot be read."""
        self._pen.text(LOG, f"the session ends here: {why}", "ERROR", ERROR)

    def marks(self, marks: Iterable[Mark]) -> None:
        """Draw marks that entries lack: of a side file, or of the parts of a merged session."""
        for mark in marks:
            words = f": {mark.text}" if mark.text else ""
            phase = [(mark.time_ns, " begins"), (mark.last_ns, " ends")]
            for time_ns, verb in [(mark.time_ns, "")] if mark.end_ns is None else phase:
                self._pen.moment(time_ns)
                self._pen.text(MARKS, f"mark {mark.label}{verb}{words}", Level.INFO.name, _COLOURS[Level.INFO])

    def review(self, review: Review) -> None:
        """Draw the review of a suture plan."""
        from igtl_gateway.addons.view.review_drawing import draw_review  # here: review is an add-on of its own

        self.seen.reviewed = True
        self.seen.scales = draw_review(review, self._pen)

    @ieee_754
    def add_robot(self, urdf: Path, namespace: str = "") -> None:
        """Draw the robot of a file at all times, before the first entry; joint states of ``namespace`` move it.

        Raises UnsupportedRecording, DamagedRecording, LimitExceeded.
        """
        path = self._pen.unique_path(path_of(f"robots/{namespace}/{urdf.stem}"))
        shown = self.seen.shown[str(urdf)] = ShownTopic(path, str(urdf), "URDF", EntityKind.ROBOT, self.seen.base_frame)
        canvas = Canvas(self._pen, self.seen, shown, self._options, len(self.seen.shown), self._robots)
        self._robots.describe(read_bytes(urdf), namespace, canvas, urdf)

    def lag(self, fixed: Signal, moving: Signal, lag: Lag, shift_ns: int) -> None:
        """Draw the lag of one stream behind another; stamps + ``shift_ns`` are times of the gateway."""
        from igtl_gateway.addons.view.lag_drawing import draw_lag  # here: sync is an add-on of its own

        self.seen.lag = f"{moving.name} behind {fixed.name}"
        draw_lag(fixed, moving, lag, shift_ns, self._pen)

    # Messages

    def _message(self, entry: Entry) -> None:
        try:
            topic = self._topics.get((entry.channel, entry.type)) or self._add_topic(entry)
        except ConversionError:  # too many topics
            self.counts.refused[entry.channel] += 1
            return
        canvas, picture = topic.canvas, topic.picture
        shown = canvas.shown
        rows = canvas.rows
        summary: dict[str, Any] = {"bytes": entry.size}
        if picture is None:
            self.counts.without_picture[entry.type] += 1
        else:
            try:
                message = picture.message.unpack(entry.data())
                stamp_ns = _stamp_ns(message)
                if stamp_ns and not timeless(stamp_ns):
                    self._pen.source_ns = stamp_ns
                picture.draw(message, canvas)
                self.counts.drawn += 1
            except (ConversionError, ValueError) as error:
                self.counts.refused[entry.channel] += 1
                summary["error"] = self._pen.displayable(str(error))
                self._pen.text(LOG, f"{entry.channel}: cannot be drawn: {error}", "WARN", WARN)
        if canvas.rows == rows:  # nothing at the path of the topic: add a row, so that rows and messages agree
            self._pen.fields(shown.path, **summary)
            canvas.rows += 1
        shown.first_ns = shown.first_ns or self._pen.stamp_ns
        shown.last_ns = self._pen.stamp_ns or shown.last_ns
        shown.count += 1
        self.counts.messages[entry.channel] += 1
        if entry.kind is Kind.ROS_OUT and picture and picture.fullness:
            self._compare(_Sibling(entry.channel.rpartition("/")[0], picture.fullness, shown))

    def _add_topic(self, entry: Entry) -> _DrawnTopic:
        """Set up a topic at its first message."""
        picture = PICTURES.get(entry.type)
        path = path_of(entry.channel)
        if path.partition("/")[0] in _RESERVED:
            path = f"topics/{path}"
        shown = ShownTopic(
            self._pen.unique_path(path),
            entry.channel,
            entry.type,
            picture.what if picture else EntityKind.DATA,
            self.seen.base_frame,
        )
        known = entry.channel in self.seen.shown
        self.seen.shown[f"{entry.channel} ({entry.type})" if known else entry.channel] = shown
        canvas = Canvas(self._pen, self.seen, shown, self._options, len(self._topics), self._robots)
        if picture is None:
            self._pen.text(LOG, f"not drawn: {entry.channel} ({entry.type})", "WARN", WARN)
        topic = self._topics[(entry.channel, entry.type)] = _DrawnTopic(canvas, picture)
        return topic

    def _compare(self, new: _Sibling) -> None:
        """Of the messages converted from one OpenIGTLink message, only the fullest is shown in 3-D."""
        for other in self._siblings:
            if other.base == new.base and other.fullness != new.fullness:
                less = other if other.fullness < new.fullness else new
                less.shown.outdone += not less.outdone
                less.outdone = True
        self._siblings.append(new)

    # Facts

    def _timeless(self, entry: Entry) -> None:
        """Count stamps outside the time lines, and log the first of them."""
        for line, time_ns, unset in ((GATEWAY_TIME, entry.stamp_ns, False), (SENDER_TIME, entry.source_ns, True)):
            if timeless(time_ns) and (time_ns or not unset):
                if not self.counts.timeless[line]:
                    text = f"entry {entry.seq}: found the stamp {time_ns}, expected 1 to {LAST_NS}: not on {line}"
                    self._pen.text(LOG, text, "WARN", WARN)
                self.counts.timeless[line] += 1

    def _note(self, entry: Entry) -> None:
        note = Note.of(entry.data())
        links = f" [link {', '.join(map(str, entry.links))}]" if entry.links else ""
        stream = f"{note.stream}: " if note.stream and note.stream not in note.text else ""
        text = f"{stream}{note.text}{links}"
        self._pen.text(LOG, text, note.level.name, _COLOURS[note.level])
        if mark := MarkNote.of(note):
            self._pen.moment(entry.stamp_ns - mark.ago_ns)
            self._pen.text(MARKS, text, note.level.name, _COLOURS[note.level])
            self._pen.at(entry)
        if entry.kind is Kind.LINK:
            self._pen.text(LINKS, text, note.level.name, _COLOURS[note.level])
        if any(word in note.code for word in _DROP_WORDS):
            dropped = note.data.get("count") or note.data.get("dropped") or 1
            self._drop(sum(dropped.values()) if isinstance(dropped, dict) else dropped, text, in_log=False)

    def _drop(self, number: int, text: str, *, in_log: bool = True) -> None:
        self._pen.log(
            DROPS, rr.TextLog(self._pen.displayable(text), level="WARN", color=WARN), rr.Scalars([float(number)])
        )
        if in_log:
            self._pen.text(LOG, text, "WARN", WARN)

    # Rates and latencies

    def _count_rate(self, entry: Entry) -> None:
        now_ns, source_ns = self._pen.stamp_ns, self._pen.source_ns
        if not now_ns:
            return
        key = (entry.kind, entry.channel)
        rhythm = self._rhythms.get(key)
        if rhythm is None:
            if len(self._rhythms) >= _MAX_PLOTS:
                return
            rhythm = self._rhythms[key] = _StreamRate(path_of(entry.channel), now_ns, now_ns)
        self._begin_ns = self._begin_ns or now_ns
        second = (now_ns - self._begin_ns) // NS_PER_S
        if second > self._second:
            self._rates(second)
        if entry.kind.is_input:
            if source_ns:
                age_ns = now_ns - source_ns
                rhythm.least_ns = min(rhythm.least_ns, age_ns) if rhythm.stamped else age_ns
                rhythm.stamped += 1
                self._pen.numbers(f"{LATENCIES}/{rhythm.path}", [(now_ns - source_ns) / _NS_PER_MS])
            pause = now_ns - rhythm.last_ns
            if rhythm.messages >= _RHYTHM and pause > NS_PER_S:
                mean = (rhythm.last_ns - rhythm.first_ns) / (rhythm.messages - 1)
                if pause > _GAP_FACTOR * mean:
                    self._drop(1, f"{entry.channel}: silent for {pause / NS_PER_S:.1f} s")
        rhythm.last_ns = now_ns
        rhythm.messages += 1
        rhythm.this_second += 1

    def _rates(self, second: int) -> None:
        """Log the number of messages of the past second at its end, and zeros at both ends of a longer pause.

        Seconds start at the first message, so that the first second is complete.
        """
        now = (self._pen.number, self._pen.stamp_ns, self._pen.source_ns)
        pause = [self._second + 1, second - 1] if second - self._second > 1 else []
        for at, counted in ((self._second, True), *((each, False) for each in dict.fromkeys(pause))):
            end_ns = self._begin_ns + (at + 1) * NS_PER_S - 1
            self._pen.number, self._pen.stamp_ns, self._pen.source_ns = now[0] - 1, end_ns, 0
            for (kind, _), rhythm in self._rhythms.items():
                value = float(rhythm.this_second) if counted else 0.0
                self._pen.numbers(f"{RATES}/{kind.value}/{rhythm.path}", [value])
        for rhythm in self._rhythms.values():
            rhythm.this_second = 0
        self._pen.number, self._pen.stamp_ns, self._pen.source_ns = now
        self._second = second


def _stamp_ns(message: Any) -> int:
    """The stamp in the header of a message, or of its first transform, UTC ns; 0 = unset."""
    first = next(iter(getattr(message, "transforms", ())), message)
    return int(getattr(getattr(first, "header", None), "stamp_ns", 0))

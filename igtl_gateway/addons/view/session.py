"""The view of a session: entries in, rows of a rerun recording out; ``SessionContents`` has the contents.

Each ROS message is one row at the entity of its topic, drawn by its row of ``table``.  An OpenIGTLink message is drawn
as the ROS messages that it was converted to.  Only trails of a few seconds and collected columns are kept in memory,
whatever the size of the session.  ``take`` draws an entry; ``take_columns`` draws many, whose messages of one form are
drawn at once, with the same result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.live import NoteEvent
from igtl_gateway.addon.messages import ieee_754
from igtl_gateway.addon.reading import Entry, EntryColumns, Kind, Level, Mark, MarkNote, Note
from igtl_gateway.addon.untrusted import read_bytes
from igtl_gateway.addons.view.blocks import NOTES, Block, Stream, Unfit
from igtl_gateway.addons.view.blueprints import is_camera, target_frame
from igtl_gateway.addons.view.canvas import Canvas, Options
from igtl_gateway.addons.view.colours import ERROR, WARN, line_colour
from igtl_gateway.addons.view.contents import (
    CHOSEN,
    DROPS,
    FRAMES,
    LAG,
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
from igtl_gateway.addons.view.pen import GATEWAY_TIME, LAST_NS, LEVELS, SENDER_TIME, Pen, line_of, timeless
from igtl_gateway.addons.view.rates import Rates
from igtl_gateway.addons.view.robots import Robots
from igtl_gateway.addons.view.rows import Form, Unlike, drawing_of, stamp_of
from igtl_gateway.addons.view.ruler import draw_ruler, ruler_of
from igtl_gateway.addons.view.table import Bulk, Picture, picture_of
from igtl_gateway.addons.view.words import ROBOT_DESCRIPTION

if TYPE_CHECKING:
    from igtl_gateway.addons.review import Review
    from igtl_gateway.addons.sync.lag import Lag
    from igtl_gateway.addons.sync.signal import Signal
    from igtl_gateway.addons.view.chosen import Series

Array = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

_ROS = frozenset((Kind.ROS_IN, Kind.ROS_OUT))
_RESERVED = frozenset((CHOSEN, LOG.partition("/")[0], RATES.partition("/")[0], FRAMES, LAG, PLACES, REVIEW))
_DROP_WORDS = ("drop", "lost", "full", "missed", "left_out")

#: Bytes of entries after which what was drawn is waited for.
_UNWRITTEN = 16 << 20
#: Forms of a topic that are kept.
_MOST_FORMS = 16
#: Messages that are drawn one by one, although they have one form: fewer cost as much at once.
_FEW = 4
#: Share of the entries of a block, and number, above which all are drawn one by one.
_ALONE, _MOST_ALONE = 16, 32


@dataclass(slots=True)
class _DrawnTopic:
    canvas: Canvas
    picture: Picture | None
    forms: list[Form] = field(default_factory=list)

    @property
    def bulk(self) -> Bulk:
        """How its messages are drawn."""
        return self.picture.bulk if self.picture else Bulk.NONE


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
        self._rates = Rates(self._pen)
        self._last_number = 0
        self._inputs = 0
        self._learns = False  # the forms of what is drawn
        self._unwritten = 0
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
            self._drop(missing, f"{missing:,} {'entry is' if missing == 1 else 'entries are'} missing")
        self._last_number = entry.seq
        if entry.kind.is_input:
            self._caused_by(self._inputs + 1)
        if entry.kind in NOTES:
            self._note(entry)
        else:
            if silence := self._rates.count(entry):
                self._drop(1, silence)
            if entry.kind in _ROS:
                self._message(entry)

    @ieee_754
    def take_columns(self, columns: EntryColumns) -> None:
        """Draw many entries, with the result of ``take``.  Raises DamagedRecording, as their entries."""
        self._learns = True
        begin = 0
        with suppress(Unfit):
            begin = self._take_block(Block.of(columns, self.seen.last_ns))
        for entry in columns.where(slice(begin, None)).entries():
            self.take(entry)
        self._unwritten += len(columns.data)
        if self._unwritten > _UNWRITTEN:  # rerun writes in a thread of its own, and waits for nothing
            self._unwritten = 0
            self._pen.recording.flush()

    @ieee_754
    def flush(self) -> None:
        """Send the collected rows; a live view calls this several times a second."""
        self._pen.flush()

    @ieee_754
    def finish(self) -> None:
        """Send the collected rows and rulers.  The last, incomplete second gets no rate: it would look like a drop."""
        self._pen.report_rest()
        self._pen.flush()
        for number, tree in enumerate(self.seen.trees().values()):
            frame = target_frame(self.seen, tree)
            eye = eye_of(self.seen, tree, frame, camera=is_camera(self.seen, frame))
            if ruler := eye and ruler_of(eye, number):
                draw_ruler(ruler, frame, self._pen)

    def clocks(self) -> tuple[str, ...]:
        """Return sentences on streams whose stamps are of another clock than those of the others."""
        return self._rates.clocks()

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
                self._pen.text(MARKS, f"mark {mark.label}{verb}{words}", Level.INFO.name, LEVELS[Level.INFO])

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

    def plot(self, series: Series) -> None:
        """Draw a field that was asked for by name, in a plot of its own."""
        number = len(self.seen.chosen)
        self.seen.chosen.append(series.title)
        for place, (name, values) in enumerate(series.curves.items()):
            path = f"{CHOSEN}/{number}/{place}"
            self._pen.curve(path, name, line_colour(place))
            self._pen.series(path, series.times, values)

    def lag(self, fixed: Signal, moving: Signal, lag: Lag, shift_ns: int) -> None:
        """Draw the lag of one stream behind another; stamps + ``shift_ns`` are times of the gateway."""
        from igtl_gateway.addons.view.lag_drawing import draw_lag  # here: sync is an add-on of its own

        self.seen.lag = f"{moving.name} behind {fixed.name}"
        draw_lag(fixed, moving, lag, shift_ns, self._pen)

    # Messages

    def _message(self, entry: Entry) -> None:
        self._draw_message(entry)
        self._compare(entry.kind, entry.channel, entry.type)

    def _draw_message(self, entry: Entry) -> None:
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
                stamp_ns = stamp_of(message)
                if stamp_ns and not timeless(stamp_ns):
                    self._pen.source_ns = stamp_ns
                picture.draw(message, canvas)
                self.counts.drawn += 1
                if self._learns and len(topic.forms) < _MOST_FORMS and picture.bulk is not Bulk.NONE:
                    if form := Form.of(entry.data(), picture, canvas):
                        topic.forms.append(form)
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

    def _add_topic(self, entry: Entry) -> _DrawnTopic:
        """Set up a topic at its first message."""
        picture = picture_of(entry.type)
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

    def _compare(self, kind: Kind, channel: str, ros_type: str) -> None:
        """Of the messages converted from one OpenIGTLink message, only the fullest is shown in 3-D."""
        topic = self._topics.get((channel, ros_type))
        if kind is not Kind.ROS_OUT or topic is None or topic.picture is None or not topic.picture.fullness:
            return
        new = _Sibling(channel.rpartition("/")[0], topic.picture.fullness, topic.canvas.shown)
        for other in self._siblings:
            if other.base == new.base and other.fullness != new.fullness:
                less = other if other.fullness < new.fullness else new
                less.shown.outdone += not less.outdone
                less.outdone = True
        self._siblings.append(new)

    def _caused_by(self, number: int) -> None:
        """Set the number of inputs so far: what follows is caused by the last one."""
        if number != self._inputs:
            self._inputs = number
            self._siblings.clear()

    # Many messages

    def _take_block(self, block: Block) -> int:
        """Draw entries up to one from which on they are drawn one by one; return it."""
        by_itself = block.gaps(self._last_number)
        for stream in block.streams:
            if stream.kind not in NOTES:
                stamps = block.times.stamps[stream.rows]
                by_itself[stream.rows] |= self._rates.alone((stream.kind, stream.channel), stamps)
        alone = by_itself.copy()
        for stream in block.streams:
            self._look(stream, by_itself, alone, 0)
        count, begin, before = len(block), 0, self._inputs
        for _ in range(_MOST_ALONE + count // _ALONE):
            found = np.flatnonzero(alone[begin:])
            end = begin + int(found[0]) if len(found) else count
            if begin < end:
                self._segment(block, begin, end, before)
            if end == count:
                return count
            changes = self._pen.changes
            self.take(block.columns.entry(end))
            begin = end + 1
            changed = block.streams if self._pen.changes != changes else [block.stream_of(end)]
            for stream in changed:
                self._look(stream, by_itself, alone, begin)
        return begin

    def _look(self, stream: Stream, by_itself: Mask, alone: Mask, begin: int) -> None:
        """Find which messages of a stream, from the entry ``begin`` on, have no known form: they are drawn alone."""
        topic = self._topics.get((stream.channel, stream.type))
        if stream.kind not in _ROS:
            return
        later = stream.rows[stream.rows >= begin]
        if topic is None or stream.channel.endswith(f"/{ROBOT_DESCRIPTION}"):
            alone[later] = True
        elif topic.bulk is Bulk.NONE:
            alone[later] = by_itself[later]
        else:
            topic.forms = [form for form in topic.forms if form.changes == self._pen.changes]
            unknown = stream.find(topic.forms) < 0
            alone[later] = by_itself[later] | unknown[len(unknown) - len(later) :]

    def _segment(self, block: Block, begin: int, end: int, inputs: int) -> None:
        """Draw entries, none of which changes how others are drawn; ``inputs``: number of those before the block."""
        times = block.times.where(slice(begin, end))
        self.seen.first_ns = self.seen.first_ns or int(times.stamps[0])
        self.seen.last_ns, self._last_number = int(times.stamps[-1]), int(times.numbers[-1])
        self._pen.begin_ns = self._pen.begin_ns or int(times.stamps[0])
        parts = [(stream, stream.between(begin, end)) for stream in block.streams]
        messages = [(stream, part) for stream, part in parts if stream.kind not in NOTES and part.start < part.stop]
        self._rates.count_rows(
            times, [((stream.kind, stream.channel), stream.rows[part] - begin) for stream, part in messages]
        )
        in_order = [stream.rows[part] for stream, part in parts if stream.kind in NOTES]
        drawn: list[tuple[int, Stream]] = []
        for stream, part in messages:
            topic = self._topics[stream.channel, stream.type] if stream.kind in _ROS else None
            if topic is not None and topic.bulk is Bulk.NONE:
                in_order.append(stream.rows[part])
            elif topic is not None and topic.picture is not None:
                self._stream(block, stream, topic, part)
                if topic.picture.fullness:
                    drawn += ((row, stream) for row in stream.rows[part].tolist())
        rows = np.sort(np.concatenate(in_order)) if in_order else np.empty(0, np.int64)
        entries: Iterator[tuple[int, Entry | Stream]] = zip(
            rows.tolist(), block.columns.where(rows).entries(), strict=True
        )
        for row, what in sorted([*entries, *drawn], key=lambda each: each[0]) if drawn else entries:
            self._caused_by(inputs + int(block.inputs[row]))
            if isinstance(what, Entry):
                self._pen.at(what)
                if what.kind in NOTES:
                    self._note(what)
                    continue
                self._draw_message(what)
            self._compare(what.kind, what.channel, what.type)
        self._caused_by(inputs + int(block.inputs[end - 1]))

    def _stream(self, block: Block, stream: Stream, topic: _DrawnTopic, part: slice) -> None:
        """Draw messages of a stream whose forms are known."""
        form = stream.form[part]
        places = np.arange(part.start, part.stop)
        if topic.bulk is Bulk.RUNS:
            batches = np.split(places, np.flatnonzero(np.diff(form)) + 1)
        else:  # the one whose last message is last comes last: its frame and names are the latest
            batches = sorted((places[form == number] for number in np.unique(form)), key=lambda batch: int(batch[-1]))
        for batch in batches:
            self._batch(block, stream, topic, batch)

    def _batch(self, block: Block, stream: Stream, topic: _DrawnTopic, places: Array) -> None:
        """Draw messages of one form, at once if that can be."""
        canvas, picture, count = topic.canvas, topic.picture, len(places)
        assert picture
        form = topic.forms[int(stream.form[places[0]])]
        rows, drawn = stream.rows[places], canvas.rows
        try:
            if count < _FEW:
                raise Unlike
            messages = stream.messages(places, len(form.sample))
            draw = drawing_of(messages, picture, canvas, block.times.where(rows))
        except (Unlike, ConversionError, ValueError) as error:
            good = getattr(error, "good", None)
            if good is not None:
                for run in np.split(places, np.flatnonzero(np.diff(good)) + 1):
                    self._batch(block, stream, topic, run)
                return
            for entry in block.columns.where(rows).entries():
                self._pen.at(entry)
                self._draw_message(entry)
            return
        draw()
        if canvas.rows == drawn:  # as of one message
            self._pen.sizes(canvas.shown.path, len(form.sample))
            canvas.rows += count
        shown, stamps = canvas.shown, block.times.stamps[rows]
        shown.first_ns, shown.last_ns = shown.first_ns or int(stamps[0]), int(stamps[-1])
        shown.count += count
        self.counts.drawn += count
        self.counts.messages[stream.channel] += count

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
        text = line_of(note, entry.links)
        self._pen.report(NoteEvent(entry.stamp_ns, entry.kind, note, entry.links))
        if mark := MarkNote.of(note):
            self._pen.moment(entry.stamp_ns - mark.ago_ns)
            self._pen.text(MARKS, text, note.level.name, LEVELS[note.level])
            self._pen.at(entry)
        if entry.kind is Kind.LINK:
            self._pen.text(LINKS, text, note.level.name, LEVELS[note.level])
        if any(word in note.code for word in _DROP_WORDS):
            dropped = note.data.get("count") or note.data.get("dropped") or 1
            self._drop(sum(dropped.values()) if isinstance(dropped, dict) else dropped, text, in_log=False)

    def _drop(self, number: int, text: str, *, in_log: bool = True) -> None:
        self._pen.log(
            DROPS, rr.TextLog(self._pen.displayable(text), level="WARN", color=WARN), rr.Scalars([float(number)])
        )
        if in_log:
            self._pen.text(LOG, text, "WARN", WARN)

"""The log of the node: the notes that the terminal shows, on ``/rosout``."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from igtl_gateway.app.note_rate import Event, NoteRate, is_routine
from igtl_gateway.base.once import Once
from igtl_gateway.gateway import FAULT
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire.fields import visible

#: Called with level, text and time (UTC ns).
Log = Callable[[Level, str, int], None]

#: Kinds of entries with a note.
NOTED = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})

_MAX_WAITING = 1000  # notes from one second to the next
_MAX_CAUSES = 1000  # that are distinguished: a peer that invents device names must not flood the log


class RosLog:
    """Collects notes under the hub's lock, and passes them on later.

    The log has the first warning and the first error of each cause, and states as often as `NoteRate` lets them pass;
    the recording has all.

    Args:
        log: takes one line.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self._once = Once(_MAX_CAUSES)
        self._rate = NoteRate()
        self._waiting: deque[Event] = deque(maxlen=_MAX_WAITING)

    def add(self, entry: Entry) -> None:
        """Take the note of an entry of the kinds ``NOTED``."""
        note = Note.unpack(entry.data())
        if is_routine(note):  # before it counts as the first of a cause
            return
        if (note.level is Level.INFO and note.code != FAULT) or self._once.first(note.code, note.subject):
            event = self._rate.take(Event(entry.stamp_ns, entry.kind, note, entry.links))
            if event:
                self._waiting.append(event)

    def flush(self, now_ns: int | None = None) -> None:
        """Pass on what has been collected until now (UTC), or all of it; not under a lock that delays messages."""
        waiting = [self._waiting.popleft() for _ in range(len(self._waiting))]
        for event in waiting + self._rate.due(now_ns):
            self._log(event.note.level, note_text(event.note, event.links), event.stamp_ns)


def note_text(note: Note, links: tuple[int, ...]) -> str:
    """Return a note as the terminal and the log of the node have it; a warning has its stream, if not in the text."""
    is_named = note.level is Level.INFO or (note.stream.rpartition("/")[2] or note.stream) in note.text
    places = [*([] if is_named else [visible(note.stream)]), *([f"link {', '.join(map(str, links))}"] if links else [])]
    return f"{note.text} [{', '.join(places)}]" if places else note.text

"""What the entries of a running bridge add up to, and the notes among them."""

from __future__ import annotations

from collections import Counter, deque

from igtl_gateway.app.note_rate import Event, NoteRate
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

_MAX_EVENTS = 1000  # notes waiting to be taken; a flood of them must not cost memory
_NOTES = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})


class EntryWatch:
    """Counts entries and stores the notes among them until they are taken; called under the hub's lock.

    Args:
        rate: which notes are to be taken; None: all.
    """

    def __init__(self, rate: NoteRate | None = None) -> None:
        self._rate = rate
        self.counts: Counter[Kind] = Counter()
        self.refused = 0
        self._events: deque[Event] = deque(maxlen=_MAX_EVENTS)

    def __call__(self, entry: Entry) -> None:
        self.counts[entry.kind] += 1
        if entry.kind in _NOTES:
            note = Note.unpack(entry.data())
            self.refused += note.level >= Level.ERROR
            event = Event(entry.stamp_ns, entry.kind, note, entry.links)
            if shown := self._rate.take(event) if self._rate else event:
                self._events.append(shown)

    def add(self, kind: Kind, number: int) -> None:
        """Count entries that passed natively."""
        self.counts[kind] += number

    def take(self, now_ns: int | None = None) -> list[Event]:
        """Return the notes since the last call, with what was held back until now (UTC); None: with all of it."""
        taken = []
        while self._events:
            taken.append(self._events.popleft())
        return taken + self._rate.due(now_ns) if self._rate else taken

"""What the entries of a running bridge add up to, and the notes among them."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

_MAX_EVENTS = 1000  # notes waiting to be taken; a flood of them must not cost memory
_NOTES = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})


@dataclass(frozen=True, slots=True)
class Event:
    """A note in the log."""

    stamp_ns: int
    kind: Kind
    note: Note
    links: tuple[int, ...]


class EntryWatch:
    """Counts entries and stores the notes among them until they are taken; called under the hub's lock."""

    def __init__(self) -> None:
        self.counts: Counter[Kind] = Counter()
        self.refused = 0
        self._events: deque[Event] = deque(maxlen=_MAX_EVENTS)

    def __call__(self, entry: Entry) -> None:
        self.counts[entry.kind] += 1
        if entry.kind in _NOTES:
            note = Note.unpack(entry.data())
            self.refused += note.level >= Level.ERROR
            self._events.append(Event(entry.stamp_ns, entry.kind, note, entry.links))

    def add(self, kind: Kind, number: int) -> None:
        """Count entries that passed natively."""
        self.counts[kind] += number

    def take(self) -> list[Event]:
        """Return the notes since the last call."""
        taken = []
        while self._events:
            taken.append(self._events.popleft())
        return taken

"""Notes of a recorder in tests."""

from __future__ import annotations

from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.recorder import LATE, MOVES, ON_TIME, STALLED

#: That the file is behind or gets no processor, and that it does again: whether they come depends on the load.
LATENESS = frozenset({LATE, ON_TIME, STALLED, MOVES})


class TimelessNotes(list[Note]):
    """All notes but those of `LATENESS`."""

    def append(self, note: Note) -> None:
        if note.code not in LATENESS:
            super().append(note)

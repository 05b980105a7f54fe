"""Notes of a recorder in tests."""

from __future__ import annotations

from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.recorder import LATE, ON_TIME

#: That the file is behind, and that it is not any more: whether they come depends on the load of the machine.
LATENESS = frozenset({LATE, ON_TIME})


class TimelessNotes(list[Note]):
    """All notes but those of `LATENESS`."""

    def append(self, note: Note) -> None:
        if note.code not in LATENESS:
            super().append(note)

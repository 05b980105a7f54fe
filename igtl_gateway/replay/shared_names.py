"""What a recording states about streams that several peers sent under one name: their messages are not one movement."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.naming import NAME_SHARED
from igtl_gateway.record.sessionfile.only import only_of_kinds
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.state_before import notes_before


def shared_names(file: SessionFile) -> Iterator[Note]:
    """Yield the notes about streams that several peers sent at one time, also before a part of a recording.

    A merged session states them itself.
    """
    for entry in chain(notes_before(file), only_of_kinds(file, {Kind.NOTE})):
        if NAME_SHARED.encode() in bytes(entry.data()):
            note = Note.of(entry.data())
            if note.code == NAME_SHARED:
                yield note

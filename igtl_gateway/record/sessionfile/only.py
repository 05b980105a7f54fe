"""The entries of some kinds, such as the notes of a long recording, without an object for any other entry."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile


def only_of_kinds(file: SessionFile, kinds: Collection[Kind]) -> Iterator[Entry]:
    """Yield the entries of these kinds, in their order; nothing stands for the others.

    Chunks without such entries are not unpacked, and the others are searched in columns: of notes this takes a
    fraction of the time of :meth:`SessionFile.entries_of_kinds`.  Raises as that.
    """
    try:
        blocks = file.columns(wanted=lambda stream: stream.kind in kinds)
    except Unfit:
        yield from (entry for entry in file.entries_of_kinds(kinds) if entry.seq and entry.kind in kinds)
        return
    for columns in blocks:
        yield from columns.entries()

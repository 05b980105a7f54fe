"""Changes of settings while a session runs: each is an input of the session, a note of code ``SETTING``.

Its ``data["settings"]`` has all settings that can change, as they are from this entry on.  So the last such note before
a moment stands for all earlier ones.
"""

from __future__ import annotations

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note

SETTING = "setting"
#: Key of the settings in the data of the note.
SETTINGS = "settings"
_MARK = SETTING.encode()


def is_change(entry: Entry) -> bool:
    """Return whether an entry changes settings."""
    if entry.kind is not Kind.EDGE_NOTE or _MARK not in (data := entry.data()):
        return False
    return Note.of(data).code == SETTING

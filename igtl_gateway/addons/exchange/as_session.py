"""A file of another program as a session, for verbs that read sessions."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from igtl_gateway.addon.writing import SessionWriter
from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.import_verb_run import import_facts
from igtl_gateway.addons.exchange.source import numbered


def write_session(path: Path, place: Path) -> None:
    """Write the recording of another program at ``path`` as a session at ``place``.

    Raises UnsupportedRecording or DamagedRecording.
    """
    with closing(open_source(path)) as source:
        facts = import_facts(path, source)
        writer = SessionWriter(place, facts, qos_of=source.qos_of, definition_of=source.definition_of)
        for entry in numbered(source.items()):
            writer.write(entry)
        writer.close({})

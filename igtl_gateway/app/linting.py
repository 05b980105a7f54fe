"""The rules of ``doctor`` on a recording: its entries and its losses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.doctor.observer import Observer
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.large_outputs import DigestedOutput
from igtl_gateway.record.sessionfile.layout import EXCLUDE_KEY, INCLUDE_KEY
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.replay.recorded_config import config_to_run


def observe(
    file: SessionFile | Salvage, config: Path | None = None, also: Callable[[Entry], None] | None = None
) -> Observer:
    """Return what the rules look at, of all entries of an open recording.

    Args:
        file: the recording.
        config: configuration file to use instead of the recorded configuration.
        also: called with each entry, so that a file is read only once.

    Raises DamagedRecording, ConfigError.
    """
    seen = Observer(config_to_run(file.session, config))
    seen.sources.is_recording = True
    seen.sources.selected = _globs(file.session, INCLUDE_KEY), _globs(file.session, EXCLUDE_KEY)
    for entry in file.entries():
        if isinstance(entry, DigestedOutput):  # of a damaged file: nothing can be found in it
            continue
        seen.add(entry)
        if also:
            also(entry)
    seen.losses = dict(_losses(file.ledger or {}))
    if isinstance(file, SessionFile):
        seen.damaged_indexes = file.damaged_indexes()
    return seen


def _globs(session: Mapping[str, str], key: str) -> tuple[str, ...]:
    """Return the globs of a fact about the selection of streams; none if it has another form."""
    with suppress(DamagedRecording):
        found = parse_json(session.get(key, "[]"), key)
        if isinstance(found, list):
            return tuple(each for each in found if isinstance(each, str))
    return ()


def _losses(ledger: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield (description, number) of messages that were lost at the edges; other losses are visible in the messages."""
    for link, fates in ledger.get("links", {}).items():
        for fate in ("dropped", "ignored"):
            if number := sum(fates.get(fate, {}).values()):
                yield f"messages {fate}, to {'closed links' if link == '0' else f'link {link}'}", number
    for topic, counts in ledger.get("ros_topics", {}).items():
        if number := counts.get("lost", 0):
            yield f"messages on {topic}, lost before the bridge received them", number
    for side, streams in ledger.get("video", {}).items():
        for stream, counts in streams.items():
            if number := sum(counts.get("dropped", {}).values()):
                yield f"pictures of {stream} that the {side} of video dropped", number
    if number := ledger.get("recorder", {}).get("dropped_entries", 0):
        yield "entries that the recorder dropped: its queue was full, or the disk failed", number

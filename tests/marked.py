"""Recordings with marks: the inputs of a fixture and notes, through a session of their own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import BEGIN, END, MarkNote
from igtl_gateway.record.sessionfile import facts
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES

#: Seconds from the start, and the mark.
MARKS = (
    (1.0, MarkNote("suture-1", "first", "nurse", BEGIN)),
    (1.5, MarkNote("slip", "the needle slipped", "nurse")),
    (2.0, MarkNote("suture-1", "", "nurse", END)),
    (3.0, MarkNote("suture-2", "second", "", BEGIN)),
    (4.0, MarkNote("suture-2", phase=END)),
    (5.0, MarkNote("rest", phase=BEGIN)),
)


def entries(
    marks: Iterable[tuple[float, MarkNote]] = MARKS, fixture: str = "star", every: int = 1
) -> tuple[list[Entry], Config]:
    """Return the entries of a fixture with marks, and its configuration; ``every``: of the small messages."""
    with SessionFile.open(FIXTURES / f"{fixture}.mcap") as file:
        config = Config.from_dict(facts.configuration(file.session))
        session = Session(make_core(config, fast_path=False))
        waiting = [(file.start_ns + round(at * 1e9), mark) for at, mark in marks]
        found: list[Entry] = []
        for entry in file.entries():
            while waiting and waiting[0][0] <= entry.stamp_ns:
                now_ns, mark = waiting.pop(0)
                found += session.input(now_ns, Kind.EDGE_NOTE, (mark.note().pack(),))
            if entry.kind is Kind.LINK or (entry.kind.is_input and _is_chosen(entry, every)):
                channel, kind = entry.channel, entry.kind
                found += session.input(
                    entry.stamp_ns, kind, entry.payload, channel=channel, type_name=entry.type, links=entry.links,
                    source_ns=entry.source_ns,
                )  # fmt: skip
    return found, config


def _is_chosen(entry: Entry, every: int) -> bool:
    return every == 1 or (entry.size < 1000 and not entry.seq // 2 % every)


def write(path: Path, made: Sequence[Entry] | None = None, fixture: str = "star") -> Path:
    """Write a recording of these entries, or of ``entries()``."""
    with SessionFile.open(FIXTURES / f"{fixture}.mcap") as file:
        session = file.session
    writer = SessionWriter(path, session)
    for entry in entries(fixture=fixture)[0] if made is None else made:
        writer.write(entry)
    writer.close({"streams": {}})
    return path

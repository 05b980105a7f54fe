"""``igtl-gateway import --each``: a session for each part of a source, in a directory.

A part that is damaged has no file and is named; the others have theirs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, DamagedRecording, GatewayError, WireError
from igtl_gateway.addon.reading import layout
from igtl_gateway.addon.terminal import count_text, print_json, print_line, size_text
from igtl_gateway.addon.writing import SessionWriter, written_folder
from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.import_verb_run import import_facts, print_rows, row_facts
from igtl_gateway.addons.exchange.source import DividedSource, ImportedStream, Source, numbered


def run_each(options: argparse.Namespace) -> int:
    """Write the sessions and print what they have; return the exit code, 1 if a message is missing."""
    with closing(open_source(options.source, options.epoch, options.episodes)) as source:
        if not isinstance(source, DividedSource):
            raise ConfigError("--each: found it with another source, expected a LeRobot data set")
        sessions: list[dict[str, Any]] = []
        rows: dict[tuple[str, str], ImportedStream] = {}
        with written_folder(options.output, overwrite=options.overwrite) as root:
            for name, part in source.each():
                sessions.append(_write(part, root / f"{name}.mcap", options))
                _add(rows, part.rows)
            if not any(each["bytes"] for each in sessions):
                raise GatewayError(f"{options.source}: found no part that can be imported: {sessions[0]['failure']}")
        good = all(row.good for row in rows.values()) and not any(each["failure"] for each in sessions)
        if options.json:
            facts = {
                "source": str(options.source),
                "format": source.facts["imported_format"],
                "folder": str(options.output),
                "good": good,
                "sessions": sessions,
                "rows": [row_facts(row) for row in rows.values()],
                "notes": source.notes,
            }
            print_json(facts)
        else:
            _print(source, list(rows.values()), sessions, options.output)
    return 0 if good else 1


def _write(part: Source, place: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Write the session of a part; without ``--partial`` a damaged one leaves no file."""
    facts, failure = import_facts(options.source, part), ""
    writer = SessionWriter(place, facts, qos_of=part.qos_of, definition_of=part.definition_of)
    try:
        for entry in numbered(part.items()):
            writer.write(entry)
    except (DamagedRecording, WireError, layout.LayoutError) as error:
        failure = str(error)
    writer.close({"import": {"rows": [row_facts(row) for row in part.rows], "failure": failure}})
    size = place.stat().st_size
    if failure and not options.partial:
        place.unlink()
        size = 0
    return {"file": place.name, "entries": writer.entries if size else 0, "bytes": size, "failure": failure}


def _add(rows: dict[tuple[str, str], ImportedStream], more: Sequence[ImportedStream]) -> None:
    """Add the numbers of a part to the sums of all."""
    for row in more:
        total = rows.setdefault((row.stream, row.type), ImportedStream(row.stream, 0, row.type, why=row.why))
        total.declared, total.taken = total.declared + row.declared, total.taken + row.taken
        total.left_out += row.left_out


def _print(source: Source, rows: Sequence[ImportedStream], sessions: Sequence[dict[str, Any]], folder: Path) -> None:
    print_line(source.title)
    print_rows(rows)
    for note in source.notes:
        print_line(f"note: {note}")
    for each in sessions:
        if each["failure"]:
            print_line(f"! {each['file']}: {'in part' if each['bytes'] else 'not written'}: {each['failure']}")
    kept = [each for each in sessions if each["bytes"]]
    entries = count_text(sum(each["entries"] for each in kept), "entry", "entries")
    size = size_text(sum(each["bytes"] for each in kept))
    print_line(f"{folder}: {count_text(len(kept), 'session')}, {entries}, {size}")

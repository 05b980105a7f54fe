"""``igtl-gateway import``: another program's recording as a session."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, DamagedRecording, GatewayError, WireError, __version__
from igtl_gateway.addon.reading import Kind, layout
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.terminal import (
    aligned,
    count_text,
    natural,
    print_json,
    print_line,
    size_text,
)
from igtl_gateway.addon.untrusted import is_same
from igtl_gateway.addon.writing import SessionWriter, written
from igtl_gateway.addons.exchange.account import first_few
from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.source import ImportedStream, Source, numbered

#: Kinds of entries that have no message.
_FACTS = (Kind.LINK, Kind.EDGE_NOTE)
#: Streams that an error lists.
_NAMED = 3


def run(options: argparse.Namespace) -> int:
    if is_same(options.output, options.source):
        raise ConfigError(f"--output: found {options.output}, which is the source, expected another file")
    failure, messages = "", 0
    with (
        closing(open_source(options.source, options.epoch, options.episodes)) as source,
        written(options.output, overwrite=options.overwrite) as place,
    ):
        writer = SessionWriter(
            place, import_facts(options.source, source), qos_of=source.qos_of, definition_of=source.definition_of
        )
        try:
            for each in source.beside():
                writer.add_beside(each)
            for entry in numbered(source.items()):
                writer.write(entry)
                messages += entry.kind not in _FACTS
        except (DamagedRecording, WireError, layout.LayoutError) as error:
            failure = str(error)
        writer.close({"import": {"rows": [row_facts(row) for row in source.rows], "failure": failure}})
        if not messages and not failure:
            raise _nothing(options.source, source.rows)
        size = place.stat().st_size
        is_kept = not failure or bool(options.partial and messages)
        if not is_kept:
            place.unlink()
    good = not failure and all(row.good for row in source.rows)
    notes = source.notes + [
        f"{name}: found no definition; other tools cannot decode its messages" for name in writer.undefined
    ]
    facts: dict[str, Any] = {
        "source": str(options.source),
        "format": source.facts["imported_format"],
        "file": str(options.output),
        "good": good,
        "entries": writer.entries,
        "bytes": size if is_kept else 0,
        "rows": [row_facts(row) for row in source.rows],
        "notes": notes,
        "failure": failure,
    }
    if options.json:
        print_json(facts)
    else:
        _print(source, facts, messages)
    return 0 if good else 1


def _nothing(path: Path, rows: Sequence[ImportedStream]) -> GatewayError:
    """The error about a file without a message that a session can have: what it has instead, and why that is left."""
    reasons = [f"{row.stream}: {row.why or 'empty'}" for row in rows]
    why = f" ({first_few(reasons, _NAMED, '; ')})" if reasons else ""
    return GatewayError(f"{path}: found no message to import{why}")


def import_facts(path: Path, source: Source) -> dict[str, str]:
    """Return the metadata of the session: without machine and time, so that equal sources give equal files."""
    return {
        "config": json.dumps(Config().to_dict(), sort_keys=True),
        "igtl_gateway_version": __version__,
        "imported_from": path.name,
        **source.facts,
    }


def row_facts(row: ImportedStream) -> dict[str, Any]:
    """Return a row of the account as JSON."""
    return {
        "stream": row.stream,
        "type": row.type,
        "unit": row.unit,
        "declared": row.declared,
        "imported": row.taken,
        "left_out": row.left_out,
        "why": row.why,
        "good": row.good,
    }


def print_rows(rows: Sequence[ImportedStream]) -> None:
    """Print the account as a table; rows that lack messages are marked."""
    table: list[Sequence[str]] = [("  stream", "found", "imported", "left out", "type")]
    for row in sorted(rows, key=lambda each: natural(each.stream)):
        numbers = (f"{number:,}" for number in (row.declared, row.taken, row.left_out))
        about = "; ".join(filter(None, (row.type or row.unit, row.why)))
        table.append((f"{' ' if row.good else '!'} {row.stream}", *numbers, about))
    print_line(*aligned(table, left=1, indent="", text=True))


def _print(source: Source, facts: dict[str, Any], messages: int) -> None:
    print_line(source.title)
    print_rows(source.rows)
    for note in facts["notes"]:
        print_line(f"note: {note}")
    if facts["failure"]:
        print_line(f"FAILED: {facts['failure']}")
        if not facts["bytes"]:
            before = f"--partial writes the {count_text(messages, 'message')} before the damage"
            print_line(f"{facts['file']}: not written; {before if messages else 'no message is before the damage'}")
            return
    elif not facts["good"]:
        print_line("DIFFERENT: the rows marked ! lack messages that the source declares")
    print_line(f"{facts['file']}: {count_text(facts['entries'], 'entry', 'entries')}, {size_text(facts['bytes'])}")

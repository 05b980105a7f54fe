"""``igtl-gateway import``: another program's recording as a session."""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording, WireError, __version__, iso_time
from igtl_gateway.addon.reading import layout
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.terminal import (
    add_json,
    add_output,
    add_overwrite,
    cell,
    count_text,
    default,
    new_recording,
    print_json,
    print_line,
    size_text,
    width,
)
from igtl_gateway.addon.untrusted import is_same
from igtl_gateway.addon.writing import SessionWriter, written
from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.source import ImportedStream, Source, numbered

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
EXAMPLES = """\
  # ROS 1 bag; its messages are converted to ROS 2
  igtl-gateway import session.bag -o session.mcap
  # rosbag2: sqlite3 or MCAP, also split
  igtl-gateway import recording/ -o session.mcap
  # tracked ultrasound: IMAGE and TRANSFORM messages with their stamps
  igtl-gateway import freehand.igs.mha -o session.mcap
  igtl-gateway import freehand.igs.nrrd -o session.mcap \\
      --epoch 2026-03-14T09:00:00Z
  # image or volume (.mha .mhd .nrrd .nhdr): an IMAGE with its position
  igtl-gateway import head.nrrd -o session.mcap
  # NIfTI, with the extra nifti
  igtl-gateway import head.nii.gz -o session.mcap
  # a scene of 3D Slicer: poses, pictures, points and strings
  igtl-gateway import scene.mrb -o session.mcap
  # a transform of 3D Slicer or ITK (.h5 .tfm .mat .txt), as TRANSFORM
  igtl-gateway import ProbeToTracker.h5 -o session.mcap
  # markups of 3D Slicer (.mrk.json .fcsv), as POINT, TRAJ and POLYDATA
  igtl-gateway import Plan.mrk.json -o session.mcap
  # the bytes that an OpenIGTLink server sent
  igtl-gateway import probe.s2c.igtl -o session.mcap
  # OpenIGTLink in captured TCP, both directions
  igtl-gateway import traffic.pcap -o session.mcap

exit code 1 if messages that the source declares are missing in the result; the
output marks them.  If SOURCE is damaged, OUT is not written without --partial."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="SOURCE", type=Path, help="file, or directory of a rosbag2 recording")
    add_output(parser, "session file to write", new_recording, required=True)
    parser.add_argument(
        "--epoch",
        metavar="TIME",
        type=epoch,
        help="start time of sequences and of messages without stamps, ISO 8601 " + default("2000-01-01T00:00:00Z"),
    )
    parser.add_argument(
        "--partial", action="store_true", help="if SOURCE is damaged, write what was read before the damage"
    )
    add_overwrite(parser, "OUT")
    add_json(parser)


def epoch(text: str) -> int:
    """Parse an ISO 8601 time; return UTC nanoseconds.  A time without a zone is UTC."""
    try:
        moment = iso_time(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time such as 2026-03-14T09:00:00Z") from None
    since = (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)) - _EPOCH
    if since.days < 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time after 1970-01-01")
    return (since.days * 86_400 + since.seconds) * NS_PER_S + since.microseconds * 1000


def run(options: argparse.Namespace) -> int:
    if is_same(options.output, options.source):
        raise ConfigError(f"--output: found {options.output}, which is the source, expected another file")
    failure = ""
    with (
        closing(open_source(options.source, options.epoch)) as source,
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
        except (DamagedRecording, WireError, layout.LayoutError) as error:
            failure = str(error)
        writer.close({"import": {"rows": [_row_facts(row) for row in source.rows], "failure": failure}})
        size = place.stat().st_size
        if failure and not options.partial:
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
        "bytes": 0 if failure and not options.partial else size,
        "rows": [_row_facts(row) for row in source.rows],
        "notes": notes,
        "failure": failure,
    }
    if options.json:
        print_json(facts)
    else:
        _print(source, facts)
    return 0 if good else 1


def import_facts(path: Path, source: Source) -> dict[str, str]:
    """Return the metadata of the session: without machine and time, so that equal sources give equal files."""
    return {
        "config": json.dumps(Config().to_dict(), sort_keys=True),
        "igtl_gateway_version": __version__,
        "imported_from": path.name,
        **source.facts,
    }


def _row_facts(row: ImportedStream) -> dict[str, Any]:
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


def _print(source: Source, facts: dict[str, Any]) -> None:
    print_line(f"{source.title}: {len(source.rows)} rows; found, imported, left out")
    streams = width(row.stream for row in source.rows)
    kinds = width(row.type or row.unit for row in source.rows)
    for row in source.rows:
        mark = " " if row.good else "!"
        numbers = f"{row.declared:>12,} {row.taken:>12,} {row.left_out:>12,}"
        print_line(
            f"{mark} {cell(row.stream, streams)}  {cell(row.type or row.unit, kinds)} {numbers}  {row.why}".rstrip()
        )
    for note in facts["notes"]:
        print_line(f"note: {note}")
    if facts["failure"]:
        print_line(f"FAILED: {facts['failure']}")
        if not facts["bytes"]:
            entries = count_text(facts["entries"], "entry", "entries")
            print_line(f"{facts['file']}: not written; --partial writes the {entries} before the damage")
            return
    elif not facts["good"]:
        print_line("DIFFERENT: the rows marked ! lack messages that the source declares")
    print_line(f"{facts['file']}: {count_text(facts['entries'], 'entry', 'entries')}, {size_text(facts['bytes'])}")

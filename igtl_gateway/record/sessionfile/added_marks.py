"""Marks that were added to a closed recording: a side file, one JSON object a line.

``out.mcap`` has ``out.mcap.marks.jsonl`` beside it; the folder of a split recording has ``marks.jsonl`` in it, and
those of its parts count, too.  The recording itself stays as it is, so its seal stays valid; the side file has none.

The first line states when the recording begins and ends: marks of another recording, for example of one that was
overwritten, are refused.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, DamagedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted import files
from igtl_gateway.base.untrusted.shape import fields, number, text, unexpected
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.gateway.log.marks import Mark, MarkNote
from igtl_gateway.record.sessionfile.new_file import write_text
from igtl_gateway.record.sessionfile.whole_files import written

SUFFIX = ".marks.jsonl"
#: In the folder of a split recording.
IN_FOLDER = "marks.jsonl"
#: Marks of one side file.
MAX_ADDED = 10_000
VERSION = 1

_HEAD = fields(
    dict.fromkeys(("igtl_gateway_marks", "start_ns", "end_ns"), number),
    needed=("igtl_gateway_marks", "start_ns", "end_ns"),
    other=unexpected,
)
_LINE = fields(
    {
        **dict.fromkeys(("label", "text", "who"), text),
        "time_ns": number,
        "end_ns": lambda value, place: None if value is None else number(value, place),
    },
    needed=("label", "text", "who", "time_ns", "end_ns"),
    other=unexpected,
)


def marks_file(recording: Path) -> Path:
    """Return the side file of a recording, which may not exist."""
    return recording / IN_FOLDER if recording.is_dir() else recording.with_name(recording.name + SUFFIX)


def marks_files(recording: Path, *, parts: bool = True) -> list[Path]:
    """Return the side files of a recording, or of the parts of a folder, even those that are not regular files."""
    of_parts = sorted(recording.glob(f"*.mcap{SUFFIX}")) if parts and recording.is_dir() else []
    own = marks_file(recording)
    return [*([own] if os.path.lexists(own) else []), *of_parts]  # a name may be too long for the system


def added_marks(recording: Path, start_ns: int, end_ns: int, *, parts: bool = True) -> tuple[Mark, ...]:
    """Return the marks in the side files of a recording, in the order of the files.

    Args:
        recording: path of a file or folder.
        start_ns, end_ns: of the recording, UTC ns.
        parts: whether those of the parts of a folder belong to them.

    Raises DamagedRecording, UnsupportedRecording, LimitExceeded.
    """
    own = marks_file(recording)
    return tuple(
        mark
        for path in marks_files(recording, parts=parts)
        for mark in _read(path, (start_ns, end_ns) if path == own else None)
    )


def _read(path: Path, span: tuple[int, int] | None) -> Iterator[Mark]:
    """Yield the marks of one side file; of a part (no span), the span is not compared."""
    try:
        lines = files.read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise DamagedRecording(f"{path}: found other bytes, expected UTF-8") from None
    if not lines or len(lines) - 1 > MAX_ADDED:
        raise DamagedRecording(f"{path}: found {count_text(len(lines), 'line')}, expected 1 to {MAX_ADDED + 1:,}")
    head = parse_json(lines[0], f"{path}: line 1")
    _HEAD(head, f"{path}: line 1")
    if head["igtl_gateway_marks"] != VERSION:
        raise DamagedRecording(f"{path}: line 1: found version {head['igtl_gateway_marks']}, expected {VERSION}")
    # the begin of a recording changes with its retention, the end with its recovery
    if span and head["start_ns"] != span[0] and head["end_ns"] != span[1]:
        raise DamagedRecording(
            f"{path}: line 1: found marks of a recording from {head['start_ns']} to {head['end_ns']} ns, expected those"
            f" of one from {span[0]} to {span[1]} ns; remove the file"
        )
    for line_number, line in enumerate(lines[1:], 2):
        place = f"{path}: line {line_number}"
        found = parse_json(line, place)
        _LINE(found, place)
        try:
            noted = MarkNote(found["label"], found["text"], found["who"])
        except ConfigError as error:
            raise DamagedRecording(f"{place}: {error}") from None
        at_ns, until_ns = found["time_ns"], found["end_ns"]
        if until_ns is not None and until_ns < at_ns:
            raise DamagedRecording(f"{place}: found an end before the begin, expected one after it")
        yield Mark(noted.label, noted.text, noted.who, at_ns, until_ns, is_added=True)


def write_marks(recording: Path, marks: Iterable[Mark], start_ns: int, end_ns: int) -> Path:
    """Replace the side file of a recording, and return its path; without marks it is removed.

    Raises ConfigError for too many marks, GatewayError if it cannot be written.
    """
    path = marks_file(recording)
    rows = sorted(marks, key=lambda mark: mark.time_ns)
    if len(rows) > MAX_ADDED:
        raise ConfigError(f"{path}: found {count_text(len(rows), 'mark')}, expected at most {MAX_ADDED:,}")
    if not rows:
        path.unlink(missing_ok=True)
        return path
    head = {"igtl_gateway_marks": VERSION, "start_ns": start_ns, "end_ns": end_ns}
    lines = [head, *map(_line, rows)]
    with written(path, overwrite=True) as place:
        write_text(place, "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines))
    return path


def _line(mark: Mark) -> dict[str, str | int | None]:
    return {
        "label": mark.label,
        "text": mark.text,
        "who": mark.who,
        "time_ns": mark.time_ns,
        "end_ns": mark.end_ns,
    }

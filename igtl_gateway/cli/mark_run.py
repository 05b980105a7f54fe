"""``igtl-gateway mark``: add a mark to a closed recording."""

from __future__ import annotations

import argparse

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import moment_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.gateway.log.marks import Mark, MarkNote
from igtl_gateway.record.sessionfile.added_marks import added_marks, write_marks
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_marks import find_mark, marked_moment, marks_of


def run(options: argparse.Namespace) -> int:
    if options.file.parent.is_file():
        raise ConfigError(f"{options.file}: found a part of a merged session, expected the session itself")
    with SessionFile.open(options.file) as file:
        added = list(added_marks(file.path, file.start_ns, file.end_ns, parts=False))
        mark = _new(file, options) if options.remove is None else _removed(added, options)
        if options.remove is None:
            added.append(mark)
        path = write_marks(file.path, added, file.start_ns, file.end_ns)
        facts = mark.to_dict(file.start_ns)
    if options.json:
        print_json({"file": str(path), "marks": len(added), "mark": facts})
    else:
        until = "" if facts["end_s"] is None else f" to {moment_text(facts['end_s'] * NS_PER_S)}"
        verb = "added" if options.remove is None else "removed"
        print_line(f"{path}: {verb} {mark.label} at {moment_text(facts['at_s'] * NS_PER_S)}{until}")
    return 0


def _new(file: SessionFile, options: argparse.Namespace) -> Mark:
    """Return the mark of the options.  Raises ConfigError."""
    if options.at is None:
        raise ConfigError("--label: found no --at, expected the time of the mark")
    noted = MarkNote(options.label, options.text, options.who)
    moments = [
        None if text is None else marked_moment(text, file.start_ns, name, lambda: marks_of(file))
        for name, text in (("--at", options.at), ("--until (end)", options.until))
    ]
    for name, at_ns in zip(("--at", "--until"), moments, strict=True):
        if at_ns is not None and not file.start_ns <= at_ns <= file.end_ns:
            raise ConfigError(
                f"{name}: found {moment_text(at_ns - file.start_ns)} from the start, expected 0 to "
                f"{moment_text(file.end_ns - file.start_ns)}"
            )
    at_ns, until_ns = moments
    assert at_ns is not None
    if until_ns is not None and until_ns < at_ns:
        raise ConfigError(f"--until: found {moment_text(at_ns - until_ns)} before --at, expected a later time")
    return Mark(noted.label, noted.text, noted.who, at_ns, until_ns, is_added=True)


def _removed(added: list[Mark], options: argparse.Namespace) -> Mark:
    """Take a mark out of those that were added, and return it.  Raises ConfigError."""
    if options.at is not None or options.until is not None or options.text or options.who:
        raise ConfigError("--remove: found --at, --until, --text or --who, expected none of them")
    mark = find_mark(options.remove, added, "--remove")
    added.remove(mark)
    return mark

"""The marks of a recording, and moments that are named by them: ``mark:LABEL``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import Mark, joined
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.moment import moment

_PREFIX = "mark:"


def marks_of(file: SessionFile) -> tuple[Mark, ...]:
    """Return the marks of an open recording in the order of their times.  Raises DamagedRecording."""
    if file.foreign:
        return ()
    notes = _noted(file.entries_of_kinds({Kind.EDGE_NOTE}))
    return joined(chain(notes_before(file), notes), file.start_ns, file.end_ns)


def notes_before(file: SessionFile) -> list[tuple[int, Note]]:
    """Return UTC ns and note of the marks before a file that begins midway: phases may be open there."""
    return [] if file.foreign else list(_noted(file.prologue()))


def _noted(entries: Iterable[Entry]) -> Iterator[tuple[int, Note]]:
    for entry in entries:
        if entry.seq and entry.kind is Kind.EDGE_NOTE:
            yield entry.stamp_ns, Note.of(entry.data())


def marked_moment(text: str, start_ns: int, option: str, marks: Callable[[], Sequence[Mark]]) -> int:
    """Return UTC ns of a moment as ``moment`` reads it, or of ``mark:LABEL``: of a phase its begin, or its end for an
    end of a window.  ``mark:LABEL#2`` is the second mark of this label.

    Args:
        text: the moment as the user wrote it.
        start_ns: start of the recording, UTC ns.
        option: name of the option, for the error; with ``end`` in it, it is the end of a window.
        marks: returns the marks of the recording.

    Raises ConfigError.
    """
    if not text.startswith(_PREFIX):
        return moment(text, start_ns, option)
    mark = find_mark(text.removeprefix(_PREFIX), marks(), option)
    return mark.end_ns if mark.end_ns is not None and "end" in option else mark.time_ns


def find_mark(name: str, marks: Sequence[Mark], option: str) -> Mark:
    """Return the mark ``LABEL``, the first of several, or ``LABEL#N``.  Raises ConfigError, with near labels."""
    label, _, number = name.rpartition("#")
    for wanted, place in ((name, 1), (label, whole_number(number) or 0)):
        found = [mark for mark in marks if mark.label == wanted]
        if 0 < place <= len(found):
            return found[place - 1]
        if found and wanted == label and place:
            raise ConfigError(f"{option}: found {_PREFIX}{name}, expected at most {_PREFIX}{label}#{len(found)}")
    labels = list(dict.fromkeys(mark.label for mark in marks))
    if not labels:
        raise ConfigError(f"{option}: found {_PREFIX}{name}, expected a recording with marks: this one has none")
    expected = did_you_mean(near_names(name, labels)) or f"expected one of {', '.join(map(repr, labels[:10]))}"
    raise ConfigError(f"{option}: found no mark {name!r}; {expected}")

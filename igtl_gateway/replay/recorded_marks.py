"""The marks of a recording, and moments that are named by them: ``mark:LABEL``.

`marks_of` is the one place where marks come together: those of the session log, of the time before a file that begins
midway, of the parts of a merged session, and of the side file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, DamagedRecording
from igtl_gateway.base.near import LISTED, one_of
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import Mark, joined
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.added_marks import added_marks, write_marks
from igtl_gateway.record.sessionfile.layout import PROLOGUE_ATTACHMENT, LayoutError
from igtl_gateway.record.sessionfile.merged import ATTACHMENT_OF, PART_NAME_KEY, is_noted
from igtl_gateway.record.sessionfile.messages import unpack_note
from igtl_gateway.record.sessionfile.only import only_of_kinds
from igtl_gateway.record.sessionfile.reader import SessionFile, prologue_of
from igtl_gateway.replay.moment import moment

_PREFIX = "mark:"


#: UTC ns and note.
Noted = tuple[int, Note]


def marks_of(file: SessionFile, notes: Iterable[Noted] | None = None, *, added: bool = True) -> tuple[Mark, ...]:
    """Return the marks of an open recording in the order of their times.

    Args:
        file: the recording.
        notes: of its entries, where they were read already.
        added: whether those of the side file belong to them.

    Raises DamagedRecording, and as ``added_marks``.
    """
    found = _merged(file) if file.merge else _logged(file, notes)
    more = added_marks(file.path, file.start_ns, file.end_ns) if added else ()
    return tuple(sorted((*found, *more), key=lambda mark: mark.time_ns))


def _logged(file: SessionFile, notes: Iterable[Noted] | None) -> tuple[Mark, ...]:
    if file.foreign:
        return ()
    noted = _noted(only_of_kinds(file, {Kind.EDGE_NOTE})) if notes is None else notes
    return joined(chain(_noted(file.prologue()), noted), file.start_ns, file.end_ns)


def _merged(file: SessionFile) -> Iterator[Mark]:
    """Yield the marks of the parts of a merged session, at the times of its reference clock."""
    assert file.merge
    notes: dict[str, list[Noted]] = {name: [] for name in file.merge.names}
    ahead_ns = {part["name"]: round((part["clock"]["offset_s"] or 0) * NS_PER_S) for part in file.merge.facts["parts"]}
    prologues = {ATTACHMENT_OF.format(name) + PROLOGUE_ATTACHMENT: name for name in notes}
    for each in file.attachments():
        if name := prologues.get(each.name):
            notes[name] += ((at - ahead_ns[name], note) for at, note in _noted(prologue_of(each, file.path)))
    for _, channel, (_, _, log_ns, _, start, end, data) in file.messages(is_noted):
        name = channel.metadata.get(PART_NAME_KEY, "")
        if name in notes:
            try:
                note = Note.of(unpack_note(data[start:end], 0, log_ns).data())
            except LayoutError as error:
                raise DamagedRecording(f"{file.path}: part {name}: {error}") from None
            notes[name].append((log_ns, note))
    for noted in notes.values():
        yield from joined(noted, file.start_ns, file.end_ns)


def _noted(entries: Iterable[Entry]) -> Iterator[Noted]:
    for entry in entries:
        if entry.seq and entry.kind is Kind.EDGE_NOTE:
            yield entry.stamp_ns, Note.of(entry.data())


def carry_marks(out: Path, added: Iterable[Mark], *, only_within: bool = True) -> None:
    """Give a new recording the marks that were added to the one that it was made of.

    Args:
        out: the new recording.
        added: the marks.
        only_within: leave out those that are not between its first and its last entry.

    Raises as ``write_marks``.
    """
    marks = list(added)
    if not marks:
        write_marks(out, (), 0, 0)
        return
    with SessionFile.open(out) as file:
        is_in = [mark.time_ns <= file.end_ns and file.start_ns <= mark.last_ns for mark in marks]
        kept = [mark for mark, within in zip(marks, is_in, strict=True) if within or not only_within]
        write_marks(out, kept, file.start_ns, file.end_ns)


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
    return mark.last_ns if "end" in option else mark.time_ns


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
    raise ConfigError(f"{option}: found no mark {name!r}, expected {one_of(name, sorted(labels), LISTED)}")

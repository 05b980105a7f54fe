"""Marks: what a person or a program points out in a session.  Each is an input, a note of code ``MARK``.

A mark is a moment or a phase.  A phase is two notes with the same label, one at its begin and one at its end.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.quantities import count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.log.timing import FUTURE_NS

MARK = "mark"
BEGIN, END = "begin", "end"
#: Most characters of each field.
BOUNDS = {"label": 64, "text": 1000, "who": 64}
#: Phases that may be open at a time.
MAX_OPEN = 100
#: Longest time from a mark to its note, seconds; the begin of the session is the other bound.
MAX_AGO_S = 86_400
#: An earlier time is in the words of a note from this on, ns.
_SAID_NS = NS_PER_S // 10
#: Facts of a note → what stands for one that is not there.
_FIELDS: tuple[tuple[str, Any], ...] = (("label", ""), ("text", ""), ("who", ""), ("phase", ""), ("ago_ns", 0))
_SIGNS = {"+": BEGIN, "-": END}
#: Label and seconds of ``LABEL @-8.5``, a mark of an earlier moment.
_EARLIER = re.compile(r"(.*\S)\s+@-([0-9]{1,5}(?:\.[0-9]{1,9})?)")
_CODE = MARK.encode()


@dataclass(frozen=True, slots=True)
class MarkNote:
    """A mark as one note has it.

    Attributes:
        label: what it is called, such as ``"suture-3"``.
        text: more words, or "".
        who: who made it, or "".
        phase: ``BEGIN`` or ``END`` of a phase; "" for a moment.
        ago_ns: time from the moment that is marked to this note: a person writes for some seconds.

    Raises:
        ConfigError: a field that is too long, has line ends or control characters, or is no string; another time.
    """

    label: str
    text: str = ""
    who: str = ""
    phase: str = ""
    ago_ns: int = 0

    def __post_init__(self) -> None:
        for name, most in BOUNDS.items():
            value: Any = getattr(self, name)
            if not isinstance(value, str) or len(value) > most or not value.isprintable():
                raise ConfigError(
                    f"mark: found {name} {_shown(value)}, expected up to {count_text(most, 'printable character')}"
                )
        label = self.label
        if not label or ":" in label or label[0] in _SIGNS or label != label.strip():
            raise ConfigError(
                f"mark: found label {label!r}, expected a name without ':', '+' or '-' at its start, and outer blanks"
            )
        if self.phase not in ("", BEGIN, END):
            raise ConfigError(f"mark: found phase {_shown(self.phase)}, expected {BEGIN!r}, {END!r} or none")
        if type(self.ago_ns) is not int or not 0 <= self.ago_ns < 1 << 63:
            raise ConfigError(f"mark: found a time {_shown(self.ago_ns)} ns before, expected 0 or more")

    @classmethod
    def parse(cls, line: str, who: str, since_ns: int = 0) -> MarkNote:
        """Return the mark in a line: ``LABEL``, ``LABEL: text``; ``+LABEL`` begins a phase, ``-LABEL`` ends it.

        ``LABEL @-8.5`` is of 8.5 s before the line, which is of ``since_ns`` before now.  Raises ConfigError.
        """
        line = line.strip()
        phase = _SIGNS.get(line[:1], "")
        label, _, text = line[1 if phase else 0 :].partition(":")
        label = label.strip()
        if earlier := _EARLIER.fullmatch(label):
            label, since_ns = earlier[1], since_ns + ago_ns(float(earlier[2]))
        return cls(label, text.strip(), who, phase, since_ns)

    @classmethod
    def of(cls, note: Note) -> MarkNote | None:
        """Return the mark in a note; None if it is not one, or of impossible values."""
        if note.code != MARK:
            return None
        try:
            return cls(*(note.data.get(name, empty) for name, empty in _FIELDS))
        except ConfigError:
            return None

    def note(self) -> Note:
        """Return the note."""
        verb = {"": "", BEGIN: " begins", END: " ends"}[self.phase]
        ago = f" ({duration_text(self.ago_ns)} before)" if self.ago_ns >= _SAID_NS else ""
        words = f"mark {self.label}{verb}{ago}" + (f": {self.text}" if self.text else "")
        data: dict[str, Any] = {"label": self.label, "text": self.text, "who": self.who}
        data |= {"phase": self.phase} if self.phase else {}
        return Note(Level.INFO, MARK, words, data=data | ({"ago_ns": self.ago_ns} if self.ago_ns else {}))


def ago_ns(seconds: object) -> int:
    """Convert the age of a mark from seconds to ns.  Raises ConfigError for no number, and outside 0 to MAX_AGO_S."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 <= seconds < MAX_AGO_S:
        raise ConfigError(f"mark: found {_shown(seconds)} s ago, expected the seconds since then, 0 to {MAX_AGO_S:,}")
    return round(seconds * NS_PER_S)


def ago_of_stamp(stamp_ns: int, now_ns: int) -> int:
    """Return the age of a mark with a stamp, ns; 0 without one, which is 0 or below.

    Raises ConfigError for a stamp in the future, and one of more than MAX_AGO_S ago.
    """
    if stamp_ns <= 0:
        return 0
    age_ns = now_ns - stamp_ns
    if not -FUTURE_NS <= age_ns < MAX_AGO_S * NS_PER_S:
        way = "ahead of" if age_ns < 0 else "behind"
        raise ConfigError(
            f"mark: found a stamp {duration_text(age_ns)} {way} the bridge's clock, expected one of the session"
        )
    return max(0, age_ns)


class OpenPhases:
    """The labels of the phases that are open."""

    def __init__(self) -> None:
        self._labels: set[str] = set()

    @property
    def labels(self) -> list[str]:
        """The labels, sorted; callable from any thread."""
        return sorted(self._labels)

    def check(self, mark: MarkNote) -> None:
        """Raise ConfigError if a mark cannot follow: the end of no phase, or the begin of an open one."""
        if mark.phase == BEGIN and mark.label in self._labels:
            raise ConfigError(f"mark: found the phase {mark.label!r} open already, expected its end first")
        if mark.phase == BEGIN and len(self._labels) >= MAX_OPEN:
            raise ConfigError(f"mark: found {MAX_OPEN} open phases, expected the end of one first")
        if mark.phase == END and mark.label not in self._labels:
            near = did_you_mean(near_names(mark.label, self._labels))
            raise ConfigError(
                f"mark: found the end of {mark.label!r}, expected a phase that is open" + (f"; {near}" if near else "")
            )

    def follow(self, note: Note) -> None:
        """Take notice of a note of the session."""
        mark = MarkNote.of(note)
        if mark and mark.phase == BEGIN and len(self._labels) < MAX_OPEN:
            self._labels.add(mark.label)
        elif mark and mark.phase == END:
            self._labels.discard(mark.label)


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark of a recording.

    Attributes:
        label, text, who: see ``MarkNote``.
        time_ns: when it is or begins, UTC ns.
        end_ns: end of the phase, UTC ns; None for a moment.
        is_open: the phase has no end in the recording; ``end_ns`` is that of the recording.
        is_added: it was added to the closed recording.
    """

    label: str
    text: str
    who: str
    time_ns: int
    end_ns: int | None = None
    is_open: bool = False
    is_added: bool = False

    @property
    def last_ns(self) -> int:
        """The end of a phase; the time of a moment."""
        return self.time_ns if self.end_ns is None else self.end_ns

    def to_dict(self, start_ns: int) -> dict[str, Any]:
        """Return it as JSON values, with times in seconds from ``start_ns``."""
        end_s = None if self.end_ns is None else (self.end_ns - start_ns) / 1e9
        return {
            "label": self.label,
            "text": self.text,
            "who": self.who,
            "time_ns": self.time_ns,
            "end_ns": self.end_ns,
            "open": self.is_open,
            "added": self.is_added,
            "at_s": (self.time_ns - start_ns) / 1e9,
            "end_s": end_s,
        }


def is_phase(entry: Entry) -> bool:
    """Return whether an entry begins or ends a phase: later notes depend on it."""
    if entry.kind is not Kind.EDGE_NOTE or _CODE not in (data := entry.data()):
        return False
    mark = MarkNote.of(Note.of(data))
    return mark is not None and bool(mark.phase)


def joined(notes: Iterable[tuple[int, Note]], start_ns: int, end_ns: int) -> tuple[Mark, ...]:
    """Return the marks in notes, in the order of their times.

    A phase whose begin is not there began at ``start_ns`` or before; one that ended before is left out.  A moment is
    kept, also if it was noted in these seconds only.

    Args:
        notes: UTC ns and note, in order; other notes are ignored.
        start_ns, end_ns: of the recording.
    """
    found: list[Mark] = []
    begun: dict[str, tuple[int, MarkNote]] = {}
    for noted_ns, note in notes:
        mark = MarkNote.of(note)
        if mark is None:
            continue
        time_ns = noted_ns - mark.ago_ns
        if mark.phase == BEGIN:
            if mark.label in begun:  # two programs at once: the first phase ends where the second begins
                found.append(_phase(*begun[mark.label], time_ns))
            begun[mark.label] = time_ns, mark
        elif mark.phase == END:
            since_ns, first = begun.pop(mark.label, (start_ns, replace(mark, text="")))
            texts = [each for each in dict.fromkeys((first.text, mark.text)) if each]
            found.append(_phase(since_ns, replace(first, text=""), time_ns, "; ".join(texts)))
        elif noted_ns >= start_ns:
            found.append(Mark(mark.label, mark.text, mark.who, time_ns))
    found += [_phase(since_ns, mark, end_ns, is_open=True) for since_ns, mark in begun.values()]
    kept = [mark for mark in found if mark.end_ns is None or mark.end_ns >= start_ns]
    return tuple(sorted(kept, key=lambda mark: mark.time_ns))


def _phase(time_ns: int, mark: MarkNote, end_ns: int, text: str = "", *, is_open: bool = False) -> Mark:
    return Mark(mark.label, text or mark.text, mark.who, time_ns, max(time_ns, end_ns), is_open)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}…"

"""Which notes are reported on the terminal, the page, ``/rosout`` and in the viewer's log, and how often.

The recording has all of them, and the counts of the messages are in the ledger and stay exact.

A peer can cause a note with each of its messages, and a timer one with each turn.  So what only drives the gateway is
not reported.  The same note is reported at once; while it repeats, after a second, ten seconds, and so on up to ten
minutes, with the number of those in between; after a minute of silence it is new.  What happens each time, such as
a mark, is reported each second.  All notes of one code together are limited: what is above the limit is reported once a
second, too, by the latest of them.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway import TICK
from igtl_gateway.gateway.dialogue.clocks import ASK_CLOCK
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.orders import UNWRITTEN

#: The same note again after this time, and while it repeats after ten times as long, up to the most.
EVERY_NS = NS_PER_S
_GROWS, _MOST_NS = 10, 600 * NS_PER_S
#: Time without the same note after which it is new.
_NEW_NS = 60 * NS_PER_S

#: Codes of notes that only drive the gateway, several times a second; of commands that were not written, the guard has
#: notes.
_ROUTINE = frozenset({ASK_CLOCK, TICK, UNWRITTEN})
#: Codes of notes of which each is news, although it has the words of the one before.
_EACH_IS_NEWS = frozenset(
    "fault link_down link_up mark no_source record_continued record_snapshot setting source_came stream_back "
    "stream_silent trigger trigger_incomplete trigger_saved".split()
)

#: Notes of one code that are reported at once, as at the start of a site with many streams, and those in a second.
_BURST, _PER_S = 100, 2.0

#: Notes of one code that are distinguished.
_MOST_CAUSES = 200

_Cause = tuple[str, str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class Event:
    """A note in the log.

    Attributes:
        more: notes like this one since the last that was reported; they are not reported themselves.
    """

    stamp_ns: int
    kind: Kind
    note: Note
    links: tuple[int, ...]
    more: int = 0


@dataclass(slots=True)
class _Episode:
    """A note that may repeat: when it was reported, and what has been held back since."""

    reported_ns: int
    held: int = 0
    last: Event | None = None
    every_ns: int = EVERY_NS
    seen_ns: int = 0

    def hold(self, event: Event) -> None:
        self.held += 1
        self.last = event
        self.seen_ns = event.stamp_ns

    def repeats(self, event: Event) -> bool:
        """Whether a note is one more of the same, and not news."""
        return event.note.code not in _EACH_IS_NEWS and event.stamp_ns - self.seen_ns < _NEW_NS

    def report(self, now_ns: int) -> Event | None:
        """Return the last one that was held back, with the number of the others."""
        event, more = self.last, self.held - 1
        self.reported_ns, self.held, self.last = now_ns, 0, None
        if event and event.note.code not in _EACH_IS_NEWS:
            self.every_ns = min(_GROWS * self.every_ns, _MOST_NS)
        return replace(event, more=more) if event else None


@dataclass(slots=True)
class _Code:
    """The notes of one code."""

    left: float
    counted_ns: int
    most: float = _BURST
    episodes: OrderedDict[_Cause, _Episode] = field(default_factory=OrderedDict)
    others: _Episode = field(default_factory=lambda: _Episode(-EVERY_NS))  # above the limit

    def takes(self, now_ns: int) -> bool:
        """Count a note that is to be reported now; whether it is within the limit."""
        passed_ns = max(0, now_ns - self.counted_ns)
        self.left = min(self.most, self.left + passed_ns * _PER_S / NS_PER_S)
        self.counted_ns = now_ns
        if self.left < 1:
            return False
        self.left -= 1
        return True


class NoteRate:
    """Which notes are reported, and when.  Any thread may call it.

    Args:
        limited: whether all notes of one code together are limited, too.
    """

    def __init__(self, *, limited: bool = True) -> None:
        self._burst = _BURST if limited else math.inf
        self._codes: dict[str, _Code] = {}
        self._lock = threading.Lock()

    def take(self, event: Event) -> Event | None:
        """Return what is to be reported now; None: it is held back, or never reported."""
        if is_routine(event.note):
            return None
        now_ns = event.stamp_ns
        with self._lock:
            code = self._codes.setdefault(event.note.code, _Code(self._burst, now_ns, self._burst))
            cause = (event.note.stream, event.note.text, event.links)
            episode = code.episodes.get(cause)
            if episode and (episode.held or now_ns - episode.reported_ns < episode.every_ns):
                episode.hold(event)
                return None
            if not code.takes(now_ns):
                code.others.hold(event)
                return None
            every_ns = min(_GROWS * episode.every_ns, _MOST_NS) if episode and episode.repeats(event) else EVERY_NS
            code.episodes[cause] = _Episode(now_ns, every_ns=every_ns, seen_ns=now_ns)
            code.episodes.move_to_end(cause)
            if len(code.episodes) > _MOST_CAUSES:
                _, oldest = code.episodes.popitem(last=False)
                if oldest.last:
                    code.others.held += oldest.held
                    code.others.last = oldest.last
            return event

    def due(self, now_ns: int | None) -> list[Event]:
        """Return what was held back and is to be reported now; None: all of it, at the end."""
        found: list[Event] = []
        with self._lock:
            for code in self._codes.values():
                for episode in (*code.episodes.values(), code.others):
                    if not episode.last:
                        continue
                    if now_ns is None:
                        found.append(_reported(episode, episode.last.stamp_ns))
                    elif now_ns - episode.reported_ns >= (EVERY_NS if episode is code.others else episode.every_ns):
                        if episode is code.others or code.takes(now_ns):
                            found.append(_reported(episode, now_ns))
                        else:
                            code.others.held += episode.held
                            code.others.last = episode.last
                            episode.report(now_ns)
        return sorted(found, key=lambda event: event.stamp_ns)


def is_routine(note: Note) -> bool:
    """Return whether a note is not for people."""
    return note.code in _ROUTINE


def _reported(episode: _Episode, now_ns: int) -> Event:
    event = episode.report(now_ns)
    assert event  # it was held back
    return event

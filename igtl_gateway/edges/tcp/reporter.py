"""How the I/O thread reports: callbacks that may raise, notes, facts that repeat quickly, errors of our own code."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.gateway.log.note import Level, Note

_log = logging.getLogger(__name__)

NOTE_EVERY_S = 1.0  # repeated facts are noted at most this often


class _RepeatedFact:
    """A fact that may repeat quickly, noted at most once a second."""

    def __init__(self, make: Callable[[int], Note]) -> None:
        self.make = make
        self.count = 0
        self.noted = 0


class Reporter:
    """Calls back; of the I/O thread alone."""

    def __init__(self, loop: Loop, on_note: Callable[[int, Note], None]) -> None:
        self._loop = loop
        self._on_note = on_note
        self._repeated: dict[str, _RepeatedFact] = {}

    def call(self, name: str, callback: Callable[..., object], *args: object) -> object:
        """Make the callback and return what it does; if it raises, note that."""
        try:
            return callback(*args)
        except Exception as exc:
            cause = f"{type(exc).__name__}: {exc}"
            _log.debug("%s raised", name, exc_info=exc)

            def make(count: int) -> Note:
                data = {"callback": name, "error": cause, "count": count}
                return Note(Level.ERROR, "callback_failed", f"{name} raised {cause}", data=data)

            self.note_rate_limited(f"{name} raised {type(exc).__name__}", make)
            return None

    def note(self, number: int, note: Note) -> None:
        """Note a fact about the link of that number (0 if none)."""
        try:
            self._on_note(number, note)
        except Exception:  # the last resort: there is no other callback
            _log.exception("on_note raised at: %s", note.text)

    def note_rate_limited(self, fact: str, make: Callable[[int], Note], times: int = 1) -> None:
        """Note a fact now, and while it repeats once a second with the count; it has come ``times`` more."""
        repeated = self._repeated.get(fact)
        if repeated is None:
            repeated = self._repeated[fact] = _RepeatedFact(make)
            self._loop.call_soon(partial(self._note_repeated, fact, repeated))
        repeated.make = make
        repeated.count += times

    def note_error(self, exc: Exception) -> None:
        """Note an unexpected exception of our own code that concerns no single link."""
        self.note_rate_limited(f"internal error {_code_location(exc)}", lambda count: error_note(exc, count=count))

    def _note_repeated(self, fact: str, repeated: _RepeatedFact) -> None:
        if repeated.count == repeated.noted:
            del self._repeated[fact]
            return
        repeated.noted = repeated.count
        self.note(0, repeated.make(repeated.count))
        self._loop.call_later(NOTE_EVERY_S, partial(self._note_repeated, fact, repeated))


def error_note(exc: Exception, **data: object) -> Note:
    """The note of an unexpected exception of our own code: what, and where in the code."""
    _log.debug("unexpected exception in the I/O thread", exc_info=exc)
    cause, place = f"{type(exc).__name__}: {exc}", _code_location(exc)
    text = f"unexpected error in the gateway's own code: {cause} ({place})"
    return Note(Level.ERROR, "internal_error", text, data={"error": cause, "place": place} | data)


def _code_location(exc: Exception) -> str:
    """File, line and function that raised."""
    frames = traceback.extract_tb(exc.__traceback__)
    if not frames:
        return "unknown place"
    last = frames[-1]
    return f"{Path(last.filename).name}:{last.lineno} {last.name}"

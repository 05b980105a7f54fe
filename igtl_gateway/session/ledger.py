"""The loss ledger: what became of every message, by stream.

For each stream that comes in, ``received = converted + recorded_only + unheard + the sum of dropped``: whatever is not
accounted for is a bug that the ledger shows.  (``unheard``: nobody in ROS listened, and nothing is recorded.)
"""

from __future__ import annotations

from typing import Any

#: Streams counted one by one in each direction; a peer that invents names adds to ``OTHERS`` beyond that.
MAX_STREAMS = 2_000
OTHERS = "(others)"


#: (direction, stream) → fate → number.
_Book = dict[tuple[str, str], dict[str, int]]


class Ledger:
    """Counts by direction, stream and fate."""

    def __init__(self) -> None:
        self._counts: _Book = {}
        self._dropped: _Book = {}
        self._streams: dict[str, set[str]] = {}  # of each direction: a stream is the same in both books

    def count(self, direction: str, stream: str, fate: str, number: int = 1) -> None:
        """Add to ``received``, ``converted``, ``recorded_only``, ``unheard``, ``sent`` or ``published``."""
        self._add(self._counts, direction, stream, fate, number)

    def drop(self, direction: str, stream: str, reason: str, number: int = 1) -> None:
        """Add to ``dropped`` with its reason."""
        self._add(self._dropped, direction, stream, reason, number)

    def counter(self, direction: str, stream: str) -> dict[str, int]:
        """The counts of a stream, for whoever adds to them often: fate → number."""
        words = self._counts.get((direction, stream))
        return self._open(self._counts, direction, stream) if words is None else words

    def _add(self, book: _Book, direction: str, stream: str, word: str, number: int) -> None:
        words = book.get((direction, stream))
        if words is None:
            words = self._open(book, direction, stream)
        words[word] = words.get(word, 0) + number

    def _open(self, book: _Book, direction: str, stream: str) -> dict[str, int]:
        known = self._streams.setdefault(direction, set())
        if stream not in known:
            if len(known) >= MAX_STREAMS:
                stream = OTHERS
            else:
                known.add(stream)
        return book.setdefault((direction, stream), {})

    def to_dict(self) -> dict[str, Any]:
        """``{direction: {stream: {fate: n, "dropped": {reason: n}}}}``, sorted."""
        told: dict[str, Any] = {}
        for direction, stream in sorted({*self._counts, *self._dropped}):
            fates: dict[str, Any] = dict(sorted(self._counts.get((direction, stream), {}).items()))
            if dropped := self._dropped.get((direction, stream)):
                fates["dropped"] = dict(sorted(dropped.items()))
            if fates:
                told.setdefault(direction, {})[stream] = fates
        return told

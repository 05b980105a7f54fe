"""The loss ledger: what became of every message, by stream.

For each stream that comes in, ``received = converted + recorded_only + the sum of dropped``: whatever is not
accounted for is a bug that the ledger shows.
"""

from __future__ import annotations

from typing import Any

#: Streams counted one by one in each direction; a peer that invents names adds to ``OTHERS`` beyond that.
MAX_STREAMS = 2_000
OTHERS = "(others)"


class Ledger:
    """Counts by direction, stream and fate."""

    def __init__(self) -> None:
        self._counts: dict[str, dict[str, dict[str, int]]] = {}
        self._dropped: dict[str, dict[str, dict[str, int]]] = {}
        self._streams: dict[str, set[str]] = {}  # of each direction: a stream is the same in both books

    def count(self, direction: str, stream: str, fate: str, number: int = 1) -> None:
        """Add to ``received``, ``converted``, ``recorded_only`` or ``sent``."""
        self._add(self._counts, direction, stream, fate, number)

    def drop(self, direction: str, stream: str, reason: str, number: int = 1) -> None:
        """Add to ``dropped`` with its reason."""
        self._add(self._dropped, direction, stream, reason, number)

    def _add(
        self, book: dict[str, dict[str, dict[str, int]]], direction: str, stream: str, word: str, number: int
    ) -> None:
        known = self._streams.setdefault(direction, set())
        if stream not in known:
            if len(known) >= MAX_STREAMS:
                stream = OTHERS
            else:
                known.add(stream)
        words = book.setdefault(direction, {}).setdefault(stream, {})
        words[word] = words.get(word, 0) + number

    def to_dict(self) -> dict[str, Any]:
        """``{direction: {stream: {fate: n, "dropped": {reason: n}}}}``, sorted."""
        told: dict[str, Any] = {}
        for direction in sorted({*self._counts, *self._dropped}):
            counts, dropped = self._counts.get(direction, {}), self._dropped.get(direction, {})
            told[direction] = {
                stream: dict(sorted(counts.get(stream, {}).items()))
                | ({"dropped": dict(sorted(dropped[stream].items()))} if stream in dropped else {})
                for stream in sorted({*counts, *dropped})
            }
        return told

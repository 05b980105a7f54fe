"""The entries that the recording lacks, by stream, and the counts at its last start and pause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from igtl_gateway.base.once import Once
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.bridge_end import BridgeGone
from igtl_gateway.record.selection import MAX_STREAMS, OTHERS

#: Between two notes of what the queue did not take, ns.
_NOTE_NS = 1_000_000_000


class Account:
    """Counts of a recording.

    Attributes:
        dropped: entries that the file could not take, by stream.
        not_queued: entries that the queue did not take, by stream, when the bridge was last asked.
        before_start: entries that were written, left out and dropped before the last start.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.not_queued: Counter[str] = Counter()
        self.before_start = 0, 0, 0
        self._left_out = 0  # before the pause that is on
        self._noted_ns: int | None = None  # when the queue's drops were reported last
        self._refused, self._undefined = Once(MAX_STREAMS), Once()  # streams, types

    def count(self, entry: Entry) -> None:
        """Count an entry that the file could not take."""
        stream = entry.channel or entry.kind.value
        if stream not in self.dropped and len(self.dropped) >= MAX_STREAMS:
            stream = OTHERS
        self.dropped[stream] += 1

    def ask(self, ask: Callable[[str], dict[str, int]], refused: int) -> None:
        """Learn what the queue did not take.

        Args:
            ask: asks the bridge; raises BridgeGone.
            refused: how many there were, which is known here, too.
        """
        try:
            self.not_queued = Counter(ask("drops"))
        except BridgeGone:
            self.not_queued[OTHERS] += max(0, refused - self.not_queued.total())

    def is_note_due(self, refused: int, now_ns: int) -> bool:
        """Return whether the queue did not take more (``refused``, so far), and the last note of that is old."""
        is_old = self._noted_ns is None or now_ns - self._noted_ns >= _NOTE_NS
        return is_old and refused != self.not_queued.total()

    def take_unnoted(self, ask: Callable[[str], dict[str, int]], refused: int, now_ns: int) -> Counter[str]:
        """Return what no note has reported of what the queue did not take, by stream; one does now (monotonic).

        Args:
            ask, refused: as of ``ask``.
        """
        before = Counter(self.not_queued)
        self.ask(ask, refused)
        self._noted_ns = now_ns
        return self.not_queued - before

    def pause(self, left_out: int) -> None:
        """A pause begins; ``left_out`` entries were left out before it."""
        self._left_out = left_out

    def left_out_since_pause(self, left_out: int) -> int:
        """Return how many of those were left out since the pause began."""
        return left_out - self._left_out

    def is_first_refused(self, stream: str) -> bool:
        """Return whether this is the first entry of the stream that does not fit the format; of many streams, never."""
        return self._refused.first(stream)

    def is_first_undefined(self, type_name: str) -> bool:
        """Return whether this is the first entry of a type that has no definition."""
        return self._undefined.first(type_name)

"""When the worker looks at the queue and flushes the file, so that a kill costs no more than the interval.

It polls the queue twenty times a second; only once in each flush interval while few entries come, because they cannot
be in the file earlier.  A worker that was late flushes earlier: the next look may be as late.
"""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_S

#: Between two looks, ns.
LOOK_NS = 50_000_000
#: A poll that finds no more entries than this is followed by a longer pause.
_FEW = 32
#: It flushes this much before the interval ends: looking, compressing and writing take time, too.
_EARLY_NS = 100_000_000
#: Of the greatest lateness, which flushes expect again, this part is forgotten at each look: half of it in 18 s.
_FORGOTTEN_PART = 512


class FlushTimes:
    """Times of a worker, monotonic, ns.

    Args:
        flush_s: the flush interval, s.
        now_ns: the present time, as of all methods.

    Attributes:
        due_ns: when the next look or flush is due.
    """

    def __init__(self, flush_s: float, now_ns: int) -> None:
        self._interval_ns = interval_ns = int(flush_s * NS_PER_S)
        self._flush_ns = interval_ns - min(_EARLY_NS, interval_ns // 4)
        self._expected_late_ns = 0
        self._empty_ns = now_ns  # when the queue was empty
        self._late_ns = 0  # since it was so before
        self._flushed_ns = self._looked_ns = self.due_ns = now_ns

    def pause_ns(self, taken: int, now_ns: int, *, waits: bool) -> int:
        """Return the time until the next poll: until the next flush, unless something has to be soon.

        Args:
            taken: entries and commands that the last poll has found.
            waits: something waits for the next poll.
        """
        due_ns = self._flushed_ns + self._flush_ns - now_ns
        if taken > _FEW or waits:
            return min(LOOK_NS, due_ns) if due_ns > 0 else LOOK_NS
        return max(LOOK_NS, due_ns)

    def rested(self, pause_ns: int, rested_ns: int) -> None:
        """Take notice of a pause, and of how long it has rested: what was planned is no lateness."""
        self._empty_ns += max(0, min(pause_ns, rested_ns) - LOOK_NS)

    def emptied(self, now_ns: int) -> None:
        """The queue is empty."""
        self._late_ns, self._empty_ns = now_ns - self._empty_ns, now_ns

    def late_ns(self, now_ns: int) -> int:
        """Return how long the oldest entry waits, or has waited, at most."""
        return max(self._late_ns, now_ns - self._empty_ns)

    def is_look_due(self, now_ns: int) -> bool:
        return now_ns - self._looked_ns >= LOOK_NS

    def is_flush_due(self, now_ns: int) -> bool:
        return now_ns - self._flushed_ns >= self._flush_ns

    def flushed(self, now_ns: int) -> None:
        """The file is flushed."""
        self._flushed_ns = now_ns

    def looked(self, now_ns: int) -> None:
        """It has looked at all that time brings."""
        self._looked_ns = now_ns

    def plan(self) -> None:
        """Choose when something is due again."""
        self.due_ns = min(self._flushed_ns + self._flush_ns, self._looked_ns + LOOK_NS)

    def expect_late(self, late_ns: int) -> None:
        """Flush so early that the interval holds where the next look is as late as the latest ones were.

        At least a quarter of the interval remains: more flushes would take the time that is missing.
        """
        kept_ns = self._expected_late_ns - self._expected_late_ns // _FORGOTTEN_PART
        self._expected_late_ns = late_ns = max(late_ns, kept_ns)
        interval_ns = self._interval_ns
        self._flush_ns = interval_ns - max(min(_EARLY_NS, interval_ns // 4), min(late_ns, interval_ns * 3 // 4))

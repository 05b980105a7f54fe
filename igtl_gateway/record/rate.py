"""How much disk a recording takes in an hour: reported when the streams are there, and when it changes much.

Strategy: the rate of the last five seconds, once it has been the same for longer than that: while streams begin, it
rises from look to look, and a burst is no rate.
"""

from __future__ import annotations

from collections import deque

from igtl_gateway.base.quantities import rough_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Level, Note

#: Code of its note.
RATE = "record_rate"
#: The rate is that of this time; rates within this part of each other are the same; a change is one by this factor.
_WINDOW_NS, _SAME, _MUCH = 5 * NS_PER_S, 0.15, 1.5
#: Slower recordings are not worth a word, bytes in a second.
_LEAST = 1_000
_HOUR_S = 3600


class RateWatch:
    """Looks at the size of a recording, once a second or so."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque()  # time, written
        self._reported = self._first = 0.0  # first: of those that are the same
        self._since_ns = 0  # for how long they are

    def look(self, now_ns: int, written: int, free: int | None) -> Note | None:
        """Return the note that is due.

        Args:
            now_ns: monotonic.
            written: bytes of the recording so far.
            free: bytes of the disk; None: not known.
        """
        self._seen.append((now_ns, written))
        while len(self._seen) > 1 and now_ns - self._seen[1][0] >= _WINDOW_NS:
            self._seen.popleft()
        begun_ns, before = self._seen[0]
        if now_ns - begun_ns < _WINDOW_NS:
            return None
        rate = (written - before) * NS_PER_S / (now_ns - begun_ns)
        if abs(rate - self._first) > _SAME * self._first:
            self._first, self._since_ns = rate, now_ns
        is_new = not self._reported / _MUCH < rate < self._reported * _MUCH
        if rate < _LEAST or now_ns - self._since_ns <= _WINDOW_NS or not is_new:
            return None
        self._reported = rate
        text = f"the recording takes {size_text(rate * _HOUR_S)} an hour"
        if free is not None:
            text += f"; the disk has room for {rough_text(free / rate)}"
        return Note(Level.INFO, RATE, text, data={"bytes_per_hour": round(rate * _HOUR_S)})

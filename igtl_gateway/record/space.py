"""How long the disk of a recording lasts, reported before it is full.

Strategy: the free space is divided by the rate at which it becomes less, or the recording grows, whichever is faster:
other programs write, too.  The time has to be short three times in a row, because a burst is no rate.  Where the
retention deletes old recordings before the disk is full, there is nothing to report.
"""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.base.quantities import rough_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Level, Note

#: Codes of its notes: the time that is left is short; it is no longer.
LOW, ENOUGH = "record_space_low", "record_space"
#: Times that are short, s: a note reports each, once until there is twice as much.
LOW_S = (1800.0, 300.0)
#: The rate is that of this time, and of no less than that one; between two looks.
_WINDOW_NS, _LEAST_NS, LOOK_NS = 60 * NS_PER_S, 3 * NS_PER_S, NS_PER_S
_IN_A_ROW = 3
#: A full disk has room again when it has these bytes more, and as many as the recording has in these seconds.
_ROOM, _ROOM_S = 1 << 20, 10


def free_bytes(folder: Path) -> int | None:
    """Return the free bytes of the file system of a folder; None where they are not known."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


class SpaceWatch:
    """Looks at the disk of a recording.

    Args:
        free: returns the free bytes; None: not known.
        until_deleted: returns how much more may be written before the retention makes room; None: it never does.

    Attributes:
        free_bytes: at the last look; None: not known.
        left_s: the time that is left, s; None: not known, or nothing is written.
        written: bytes of the recording so far.
    """

    def __init__(self, free: Callable[[], int | None], until_deleted: Callable[[], int | None] = lambda: None) -> None:
        self.free_bytes: int | None = None
        self.left_s: float | None = None
        self._free, self._until_deleted = free, until_deleted
        self._seen: deque[tuple[int, int, int]] = deque()  # time, written, free
        self._level = self._next_level = self._in_a_row = 0
        self._looked_ns = self.written = 0
        self._rate = 0.0  # bytes in a second, as long as something is written
        self._closed_bytes = self._present_bytes = 0  # of the files before the present one, and of that

    def has_more_than(self, full: int) -> bool:
        """Return whether a disk that was full with these bytes free has room again, for several seconds at least."""
        room = max(_ROOM, int(_ROOM_S * self._rate))
        return self.free_bytes is not None and self.free_bytes >= full + room

    def is_due(self, now_ns: int) -> bool:
        """Return whether it is time for the next look."""
        return now_ns - self._looked_ns >= LOOK_NS

    def look_at(self, now_ns: int, size: int) -> Note | None:
        """As ``look``, by the size of the present file: where that is smaller than before, another file has begun."""
        self._looked_ns = now_ns
        if size < self._present_bytes:
            self._closed_bytes += self._present_bytes
        self._present_bytes = size
        self.written = self._closed_bytes + size
        return self.look(now_ns, self.written)

    def look(self, now_ns: int, written: int) -> Note | None:
        """Return the note that is due; ``written``: bytes of the recording so far, ``now_ns``: monotonic."""
        self.free_bytes = free = self._free()
        if free is None:
            self.left_s = None
            return None
        self._seen.append((now_ns, written, free))
        while now_ns - self._seen[0][0] > _WINDOW_NS:
            self._seen.popleft()
        self.left_s = self._left_s(now_ns, written, free)
        level = 0 if self.left_s is None else sum(self.left_s < each for each in LOW_S)
        if level == self._next_level:
            self._in_a_row += 1
        else:
            self._next_level, self._in_a_row = level, 1
        if self._in_a_row < _IN_A_ROW or level == self._level:
            return None
        if level < self._level and self.left_s is not None and self.left_s < 2 * LOW_S[self._level - 1]:
            return None
        rises, self._level = level > self._level, level
        return self._note(free, rises=rises)

    def _left_s(self, now_ns: int, written: int, free: int) -> float | None:
        begun_ns, before, free_before = self._seen[0]
        if now_ns - begun_ns < _LEAST_NS:
            return None
        room = self._until_deleted()
        rate = max(written - before, free_before - free) / (now_ns - begun_ns) * NS_PER_S
        self._rate = (written - before) / (now_ns - begun_ns) * NS_PER_S or self._rate
        return free / rate if rate > 0 and (room is None or room > free) else None

    def _note(self, free: int, *, rises: bool) -> Note:
        if self.left_s is None:
            return Note(Level.INFO, ENOUGH, f"the disk of the recording has {size_text(free)} free")
        left = rough_text(self.left_s)
        text = f"the disk of the recording has {size_text(free)} free: {left} at the present rate"
        level, code = (Level.WARN, LOW) if rises or self._level else (Level.INFO, ENOUGH)
        return Note(level, code, text, data={"free_bytes": free, "left_s": round(self.left_s, 1)})

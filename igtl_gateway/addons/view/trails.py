"""Trails: the way that a tool has come in the last seconds, as a line."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

NS_PER_MS = 1_000_000
#: The length of a trail in time, the time between its points, and the time between two drawings.
TRAIL_NS, STEP_NS, DRAW_NS = 5_000 * NS_PER_MS, 20 * NS_PER_MS, 100 * NS_PER_MS
_ROOM = 2 * (TRAIL_NS // STEP_NS + 1)


class Trail:
    """The latest positions of a tool."""

    def __init__(self) -> None:
        self._frame = ""
        self._drawn_ns = 0
        self._times: deque[int] = deque()
        self._places = np.empty((_ROOM, 3), np.float32)
        self._end = 0  # of the places

    def lines(self, frame: str, stamps: Array, places: Array) -> Iterator[tuple[int, Array]]:
        """Yield the lines to draw: the row that each is drawn at, and (k, 3) places in metres.

        Args:
            frame: of the places; in another frame a trail begins anew.
            stamps: (n,) gateway times, UTC ns, ascending.
            places: (n, 3) metres.
        """
        times = self._times
        if frame != self._frame:
            times.clear()
            self._frame = frame
        row = 0
        while row < len(stamps):
            if times and (next_ns := times[-1] + STEP_NS) > stamps[row]:
                row += int(stamps[row:].searchsorted(next_ns))
                continue
            now_ns = int(stamps[row])
            self._add(now_ns, places[row])
            if now_ns - self._drawn_ns >= DRAW_NS and len(times) > 1:
                self._drawn_ns = now_ns
                yield row, self._places[self._end - len(times) : self._end].copy()
            row += 1

    def _add(self, now_ns: int, place: Array) -> None:
        times = self._times
        times.append(now_ns)
        while now_ns - times[0] > TRAIL_NS:
            times.popleft()
        if self._end == _ROOM:
            kept = len(times) - 1
            self._places[:kept] = self._places[self._end - kept :]
            self._end = kept
        self._places[self._end] = place
        self._end += 1

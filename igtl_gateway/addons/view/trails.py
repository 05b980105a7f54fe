"""Trails: the way that a tool has come in the last seconds, as a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

NS_PER_MS = 1_000_000
#: The length of a trail in time, the time between its points, and the time between two drawings.
TRAIL_NS, STEP_NS, DRAW_NS = 5_000 * NS_PER_MS, 20 * NS_PER_MS, 100 * NS_PER_MS


class Trail:
    """The latest positions of a tool."""

    def __init__(self) -> None:
        self._frame = ""
        self._drawn_ns = 0
        self._stamps: Array = np.empty(0, np.int64)
        self._places: Array = np.empty((0, 3), np.float32)

    def lines(self, frame: str, stamps: Array, places: Array) -> tuple[list[int], list[Array]]:
        """Return the lines to draw: the rows that they are drawn at, and (k, 3) places in metres.

        Args:
            frame: of the places; in another frame a trail begins again.
            stamps: (n,) gateway times, UTC ns, ascending.
            places: (n, 3) metres.
        """
        if frame != self._frame:
            self._frame = frame
            self._stamps, self._places = self._stamps[:0], self._places[:0]
        kept = len(self._stamps)
        points = _apart(stamps, int(self._stamps[-1]) if kept else None, STEP_NS)
        if not points:
            return [], []
        known = np.concatenate((self._stamps, stamps[points]))
        way = np.concatenate((self._places, places[points].astype(np.float32)))
        begins = known.searchsorted(known - TRAIL_NS)
        long = np.flatnonzero(np.arange(len(known)) - begins > 0)
        long = long[long >= kept]
        drawn = long[_apart(known[long], self._drawn_ns, DRAW_NS)]
        if len(drawn):
            self._drawn_ns = int(known[drawn[-1]])
        self._stamps, self._places = known[begins[-1] :], way[begins[-1] :]
        rows = [points[each - kept] for each in drawn.tolist()]
        return rows, [way[begin : end + 1] for begin, end in zip(begins[drawn].tolist(), drawn.tolist(), strict=True)]


def _apart(stamps: Array, after_ns: int | None, least_ns: int) -> list[int]:
    """Return the first of some times (n,), ascending, after another one, and each next one, with this time between."""
    if len(stamps) == 1:
        return [0] if after_ns is None or stamps[0] - after_ns >= least_ns else []
    following = stamps.searchsorted(stamps + least_ns).tolist()
    row = 0 if after_ns is None else int(stamps.searchsorted(after_ns + least_ns))
    found = []
    while row < len(following):
        found.append(row)
        row = following[row]
    return found

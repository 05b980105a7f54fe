"""The offset between the clocks of two recorders, from the messages that cross between them.

A message of A cannot arrive at B before A sends it.  So the clock of B is ahead of that of A by at most the shortest
(received by B - sent by A), and by at least the longest (sent by B - received by A), as in NTP.  Both are bounds
whatever the delays are: asymmetric ones make the interval wide, not wrong.

The offset may drift: it is a line, at most 200 ppm steep.  All lines that keep every bound are a convex polygon in the
plane of (offset, slope), so the interval is that of the polygon.  A drift is part of the result only if no line without
slope keeps the bounds.  If no line keeps them at all, the clock was set or its rate changed: each piece
has a line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.writing import Method

Array = npt.NDArray[Any]

#: Two clocks of computers differ by no more than this, ns per s (200 ppm), unless one is set.
MOST_SKEW = 200_000.0
#: More pieces than this are no clock: some messages that look alike are not the same message.
MOST_PIECES = 64
#: Offsets below (13 days), and times that far from the start of a line (52 days), are exact as floating-point numbers.
_SMALL_NS, _EXACT_NS = 1 << 50, 1 << 52
_SIGNED_NS = 1 << 62
#: Stamps are whole nanoseconds.
_ROUNDING_NS = 1.0


@dataclass(frozen=True, slots=True)
class Piece:
    """A line: from ``start_ns`` on the offset is ``offset_ns`` plus ``slope`` ns for each second since then."""

    start_ns: int
    offset_ns: int
    slope: float = 0.0

    def at(self, time_ns: int) -> int:
        return self.offset_ns + round(self.slope * ((time_ns - self.start_ns) / NS_PER_S))


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How far a clock is ahead of another one, as a function of its own time.

    Attributes:
        method: how it is known.
        pieces: lines, in order of their start; the first one also applies before it.
        low_ns, high_ns: the offset is between the lines this much below and above (ns, not negative); infinite
            where nothing bounds it.
        low_ppm, high_ppm: interval of the drift; NaN if it is not measured.
        is_drifting: whether the data prove a drift.
    """

    method: Method
    pieces: tuple[Piece, ...]
    low_ns: float = 0.0
    high_ns: float = 0.0
    low_ppm: float = math.nan
    high_ppm: float = math.nan

    @property
    def is_drifting(self) -> bool:
        return any(piece.slope for piece in self.pieces)

    @property
    def error_ns(self) -> float:
        """Half of the width of the interval, ns."""
        return (self.low_ns + self.high_ns) / 2

    def at(self, time_ns: int) -> int:
        """The offset at a time of the clock itself, ns."""
        found = self.pieces[0]
        for piece in self.pieces[1:]:
            if piece.start_ns > time_ns:
                break
            found = piece
        return found.at(time_ns)

    def is_exact(self, low_ns: int, high_ns: int) -> bool:
        """Whether :meth:`of` is :meth:`at` for all times between these two: no difference of them is rounded."""
        starts = [piece.start_ns for piece in self.pieces[1:]]
        return starts == sorted(starts) and all(
            abs(piece.start_ns) < _SIGNED_NS
            and abs(piece.offset_ns) < _SMALL_NS
            and (
                not piece.slope
                or (
                    abs(piece.slope) < NS_PER_S
                    and piece.start_ns - _EXACT_NS < low_ns <= high_ns < piece.start_ns + _EXACT_NS
                )
            )
            for piece in self.pieces
        )

    def of(self, times_ns: Array) -> Array:
        """The offsets at times (N,) int64 of the clock itself, ns."""
        number = np.searchsorted([piece.start_ns for piece in self.pieces[1:]], times_ns, side="right")
        found = np.zeros(len(times_ns), np.int64)
        for index, piece in enumerate(self.pieces):
            here = number == index
            seconds = (times_ns[here] - piece.start_ns) / NS_PER_S
            found[here] = piece.offset_ns + np.rint(piece.slope * seconds).astype(np.int64)
        return found


class Contradiction(ValueError):
    """Bounds that no clock keeps."""


def measure_offset(there: tuple[Array, Array], back: tuple[Array, Array]) -> ClockOffset:
    """Return how far the clock of B is ahead of that of A.

    Args:
        there: messages from A to B: times when A sent and when B received each, (N,) int64 ns, each by its own clock.
        back: messages from B to A: times when B sent and when A received each.

    Raises:
        Contradiction: no clock fits, or there is no message.
    """
    times = np.concatenate([there[1], back[0]])
    values = np.concatenate([there[1] - there[0], back[0] - back[1]])
    upper = np.arange(len(times)) < len(there[0])
    if not len(times):
        raise Contradiction("found no message in either direction, expected one")
    if upper.all() or not upper.any():
        value = int(values.min() if upper.any() else values.max())
        bounds = (math.inf, 0.0) if upper.any() else (0.0, math.inf)
        return ClockOffset(Method.ONE_WAY, (Piece(int(times.min()), value),), *bounds)
    order = np.argsort(times, kind="stable")
    return _of_pieces(times[order], values[order], upper[order])


@dataclass(frozen=True, slots=True)
class _Lines:
    """All lines that keep some bounds: corners (N, 2) of the polygon of offset, ns, and slope, ns/s; its origin."""

    corners: Array
    start_ns: int
    base_ns: int

    def line(self) -> tuple[float, float]:
        """The line to use: without slope if one keeps the bounds, otherwise the centre of the polygon."""
        slopes = self.corners[:, 1]
        if slopes.min() <= 0 <= slopes.max():
            flat = self._at_slope_0()
            return (flat.min() + flat.max()) / 2, 0.0
        return tuple(_centre(self.corners).tolist())

    def _at_slope_0(self) -> Array:
        """Offsets of the lines without slope: where the edges of the polygon cross slope 0."""
        ends = np.roll(self.corners, -1, axis=0)
        found = [self.corners[self.corners[:, 1] == 0, 0]]
        crossing = self.corners[:, 1] * ends[:, 1] < 0
        one, two = self.corners[crossing], ends[crossing]
        found.append(one[:, 0] - one[:, 1] * (two[:, 0] - one[:, 0]) / (two[:, 1] - one[:, 1]))
        return np.concatenate(found)


def _of_pieces(times: Array, values: Array, upper: Array) -> ClockOffset:
    """The offset of bounds that are in order of time."""
    pieces: list[Piece] = []
    low = high = 0.0
    slopes: list[tuple[float, float]] = []
    begin = 0
    while begin < len(times):
        end, lines = _longest(times, values, upper, begin)
        begin_ns = int(times[begin])
        if upper[begin:end].all() or not upper[begin:end].any():
            # one direction only: as near to the piece before as the bounds permit
            before = pieces[-1].at(begin_ns) if pieces else 0
            bound = int(values[begin:end].min() if upper[begin] else values[begin:end].max())
            pieces.append(Piece(begin_ns, min(before, bound) if upper[begin] else max(before, bound)))
            low, high = (math.inf, high) if upper[begin] else (low, math.inf)
        else:
            offset, slope = lines.line()
            pieces.append(Piece(lines.start_ns, lines.base_ns + round(offset), slope))
            seconds = (times[[begin, end - 1]] - lines.start_ns) / NS_PER_S
            apart = lines.corners[:, :1] - offset + (lines.corners[:, 1:] - slope) * seconds
            low, high = max(low, float(-apart.min())), max(high, float(apart.max()))
            slopes.append((float(lines.corners[:, 1].min()), float(lines.corners[:, 1].max())))
        if len(pieces) > MOST_PIECES:
            raise Contradiction(
                f"found messages that arrive before they are sent by any clock, in more than {MOST_PIECES} places"
            )
        begin = end
    low_ppm, high_ppm = (1e-3 * slopes[0][0], 1e-3 * slopes[0][1]) if len(pieces) == 1 else (math.nan, math.nan)
    return ClockOffset(Method.BOTH_WAYS, tuple(pieces), low, high, low_ppm, high_ppm)


def _longest(times: Array, values: Array, upper: Array, begin: int) -> tuple[int, _Lines]:
    """The end of the longest run of bounds from ``begin`` on that a line keeps, and the lines."""
    lines = _lines(times[begin:], values[begin:], upper[begin:])
    if lines is not None:
        return len(times), lines
    good, bad = begin, len(times)
    found: _Lines | None = None
    while bad - good > 1:
        middle = (good + bad) // 2
        lines = _lines(times[begin:middle], values[begin:middle], upper[begin:middle])
        if lines is None:
            bad = middle
        else:
            good, found = middle, lines
    if found is None:
        raise Contradiction("found two messages that contradict each other at the same moment")
    return good, found


def _lines(times: Array, values: Array, upper: Array) -> _Lines | None:
    """The lines that keep all bounds; None without any."""
    start_ns, base_ns = int(times[0]), int(np.median(values))
    seconds = (times - start_ns) / NS_PER_S
    offsets = (values - base_ns).astype(np.float64)
    room = float(np.ptp(offsets)) + MOST_SKEW * float(seconds[-1]) + NS_PER_S
    corners = [(-room, -MOST_SKEW), (room, -MOST_SKEW), (room, MOST_SKEW), (-room, MOST_SKEW)]
    for sign, some in ((1.0, upper), (-1.0, ~upper)):
        # a line below the lower hull of the upper bounds is below them all
        for x, y in _hull(seconds[some], sign * offsets[some]):
            corners = _cut(corners, x, y + _ROUNDING_NS / 2, sign)
            if not corners:
                return None
    return _Lines(np.array(corners), start_ns, base_ns)


def _hull(xs: Array, ys: Array) -> list[tuple[float, float]]:
    """The lower convex hull of points in order of x."""
    hull: list[tuple[float, float]] = []
    for x, y in zip(xs.tolist(), ys.tolist(), strict=True):
        if hull and hull[-1][0] == x:
            if hull[-1][1] <= y:
                continue
            hull.pop()
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def _cut(corners: Sequence[tuple[float, float]], x: float, y: float, sign: float) -> list[tuple[float, float]]:
    """The part of a polygon where sign * (offset + slope * x) is at most y."""
    kept: list[tuple[float, float]] = []
    over = [sign * (offset + slope * x) - y for offset, slope in corners]
    for index, here in enumerate(corners):
        there = corners[index - 1]
        one, two = over[index - 1], over[index]
        if (one > 0) != (two > 0):
            part = one / (one - two)
            kept.append((there[0] + part * (here[0] - there[0]), there[1] + part * (here[1] - there[1])))
        if two <= 0:
            kept.append(here)
    return kept


def _centre(corners: Array) -> Array:
    """The centre of gravity of a convex polygon; of its corners if it is a line."""
    origin = corners[0]
    one, two = corners[1:-1] - origin, corners[2:] - origin
    areas = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    if len(corners) < 3 or not abs(areas.sum()) > 0:
        return np.asarray(corners.mean(axis=0))
    return np.asarray(origin + (areas[:, np.newaxis] * (one + two)).sum(axis=0) / (3 * areas.sum()))

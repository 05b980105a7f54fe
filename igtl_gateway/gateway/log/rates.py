"""Rates over the last seconds, from counts that are read now and then."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from igtl_gateway.base.stamp import NS_PER_S

#: Time over which rates are averaged, in seconds.
RATES_OVER_S = 5.0

#: Direction → stream → messages so far.
Totals = Mapping[str, Mapping[str, int]]


class Rates:
    """Messages per second, with a memory of the counts before."""

    def __init__(self) -> None:
        self._past: deque[tuple[int, Totals]] = deque()

    def take(self, now_ns: int, totals: Totals) -> tuple[float, dict[str, dict[str, float]]]:
        """Take the counts of a moment (monotonic ns); return the averaging time in seconds, and the rates."""
        past = self._past
        past.append((now_ns, totals))
        while len(past) > 2 and now_ns - past[1][0] >= RATES_OVER_S * NS_PER_S:  # keep one sample of at least that age
            past.popleft()
        then_ns, before = past[0]
        seconds = (now_ns - then_ns) / NS_PER_S
        rates = {
            direction: _rates(streams, before.get(direction, {}), seconds) for direction, streams in totals.items()
        }
        return seconds, rates


def _rates(streams: Mapping[str, int], before: Mapping[str, int], seconds: float) -> dict[str, float]:
    if not seconds:
        return dict.fromkeys(streams, 0.0)
    return {stream: round((total - before.get(stream, 0)) / seconds, 3) for stream, total in streams.items()}

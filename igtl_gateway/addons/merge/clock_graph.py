"""The clocks of several recorders relative to that of one: the offsets between pairs, joined on the best way."""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.writing import Method
from igtl_gateway.addons.merge.offsets import ClockOffset

Array = npt.NDArray[Any]

#: The same numbers with a sign, and room to add others.
_SIGNED_NS = 1 << 62
#: A bound costs more than any way by intervals.
_UNBOUNDED_NS = 1e15


@dataclass(frozen=True, slots=True)
class Clock:
    """The clock of a part, relative to that of the reference.

    Attributes:
        chain: offsets; the first one is that of the clock itself, each further one that of the clock that the one
            before leads to, and the last one leads to the reference.
        via: names of the parts that they lead to, without the reference.
    """

    chain: tuple[ClockOffset, ...] = ()
    via: tuple[str, ...] = ()

    def to_reference(self, time_ns: int) -> int:
        """A time of this clock, by the clock of the reference, UTC ns."""
        for offset in self.chain:
            time_ns -= offset.at(time_ns)
        return time_ns

    def all_to_reference(self, times_ns: Array) -> Array:
        """Times (N,) int64 of this clock, by the clock of the reference."""
        for offset in self.chain:
            times_ns = times_ns - offset.of(times_ns)
        return times_ns

    def exactly_to_reference(self, times_ns: Array) -> Array:
        """Times (N,) uint64 of this clock as :meth:`to_reference`, to the nanosecond; int64, or Python numbers."""
        low_ns, high_ns = int(times_ns.min()), int(times_ns.max())
        if high_ns < _SIGNED_NS and all(offset.is_exact(low_ns, high_ns) for offset in self.chain):
            return self.all_to_reference(times_ns.astype(np.int64))
        return np.array([self.to_reference(time_ns) for time_ns in times_ns.tolist()], object)

    @property
    def interval_ns(self) -> tuple[float, float]:
        """How far the true offset may be below and above the stated one, ns."""
        return sum(offset.low_ns for offset in self.chain), sum(offset.high_ns for offset in self.chain)

    @property
    def method(self) -> Method:
        """How the offset is known: by the weakest of the chain."""
        return max((offset.method for offset in self.chain), key=list(Method).index, default=Method.REFERENCE)

    @property
    def cost(self) -> float:
        """What a better way has less of."""
        return sum(min(offset.low_ns + offset.high_ns, _UNBOUNDED_NS) + 1 for offset in self.chain)

    def facts(self, middle_ns: int) -> dict[str, Any]:
        """The offset in the middle of the session, its interval and its method, as JSON values."""
        offset_ns = middle_ns - self.to_reference(middle_ns)
        low_ns, high_ns = self.interval_ns
        only = self.chain[0] if len(self.chain) == 1 else None
        return {
            "offset_s": offset_ns / NS_PER_S,
            "low_s": _finite((offset_ns - low_ns) / NS_PER_S),
            "high_s": _finite((offset_ns + high_ns) / NS_PER_S),
            "method": self.method.name.lower(),
            "via": list(self.via),
            "drift_ppm": only.pieces[0].slope / 1e3 if only and len(only.pieces) == 1 else None,
            "drift_low_ppm": _finite(only.low_ppm) if only else None,
            "drift_high_ppm": _finite(only.high_ppm) if only else None,
            "is_drifting": any(offset.is_drifting for offset in self.chain),
            "chain": [
                [[piece.start_ns, piece.offset_ns, piece.slope] for piece in offset.pieces] for offset in self.chain
            ],
        }


def _finite(value: float) -> float | None:
    """JSON has no NaN and no infinity: null."""
    return value if math.isfinite(value) else None


def clocks_of(names: Sequence[str], edges: Mapping[tuple[str, str], Clock]) -> dict[str, Clock]:
    """Return name → clock for all that are joined to the first name: on the way with the narrowest interval.

    Args:
        names: of the parts; the first one is the reference.
        edges: (name, other name) → clock of the first relative to that of the other.
    """
    found: dict[str, Clock] = {}
    waiting: list[tuple[float, int, str, Clock]] = [(0.0, 0, names[0], Clock())]
    while waiting:
        _, _, name, clock = heapq.heappop(waiting)
        if name in found:
            continue
        found[name] = clock
        for (one, two), edge in edges.items():
            if two == name and one not in found:
                via = (*edge.via, *([name] if name != names[0] else []), *clock.via)
                joined = Clock((*edge.chain, *clock.chain), via)
                heapq.heappush(waiting, (joined.cost, names.index(one), one, joined))
    return found


def latency_facts(times_ns: Array) -> dict[str, Any]:
    """Number, minimum, median and 99th percentile of latencies (N,) in ns, as JSON values in ms."""
    low, middle, high = np.quantile(times_ns, [0, 0.5, 0.99], method="higher").tolist() if len(times_ns) else [None] * 3
    return {
        "messages": len(times_ns),
        **{
            key: None if value is None else value / 1e6
            for key, value in (("min_ms", low), ("p50_ms", middle), ("p99_ms", high))
        },
    }

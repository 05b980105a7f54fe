"""Gaps in a series: pauses that are far longer than those before them, over which a plot draws no line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S

#: A gap is longer than this, and than this many mean pauses of at least this number.
_LEAST_NS, _MEANS, _ENOUGH = NS_PER_S // 2, 5, 3


class Rhythm:
    """The pauses of a series so far, without its gaps."""

    def __init__(self) -> None:
        self._last_ns = self._total_ns = self._count = 0

    def gaps(self, stamps: npt.NDArray[Any]) -> list[int]:
        """Return which of the next values (n,), at gateway times in UTC ns, ascending, come after a gap."""
        begins = not self._last_ns
        pauses = np.diff(stamps, prepend=stamps[0] if begins else self._last_ns)
        sums = np.cumsum(pauses)
        found: list[int] = []
        left_ns = 0  # what gaps have of the sum
        for at in np.flatnonzero(pauses > _LEAST_NS).tolist():
            count = self._count + at - begins - len(found)
            before_ns = self._total_ns + int(sums[at] - pauses[at]) - left_ns
            if count >= _ENOUGH and int(pauses[at]) * count > _MEANS * before_ns:
                found.append(at)
                left_ns += int(pauses[at])
        self._total_ns += int(sums[-1]) - left_ns
        self._count += len(stamps) - begins - len(found)
        self._last_ns = int(stamps[-1])
        return found

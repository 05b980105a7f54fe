"""Which messages of a stream belong to a moment: the one rule by which two streams are joined.

Every reader that pairs streams asks `pick`: Python's ``align`` and ``tf.lookup``, tracked sequences, LeRobot, review.
`gateway.log.one_clock` gives the times, so that both streams have one clock.  A moment without a sample that is near
enough has none: it is INVALID, NaN or left out, never the pose of another moment.
``docs/reference/which-moment.md`` has the table of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Rule = Literal["nearest", "interpolate", "hold"]

#: Largest distance of a sample that stands for a moment, unless the user states another one: 10 mm at 100 mm/s.
NEAR_NS = 100_000_000
#: So near, a sample stands for a moment without another one on the other side: stamps that were rounded differ by less.
END_NS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Picks:
    """The samples of a stream for N moments.

    Attributes:
        before, after: (N,) indices of samples; they differ only between two samples.
        share: (N,) float64, part of the way from ``before`` to ``after``.
        good: (N,) whether there is a sample that is near enough; the other columns mean nothing where there is none.
    """

    before: Times
    after: Times
    share: npt.NDArray[np.float64]
    good: Flags


def pick(
    times: Times,
    wanted: Times,
    rule: Rule,
    *,
    most_ns: int | None = None,
    gap_ns: int | None = None,
    segments: Array | None = None,
    end_ns: int = 0,
) -> Picks:
    """Return the samples that belong to moments.

    Args:
        times: (M,) int64, of the samples, ascending, ns.
        wanted: (N,) int64, the moments, ns of the same clock.
        rule: ``nearest``: the nearest sample, the earlier one of two; ``hold``: the last one at or before the moment;
            ``interpolate``: the sample of the moment itself, or the two around it; never extrapolated.
        most_ns: largest distance between a moment and each of its samples; None: any.
        gap_ns: for ``interpolate``: largest time between the two samples; None: any.
        segments: (M,) for ``interpolate``: there is nothing between samples with different values.
        end_ns: for ``interpolate``: the first and the last sample also stand for moments this near outside of them.
    """
    count = len(times)
    if not count:
        nobody = np.zeros(len(wanted), np.int64)
        return Picks(nobody, nobody, np.zeros(len(wanted)), np.zeros(len(wanted), np.bool_))
    left = np.searchsorted(times, wanted, side="left")
    inside = np.minimum(left, count - 1)
    exact = (left < count) & (times[inside] == wanted)
    if rule == "hold":
        before = np.searchsorted(times, wanted, side="right") - 1
        chosen = np.maximum(before, 0)
        return _single(chosen, wanted - times[chosen], most_ns, before >= 0)
    before = np.where(exact, inside, np.maximum(left - 1, 0))
    # as integers: float64 does not hold nanoseconds of today
    back, ahead = np.abs(wanted - times[before]), np.abs(times[inside] - wanted)
    if rule == "nearest":
        chosen = np.where(back <= ahead, before, inside)
        return _single(chosen, np.minimum(back, ahead), most_ns, np.ones(len(wanted), np.bool_))
    good = (wanted >= times[0]) & (wanted <= times[-1])
    gap = times[inside] - times[before]
    between = np.ones(len(wanted), np.bool_)
    if most_ns is not None:
        between &= np.maximum(back, ahead) <= most_ns
    if gap_ns is not None:
        between &= gap <= gap_ns
    if segments is not None:
        between &= segments[before] == segments[inside]
    good &= exact | between
    if end_ns:
        # both are the sample at the end
        good |= (np.minimum(back, ahead) <= end_ns) & ((wanted < times[0]) | (wanted > times[-1]))
    share = np.where(gap > 0, (wanted - times[before]) / np.maximum(gap, 1), 0.0)
    return Picks(before, inside, share, good)


def _single(chosen: Times, away: Times, most_ns: int | None, good: Flags) -> Picks:
    """One sample for each moment, at a distance (N,) from it."""
    return Picks(chosen, chosen, np.zeros(len(chosen)), good if most_ns is None else good & (away <= most_ns))

"""The rules of sampling: which samples a moment has, and during which times a stream has any."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.streams import pick as pick_rows
from igtl_gateway.addons.lerobot.samples import Samples

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

_NEVER = (1 << 63) - 1


@dataclass(frozen=True, slots=True, eq=False)
class Picks:
    """The samples of a stream for N moments.

    Attributes:
        before, after: (N,) indices of samples; they differ only for interpolation, and for the rule ``none``: there,
            those of the first and the last string of the moment, with ``after`` below ``before`` if it has none.
        share: (N,) float64, part of the way from ``before`` to ``after``.
        held: (N,) bool, whether the sample is older than the tolerance, by ``fill = "hold"``.
    """

    before: Times
    after: Times
    share: npt.NDArray[np.float64]
    held: npt.NDArray[np.bool_]

    @property
    def empty(self) -> npt.NDArray[np.bool_]:
        """(N,) bool, whether a moment has no sample, by the rule ``none``."""
        return self.after < self.before

    def part(self, first: int, end: int) -> Picks:
        """Return those of the moments from ``first`` up to ``end``, not included."""
        chosen = slice(first, end)
        return Picks(self.before[chosen], self.after[chosen], self.share[chosen], self.held[chosen])


def moments(start_ns: int, count: int, fps: int) -> Times:
    """Return the times of ``count`` frames: ``start_ns`` + i / fps, rounded to nanoseconds."""
    return start_ns + (np.arange(count, dtype=np.int64) * NS_PER_S + fps // 2) // fps


def frame_count(start_ns: int, end_ns: int, fps: int) -> int:
    """Return the number of frames from ``start_ns`` up to ``end_ns``, both included."""
    if end_ns < start_ns:
        return 0
    count = ((end_ns - start_ns) * fps) // NS_PER_S + 1
    # the last moment is rounded up by less than a nanosecond
    return count - int(start_ns + ((count - 1) * NS_PER_S + fps // 2) // fps > end_ns)


def tolerance_ns(samples: Samples) -> int:
    """Return the tolerance of the row in ns; 2^63 − 1 for any."""
    tolerance_ms = samples.row.tolerance_ms
    return _NEVER if tolerance_ms is None else round(tolerance_ms * 1e6)


def coverage(samples: Samples) -> list[tuple[int, int]]:
    """Return the times (ns, both included) during which the rule gives a value.

    Between the samples of ``nearest`` and ``interpolate``, unless they are further apart than the rule allows; after a
    sample of ``hold``, until it is too old; always for ``none``.
    """
    times, rule, most = samples.times, samples.row.rule, tolerance_ns(samples)
    if rule == "none":
        return [(-_NEVER, _NEVER)]
    if rule == "hold":
        # the last sample is valid for its tolerance; without one, as long as the other streams are
        return _runs(times, _NEVER if samples.row.fill == "hold" else most, most)
    if samples.row.fill == "hold":
        return _runs(times, _NEVER, 0)
    return _runs(times, min(2 * most, _NEVER) if rule == "nearest" else most, 0)


def _runs(times: Times, most: int, beyond: int) -> list[tuple[int, int]]:
    """Runs of times at most ``most`` apart, prolonged by ``beyond``."""
    cuts = np.flatnonzero(np.diff(times) > most)
    starts, ends = times[np.concatenate([[0], cuts + 1])], times[np.concatenate([cuts, [len(times) - 1]])]
    return [(int(start), min(int(end) + beyond, _NEVER)) for start, end in zip(starts, ends, strict=True)]


def common(one: list[tuple[int, int]], two: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the intersection of two lists of intervals, both sorted."""
    found, here, there = [], 0, 0
    while here < len(one) and there < len(two):
        start, end = max(one[here][0], two[there][0]), min(one[here][1], two[there][1])
        if start <= end:
            found.append((start, end))
        if one[here][1] < two[there][1]:
            here += 1
        else:
            there += 1
    return found


def pick(samples: Samples, wanted: Times, fps: int) -> Picks:
    """Return the samples for the moments of an episode, inside of the coverage, which are 1 / fps apart."""
    rule, most = samples.row.rule, tolerance_ns(samples)
    if rule == "none":
        return _own(samples.times, wanted, fps)
    last = pick_rows(samples.times, wanted, "hold").before
    if rule == "hold":
        found = pick_rows(samples.times, wanted, "hold", most_ns=most)
    elif rule == "nearest":
        found = pick_rows(samples.times, wanted, "nearest", most_ns=most)
    else:
        found = pick_rows(samples.times, wanted, "interpolate", gap_ns=most)
    # beyond the tolerance the last sample is held, which only ``fill = "hold"`` allows
    good, held = found.good, ~found.good
    share = np.where(good, found.share, 0.0)
    before = np.where(good, found.before, last)
    return Picks(before, np.where(share > 0, found.after, before), share, held)


def _own(times: Times, wanted: Times, fps: int) -> Picks:
    """The samples nearer to a moment than to any other one; the earlier moment of two has what is in the middle."""
    half = NS_PER_S // (2 * fps)
    between = wanted[:-1] + np.diff(wanted) // 2
    edges = np.concatenate([[wanted[0] - half - 1], between, [wanted[-1] + half]])
    ends = np.searchsorted(times, edges, side="right")
    # without a sample in it, ``before`` still is an index
    before = np.minimum(ends[:-1], len(times) - 1)
    after = np.where(ends[1:] > ends[:-1], ends[1:], before) - 1
    return Picks(before, after, np.zeros(len(wanted)), np.zeros(len(wanted), np.bool_))

"""The rules of sampling: which samples a moment has, and during which times a stream has any."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.lerobot.samples import Samples

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

_NEVER = (1 << 63) - 1


@dataclass(frozen=True, slots=True, eq=False)
class Picks:
    """The samples of a stream for N moments.

    Attributes:
        before, after: (N,) indices of samples; they differ only for interpolation.
        share: (N,) float64, part of the way from ``before`` to ``after``.
        held: (N,) bool, whether the sample is older than the tolerance, by ``fill = "hold"``.
    """

    before: Times
    after: Times
    share: npt.NDArray[np.float64]
    held: npt.NDArray[np.bool_]


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
    sample of ``hold``, until it is too old.
    """
    times, rule, most = samples.times, samples.row.rule, tolerance_ns(samples)
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


def pick(samples: Samples, wanted: Times) -> Picks:
    """Return the samples for moments inside of the coverage."""
    times, rule, most = samples.times, samples.row.rule, tolerance_ns(samples)
    count = len(times)
    at = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, count - 1)
    following = np.clip(at + 1, 0, count - 1)
    back, ahead = wanted - times[at], times[following] - wanted
    nobody = np.zeros(len(wanted), np.bool_)
    none = np.zeros(len(wanted))
    if rule == "hold":
        return Picks(at, at, none, back > most)
    if rule == "nearest":
        # the earlier one of two; past the end there is no later one
        chosen = np.where((ahead < back) & (following > at), following, at)
        held = (np.minimum(back, np.where(following > at, ahead, back)) > most) if most < _NEVER else nobody
        chosen = np.where(held, at, chosen)
        return Picks(chosen, chosen, none, held)
    gap = times[following] - times[at]
    held = (gap > most) & (back > 0)
    share = np.where((gap > 0) & ~held, back / np.maximum(gap, 1), 0.0)
    after = np.where(share > 0, following, at)
    return Picks(at, after, share, held)

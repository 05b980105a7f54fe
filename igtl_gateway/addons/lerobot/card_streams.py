"""What the card states about each stream: rate, jitter, gaps, use in the frames, lag."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from igtl_gateway.addon import NS_PER_MS, NS_PER_S, GatewayError
from igtl_gateway.addon.reading import Recording
from igtl_gateway.addons.lerobot.frames import Plan
from igtl_gateway.addons.lerobot.resampling import coverage
from igtl_gateway.addons.lerobot.samples import Samples, signal_of, stamps_of
from igtl_gateway.addons.sync.lag import Lag, measure_lag
from igtl_gateway.addons.sync.signal import Signal


@dataclass(frozen=True, slots=True)
class Facts:
    """A row of the recipe and its stream.

    Attributes:
        index: of the row.
        samples: its samples.
        rate_hz: samples per second, from the median interval; 0 for one sample.
        jitter_ms: standard deviation of the intervals, without gaps.
        largest_ms: largest interval.
        gaps: intervals above three median ones.
        cuts, missing_s: times without a value by the rule between the first and the last sample, and their sum.
        used: samples that are in a frame.
        within: samples from the first to the last frame of an episode.
        interpolated, held: frames between two samples, and frames with a sample older than the tolerance.
        median_ms, furthest_ms: distance in time between the frames and their samples; of two samples the further one.
        lag: measured lag behind the first stream, or why there is none; ``""`` for the first one.
    """

    index: int
    samples: Samples
    rate_hz: float
    jitter_ms: float
    largest_ms: float
    gaps: int
    cuts: int
    missing_s: float
    used: int
    within: int
    interpolated: int
    held: int
    median_ms: float
    furthest_ms: float
    lag: Lag | str


def stream_facts(recording: Recording, plan: Plan) -> list[Facts]:
    """Return what is known about the stream of each row of the recipe."""
    rows = [(index, each) for index, each in enumerate(plan.samples) if each is not None]
    return [
        _facts(plan, index, samples, lag)
        for (index, samples), lag in zip(rows, _lags(recording, plan, rows), strict=True)
    ]


def _facts(plan: Plan, index: int, samples: Samples, lag: Lag | str) -> Facts:
    steps = np.diff(samples.times)
    middle = float(np.median(steps)) if len(steps) else 0.0
    usual = steps[steps <= 3 * middle]
    used = np.zeros(len(samples.times), np.bool_)
    offsets, within, interpolated, held = [np.zeros(0, np.int64)], 0, 0, 0
    for episode in plan.episodes:
        picks = episode.picks[index]
        if picks is None:
            continue
        if samples.row.rule == "none":  # the first one of a moment, and those up to the last one
            used[np.concatenate([np.arange(*each) for each in zip(picks.before, picks.after + 1, strict=True)])] = True
        else:
            used[picks.before] = used[picks.after] = True
        own, at = picks.part(0, episode.count), episode.times
        interpolated += int(np.sum(own.share > 0))
        held += int(np.sum(own.held))
        within += int(np.searchsorted(samples.times, at[-1], "right") - np.searchsorted(samples.times, at[0]))
        away = np.maximum(abs(samples.times[own.before] - at), abs(samples.times[own.after] - at))
        offsets.append(away[~own.empty])
    away = np.concatenate(offsets) / NS_PER_MS
    covered = coverage(samples)
    missing = [start - end for (_, end), (start, _) in pairwise(covered)]
    return Facts(
        index, samples, NS_PER_S / middle if middle else 0.0,
        float(usual.std()) / NS_PER_MS if len(usual) else 0.0,
        float(steps.max()) / NS_PER_MS if len(steps) else 0.0, int(np.sum(steps > 3 * middle)),
        len(missing), sum(missing) / NS_PER_S,
        int(used.sum()), within, interpolated, held, float(np.median(away)) if len(away) else 0.0,
        float(away.max(initial=0.0)), lag,
    )  # fmt: skip


def _lags(recording: Recording, plan: Plan, rows: list[tuple[int, Samples]]) -> list[Lag | str]:
    """The lag of each stream behind the first one, with the recorded stamps."""
    if not plan.recipe.measure_lags:
        return ["not measured: measure_lags = false"] * len(rows)
    found: list[Lag | str] = []
    known: dict[tuple[str, str], Lag | str] = {}
    fixed: Signal | None = None
    first = rows[0][1].row
    for _, samples in rows:
        key = (samples.row.stream, samples.row.frame)
        if key == (first.stream, first.frame):
            found.append("")
            continue
        if key not in known:
            try:
                fixed = fixed or _signal(recording, plan, rows[0][1])
                known[key] = measure_lag(fixed, _signal(recording, plan, samples))
            except GatewayError as error:
                known[key] = f"not measured: {error}"
        found.append(known[key])
    return found


def _signal(recording: Recording, plan: Plan, samples: Samples) -> Signal:
    stream = recording[samples.row.stream]
    return signal_of(stream, stamps_of(stream, samples.row, plan.joined), samples.row.frame, samples.pictures)

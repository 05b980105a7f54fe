"""Trajectories of an instrument, as in SurgPose: the kinematics and what a video shows of them, with one lag.

The jaw opens and closes with a period, the insertion does not repeat itself.  The clocks of video and kinematics differ
by a constant of up to 2.4 s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from igtl_gateway.addons.sync.signal import Floats, Signal
from tests.addons.sync.worlds import stamps

COUNT = 68
Random = np.random.Generator
Movement = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Trajectory:
    """Two pairs of signals with one lag.

    Attributes:
        jaw, insertion: (kinematics, video) of each.
        lag_s: how late the stamps of the video are.
        frame_s: time between two frames of the video.
        period_s: of the jaw.
    """

    jaw: tuple[Signal, Signal]
    insertion: tuple[Signal, Signal]
    lag_s: float
    frame_s: float
    period_s: float


def trajectory(number: int, seed: int = 0) -> Trajectory:
    """Return one of the trajectories; 4 of 68 have no lag, as in SurgPose."""
    random = np.random.default_rng([seed, number])
    seconds = float(random.uniform(25, 70))
    lag_s = 0.0 if number % 17 == 0 else float(random.uniform(0.02, 2.4) * random.choice([-1, 1]))
    frame_s = 1 / float(random.choice([24, 25, 29.97, 30, 60]))
    period_s = float(random.uniform(0.7, 3.5))
    jaw = _jaw(random, seconds, period_s)
    insertion = _insertion(random, seconds)
    robot = np.arange(-3, seconds + 3, 1 / float(random.choice([30, 50, 100, 200])))
    robot = robot + random.normal(0, 0.0005, len(robot))
    video = np.arange(0, seconds, frame_s)
    kept = random.random(len(video)) >= float(random.choice([0, 0.02, 0.15]))
    if random.random() < 0.3:
        gap = random.uniform(0, seconds - 1)
        kept &= ~((video > gap) & (video < gap + random.uniform(0.2, 1)))
    video = video[kept]
    seen = stamps(video + lag_s + random.normal(0, 0.002, len(video)))
    known = stamps(robot)
    scale = random.uniform(0.2, 3, 2) * random.choice([-1, 1], 2)
    depth = insertion(video) / (1 + 0.3 * insertion(video) / np.ptp(insertion(video)))  # perspective
    opening = jaw(video) * (1 + 0.1 * depth / np.std(depth))
    return Trajectory(
        (
            Signal.of(known, _noisy(random, jaw(robot), 0.005), "/psm/jaw"),
            Signal.of(seen, scale[0] * _tracked(random, opening, float(random.uniform(0.05, 0.5))), "/video/jaw"),
        ),
        (
            Signal.of(known, _noisy(random, insertion(robot), 0.005), "/psm/insertion"),
            Signal.of(seen, scale[1] * _tracked(random, depth, float(random.uniform(0.05, 0.8))), "/video/insertion"),
        ),
        lag_s,
        frame_s,
        period_s,
    )


def staircase(number: int, *, is_related: bool = True) -> tuple[list[tuple[Signal, Signal]], float, float]:
    """Return two pairs, the lag and the time of a frame: a jaw, and an insertion in steps that sum up, or go one way.

    Without ``is_related``, the video shows another insertion than that of the kinematics.
    """
    random = np.random.default_rng([77, number])
    seconds, lag_s, period_s = (float(random.uniform(*span)) for span in ((25, 60), (-2.4, 2.4), (0.6, 2.5)))
    jaw = _jaw(random, seconds, period_s)
    insertions = [_steps(random, seconds, one_way=number % 2 == 0) for _ in range(2)]
    robot, video = np.arange(-3, seconds + 3, 1 / 100), np.arange(0, seconds, 1 / 30)
    known, seen = stamps(robot), stamps(video + lag_s + random.normal(0, 0.002, len(video)))
    pairs = [
        (
            Signal.of(known, here(robot) + random.normal(0, 0.01, len(robot)), "/psm"),
            Signal.of(seen, -there(video) + random.normal(0, float(random.uniform(0.02, 0.3)), len(video)), "/video"),
        )
        for here, there in ((jaw, jaw), (insertions[0], insertions[not is_related]))
    ]
    return pairs, lag_s, 1 / 30


def strokes(random: Random, time: Floats) -> Floats:
    """Two insertions within 40 s: in, a pause, and out."""
    at = np.zeros(len(time))
    for begin in random.uniform(0, 36, 2):
        at += np.interp(time, begin + np.cumsum([0, *random.uniform(0.5, 2, 3)]), [0, 1, 1, 0])
    return np.asarray(at + random.normal(0, 0.02, len(time)))


def _steps(random: Random, seconds: float, *, one_way: bool) -> Movement:
    """Movements from place to place, with pauses."""
    begins = np.cumsum(random.uniform(0.5, 3, 200)) - 6
    sizes = random.normal(size=200)
    lasts = random.uniform(0.4, 3, 200)

    def at(time: Floats) -> Floats:
        part = np.clip((time[:, np.newaxis] - begins) / lasts, 0, 1)
        return np.asarray((part**3 * (10 - 15 * part + 6 * part**2)) @ (np.abs(sizes) if one_way else sizes))

    return at


def _tracked(random: Random, values: Floats, size: float) -> Floats:
    """What a tracker in a video makes of a movement: its errors last for some frames, and some are large."""
    errors = random.normal(0, 1, (2, len(values)))
    slow = np.convolve(errors[0], np.exp(-np.arange(30) / float(random.uniform(1, 10))), "same")
    errors[1, random.random(len(values)) < 0.005] *= 8
    share = float(random.uniform(0, 1))
    mixed = np.sqrt(share) * slow / np.std(slow) + np.sqrt(1 - share) * errors[1]
    return np.asarray(values + size * float(np.std(values)) * mixed)


def _noisy(random: Random, values: Floats, size: float) -> Floats:
    return np.asarray(values + random.normal(0, size * float(np.std(values)), values.shape))


def _jaw(random: Random, seconds: float, period_s: float) -> Movement:
    """Open and close: a sine, one with pauses, or a trapezoid; the cycles are equal within a few per cent."""
    shape = int(random.integers(3))
    wander = float(random.choice([0, 0.01, 0.05])) * period_s
    begins = np.arange(-5, seconds + 5, period_s)
    sizes = 1 + random.normal(0, float(random.choice([0, 0.05, 0.15])), len(begins))
    shifts = random.normal(0, wander, len(begins))

    def at(time: Floats) -> Floats:
        phase = 2 * np.pi * (time - np.interp(time, begins, shifts)) / period_s
        wave = (np.cos(phase), np.maximum(np.cos(phase), -0.3), np.clip(2 * np.cos(phase), -1, 1))[shape]
        return np.asarray(wave * np.interp(time, begins, sizes))

    return at


def _insertion(random: Random, seconds: float) -> Movement:
    """Reaches of different lengths, a sum of waves without a common period, or a walk."""
    shape = int(random.integers(3))
    if shape == 0:
        begins = np.cumsum(random.uniform(1.5, 4, 60)) - 6
        places = random.uniform(-1, 1, 61)
        lasts = random.uniform(0.6, 1.5, 60)

        def reaches(time: Floats) -> Floats:
            part = np.clip((time[:, np.newaxis] - begins) / lasts, 0, 1)
            return np.asarray((part**3 * (10 - 15 * part + 6 * part**2)) @ np.diff(places))

        return reaches
    if shape == 1:
        frequencies, phases = random.uniform(0.05, 0.6, 10), random.uniform(0, 2 * np.pi, 10)
        sizes = random.normal(size=10) / (1 + 2 * frequencies)
        return lambda time: np.asarray(np.sin(2 * np.pi * time[:, np.newaxis] * frequencies + phases) @ sizes)
    knots = np.arange(-6, seconds + 6, float(random.uniform(0.8, 1.6)))
    heights = random.normal(size=len(knots))
    width = float(np.diff(knots[:2])[0])
    return lambda time: np.asarray(np.exp(-0.5 * ((time[:, np.newaxis] - knots) / width) ** 2) @ heights)

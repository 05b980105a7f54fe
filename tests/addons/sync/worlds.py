"""Movements with a known lag, seen by two streams."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.sync.signal import Floats, Signal
from igtl_gateway.base.stamp import NS_PER_S
from tests.plus_sequences import water_tank

BEGIN_NS = 1_700_000_000 * NS_PER_S


def stamps(seconds: Floats) -> npt.NDArray[np.int64]:
    """Stamps of times after the begin."""
    return (seconds * NS_PER_S).round().astype(np.int64) + BEGIN_NS


@dataclass(frozen=True)
class World:
    """Two streams of one movement.

    Attributes:
        fixed, moving: the signals.
        seconds, lag_s, skew, noise: duration, lag in the middle of it, skew, noise relative to the movement.
    """

    fixed: Signal
    moving: Signal
    seconds: float
    lag_s: float
    skew: float
    noise: float

    def lag_at(self, time_ns: int) -> float:
        """Return the true lag at a time of the fixed stream."""
        return self.lag_s + self.skew * ((time_ns - BEGIN_NS) / NS_PER_S - self.seconds / 2)


def irregular(random: np.random.Generator, seconds: float, rate_hz: float, count: int, band_hz: float) -> Signal:
    """Return a movement of some components below a frequency, with 1 % of noise."""
    at = np.arange(0, seconds, 1 / rate_hz)
    frequencies, phases = random.uniform(0.05, band_hz, (count, 12)), random.uniform(0, 2 * np.pi, (count, 12))
    sizes = random.normal(size=(count, 12)) / (1 + 1.5 * frequencies)
    waves = np.sin(2 * np.pi * frequencies[:, :, None] * at + phases[:, :, None])
    values = np.sum(sizes[:, :, None] * waves, axis=1).T
    return Signal.of(stamps(at), values + random.normal(0, 0.02, values.shape))


def world(number: int) -> World:
    """Return a random case: irregular movement, seen as poses or as one number, with jitter, noise and gaps."""
    random = np.random.default_rng(number)
    seconds = float(random.choice([15, 20, 30, 60, 120]))
    lag_s, skew = float(random.uniform(-0.5, 0.5)), float(random.choice([0, 0, random.uniform(-200e-6, 200e-6)]))
    rates = (float(random.choice([10, 20, 30, 50])), float(random.choice([15, 25, 40, 100])))
    noise, jitter_s = float(random.choice([0.01, 0.05, 0.1, 0.2])), float(random.choice([0, 0.001, 0.003]))
    lost = float(random.choice([0, 0, 0.05, 0.2]))
    frequencies = random.uniform(0.1, 1.2, (3, 12))
    phases = random.uniform(0, 2 * np.pi, (3, 12))
    sizes = random.normal(size=(3, 12)) / (1 + 1.5 * frequencies) * np.array([[20.0], [10.0], [6.0]])

    def place(at: Floats) -> Floats:
        waves = np.sin(2 * np.pi * frequencies[:, :, None] * at + phases[:, :, None])
        return np.asarray(np.sum(sizes[:, :, None] * waves, axis=1).T)

    def times(rate: float) -> Floats:
        at = np.arange(0, seconds, 1 / rate)
        at = at + random.normal(0, jitter_s, len(at))
        kept = random.random(len(at)) >= lost
        if lost:
            gap = random.uniform(0, seconds - 1)
            kept &= ~((at > gap) & (at < gap + 1))
        return np.asarray(at[kept])

    def noisy(values: Floats) -> Floats:
        return np.asarray(values + random.normal(0, noise, values.shape) * values.std())

    first, second = times(rates[0]), times(rates[1])
    turned, _ = np.linalg.qr(random.normal(size=(3, 3)))
    seen = place(first) @ (random.normal(size=(3, 1)) if random.random() < 0.5 else turned)
    late = second + lag_s + skew * (second - seconds / 2)
    return World(
        Signal.of(stamps(first), noisy(seen)),
        Signal.of(stamps(late), noisy(place(second))),
        seconds,
        lag_s,
        skew,
        noise,
    )


@cache
def pair_of_plus() -> tuple[Signal, Signal]:
    """Return the signals of the water tank: rows of the line in the video, and mm of the tracker."""
    tank = water_tank()
    video = Signal.of(stamps(tank.video_s), tank.line_px, "video", "px")
    return video, Signal.of(stamps(tank.tracker_s), tank.place_mm, "tracker", "mm")

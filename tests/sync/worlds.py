"""Movements with a known lag, seen by two streams."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.sync.plus import line_height
from igtl_gateway.sync.signal import Floats, Signal, main_component

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


def sequence_frames(path: Path) -> tuple[list[dict[str, str]], npt.NDArray[np.uint8]]:
    """Return fields of the frames and pixels (frames, rows, columns) of a sequence of PLUS."""
    text, _, raw = path.read_bytes().partition(b"ElementDataFile = LOCAL\n")
    frames: dict[str, dict[str, str]] = {}
    header = dict(line.split(" = ", 1) for line in text.decode().splitlines() if " = " in line)
    for key, value in header.items():
        if key.startswith("Seq_Frame"):
            number, _, name = key.removeprefix("Seq_Frame").partition("_")
            frames.setdefault(number, {})[name] = value.strip()
    columns, rows, count = map(int, header["DimSize"].split())
    pixels = zlib.decompress(raw) if header.get("CompressedData", "").strip() == "True" and raw else raw
    shape = (count, rows, columns) if len(pixels) == count * rows * columns else (0, rows, columns)
    return list(frames.values()), np.frombuffer(pixels, np.uint8, shape[0] * rows * columns).reshape(shape)


@cache
def pair_of_plus(shared_dir: Path) -> tuple[Signal, Signal]:
    """Return the signals of the water tank: rows of the line in the video, and mm of the tracker."""
    folder = shared_dir / "data/plus-temporal-calibration"
    frames, pixels = sequence_frames(folder / "WaterTankBottomTranslationVideoBuffer.igs.mha")
    times = np.array([float(frame["Timestamp"]) for frame in frames])
    video = Signal.of(stamps(times), [line_height(picture) for picture in pixels], "video", "px")
    tracked, _ = sequence_frames(folder / "WaterTankBottomTranslationTrackerBuffer.igs.mha")
    at, places = [], []
    for frame in tracked:
        poses = [f"{name}ToTrackerTransform" for name in ("Reference", "Probe")]
        if all(frame[f"{pose}Status"] == "OK" for pose in poses):
            reference, probe = (np.array(frame[pose].split(), float).reshape(4, 4) for pose in poses)
            at.append(float(frame["Timestamp"]))
            places.append((np.linalg.inv(reference) @ probe)[:3, 3])
    seconds = np.array(at)
    near = (seconds >= times[0] - 1) & (seconds <= times[-1] + 1)
    return video, Signal.of(stamps(seconds[near]), main_component(np.array(places)[near]), "tracker", "mm")

"""Statistics of features, as the readers of the format expect them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Stats = dict[str, list[Any]]

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
#: Pictures of an episode that are sampled, evenly.
SAMPLED_PICTURES = 100


#: Values whose statistics are computed at the same time.
_BLOCK = 1 << 22


def number_stats(values: Array) -> Stats:
    """Return the statistics of numbers (N, K), each as K values."""
    found: Stats = {}
    step = max(_BLOCK // max(len(values), 1), 1)
    for first in range(0, values.shape[1], step):
        with np.errstate(over="ignore", invalid="ignore"):  # the sum of doubles near the largest one
            part = _number_stats(values[:, first : first + step].astype(np.float64))
        for name, each in part.items():
            found.setdefault(name, []).extend(each.tolist())
    return found | {"count": [len(values)]}


def _number_stats(exact: Array) -> dict[str, Array]:
    found = {
        "min": exact.min(axis=0),
        "max": exact.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
    }
    quantiles = np.quantile(exact, list(QUANTILES.values()), axis=0)
    return found | dict(zip(QUANTILES, quantiles, strict=True))


def joined_stats(parts: list[Stats]) -> Stats:
    """Return minimum, maximum, mean, standard deviation and count of parts together."""
    low, high, means, stds = (np.array([each[name] for each in parts]) for name in ("min", "max", "mean", "std"))
    with np.errstate(over="ignore", invalid="ignore"):
        return _joined(low, high, means, stds, parts)


def _joined(low: Array, high: Array, means: Array, stds: Array, parts: list[Stats]) -> Stats:
    counts = np.array([each["count"] for each in parts], np.float64)
    mean = (counts * means).sum(axis=0) / counts.sum()
    variance = (counts * (stds**2 + (means - mean) ** 2)).sum(axis=0) / counts.sum()
    found = {"min": low.min(axis=0), "max": high.max(axis=0), "mean": mean, "std": np.sqrt(variance)}
    return {name: each.tolist() for name, each in found.items()} | {"count": [int(counts.sum())]}


def bounded_stats(one: Stats, two: Stats) -> Stats:
    """Return the statistics of two parts together, of whose values nothing else is known, by the rule of LeRobot.

    Mean and standard deviation follow from the counts; quantiles are bounds: the lower ones of the two up to the
    median, the higher ones above it.  A statistic that one part lacks is left out.

    Raises ValueError, TypeError or KeyError for statistics of another form.
    """
    counts = [int(each["count"][0]) for each in (one, two)]
    values = {name: np.array([one[name], two[name]], np.float64) for name in one if name != "count" and name in two}
    mean = np.average(values["mean"], axis=0, weights=counts)
    spread = values["std"] ** 2 + (values["mean"] - mean) ** 2
    found = {"mean": mean, "std": np.sqrt(np.average(spread, axis=0, weights=counts))}
    for name, each in values.items():
        if name == "min" or QUANTILES.get(name, 1) <= 0.5:
            found[name] = each.min(axis=0)
        elif name == "max" or name in QUANTILES:
            found[name] = each.max(axis=0)
    return {name: each.tolist() for name, each in found.items()} | {"count": [sum(counts)]}


@dataclass(slots=True)
class PictureStats:
    """Statistics of pictures, per channel: exact for the pictures that were added.

    Attributes:
        counts: (C, L), how often each value occurs: (3, 256) of colours, (1, 4096) of depth.
        pictures: number of pictures.
        low, high: what the first and the last value stand for; depth in mm.
    """

    counts: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((3, 256), np.int64))
    pictures: int = 0
    low: float = 0.0
    high: float = 1.0

    def add(self, picture: npt.NDArray[Any]) -> None:
        """Add a picture (rows, columns, C)."""
        channels, levels = self.counts.shape
        for channel in range(channels):
            self.counts[channel] += np.bincount(picture[:, :, channel].ravel(), minlength=levels)
        self.pictures += 1

    def join(self, other: PictureStats) -> None:
        """Add the pictures of others; without a picture, it becomes as those."""
        if not self.pictures:
            self.counts, self.low, self.high = np.zeros_like(other.counts), other.low, other.high
        self.counts += other.counts
        self.pictures += other.pictures

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON."""
        scale = {} if (self.low, self.high) == (0.0, 1.0) else {"low": self.low, "high": self.high}
        return {"pictures": self.pictures, "counts": self.counts.tolist(), **scale}

    def stats(self) -> Stats:
        """Return the statistics; each has the shape (C, 1, 1)."""
        channels, count = self.counts.shape
        levels = self.low + np.arange(count) / (count - 1) * (self.high - self.low)
        total = self.counts.sum(axis=1)
        mean = self.counts @ levels / total
        found = {
            "min": levels[np.argmax(self.counts > 0, axis=1)],
            "max": levels[count - 1 - np.argmax(self.counts[:, ::-1] > 0, axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(self.counts @ levels**2 / total - mean**2, 0)),
        }
        running = np.cumsum(self.counts, axis=1)
        for name, share in QUANTILES.items():
            found[name] = levels[np.argmax(running >= share * total[:, None], axis=1)]
        return {name: each.reshape(channels, 1, 1).tolist() for name, each in found.items()} | {
            "count": [self.pictures]
        }


def sampled(count: int) -> npt.NDArray[np.int64]:
    """Return the frames of an episode whose pictures count for the statistics."""
    return np.unique(np.linspace(0, count - 1, min(count, SAMPLED_PICTURES)).round().astype(np.int64))

"""Settings and results of a soak test."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igtl_gateway_lab.programs import Event

#: How a bridge and its recorder were at one moment, see ``soak_watch.take``.
Sample = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Settings:
    """See the command line."""

    seconds: float
    seed: int
    folder: Path
    scale: float
    part_s: float
    sample_s: float
    guest_s: float
    growth_mb: float
    disk_gb: float
    keep: bool

    @property
    def warm_s(self) -> float:
        """What is before does not count for the line: a third, five minutes at most."""
        return min(self.seconds / 3, 300.0)

    @property
    def most_stay_s(self) -> float:
        """Longest stay of a short-lived peer; less in a short run, so that queues stay below their initial length."""
        return min(self.seconds / 8, 30.0)


@dataclass
class Found:
    """What a soak brought to light, filled as it goes on."""

    samples: list[Sample] = field(default_factory=list)
    baseline: Sample = field(default_factory=dict)
    end: Sample = field(default_factory=dict)
    guests: Counter[str] = field(default_factory=Counter)
    parts: list[dict[str, Any]] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    passages: list[dict[str, Any]] = field(default_factory=list)
    stopped: Event = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that is judged."""

    name: str
    good: bool
    text: str


def say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}", flush=True)

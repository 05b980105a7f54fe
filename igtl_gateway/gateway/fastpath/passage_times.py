"""Where the time of messages goes in the native passage: percentiles of each phase.

``middleware``: from the source stamp of a ROS message until the passage has it: DDS, and the scheduler.  ``sequence``:
until it has the sequence lock.  ``conversion``: until it has its number, with the recorder's lock and the guard.
``output``: until it is sent or published.  ``recording``: until it is in the recorder's memory.
"""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.native.passage import Passage

DIRECTIONS = ("igtl_to_ros", "ros_to_igtl")
PHASES = ("middleware", "sequence", "conversion", "output", "recording")

_SHARES = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999, "max_us": 1.0}


def percentiles(counts: Sequence[tuple[int, int]]) -> dict[str, float]:
    """Return percentiles (microseconds, at most a fifth too high) of (upper bound in ns, messages) in rising order."""
    total = sum(number for _, number in counts)
    found = {}
    for name, share in _SHARES.items():
        below = 0
        for above_ns, number in counts:
            below += number
            if below >= share * total:
                found[name] = above_ns / 1_000
                break
    return found


def times_of(passage: Passage) -> dict[str, dict[str, dict[str, float]]]:
    """Return direction → phase → percentiles, for phases that messages had; the caller has the sequence lock."""
    rows = passage.times()
    found: dict[str, dict[str, dict[str, float]]] = {}
    for number, row in enumerate(rows):
        if row:
            direction, phase = DIRECTIONS[number // len(PHASES)], PHASES[number % len(PHASES)]
            found.setdefault(direction, {})[phase] = percentiles(row)
    return found

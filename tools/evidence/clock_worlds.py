"""Peers with clocks that are known, asked once a second, and the estimate of their offset.

    python -m tools.evidence.clock_worlds [--worlds 200] [--hours 24]

Prints how often the truth is outside of the stated interval, how soon planted steps are noticed, and how many steps are
noticed that are not planted.
"""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.gateway.log.clock_offset import ClockStep, NoClock, OffsetEstimate

START_NS = 1_767_225_600_000_000_000
STEP_NS = 20 * NS_PER_MS

#: How programs write the time into a stamp.
STAMPS: Mapping[str, Callable[[int], int]] = {
    "32.32 fixed point": lambda ns: ticks_to_ns(ns_to_ticks(ns)),
    "float64 seconds": lambda ns: ticks_to_ns(int(ns / 1e9 * (1 << 32))),
    "microseconds": lambda ns: ns // 1_000 * 1_000,
    "milliseconds": lambda ns: ns // NS_PER_MS * NS_PER_MS,
}


@dataclass
class World:
    """A peer and the way to it.

    Attributes:
        seconds: duration.
        step_s: when its clock is set by ``step_ns``; inf: never.
    """

    chance: random.Random
    seconds: int
    step_s: float = math.inf
    step_ns: int = STEP_NS
    offsets: list[int] = field(default_factory=list)  # of the clock without its step, ns, at each second

    def __post_init__(self) -> None:
        chance = self.chance
        self.least_ns = [round(10 ** chance.uniform(4.7, 6.7)) for _ in range(2)]  # 50 us to 5 ms, there and back
        self.jitter_ns = 10 ** chance.uniform(4.3, 6.3)
        self.stamp = STAMPS[chance.choice(list(STAMPS))]
        offset = chance.choice((0, 1_000, 3_600 * NS_PER_S, 10**18)) * chance.uniform(-1, 1)
        own, other = chance.uniform(-50, 50), chance.uniform(-50, 50)
        slew = slews = 0.0
        for _ in range(self.seconds + 10):
            self.offsets.append(round(offset))
            # quartz: each within 50 ppm; NTP slews one of them by 500 ppm, for up to two minutes
            own, other = (max(-50.0, min(50.0, rate + chance.gauss(0, 0.05))) for rate in (own, other))
            if slews <= 0 and chance.random() < 1 / 900:
                slew, slews = chance.choice((-500.0, 500.0)), chance.uniform(1, 120)
            slews -= 1
            offset += (own - other + (slew if slews > 0 else 0.0)) * 1_000

    def offset_ns(self, time_ns: int) -> int:
        """How far the clock is ahead at a gateway time."""
        second, rest = divmod(time_ns - START_NS, NS_PER_S)
        one, two = self.offsets[second], self.offsets[second + 1]
        stepped = time_ns - START_NS >= self.step_s * NS_PER_S
        return one + (two - one) * rest // NS_PER_S + (self.step_ns if stepped else 0)

    def delay_ns(self, way: int, is_burst: bool, is_load: bool) -> int:
        """The time of a message on its way, there (0) or back (1)."""
        chance = self.chance
        ns = self.least_ns[way] + chance.expovariate(1 / self.jitter_ns)
        if is_burst:
            ns += chance.uniform(0, 300 * NS_PER_MS)
        if is_load:
            ns += chance.expovariate(1 / (5 * NS_PER_MS))
        return round(ns)


@dataclass
class Found:
    """What the estimate showed of a world.

    Attributes:
        judged: moments at which the interval was compared with the truth; outside: with the truth outside.
        hidden: the same between a planted step and its note.
        noticed_s: from the planted step to its note; inf: there was none.
        false: steps that are not planted; no_clock: findings that this is no clock.
        bounds_ns: half widths of the interval.
    """

    judged: int = 0
    outside: int = 0
    hidden: int = 0
    noticed_s: float = math.inf
    false: int = 0
    no_clock: int = 0
    bounds_ns: list[int] = field(default_factory=list)


def run(world: World) -> Found:
    """Ask once a second, if the last question has its answer."""
    chance, estimate, found = world.chance, OffsetEstimate(), Found()
    step_ns = START_NS + round(world.step_s * NS_PER_S) if world.step_s < math.inf else 1 << 62
    now_ns, burst_until, load_until = START_NS, 0, 0
    end_ns = START_NS + world.seconds * NS_PER_S
    while now_ns < end_ns:
        if chance.random() < 1 / 60:
            burst_until = now_ns + round(chance.uniform(0.2, 3) * NS_PER_S)
        if chance.random() < 1 / 600:
            load_until = now_ns + round(chance.uniform(5, 120) * NS_PER_S)

        busy = now_ns < burst_until, now_ns < load_until
        made_ns = now_ns + world.delay_ns(0, *busy)
        answered_ns = made_ns + world.delay_ns(1, *busy)
        stamp_ns = world.stamp(made_ns + world.offset_ns(made_ns))
        shown = estimate.add(now_ns, stamp_ns, answered_ns)
        if isinstance(shown, ClockStep):
            if answered_ns >= step_ns and found.noticed_s == math.inf:
                found.noticed_s = (answered_ns - step_ns) / NS_PER_S
            else:
                found.false += 1
        found.no_clock += isinstance(shown, NoClock)
        next_ns = max(answered_ns, now_ns + NS_PER_S + round(chance.expovariate(1 / NS_PER_MS)))
        for at_ns in (answered_ns, next_ns):
            offset = estimate.offset(at_ns)
            truth_ns = world.offset_ns(at_ns)
            if offset and not (made_ns < step_ns <= at_ns):  # what no answer has shown yet, is not known
                found.judged += 1
                is_outside = not offset.low_ns <= truth_ns <= offset.high_ns
                is_hidden = at_ns >= step_ns and found.noticed_s == math.inf
                found.outside += is_outside and not is_hidden
                found.hidden += is_outside and is_hidden
                if len(found.bounds_ns) < 10_000:
                    found.bounds_ns.append(offset.bound_ns)
        now_ns = next_ns
    return found


def planted(count: int, seed: int = 1, seconds: int = 600) -> list[tuple[World, Found]]:
    """Worlds of ten minutes; every second one has a step of 20 ms, forward or back."""
    results = []
    for number in range(count):
        chance = random.Random(seed * 1_000_003 + number)
        step_s = chance.uniform(0.2, 0.9) * seconds if number % 2 else math.inf
        world = World(chance, seconds, step_s, chance.choice((-STEP_NS, STEP_NS)))
        results.append((world, run(world)))
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=200)
    parser.add_argument("--hours", type=int, default=24)
    parser.add_argument("--long", type=int, default=8, help="number of worlds of --hours")
    options = parser.parse_args()
    results = planted(options.worlds)
    found = [one for _, one in results]
    steps = sorted(one.noticed_s for world, one in results if world.step_s < math.inf)
    bounds = sorted(ns for one in found for ns in one.bounds_ns)
    long = [run(World(random.Random(7_000 + number), options.hours * 3_600)) for number in range(options.long)]
    rows = {
        "moments at which the interval was compared": f"{sum(one.judged for one in found):,}",
        "truth outside of the interval": f"{sum(one.outside for one in found):,}",
        "the same between a planted step and its note": f"{sum(one.hidden for one in found):,}",
        "half width of the interval": f"median {bounds[len(bounds) // 2] / 1e6:.2f} ms, 95 % below "
        f"{bounds[len(bounds) * 95 // 100] / 1e6:.1f} ms",
        "steps of 20 ms noticed": f"{sum(one < math.inf for one in steps):,} of {len(steps):,}, "
        f"median {steps[len(steps) // 2]:.1f} s, in 10 s {sum(one <= 10 for one in steps):,}",
        "steps that are not planted": f"{sum(one.false + one.no_clock for one in found)}",
        f"{options.long} peers for {options.hours} h: questions": f"{sum(one.judged for one in long) // 2:,}",
        "of these: steps that are not planted": f"{sum(one.false + one.no_clock for one in long)}",
        "of these: truth outside of the interval": f"{sum(one.outside for one in long)}",
    }
    print(f"| {options.worlds:,} peers for 10 min, of which {len(steps):,} have a step of 20 ms | |\n|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()

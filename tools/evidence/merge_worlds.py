"""Recordings of several recorders with clocks that are known, and what ``merge`` makes of them.

    python tools/evidence/merge_worlds.py [WORLDS]

Prints how far the stated offsets are from the planted ones, how often the stated interval contains the truth, and
how many messages are in the wrong order although they are further apart than the stated errors.
"""

from __future__ import annotations

import json
import math
import random
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.merged import PART_NAME_KEY
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter

START_NS = 1_767_225_600_000_000_000
_TYPE = "geometry_msgs/msg/PoseStamped"
_TYPES = RosTypes()


@dataclass(frozen=True)
class World:
    """What is planted.

    Attributes:
        offsets_s: of the clock of each recorder, relative to true time.
        drifts_ppm: of each clock.
        step_s: by how much the clock of the last recorder is set in the middle.
        seconds: duration.
        rate_hz: messages of each recorder to each other one.
        delays_s: least delay from a recorder with a lower number to one with a higher number, and back.
        jitter_s: mean of what a delay has besides.
        loss, doubled: part of the messages that do not arrive, or arrive twice.
        repeated: part of the messages that are equal to the one before.
        coarse_ns: clocks count in these steps, so that stamps of several recorders are equal.
        one_way: only recorders with lower numbers send.
        pairs: numbers of recorders that exchange messages.
    """

    offsets_s: tuple[float, ...] = (0.0, 1.7)
    drifts_ppm: tuple[float, ...] = (0.0, 0.0)
    step_s: float = 0.0
    seconds: float = 20.0
    rate_hz: float = 20.0
    delays_s: tuple[float, float] = (0.001, 0.001)
    jitter_s: float = 0.002
    loss: float = 0.0
    doubled: float = 0.0
    repeated: float = 0.0
    coarse_ns: int = 1
    one_way: bool = False
    pairs: tuple[tuple[int, int], ...] = ((0, 1),)

    def clock_ns(self, recorder: int, time_ns: int) -> int:
        """What the clock of a recorder shows at a true time."""
        shown = time_ns + round(self.offsets_s[recorder] * 1e9)
        shown += round(self.drifts_ppm[recorder] * 1e-6 * (time_ns - START_NS))
        if recorder == len(self.offsets_s) - 1 and time_ns - START_NS > self.seconds * 5e8:
            shown += round(self.step_s * 1e9)
        return shown // self.coarse_ns * self.coarse_ns


@dataclass
class Recordings:
    """The files of a world, and the true time of each entry, by name and number."""

    sources: list[Source]
    truth: dict[str, list[int]] = field(default_factory=dict)


def record(world: World, folder: Path, seed: int) -> Recordings:
    """Write the recordings of a world."""
    chance = random.Random(seed)
    events: list[list[tuple[int, Kind, str, bytes]]] = [[] for _ in world.offsets_s]
    end_ns = START_NS + round(world.seconds * 1e9)
    number = 0
    for recorder, own in enumerate(events):
        for _ in range(int(world.seconds * 3)):  # what only one of them has
            number += 1
            own.append((chance.randrange(START_NS, end_ns), Kind.ROS_IN, "/own/pose", _payload(number)))
        for one, two in world.pairs:
            for sender, receiver, least_s in ((one, two, world.delays_s[0]), (two, one, world.delays_s[1])):
                if sender != recorder or (world.one_way and sender > receiver):
                    continue
                for _ in range(int(world.seconds * world.rate_hz)):
                    number += chance.random() >= world.repeated
                    topic, sent_ns = f"/to{receiver}/pose", chance.randrange(START_NS, end_ns)
                    own.append((sent_ns, Kind.ROS_OUT, topic, _payload(number)))
                    for _ in range(chance.random() >= world.loss and 1 + (chance.random() < world.doubled)):
                        delay_s = least_s + chance.expovariate(1 / world.jitter_s)
                        received_ns = sent_ns + round(delay_s * 1e9)
                        events[receiver].append((received_ns, Kind.ROS_IN, f"/remote{topic}", _payload(number)))
    found = Recordings([])
    for recorder, own in enumerate(events):
        own.sort(key=lambda event: event[0])
        name = f"r{recorder}"
        path = folder / f"{name}.mcap"
        writer = SessionWriter(path, _facts(), types=_TYPES, overwrite=True)
        stamp_ns, truth = 0, []
        for seq, (time_ns, kind, topic, payload) in enumerate(own, 1):
            stamp_ns = max(stamp_ns + 1, world.clock_ns(recorder, time_ns))
            writer.write(Entry(seq, stamp_ns, kind, topic, _TYPE, (payload,)))
            truth.append(time_ns)
        writer.close({})
        found.sources.append(Source(name, path))
        found.truth[name] = truth
    return found


def _facts() -> dict[str, str]:
    return {
        layout.FORMAT_VERSION_KEY: str(layout.FORMAT_VERSION),
        layout.CONFIGURATION_KEY: json.dumps(Config().to_dict()),
    }


def _payload(number: int) -> bytes:
    return b"\x00\x01\x00\x00" + number.to_bytes(8, "little") * 10


@dataclass(frozen=True)
class Judgement:
    """How a merged session compares with the truth.

    Attributes:
        errors_s: by part, the largest difference of its clock from the planted one.
        outside: parts whose stated interval does not contain the truth.
        inverted: messages in the wrong order although their true times differ by more than the stated errors.
        early: messages that arrive before they are sent.
    """

    errors_s: dict[str, float]
    outside: list[str]
    inverted: int
    early: int


def judge(world: World, recordings: Recordings, facts: dict[str, Any], out: Path) -> Judgement:
    """Compare a merged session with the truth."""
    intervals = {part["name"]: part["clock"] for part in facts["parts"]}
    times: dict[str, list[int]] = {name: [] for name in recordings.truth}
    order: list[tuple[int, str]] = []
    sent: dict[bytes, int] = {}
    received: list[tuple[bytes, int]] = []
    with SessionFile.open(out) as file:
        for _, channel, row in file.messages():
            name = channel.metadata[PART_NAME_KEY]
            order.append((recordings.truth[name][len(times[name])], name))
            times[name].append(row[2])
            payload = row[6][row[4] : row[5]]
            if "/to" in channel.topic and "/remote" not in channel.topic:
                sent.setdefault(payload, row[2])
            elif "/remote" in channel.topic:
                received.append((payload, row[2]))
    errors, outside = {}, []
    reference = facts["reference"]
    for name, merged in times.items():
        base = int(reference.removeprefix("r"))
        apart = [
            (time - world.clock_ns(base, true)) / 1e9 for time, true in zip(merged, recordings.truth[name], strict=True)
        ]
        errors[name] = max(map(abs, apart), default=0.0)
        clock = intervals[name]
        low, high = (
            math.inf if clock[key] is None else abs(clock[key] - clock["offset_s"]) for key in ("low_s", "high_s")
        )
        # stamps of one recorder differ by 1 ns or more, whatever its clock shows
        slack = 1e-9 * (world.coarse_ns + len(merged))
        if apart and (max(apart) > high + slack or min(apart) < -low - slack):
            outside.append(name)
    widest = max(errors.values())
    latest, inverted = -math.inf, 0
    for true, _ in order:
        inverted += true < latest - 2e9 * widest - world.coarse_ns
        latest = max(latest, true)
    early = sum(time_ns < sent[payload] - 1 for payload, time_ns in received)
    return Judgement(errors, outside, inverted, early)


def random_world(chance: random.Random) -> World:
    """A world of two to five recorders."""
    count = chance.choice((2, 2, 2, 3, 5))
    delays_s = 10 ** chance.uniform(-4, -1), 10 ** chance.uniform(-4, -1)
    pairs = tuple((chance.randrange(number), number) for number in range(1, count))
    return World(
        offsets_s=tuple(
            chance.choice((0.0, 10 ** chance.uniform(-5, 3) * chance.choice((-1, 1)))) for _ in range(count)
        ),
        drifts_ppm=tuple(chance.choice((0.0, chance.uniform(-60, 60))) for _ in range(count)),
        seconds=10 ** chance.uniform(0, 2.5),
        rate_hz=chance.choice((1.0, 10.0, 30.0)),
        delays_s=delays_s,
        jitter_s=10 ** chance.uniform(-4, -1.5),
        loss=chance.choice((0.0, 0.3)),
        doubled=chance.choice((0.0, 0.1)),
        repeated=chance.choice((0.0, 0.5)),
        coarse_ns=chance.choice((1, 1, 1_000_000)) if min(delays_s) > 0.001 else 1,
        pairs=pairs,
    )


def main(worlds: int) -> int:
    chance = random.Random(1)
    errors, widths, outside, inverted, early, drifting = [], [], 0, 0, 0, 0
    refused: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        for seed in range(worlds):
            world = random_world(chance)
            recordings = record(world, Path(name), seed)
            out = Path(name) / "merged.mcap"
            try:
                facts = merge(recordings.sources, out, given={}, overwrite=True)
            except GatewayError as error:
                refused.append(str(error))
                continue
            found = judge(world, recordings, facts, out)
            for part in facts["parts"][1:]:
                clock = part["clock"]
                errors.append(1e3 * found.errors_s[part["name"]])
                if clock["low_s"] is not None and clock["high_s"] is not None:
                    widths.append(500 * (clock["high_s"] - clock["low_s"]))
                drifting += clock["is_drifting"]
            outside += len(found.outside)
            inverted += found.inverted
            early += found.early
            if found.outside or found.inverted:
                print(seed, world, found, file=sys.stderr)
    print(f"{worlds} worlds, {len(errors)} clocks, {drifting} with a proven drift, {len(refused)} worlds refused")
    for title, values in (("error", errors), ("half width of the interval", widths)):
        low, middle, high = np.quantile(values, [0.5, 0.95, 1.0])
        print(f"{title}: median {low:.3f}, 95 % {middle:.3f}, largest {high:.3f} ms")
    print(
        f"truth outside of the interval: {outside}; messages in the wrong order: {inverted}; "
        f"before they are sent: {early}"
    )
    for text in sorted(set(refused)):
        print(f"  {text}")
    return 1 if outside or inverted else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 100))

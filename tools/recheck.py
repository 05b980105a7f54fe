"""Verification by compiled conversions beside that of the full path: random sessions, and changes in their recordings.

    python tools/recheck.py [SESSIONS] [CHANGES]

Prints a table of how many results are equal, in everything that `verify --json` prints, also where segments give the
result.
"""

from __future__ import annotations

import json
import math
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from igtl_gateway.app.verification import Verification, verify_recording
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, TICK, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay import segments
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.verify import DeclaredLosses, VerifyReport
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.text import String as StringBody
from igtl_gateway.wire.transform import Position, Transform

START_NS = 1_767_225_600_000_000_000
CONFIG = Config(
    to_igtl=(
        ToIgtlRow(topic="/a"),
        ToIgtlRow(topic="/b", max_age_s=30.0),
        ToIgtlRow(topic="/text"),
        ToIgtlRow(topic="/joints"),
        ToIgtlRow(topic="/arm", type="NDARRAY", max_age_s=30.0),
    ),
    to_ros=(ToRosRow(device="Aged", max_age_s=30.0),),
).watched()

Entries = list[Entry]
Change = Callable[[Entries, random.Random], Entries]


class _World:
    """A session that is made input by input, by the fast path where it fits."""

    def __init__(self, chance: random.Random) -> None:
        self.chance, self.now_ns = chance, START_NS
        self.core = Gateway(CONFIG)
        self._session = Session(self.core)
        self.entries: Entries = []

    def feed(self, kind: Kind, payload: bytes, **names: Any) -> None:
        self.now_ns += self.chance.choice((1, 1, 1, 3, 40, 400)) * NS_PER_MS
        self.entries += self._session.input(self.now_ns, kind, (payload,), **names)

    def note(self, kind: Kind, code: str, links: tuple[int, ...] = ()) -> None:
        self.feed(kind, Note(Level.INFO, code, code).pack(), links=links)

    def stamp(self) -> int:
        now_ns = self.now_ns
        return self.chance.choice([now_ns] * 60 + [0, 1, now_ns + NS_PER_S, now_ns - 40 * NS_PER_S])

    def numbers(self, step: int) -> tuple[float, float, float]:
        if self.chance.random() < 0.01:
            return self.chance.choice([(math.nan, 0.0, 0.0), (3e38, 0.0, 0.0), (300.0, 200.0, 100.0)])
        return 0.3 + step * 1e-6, 0.2, 0.1

    def ros(self, step: int) -> None:
        kind, header = self.chance.random(), Header(self.stamp(), self.chance.choice(["base"] * 60 + ["camera"]))
        place, turn = self.numbers(step), tuple(self.chance.uniform(-1, 1) for _ in range(4))
        source_ns = self.chance.choice([0, self.now_ns - 1])
        message: Any
        if kind < 0.5:
            topic, message = "/a", TransformStamped(header, "tool", place, turn)  # type: ignore[arg-type]
        elif kind < 0.75:
            topic, message = "/b", PoseStamped(header, (*place, *turn))  # type: ignore[arg-type]
        elif kind < 0.9:
            topic = "/joints" if kind < 0.85 else "/arm"
            names = self.chance.choice([("q1", "wrist", "q3")] * 60 + [("q1", "elbow", "q3"), ()])
            message = JointState(header, names, np.array(place), np.array(turn[:3]))
        else:
            topic, message = "/text", rosmsg.String(f"text {step}")
        self.feed(Kind.ROS_IN, message.pack(), channel=topic, type_name=message.TYPE, source_ns=source_ns)

    def igtl(self, step: int, link: int) -> None:
        version = self.chance.choice([1, 1, 2])
        items = (Item.of("status", self.chance.choice(["OK"] * 9 + ["MISSING"])),) if version == 2 else ()
        device, ticks = self.chance.choice(["Tool", "Aged", "Third"]), ns_to_ticks(self.stamp())
        kind = "TRANSFORM"
        content: Any
        if self.chance.random() < 0.8:
            content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *self.numbers(step)))
        elif self.chance.random() < 0.7:
            kind, content = "POSITION", Position(self.numbers(step), (0.0, 0.6, 0.0, 0.8), "all")
        else:
            kind, content = "STRING", StringBody.of(f"text {step}")
        data = bytearray(join(encode(Message(kind, device, content, ticks, version, step, items))))
        if self.chance.random() < 0.005:
            data[self.chance.randrange(58, len(data))] ^= 1
        self.feed(Kind.IGTL_IN, bytes(data), links=(link,))


def random_session(chance: random.Random, steps: int = 600) -> tuple[Config, Entries]:
    """A session of poses and strings both ways, with odd messages among them, and peers that come and go."""
    world, peers, last = _World(chance), [1], 1
    world.note(Kind.LINK, LINK_UP, (1,))
    for step in range(steps):
        kind = chance.random()
        if kind < 0.48:
            world.ros(step)
        elif kind < 0.98:
            world.igtl(step, chance.choice(peers))
        elif kind < 0.985 and len(peers) < 3:
            last += 1
            peers.append(last)
            world.note(Kind.LINK, LINK_UP, (last,))
        elif kind < 0.99 and len(peers) > 1:
            world.note(Kind.LINK, LINK_DOWN, (peers.pop(chance.randrange(len(peers))),))
        elif (due_ns := world.core.due_ns) is not None and due_ns <= world.now_ns:
            world.note(Kind.EDGE_NOTE, TICK)
    return CONFIG, world.entries


def written(path: Path, config: Config, entries: Sequence[Entry], *, chunk_bytes: int = 20_000) -> Path:
    """A recording of these entries, which declares no loss."""
    writer = SessionWriter(path, {layout.CONFIGURATION_KEY: json.dumps(config.to_dict())}, chunk_bytes=chunk_bytes)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return path


def _place(entries: Entries, chance: random.Random, kinds: Sequence[Kind]) -> int:
    return chance.choice([at for at, entry in enumerate(entries) if entry.kind in kinds])


def _at(entries: Entries, at: int, *new: Entry) -> Entries:
    return [*entries[:at], *new, *entries[at + 1 :]]


_IN, _OUT = (Kind.IGTL_IN, Kind.ROS_IN), (Kind.IGTL_OUT, Kind.ROS_OUT)


def _bit(kinds: Sequence[Kind]) -> Change:
    def change(entries: Entries, chance: random.Random) -> Entries:
        at = _place(entries, chance, kinds)
        data = bytearray(entries[at].data())
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        return _at(entries, at, replace(entries[at], payload=(bytes(data),)))

    return change


def _field(name: str, kinds: Sequence[Kind], other: Callable[[Any, random.Random], Any]) -> Change:
    def change(entries: Entries, chance: random.Random) -> Entries:
        at = _place(entries, chance, kinds)
        return _at(entries, at, replace(entries[at], **{name: other(getattr(entries[at], name), chance)}))

    return change


def _removed(kinds: Sequence[Kind]) -> Change:
    def change(entries: Entries, chance: random.Random) -> Entries:
        return _at(entries, _place(entries, chance, kinds))

    return change


def _exchanged(kinds: Sequence[Kind]) -> Change:
    """The contents of two entries exchanged, which keep their numbers and times."""

    def change(entries: Entries, chance: random.Random) -> Entries:
        one, other = (_place(entries, chance, kinds) for _ in range(2))
        a, b = entries[one], entries[other]
        made = _at(entries, one, replace(b, seq=a.seq, stamp_ns=a.stamp_ns))
        return _at(made, other, replace(a, seq=b.seq, stamp_ns=b.stamp_ns))

    return change


def _renumbered(entries: Entries, chance: random.Random) -> Entries:
    at = _place(entries, chance, (*_IN, *_OUT))
    return [*entries[:at], *(replace(entry, seq=entry.seq + 1) for entry in entries[at:])]


def _added(entries: Entries, chance: random.Random) -> Entries:
    """An output a second time, with the number behind it; all others follow."""
    at = _place(entries, chance, _OUT)
    more = [replace(entry, seq=entry.seq + 1) for entry in entries[at:]]
    return [*entries[: at + 1], *more]


def _bit_of(value: int, chance: random.Random) -> int:
    return int(value ^ 1 << chance.randrange(40))


#: What is changed in a recording.
CHANGES: dict[str, Change] = {
    "a bit of an input": _bit(_IN),
    "a bit of an output": _bit(_OUT),
    "a bit of a note": _bit((Kind.NOTE,)),
    "gateway time of an input": _field("stamp_ns", _IN, _bit_of),
    "gateway time of an output": _field("stamp_ns", _OUT, _bit_of),
    "stamp of an input": _field("source_ns", _IN, _bit_of),
    "stamp of an output": _field("source_ns", _OUT, _bit_of),
    "link of an input": _field("links", (Kind.IGTL_IN,), lambda links, _: (links[0] + 1,)),
    "links of an output": _field("links", (Kind.IGTL_OUT,), lambda links, _: (*links, 9)),
    "channel of an output": _field("channel", _OUT, lambda name, _: name + "_"),
    "an input is missing": _removed(_IN),
    "an output is missing": _removed(_OUT),
    "a note is missing": _removed((Kind.NOTE, Kind.LINK)),
    "inputs exchanged": _exchanged(_IN),
    "outputs exchanged": _exchanged(_OUT),
    "a number left out": _renumbered,
    "an output twice": _added,
}
#: Of each sort one or two, for tests that take seconds.
FEW_CHANGES = (
    "a bit of an input",
    "a bit of an output",
    "gateway time of an output",
    "link of an input",
    "an input is missing",
    "inputs exchanged",
)


def both(path: Path) -> tuple[Any, Any]:
    """The results by compiled conversions and by the full path alone, or the errors."""
    return _result(path, reference=False), _result(path, reference=True)


def _result(path: Path, *, reference: bool) -> Verification | str:
    try:
        return verify_recording(path, reference=reference)
    except GatewayError as error:
        return str(error)


def in_segments(path: Path, most: int = 4) -> VerifyReport | None:
    """The result of segments; None: they do not show that the recording is verified."""
    with SessionFile.open(path) as file, patch.object(segments, "LEAST_ENTRIES", 20):
        losses, config = DeclaredLosses.of(file.session, file.ledger), config_to_run(file.session)
        planned = segments.plan(file, losses, most)

        def run(some: Sequence[segments.Segment]) -> list[segments.SegmentResult | None]:
            return [segments.verify_segment(file, each, config, losses, compiles=True) for each in some]

        try:
            return segments.verify_in_segments(planned, run, file.entry_count) if planned else None
        except GatewayError:
            return None


def is_equal(report: VerifyReport, result: Verification | str) -> bool:
    """Whether segments give the result of the whole."""
    found = {each.name: getattr(report, each.name) for each in fields(report)} | {"compiled": 0}
    return not isinstance(result, str) and found.items() <= (judged(result) | {"differences": []}).items()


def judged(result: Verification | str) -> dict[str, Any]:
    """What has to be equal."""
    return {"error": result} if isinstance(result, str) else result.to_dict() | {"compiled": 0}


def main(sessions: int = 1_000, changes: int = 500) -> int:
    rows: dict[str, Counter[str]] = {name: Counter() for name in ("unchanged", *CHANGES)}
    names = [*["unchanged"] * sessions, *(list(CHANGES)[at % len(CHANGES)] for at in range(changes))]
    with tempfile.TemporaryDirectory() as folder:
        for seed, name in enumerate(names):
            chance = random.Random(seed)
            config, entries = random_session(chance)
            if name != "unchanged":
                entries = CHANGES[name](entries, chance)
            path = written(Path(folder) / f"{seed}.mcap", config, entries)
            quick, reference = both(path)
            report = in_segments(path)
            path.unlink()
            row, wanted = rows[name], judged(reference)
            row["planted"] += 1
            row["found"] += not wanted.get("good", False)
            row["equal"] += judged(quick) == wanted
            row["segments"] += report is not None
            row["segments equal"] += report is None or is_equal(report, reference)
            if not isinstance(quick, str):
                row["compiled"] += quick.compiled
                row["inputs"] += quick.inputs
    head = ("change", "recordings", "found by the full path", "equal results", "result by segments", "of these equal")
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name, row in rows.items():
        wrong = row["planted"] - row["segments equal"]
        numbers = (row["planted"], row["found"], row["equal"], row["segments"], row["segments"] - wrong)
        print(f"| {name} | {' | '.join(f'{number:,}' for number in numbers)} |")
    good = rows["unchanged"]
    print(f"\n{good['compiled']:,} of {good['inputs']:,} inputs by compiled conversions")
    return 0 if all(row["planted"] == row["equal"] == row["segments equal"] for row in rows.values()) else 1


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))

"""Changes of a sealed recording, each with the only right answer of ``verify --seal``.

    .venv/bin/python tools/seal_mutations.py [--cases 2400] [--seed 1]     count right and wrong answers by kind

Strategy: a short sealed recording with all kinds of records is changed in one place: a byte, a record or a chunk that
is dropped, swapped, moved, duplicated or added, an end that is cut off.  What is changed is drawn at random, so that
all parts of the file are hit: header, schemas, channels, chunks, message indexes, attachments, metadata, seals, index
and footer.  The right answer follows from the change alone.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, UNSEALED, SealReport, check_seal
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.seals import has_name_of_seal
from igtl_gateway.record.sessionfile.units import FoundUnit, units
from igtl_gateway.record.sessionfile.writer import SessionWriter

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "fixtures" / "every-type.mcap"

#: What is wrong with an answer; "" if it is right.
Judge = Callable[[SealReport], str]


@dataclass(frozen=True)
class Case:
    """One change: its kind, the changed file, and the judge of the answer."""

    kind: str
    data: bytes
    judge: Judge


@dataclass(frozen=True)
class Original:
    """A sealed file, its units, and the ends of its seals."""

    data: bytes
    units: list[FoundUnit]
    seals: list[FoundUnit]


def sealed_file(path: Path, key: SigningKey, entries: int = 400, each: int = 25) -> Original:
    """Write a sealed recording with a seal after a number of entries, and return it."""
    clock = iter(range(1_700_000_000_000_000_000, sys.maxsize, 1_000_000))
    series = SealSeries(key, lambda: next(clock))
    with SessionFile.open(SOURCE) as source:
        sealer = series.next_file(path)
        writer = SessionWriter(path, source.session, overwrite=True, sealer=sealer, chunk_bytes=6000)
        for number, entry in zip(range(entries), source.entries(), strict=False):
            writer.write(entry)
            if number % each == each - 1:
                writer.flush()
        writer.close(source.ledger or {})
    data = path.read_bytes()
    stream = BytesIO(data)
    found = list(units(stream, 0, len(data)))
    seals = [each for each in found if each.opcode == records.METADATA and has_name_of_seal(stream, each.at)]
    return Original(data, found, seals)


def cases(original: Original, count: int, seed: int) -> Iterator[Case]:
    """Yield ``count`` changes, of all kinds in turn."""
    chance = random.Random(seed)
    kinds = (_byte, _drop, _swap, _move, _duplicate, _add, _cut, _byte_of_the_end, _drop_range, _append)
    for number in range(count):
        yield kinds[number % len(kinds)](original, chance)


def _expect(what: str, begin: int | None = None, inside: int | None = None, end: int | None = None) -> Judge:
    def judge(report: SealReport) -> str:
        first = report.first
        if report.state != CHANGED or first is None or first.what != what:
            return f"found {report.state}, {first}, expected {what}"
        if begin is not None and first.begin != begin:
            return f"found {first}, expected byte {begin}"
        if end is not None and first.end != end:
            return f"found {first}, expected the end {end}"
        if inside is not None and not first.begin <= inside < first.end:
            return f"found {first}, expected byte {inside} in it"
        return ""

    return judge


def _bit(data: bytes, at: int, chance: random.Random) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]


def _byte(original: Original, chance: random.Random) -> Case:
    """One bit of a unit, so that small units are hit as often as large ones."""
    unit = chance.choice(original.units)
    at = chance.randrange(unit.at, unit.end)
    return Case("byte", _bit(original.data, at, chance), _expect("changed", inside=at))


def _byte_of_the_end(original: Original, chance: random.Random) -> Case:
    at = chance.randrange(original.units[-1].end, len(original.data))
    data = _bit(original.data, at, chance)

    def judge(report: SealReport) -> str:
        if at >= len(data) - len(records.MAGIC):  # without its magic, the end looks like one that is cut
            return "" if report.state in (CHANGED, CUT) else f"found {report.state}"
        return _expect("changed", inside=at)(report)

    return Case("byte of the index", data, judge)


def _joined(original: Original, order: list[FoundUnit]) -> bytes:
    parts = [original.data[each.at : each.end] for each in order]
    return b"".join((*parts, original.data[original.units[-1].end :]))


def _drop(original: Original, chance: random.Random) -> Case:
    number = chance.randrange(1, len(original.units) - 1)
    unit = original.units[number]
    order = original.units[:number] + original.units[number + 1 :]
    return Case("drop", _joined(original, order), _expect("dropped", unit.at, end=unit.end))


def _drop_range(original: Original, chance: random.Random) -> Case:
    first, last = sorted(chance.sample(range(1, len(original.units) - 1), 2))
    order = original.units[:first] + original.units[last:]
    # where a seal is dropped, the records that it alone covers have no digest of their own any more
    return Case("drop of several", _joined(original, order), _expect("dropped", inside=original.units[first].at))


def _swap(original: Original, chance: random.Random) -> Case:
    one, other = sorted(chance.sample(range(1, len(original.units) - 1), 2))
    order = list(original.units)
    order[one], order[other] = order[other], order[one]
    return Case("swap", _joined(original, order), _expect("swapped", original.units[one].at))


def _move(original: Original, chance: random.Random) -> Case:
    one, place = chance.sample(range(1, len(original.units) - 1), 2)
    while abs(one - place) == 1:
        one, place = chance.sample(range(1, len(original.units) - 1), 2)
    order = list(original.units)
    unit = order.pop(one)
    order.insert(place, unit)
    return Case("move", _joined(original, order), _expect("moved", unit.at))


def _duplicate(original: Original, chance: random.Random) -> Case:
    one, place = chance.randrange(1, len(original.units) - 1), chance.randrange(1, len(original.units) - 1)
    unit = original.units[one]
    order = list(original.units)
    order.insert(place, unit)
    begin = unit.end if one == place else original.units[place].at
    return Case("duplicate", _joined(original, order), _expect("duplicated", begin, end=begin + unit.size))


def _add(original: Original, chance: random.Random) -> Case:
    """A record of a unit's kind with other contents, or bytes that are not a record."""
    unit = chance.choice([each for each in original.units if each.opcode == records.CHUNK])
    foreign = _bit(original.data[unit.at : unit.end], unit.size - 1, chance)
    if chance.random() < 0.3:
        foreign = bytes(chance.randrange(256) for _ in range(chance.randrange(1, 200)))
    place = chance.choice(original.units[1:])
    data = original.data[: place.at] + foreign + original.data[place.at :]
    return Case("add", data, _expect("added", place.at, end=place.at + len(foreign)))


def _append(original: Original, chance: random.Random) -> Case:
    more = bytes(chance.randrange(256) for _ in range(chance.randrange(1, 200)))
    return Case(
        "append", original.data + more, _expect("added", len(original.data), end=len(original.data) + len(more))
    )


def _cut(original: Original, chance: random.Random) -> Case:
    at = chance.randrange(len(original.data))
    whole = [each.end for each in original.seals if each.end <= at]

    def judge(report: SealReport) -> str:
        state, sealed_bytes = (CUT, whole[-1]) if whole else (UNSEALED, 0)
        if (report.state, report.sealed_bytes) != (state, sealed_bytes) and not (
            not whole and report.state == CHANGED and "none of them" in (report.first.text if report.first else "")
        ):
            return f"found {report.state}, {report.sealed_bytes} bytes, expected {state}, {sealed_bytes}"
        return ""

    return Case("cut", original.data[:at], judge)


def main() -> int:
    """Run the cases and print how many of each kind are right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=2400)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    key = SigningKey.generate()
    trusted = frozenset([key.public])
    right: Counter[str] = Counter()
    every: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sealed.mcap"
        original = sealed_file(path, key)
        if check_seal(path, trusted).state != SEALED:
            raise AssertionError("the file does not verify")
        for number, case in enumerate(cases(original, options.cases, options.seed)):
            path.write_bytes(case.data)
            wrong = case.judge(check_seal(path, trusted))
            every[case.kind] += 1
            right[case.kind] += not wrong
            if wrong:
                print(f"case {number}, {case.kind}: {wrong}")
    print(
        f"{len(original.data):,} bytes, {len(original.units)} units, {len(original.seals)} seals, seed {options.seed}"
    )
    for kind, count in every.items():
        print(f"{kind:<20}{right[kind]:>6} of {count:>6} right")
    return 0 if right == every else 1


if __name__ == "__main__":
    sys.exit(main())

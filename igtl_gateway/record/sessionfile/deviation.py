"""What has happened at the first place where a file is not as it was sealed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import IO

from igtl_gateway.base.quantities import by_count, count_text
from igtl_gateway.record.sessionfile.units import FoundUnit, digest_of, kind_of, units

CHANGED, DROPPED, SWAPPED, MOVED, DUPLICATED, ADDED = "changed", "dropped", "swapped", "moved", "duplicated", "added"


@dataclass(frozen=True, slots=True)
class ExpectedUnit:
    """A unit as it was sealed.

    Attributes:
        kind: of the unit.
        number: of the unit among those of its kind in the file, from 1; 0 for a range of unknown units.
        at, size: its place in the sealed file.
        digest: its SHA-256; None for a range of unknown units.
        first, last: entry numbers, low 32 bits; −1: none.
        head_before, head: of such a range: heads of the chain around it.
    """

    kind: str
    number: int
    at: int
    size: int
    digest: bytes | None
    first: int = -1
    last: int = -1
    head_before: bytes = b""
    head: bytes = b""

    @property
    def end(self) -> int:
        return self.at + self.size


@dataclass(frozen=True, slots=True)
class Deviation:
    """The first deviation of a file from its seals.

    Attributes:
        what: ``changed``, ``dropped``, ``swapped``, ``moved``, ``duplicated`` or ``added``.
        kind, number: of the unit, as ``chunk`` 12; the number is 0 where it has none.
        begin, end: its bytes; of a dropped or moved unit those that it had when it was sealed, otherwise in this file.
        first_entry, last_entry: entry numbers of the unit, low 32 bits; −1: none.
        text: what else is known.
    """

    what: str
    kind: str
    number: int
    begin: int
    end: int
    first_entry: int = -1
    last_entry: int = -1
    text: str = ""


def deviation_at(stream: IO[bytes], size: int, expected: Sequence[ExpectedUnit], number: int, shift: int) -> Deviation:
    """Return what has happened to the unit with a number, the first that is not at its place.

    Args:
        stream, size: the file.
        expected: the sealed units; the last one is a seal.
        shift: how far that seal is behind its place in the sealed file.
    """
    unit = expected[number]
    places = {each.digest: at for at, each in reversed(list(enumerate(expected))) if each.digest}
    here = list(islice(units(stream, unit.at, size), 3))
    found = here[0] if here else None
    if found and (other := places.get(found.digest)) is not None and other != number:
        if other > number:
            return _later_unit_here(stream, size, expected, number, other)
        copy = f"a copy of {_name(expected[other])}"
        if len(here) > 1 and here[1].digest == unit.digest:
            return _of_found(DUPLICATED, expected[other], found)
        following = expected[number + 1].digest if number + 1 < len(expected) else None
        if len(here) > 1 and here[1].digest == following:
            return _of(CHANGED, unit, unit.at, found.end, f"replaced by {copy}")
        return _of_found(DUPLICATED, expected[other], found)
    return _unknown_unit_here(stream, size, expected, number, shift, found)


def unnamed_deviation(stream: IO[bytes], size: int, expected: Sequence[ExpectedUnit], number: int) -> Deviation:
    """Return the deviation in a range whose seal is lost, so that its units cannot be named."""
    gap, after = expected[number], expected[number + 1]
    later = {each.digest for each in expected[number + 2 :]}
    known = next((each for each in units(stream, gap.at, size) if each.digest in later), None)
    if known and known.at < after.end:
        text = (
            f"with their seal; {count_text(known.at - gap.at, 'byte')} of this range "
            f"{by_count(known.at - gap.at, 'is', 'are')} there, which no seal covers now"
        )
        return Deviation(DROPPED, "records", 0, gap.at, after.end, text=text)
    return Deviation(CHANGED, "records", 0, gap.at, after.end, text="with their seal")


def _later_unit_here(
    stream: IO[bytes], size: int, expected: Sequence[ExpectedUnit], number: int, other: int
) -> Deviation:
    """In the place of one unit is another one that belongs behind it."""
    unit, later = expected[number], expected[other]
    digests: list[bytes] = []
    again = None  # the unit, behind its place
    copies = 0
    for found in units(stream, unit.at, size):
        digests.append(found.digest)
        copies += found.digest == later.digest
        if found.digest == unit.digest and again is None:
            again = found
    if again is None:
        until = f" to {_name(expected[other - 1])}" if other > number + 1 else ""
        return _of(DROPPED, unit, unit.at, unit.end, f"with all{until}" if until else "")
    if copies > 1:
        end = unit.at + later.size
        return Deviation(DUPLICATED, later.kind, later.number, unit.at, end, later.first, later.last)
    swapped = [later.digest, *(each.digest for each in expected[number + 1 : other]), unit.digest]
    if digests[: len(swapped)] == swapped:
        return _of(SWAPPED, unit, unit.at, again.end, f"with {_name(later)}")
    if len(digests) > 1 and digests[1] == unit.digest:
        return _of(MOVED, later, later.at, later.end, f"to byte {unit.at:,}, before {_name(unit)}")
    return _of(MOVED, unit, unit.at, unit.end, f"to byte {again.at:,}")


def _unknown_unit_here(
    stream: IO[bytes], size: int, expected: Sequence[ExpectedUnit], number: int, shift: int, found: FoundUnit | None
) -> Deviation:
    """In the place of a unit are bytes that were not sealed."""
    unit = expected[number]
    following = expected[number + 1] if number + 1 < len(expected) else None

    def follows(at: int) -> bool:
        return bool(following and following.digest and digest_of(stream, at, following.size) == following.digest) or (
            following is None and at == size
        )

    if follows(unit.end):
        return _of(CHANGED, unit, unit.at, unit.end)
    for each in units(stream, unit.at, size):
        if each.digest == unit.digest:
            kind = kind_of(found.opcode) if found else "bytes"
            return Deviation(ADDED, kind, 0, unit.at, each.at, text=f"before {_name(unit)}")
    if shift > 0 and digest_of(stream, unit.at + shift, unit.size) == unit.digest:
        return Deviation(ADDED, "bytes", 0, unit.at, unit.at + shift, text=f"before {_name(unit)}")
    if shift and unit.size + shift > 0 and follows(unit.end + shift):
        lost = f"{count_text(-shift, 'byte')} fewer" if shift < 0 else f"{count_text(shift, 'byte')} more"
        return _of(CHANGED, unit, unit.at, unit.end + shift, f"it has {lost} than when it was sealed")
    return _of(CHANGED, unit, unit.at, min(unit.end, size))


def _of(what: str, unit: ExpectedUnit, begin: int, end: int, text: str = "") -> Deviation:
    return Deviation(what, unit.kind, unit.number, begin, end, unit.first, unit.last, text)


def _of_found(what: str, unit: ExpectedUnit, found: FoundUnit) -> Deviation:
    return _of(what, unit, found.at, found.end)


def _name(unit: ExpectedUnit) -> str:
    return f"{unit.kind} {unit.number}" if unit.number else unit.kind

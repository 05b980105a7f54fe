"""Checking a sealed file: every byte against the signed digests, and the first deviation by name.

Up to the first deviation all offsets are those of the seals, so the check is one pass over the file.  Only at the
deviation are the records followed, to find out what has happened there (``deviation``).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted import files
from igtl_gateway.record.seal import keys
from igtl_gateway.record.seal.statement import NO_HEAD, next_head
from igtl_gateway.record.seal.time_stamps import TimeStamp, check_reply
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.deviation import Deviation, ExpectedUnit, deviation_at, unnamed_deviation
from igtl_gateway.record.sessionfile.records import MAGIC
from igtl_gateway.record.sessionfile.sealing import SEAL
from igtl_gateway.record.sessionfile.seals import FoundSeal, find_seals, has_name_of_seal
from igtl_gateway.record.sessionfile.stamped import Stamp, has_sealed_end, stamp_at
from igtl_gateway.record.sessionfile.units import data_end, digest_of, has_footer, units

#: States of a file: every byte is as it was sealed; the end is missing, and the rest is as it was sealed; something
#: was changed; it has no seals; it has seals, but none of a trusted key.
SEALED, CUT, CHANGED, UNSEALED, UNTRUSTED = "sealed", "cut", "changed", "unsealed", "untrusted"
#: Kind of what is behind the last seal of a file with a time stamp.
TIME_STAMP = "time stamp"


@dataclass(frozen=True, slots=True)
class SealReport:
    """The result for one file.

    Attributes:
        file: the file.
        state: ``SEALED``, ``CUT``, ``CHANGED``, ``UNSEALED`` or ``UNTRUSTED``.
        first: the first deviation, if something was changed.
        key: identifier of the key of the seals; "" without seals.
        trusted: whether the key is trusted; None if no trusted keys were given.
        introduced: whether it is trusted because a trusted key introduces it.
        recording, part: the recording, and the number of this part of it.
        last_part: whether the recording ends with this file; None if its last seal is missing.
        previous: SHA-256 of the last seal of the part before it; "" for the first.
        last_seal: SHA-256 of the last seal of this file; "" if that is missing.
        seals: number of valid seals.
        sealed_bytes: bytes from the beginning that are as they were sealed.
        sealed_entry: number of the last entry among them, low 32 bits; −1: none.
        unsealed_bytes: of a cut file, bytes behind its last seal.
        first_ns, last_ns: UTC ns in the first and in the last seal, by the clock of the machine that sealed.
        end_of_seals: offset behind the last seal.
        time_stamp: of the last seal; None if there is none.
    """

    file: Path
    state: str
    first: Deviation | None = None
    key: str = ""
    trusted: bool | None = None
    introduced: bool = False
    recording: str = ""
    part: int = 0
    last_part: bool | None = None
    previous: str = ""
    last_seal: str = ""
    seals: int = 0
    sealed_bytes: int = 0
    sealed_entry: int = -1
    unsealed_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    end_of_seals: int = 0
    time_stamp: TimeStamp | None = None


def check_seal(
    path: Path, trusted: frozenset[bytes] | None = None, authorities: tuple[Any, ...] | None = None
) -> SealReport:
    """Check the seal of a file.

    Args:
        path: the file.
        trusted: public keys; None: any key, which is worth as much as the way that its identifier came.
        authorities: certificates that may have signed a time stamp; None: it is not checked.

    Raises UnsupportedRecording if it cannot be opened, LimitExceeded, Unavailable.
    """
    with files.open_file(path) as stream:
        size = stream.seek(0, os.SEEK_END)
        found = find_seals(path, stream, size)
        if not found.valid:
            return SealReport(path, CHANGED if found.invalid else UNSEALED, _no_valid(size) if found.invalid else None)
        accepted = [each for each in found.valid if _is_trusted(each, trusted)]
        if not accepted:
            return SealReport(path, UNTRUSTED, key=keys.key_id(found.valid[0].statement.public), trusted=False)
        return _Check(path, stream, size, _one_recording(accepted), trusted).report(authorities)


def _no_valid(size: int) -> Deviation:
    return Deviation("changed", "file", 0, 0, size, text="it has the names of seals, but none of them is valid")


def _is_trusted(seal: FoundSeal, trusted: frozenset[bytes] | None) -> bool:
    statement = seal.statement
    return trusted is None or statement.public in keys.trusted_with(trusted, statement.introductions)


def _one_recording(found: list[FoundSeal]) -> list[FoundSeal]:
    """Return the seals of the file that most of them are about, each number once, in the order of their numbers."""
    files_: dict[tuple[bytes, str, int], dict[int, FoundSeal]] = {}
    for seal in found:
        statement = seal.statement
        key = (statement.public, statement.part.recording, statement.part.number)
        files_.setdefault(key, {}).setdefault(statement.checkpoint, seal)
    most = max(files_.values(), key=len)  # of equal numbers, the first in the file
    return [most[number] for number in sorted(most)]


class _Check:
    """The check of a file against the seals of one recording."""

    def __init__(
        self, path: Path, stream: IO[bytes], size: int, seals: list[FoundSeal], trusted: frozenset[bytes] | None
    ) -> None:
        self._path, self._stream, self._size, self._trusted = path, stream, size, trusted
        self._seals, self._expected = _expected_units(seals)

    def report(self, authorities: tuple[Any, ...] | None) -> SealReport:
        last = self._seals[-1]
        statement = last.statement
        first, sealed_bytes = self._first_deviation()
        state, unsealed = CHANGED, 0
        if first is None:
            first, state, sealed_bytes = self._behind(last)
            unsealed = self._size - sealed_bytes
        entries = [unit.last for unit in self._expected if unit.at + unit.size <= sealed_bytes and unit.last >= 0]
        end = statement.end_of_file
        stamp = stamp_at(self._stream, last.end, self._size) if end and state == SEALED else None
        checked = None
        if stamp:
            checked = TimeStamp() if authorities is None else check_reply(stamp.reply, last.sha256, authorities)
        return SealReport(
            self._path,
            state,
            first,
            keys.key_id(statement.public),
            None if self._trusted is None else True,
            self._trusted is not None and statement.public not in self._trusted,
            statement.part.recording,
            statement.part.number,
            end.last_part if end else None,
            statement.part.previous,
            last.sha256.hex() if end else "",
            len(self._seals),
            sealed_bytes,
            entries[-1] if entries else -1,
            unsealed if state == CUT else 0,
            self._seals[0].statement.time_ns,
            statement.time_ns,
            last.end,
            checked,
        )

    def _first_deviation(self) -> tuple[Deviation | None, int]:
        """Return the first deviation up to the last seal, and the bytes before it."""
        expected = self._expected
        for number, unit in enumerate(expected):
            if unit.digest is not None:
                if unit.at + unit.size > self._size or digest_of(self._stream, unit.at, unit.size) != unit.digest:
                    return deviation_at(self._stream, self._size, expected, number, self._shift), unit.at
            elif not self._has_head(unit):
                return unnamed_deviation(self._stream, self._size, expected, number), unit.at
        return None, self._seals[-1].end

    @property
    def _shift(self) -> int:
        """How far the last seal is behind the offset that it states."""
        last = self._seals[-1]
        return last.at - last.statement.end

    def _has_head(self, gap: ExpectedUnit) -> bool:
        """Whether the units in a range, of which the seal is lost, have the head that the next seal states."""
        head, at = gap.head_before, gap.at
        for unit in units(self._stream, gap.at, gap.at + gap.size):
            head, at = next_head(head, unit.digest), unit.end
        return head == gap.head and at == gap.at + gap.size

    def _behind(self, last: FoundSeal) -> tuple[Deviation | None, str, int]:
        """Return the deviation behind the last seal, the state of the file, and the bytes that are as sealed."""
        at, end = last.end, last.statement.end_of_file
        rest = self._size - at
        if end is None:
            missing = self._missing_last_seal(at)
            return missing, CHANGED if missing else CUT, at
        if stamp := stamp_at(self._stream, at, self._size):
            return self._behind_stamp(stamp, last)
        if digest_of(self._stream, at, end.size) == end.digest and rest >= end.size:
            if rest == end.size:
                return None, SEALED, self._size
            here = at + end.size
            return Deviation("added", "bytes", 0, here, self._size, text="behind the end of the file"), CHANGED, here
        if not self._ends_with_magic() and (rest < end.size or self._has_begun_stamp(at)):
            return None, CUT, at
        text = f"the index at the end of the file: {count_text(rest, 'byte')}, {end.size:,} sealed"
        return Deviation("changed", "index", 0, at, self._size, text=text), CHANGED, at

    def _behind_stamp(self, stamp: Stamp, last: FoundSeal) -> tuple[Deviation | None, str, int]:
        """As :meth:`_behind`, for a file with a time stamp behind its last seal."""
        end = last.statement.end_of_file
        problem = stamp.problem or ("" if last.sha256 in stamp.reply else "it is of another seal")
        if problem:
            return Deviation("changed", TIME_STAMP, 0, stamp.at, stamp.end, text=problem), CHANGED, stamp.at
        if end and has_sealed_end(self._stream, self._size, stamp, end):
            return None, SEALED, self._size
        if not self._ends_with_magic() and not has_footer(self._stream, stamp.end, self._size):
            return None, CUT, stamp.at
        text = f"the index at the end of the file: {count_text(self._size - stamp.end, 'byte')} behind the time stamp"
        return Deviation("changed", "index", 0, stamp.end, self._size, text=text), CHANGED, stamp.at

    def _has_begun_stamp(self, at: int) -> bool:
        """Return whether an attachment begins at an offset, as behind the last seal only a time stamp does."""
        self._stream.seek(at)
        return self._stream.read(1) == bytes([records.ATTACHMENT])

    def _missing_last_seal(self, at: int) -> Deviation | None:
        """Return the deviation of a file that was closed but has no last seal; None if its end was cut."""
        end = data_end(self._stream, at, self._size)
        if end is None and not self._ends_with_magic():
            return None
        for unit in units(self._stream, at, self._size):
            if unit.opcode == records.METADATA and has_name_of_seal(self._stream, unit.at):
                return Deviation("changed", SEAL, 0, unit.at, unit.end, text="the last seal is not valid")
        text = "the file has an end, but its last seal was changed or dropped, or what is before that"
        return Deviation("changed", SEAL, 0, at, end or self._size, text=text)

    def _ends_with_magic(self) -> bool:
        self._stream.seek(max(0, self._size - len(MAGIC)))
        return self._stream.read() == MAGIC


def _expected_units(seals: list[FoundSeal]) -> tuple[list[FoundSeal], list[ExpectedUnit]]:
    """Return the seals that continue each other, and the units up to the last of them.

    A range whose seal is lost is one unit without a digest, with the heads of the seals around it.
    """
    used: list[FoundSeal] = []
    expected: list[ExpectedUnit] = []
    count = _counter()
    at, head = 0, NO_HEAD
    for seal in seals:
        statement = seal.statement
        if statement.start < at or (statement.start == at and statement.head_before != head):
            continue  # of a key that sealed twice
        if statement.start > at:
            if used:  # the seal before the gap is known, although no seal has a row of it
                before = used[-1]
                expected.append(ExpectedUnit(SEAL, count(SEAL), at, before.size, before.digest))
                at, head = at + before.size, next_head(head, before.digest)
            expected.append(
                ExpectedUnit("records", 0, at, statement.start - at, None, head_before=head, head=statement.head_before)
            )
            at = statement.start
        for row in statement.units:
            expected.append(ExpectedUnit(row.kind, count(row.kind), at, row.size, row.digest, row.first, row.last))
            at += row.size
        head = statement.head
        used.append(seal)
    last = used[-1]
    expected.append(ExpectedUnit(SEAL, count(SEAL), at, last.size, last.digest))
    return used, expected


def _counter() -> Callable[[str], int]:
    counts: dict[str, int] = {}

    def count(kind: str) -> int:
        counts[kind] = counts.get(kind, 0) + 1
        return counts[kind]

    return count

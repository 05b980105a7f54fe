"""Sealing a file while it is written: which bytes a seal covers, and the record that holds it.

A seal is a metadata record ``igtl_gateway.seal`` with one item, the envelope: any MCAP tool opens the file.  It covers
all records between the seal before it and itself.  The last one also covers what follows it (the index and the end of
the file), so every byte of a closed file is under a signature.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.records import Metadata

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.record.seal import envelope
from igtl_gateway.record.seal.digest import new_digest
from igtl_gateway.record.seal.envelope import Envelope
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.seal.statement import NO_HEAD, EndOfFile, PartPlace, Statement, UnitRow, head_after, sign
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, MESSAGE_INDEX_HEAD, U64, pack

#: The item of the metadata record.
ENVELOPE_KEY = "envelope"
#: Maximum number of units of a seal, so that a reader needs little memory for one.
MOST_UNITS = 1024

#: Opcode → kind of a unit.
KINDS = {
    records.HEADER: "header",
    records.SCHEMA: "schema",
    records.CHANNEL: "channel",
    records.MESSAGE: "messages",
    records.CHUNK: "chunk",
    records.MESSAGE_INDEX: "message index",
    records.ATTACHMENT: "attachment",
    records.METADATA: "metadata",
}
SEAL = "seal"

#: Bytes of the pairs (time, offset) of a message index.
_PAIR = 2 * U64.size


def seal_record(found: Envelope) -> bytes:
    """Return the metadata record of a seal."""
    return pack(Metadata(name=SEAL_METADATA, metadata={ENVELOPE_KEY: envelope.pack(found)}))


def entry_numbers(chunk: Buffer, index: bytes, rows: tuple[tuple[int, int, int], ...]) -> tuple[int, int]:
    """Return the first and the last entry number of a chunk, whose messages lie in the order of their numbers.

    Args:
        chunk: its records, of the last message at least the head.
        index: its message indexes.
        rows: channel, offset in ``index`` and number of messages, for each of them.
    """
    begin = HEAD.size + MESSAGE_INDEX_HEAD.size
    firsts = [U64.unpack_from(index, at + begin + U64.size)[0] for _, at, _ in rows]
    lasts = [U64.unpack_from(index, at + begin + _PAIR * count - U64.size)[0] for _, at, count in rows]
    return _number(chunk, min(firsts)), _number(chunk, max(lasts))


def _number(chunk: Buffer, at: int) -> int:
    assert HEAD.unpack_from(chunk, at)[0] == MESSAGE
    return int(MESSAGE_HEAD.unpack_from(chunk, at + HEAD.size)[1])


@dataclass(frozen=True, slots=True)
class SealMark:
    """A place between two units of a file: the units since the last seal, and what that has to state."""

    units: tuple[UnitRow, ...]
    start: int
    head: bytes
    checkpoint: int


class Sealer:
    """Computes the seals of one file.

    Args:
        key: signs.
        name: of the file, for people.
        utc_ns: returns the time for the statements.
        part: the file.
    """

    def __init__(self, key: SigningKey, name: str, utc_ns: Callable[[], int], part: PartPlace) -> None:
        self.part = part
        #: SHA-256 of the last seal of the finished file.
        self.last_digest = ""
        self._key, self._name, self._utc_ns = key, name, utc_ns
        self._hash = new_digest()
        self._size = 0  # bytes of the unit so far
        self._units: list[UnitRow] = []
        self._start = 0
        self._head = NO_HEAD
        self._checkpoint = 0

    def __len__(self) -> int:
        """Number of units that are not sealed yet."""
        return len(self._units)

    def __bool__(self) -> bool:
        return True

    @property
    def is_due(self) -> bool:
        """Whether a unit that is not a seal is not sealed yet."""
        return any(unit.kind != SEAL for unit in self._units)

    @property
    def is_full(self) -> bool:
        """Whether the next seal has as many units as one may have."""
        return len(self._units) >= MOST_UNITS

    def update(self, data: Buffer) -> None:
        """Add bytes of a unit."""
        self._hash.update(data)
        self._size += len(data)

    def end_unit(self, kind: str, first: int = -1, last: int = -1) -> None:
        """End a unit, with its first and last entry number."""
        self._units.append(UnitRow(kind, self._size, self._hash.digest(), first, last))
        self._hash, self._size = new_digest(), 0

    def mark(self) -> SealMark:
        """Where it is now, at the end of a unit, for `go_back`."""
        return SealMark(tuple(self._units), self._start, self._head, self._checkpoint)

    def go_back(self, mark: SealMark) -> None:
        """Forget what came after a mark."""
        self._units, self._start, self._head, self._checkpoint = (
            list(mark.units),
            mark.start,
            mark.head,
            mark.checkpoint,
        )
        self._hash, self._size = new_digest(), 0

    def add(self, unit: UnitRow) -> None:
        """Add a unit that is in the file already."""
        self._units.append(unit)

    def seal(self) -> bytes:
        """Return the record that seals all units since the last one; it is the first unit of the next."""
        statement = self._statement(self._utc_ns(), None)
        record = seal_record(sign(statement, self._key))
        self._start, self._head, self._units = statement.end, statement.head, []
        self._checkpoint += 1
        return record

    def last_seal(self, end: Callable[[int], bytes], *, last_part: bool) -> tuple[bytes, bytes]:
        """Return the last seal, and the bytes that follow it up to the end of the file.

        Args:
            end: returns these bytes for a length of the seal; their number does not depend on it.
            last_part: the recording has no further part.
        """
        now_ns = self._utc_ns()
        stated = EndOfFile(len(end(0)), bytes(32), last_part)
        length = len(seal_record(sign(self._statement(now_ns, stated), self._key)))
        rest = end(length)
        stated = replace(stated, digest=new_digest().update(rest).digest())
        record = seal_record(sign(self._statement(now_ns, stated), self._key))
        self.last_digest = hashlib.sha256(record).hexdigest()
        return record, rest

    def _statement(self, time_ns: int, end_of_file: EndOfFile | None) -> Statement:
        units = tuple(self._units)
        return Statement(
            self._name,
            self.part,
            self._checkpoint,
            self._start,
            self._start + sum(unit.size for unit in units),
            self._head,
            head_after(self._head, units),
            units,
            time_ns,
            self._key.public,
            self._key.introductions,
            end_of_file,
        )


class SealSeries:
    """The sealers of the files of one recording, which refer to each other.

    Args:
        key: signs.
        utc_ns: returns the time for the statements.
    """

    def __init__(self, key: SigningKey, utc_ns: Callable[[], int]) -> None:
        self._key, self._utc_ns = key, utc_ns
        self._last: Sealer | None = None

    def next_file(self, path: Path, *, alone: bool = False) -> Sealer:
        """Return the sealer of the next part; of another recording if ``alone``, or if the last part has no end."""
        before = self._last
        part = PartPlace(os.urandom(16).hex())
        if before and before.last_digest and not alone:
            part = PartPlace(before.part.recording, before.part.number + 1, before.last_digest)
        return Sealer(self._key, path.name, self._utc_ns, part)

    def has_begun(self, sealer: Sealer) -> None:
        """Its file is there: the next one follows it."""
        self._last = sealer

"""The units of a file that a seal has digests of, found by one walk over its records."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

from igtl_gateway.record.seal.digest import new_digest
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.records import HEAD, MAGIC
from igtl_gateway.record.sessionfile.sealing import KINDS

_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class FoundUnit:
    """A unit in a file: its opcode, offset, bytes and BLAKE3."""

    opcode: int
    at: int
    size: int
    digest: bytes

    @property
    def end(self) -> int:
        return self.at + self.size


def digest_of(stream: IO[bytes], at: int, size: int) -> bytes:
    """Return the BLAKE3 of a range of a file; of a shorter one where the file ends."""
    stream.seek(at)
    found = new_digest()
    while size > 0 and (piece := stream.read(min(size, _PIECE))):
        found.update(piece)
        size -= len(piece)
    return found.digest()


def units(stream: IO[bytes], at: int, end: int) -> Iterator[FoundUnit]:
    """Yield the units from the offset of one up to the end of the data section or the first record that is cut.

    Args:
        at: 0, or the offset of a record.
        end: bytes of the file.
    """
    while (opcode := _opcode(stream, at, end)) is not None:
        stop = _unit_end(stream, at, end, opcode)
        if stop is None:
            return
        yield FoundUnit(opcode, at, stop - at, digest_of(stream, at, stop - at))
        at = stop


def data_end(stream: IO[bytes], at: int, end: int) -> int | None:
    """Return the offset of the end of the data section, from the offset of a record on; None if there is none."""
    while (head := _head(stream, at, end)) is not None:
        opcode, stop = head
        if opcode == records.DATA_END:
            return at
        at = stop
    return None


def has_footer(stream: IO[bytes], at: int, end: int) -> bool:
    """Return whether there is a footer with room for the last magic behind it, from the offset of a record on."""
    while (head := _head(stream, at, end)) is not None:
        opcode, at = head
        if opcode == records.FOOTER:
            return at + len(MAGIC) <= end
    return False


def kind_of(opcode: int) -> str:
    """Return the kind of a unit that begins with an opcode."""
    return KINDS.get(opcode, f"record 0x{opcode:02x}")


def _opcode(stream: IO[bytes], at: int, end: int) -> int | None:
    """Return the opcode of the unit at an offset; None at the end of the data section, and where there is no record."""
    head = _head(stream, at + (len(MAGIC) if at == 0 else 0), end)
    return None if head is None or head[0] == records.DATA_END else head[0]


def _unit_end(stream: IO[bytes], at: int, end: int, opcode: int) -> int | None:
    follower = {records.CHUNK: records.MESSAGE_INDEX, records.MESSAGE: records.MESSAGE}.get(opcode)
    head = _head(stream, at + (len(MAGIC) if at == 0 else 0), end)
    stop = None
    while head is not None:
        stop = head[1]
        head = _head(stream, stop, end)
        if head is None or head[0] != follower:
            break
    return stop


def _head(stream: IO[bytes], at: int, end: int) -> tuple[int, int] | None:
    """Return opcode and end of the record at an offset; None if there is no whole record."""
    stream.seek(at)
    data = stream.read(HEAD.size)
    if len(data) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(data)
    stop = at + HEAD.size + length
    return (opcode, stop) if opcode and stop <= end else None

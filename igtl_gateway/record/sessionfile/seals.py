"""The seals in a file: found anywhere in it, also where its records cannot be followed, and checked one by one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.seal import envelope, keys
from igtl_gateway.record.seal.digest import new_digest
from igtl_gateway.record.seal.envelope import Envelope
from igtl_gateway.record.seal.statement import Statement, parse
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.contents import Index
from igtl_gateway.record.sessionfile.index import read_index
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.records import HEAD, U32, Malformed
from igtl_gateway.record.sessionfile.sealing import ENVELOPE_KEY, seal_record

#: How the content of every seal begins.
_NEEDLE = U32.pack(len(SEAL_METADATA)) + SEAL_METADATA.encode()
_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class FoundSeal:
    """A valid seal: its offset, its bytes, their BLAKE3 as of any unit, their SHA-256, and what it states."""

    at: int
    size: int
    digest: bytes
    sha256: bytes
    statement: Statement

    @property
    def end(self) -> int:
        return self.at + self.size


@dataclass(frozen=True, slots=True)
class Seals:
    """The seals of a file.

    Attributes:
        valid: those with a signature of their own key, in the order of the file.
        invalid: number of other places with the name of a seal: invalid records, and each row of the index.
    """

    valid: list[FoundSeal]
    invalid: int


@dataclass(frozen=True, slots=True)
class StatedSeals:
    """What a file states about its seals, unchecked: identifiers of keys, number, whether there is a last seal."""

    keys: tuple[str, ...]
    seals: int
    closed: bool


def find_seals(path: Path, stream: IO[bytes], size: int) -> Seals:
    """Return all seals of a file.  Raises LimitExceeded, Unavailable."""
    valid: list[FoundSeal] = []
    invalid = 0
    for place in _places(path, stream, size):
        if valid and place < valid[-1].end:
            continue
        found = _parsed_seal(stream, place, size, str(path))
        if found and keys.verifies(found[1], found[0].statement.public):
            valid.append(found[0])
            limits.check_limit("count", len(valid), f"{path}: seals")
        else:
            invalid += 1
    return Seals(valid, invalid)


def stated_seals(path: Path) -> StatedSeals | None:
    """Return what a file states about its seals, which is not checked; None if it has none.  Raises LimitExceeded."""
    names, count, closed = set(), 0, False
    with files.open_file(path) as stream:
        size = stream.seek(0, os.SEEK_END)
        try:
            index = read_index(path, stream)
            places = [each.at for each in index.metadata if each.name == SEAL_METADATA]
        except LimitExceeded:
            raise
        except DamagedRecording:  # it was not closed
            places = list(_places(path, stream, size))
        for place in places:
            if found := _parsed_seal(stream, place, size, str(path)):
                names.add(found[1].key_id)
                count += 1
                closed = found[0].statement.end_of_file is not None
    return StatedSeals(tuple(sorted(names)), count, closed) if count else None


def ends_sealed(path: Path, stream: IO[bytes], index: Index, size: int) -> bool:
    """Return whether the last seal that the index names states the end of the file; its signature is not checked."""
    places = [each.at for each in index.metadata if each.name == SEAL_METADATA]
    found = _parsed_seal(stream, max(places), size, str(path)) if places else None
    return found is not None and found[0].statement.end_of_file is not None


def _parsed_seal(stream: IO[bytes], at: int, size: int, place: str) -> tuple[FoundSeal, Envelope] | None:
    """Return the seal at an offset, whose signature is not checked; None if there is none."""
    stream.seek(max(at, 0))
    head = stream.read(HEAD.size)
    if at < 0 or len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode != records.METADATA or length > min(size - at - HEAD.size, limits.current_limits().free):
        return None
    content = stream.read(length)
    try:
        metadata = records.parse_metadata(content)
        found = envelope.parse(metadata.metadata.get(ENVELOPE_KEY, ""), f"{place}: seal at offset {at}")
        statement = parse(found, f"{place}: seal at offset {at}")
    except (Malformed, DamagedRecording):
        return None
    record = head + content
    if seal_record(found) != record:
        return None
    digest = new_digest().update(record).digest()
    return FoundSeal(at, len(record), digest, hashlib.sha256(record).digest(), statement), found


def has_name_of_seal(stream: IO[bytes], at: int) -> bool:
    """Return whether the record at an offset has the name of a seal."""
    stream.seek(at + HEAD.size)
    return stream.read(len(_NEEDLE)) == _NEEDLE


def _places(path: Path, stream: IO[bytes], size: int) -> Iterator[int]:
    """Yield the offsets of records that have the name of a seal.  Raises LimitExceeded."""
    deadline = limits.Deadline(files.stored_bytes(path, size))
    base, rest = 0, b""
    while True:
        stream.seek(base + len(rest))
        piece = stream.read(_PIECE)
        data = rest + piece
        at = data.find(_NEEDLE)
        while at >= 0:
            deadline.check(str(path))
            yield base + at - HEAD.size
            at = data.find(_NEEDLE, at + 1)
        if not piece:
            return
        keep = min(len(data), len(_NEEDLE) - 1)
        base, rest = base + len(data) - keep, data[len(data) - keep :]

"""What a seal states: the records since the seal before it, with a BLAKE3 of each, and the end of the file.

A *unit* is what one digest covers: a record between the first magic and the end of the data section; a chunk with the
message indexes behind it; messages in a row outside of chunks; the magic with the header.  A statement has a row for
each unit since the last one, the seal before it included.  The *head* is a chain over all units of the file:
``head = SHA-256(head before + digest of the unit)``, from 32 zero bytes on.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.shape import anything, fields, list_of, number, text, truth
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.record.seal import digest as digests
from igtl_gateway.record.seal.envelope import Envelope
from igtl_gateway.record.seal.keys import SigningKey, public_of

STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "urn:igtl-gateway:seal:v1"

#: The head before the first unit.
NO_HEAD = bytes(32)

_SHA256 = re.compile(r"[0-9a-f]{64}")
_RECORDING = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, slots=True)
class UnitRow:
    """A unit: its kind, bytes, BLAKE3, and its first and last entry number (low 32 bits; −1: no entries)."""

    kind: str
    size: int
    digest: bytes
    first: int = -1
    last: int = -1


@dataclass(frozen=True, slots=True)
class EndOfFile:
    """What is behind the last seal of a file: bytes, BLAKE3, and whether the recording has no further part."""

    size: int
    digest: bytes
    last_part: bool


@dataclass(frozen=True, slots=True)
class PartPlace:
    """A file of a recording.

    Attributes:
        recording: 32 hexadecimal digits, equal in all parts of a recording.
        number: of the part, from 0.
        previous: SHA-256 of the last seal of the part before it, as hexadecimal digits; "" for the first part.
    """

    recording: str
    number: int = 0
    previous: str = ""


@dataclass(frozen=True, slots=True)
class Statement:
    """What one seal states.

    Attributes:
        name: name of the file when it was sealed; nothing is checked against it.
        part: the file.
        checkpoint: number of the seal in the file, from 0.
        start, end: offsets of the first unit, and of the seal itself.
        head_before, head: of the chain.
        units: in the order of the file.
        time_ns: UTC ns of the clock of the machine that sealed.
        public: key that signs.
        introductions: of the key.
        end_of_file: in the last seal only.
    """

    name: str
    part: PartPlace
    checkpoint: int
    start: int
    end: int
    head_before: bytes
    head: bytes
    units: tuple[UnitRow, ...]
    time_ns: int
    public: bytes
    introductions: tuple[str, ...] = ()
    end_of_file: EndOfFile | None = None


def next_head(head: bytes, digest: bytes) -> bytes:
    """Return the head of the chain behind one more unit."""
    return hashlib.sha256(head + digest).digest()


def head_after(head: bytes, units: Sequence[UnitRow]) -> bytes:
    """Return the head of the chain behind some units."""
    for unit in units:
        head = next_head(head, unit.digest)
    return head


def sign(statement: Statement, key: SigningKey) -> Envelope:
    """Return the signed envelope of a statement."""
    given = statement
    end = given.end_of_file
    document = {
        "_type": STATEMENT_TYPE,
        "subject": [{"name": given.name, "digest": {"igtlGatewaySealHead": given.head.hex()}}],
        "predicateType": PREDICATE_TYPE,
        "predicate": {
            "recording": given.part.recording,
            "part": given.part.number,
            "previous_part": given.part.previous,
            "checkpoint": given.checkpoint,
            "start": given.start,
            "end": given.end,
            "head_before": given.head_before.hex(),
            "head": given.head.hex(),
            "digest": digests.NAME,
            "units": [[each.kind, each.size, each.digest.hex(), each.first, each.last] for each in given.units],
            "time_ns": given.time_ns,
            "key": given.public.hex(),
            "introductions": list(given.introductions),
            "end_of_file": end and {"size": end.size, "digest": end.digest.hex(), "last_part": end.last_part},
        },
    }
    return key.sign(json.dumps(document, ensure_ascii=True, separators=(",", ":")).encode())


def _digest(value: Any, place: str) -> None:
    text(value, place)
    if not _SHA256.fullmatch(value):
        raise DamagedRecording(f"{place}: found other text, expected 64 hexadecimal digits")


def _name_of_digest(value: Any, place: str) -> None:
    text(value, place)
    if value != digests.NAME:
        raise DamagedRecording(f"{place}: found another digest, expected {digests.NAME}")


def _entry_number(value: Any, place: str) -> None:
    if value != -1 or isinstance(value, bool):
        number(value, place)


def _row(value: Any, place: str) -> None:
    shapes = (text, number, _digest, _entry_number, _entry_number)
    if not isinstance(value, list) or len(value) != len(shapes):
        raise DamagedRecording(f"{place}: found another value, expected kind, size, digest, first and last entry")
    for shape, item in zip(shapes, value, strict=True):
        shape(item, place)


def _recording(value: Any, place: str) -> None:
    text(value, place)
    if not _RECORDING.fullmatch(value):
        raise DamagedRecording(f"{place}: found other text, expected 32 hexadecimal digits")


_END = fields({"size": number, "digest": _digest, "last_part": truth}, needed=("size", "digest", "last_part"))
_PREDICATE = {
    "recording": _recording,
    "part": number,
    "previous_part": lambda value, place: None if value == "" else _digest(value, place),
    "checkpoint": number,
    "start": number,
    "end": number,
    "head_before": _digest,
    "head": _digest,
    "digest": _name_of_digest,
    "units": list_of(_row),
    "time_ns": number,
    "key": _digest,
    "introductions": list_of(text),
    "end_of_file": lambda value, place: None if value is None else _END(value, place),
}
_DOCUMENT = fields(
    {
        "predicateType": text,
        "subject": list_of(fields({"name": text}, needed=("name",))),
        "predicate": fields(_PREDICATE, needed=tuple(_PREDICATE)),
    },
    needed=("predicateType", "subject", "predicate"),
    other=anything,
)


def parse(found: Envelope, place: str) -> Statement:
    """Parse the statement in an envelope; the signature is not checked.

    Raises DamagedRecording for another statement, and for one that contradicts itself.
    """
    try:
        document = parse_json(str(found.payload, "utf-8"), place)
    except UnicodeDecodeError:
        raise DamagedRecording(f"{place}: found other bytes, expected UTF-8") from None
    _DOCUMENT(document, place)
    if document["predicateType"] != PREDICATE_TYPE or not document["subject"]:
        raise DamagedRecording(f"{place}: found another statement, expected {PREDICATE_TYPE}")
    given = document["predicate"]
    units = tuple(UnitRow(row[0], row[1], bytes.fromhex(row[2]), row[3], row[4]) for row in given["units"])
    end = given["end_of_file"]
    statement = Statement(
        document["subject"][0]["name"],
        PartPlace(given["recording"], given["part"], given["previous_part"]),
        given["checkpoint"],
        given["start"],
        given["end"],
        bytes.fromhex(given["head_before"]),
        bytes.fromhex(given["head"]),
        units,
        given["time_ns"],
        public_of(given["key"]),
        tuple(given["introductions"]),
        end and EndOfFile(end["size"], bytes.fromhex(end["digest"]), end["last_part"]),
    )
    sized = statement.start + sum(unit.size for unit in units) == statement.end
    if not sized or not all(unit.size for unit in units) or head_after(statement.head_before, units) != statement.head:
        raise DamagedRecording(f"{place}: found a statement that contradicts itself")
    return statement

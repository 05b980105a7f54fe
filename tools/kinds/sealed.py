"""Sealed recordings, and replies of time-stamp authorities."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from igtl_gateway.record.seal import envelope
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.seal.time_stamps import TimeStamp, check_reply, load_authorities
from igtl_gateway.record.sessionfile.records import HEAD, METADATA
from igtl_gateway.record.sessionfile.seal_check import check_seal
from tests.record.seal.authority import new_authority
from tools import mcap_build
from tools.kinds.values import Maker
from tools.seal_mutations import Original, sealed_file

Files = Mapping[str, bytes]
DIGEST = hashlib.sha256(b"a seal").digest()


@cache
def _key() -> SigningKey:
    private = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    return SigningKey(private, private.public_key().public_bytes_raw())


@cache
def _sealed() -> Original:
    with tempfile.TemporaryDirectory() as folder:
        return sealed_file(Path(folder) / "a.mcap", _key(), entries=60, each=20)


def seal(make: Maker) -> Files:
    """A sealed recording: any value of a statement, which is signed again, and of its envelope."""
    original = _sealed()
    unit = original.seals[make.rng.randrange(len(original.seals))]
    name, items = _metadata(original.data[unit.at + HEAD.size : unit.end])
    key = next(key for key, text in items.items() if text.startswith('{"payload"'))
    payload = envelope.parse(items[key], "a.mcap").payload
    document = json.loads(payload)
    written = make.json("statement", document)
    if written != json.dumps(document):
        payload = written.encode("utf-8", "surrogatepass")
    signed = json.loads(envelope.pack(_key().sign(payload)))
    items[key] = make.json("envelope", signed).encode("utf-8", "backslashreplace").decode()
    content = make.blob("metadata", mcap_build.metadata(name, items)[:])
    record = HEAD.pack(METADATA, make.length("metadata.length", len(content), 64)) + content
    data = original.data[: unit.at] + record + original.data[unit.end :]
    return {"a.mcap": data[:-30] + make.words("end", data[-30:], 30, 1)}


def read_seal(path: Path, _rng: Random) -> str:
    """The check of a seal."""
    check_seal(path)
    return "read"


def _metadata(data: bytes) -> tuple[str, dict[str, str]]:
    """Name and items of a metadata record."""
    words, at = [], 0
    for is_size in (False, True):
        size = struct.unpack_from("<I", data, at)[0]
        at += 4
        if not is_size:
            words.append(data[at : at + size].decode())
            at += size
    while at < len(data):
        size = struct.unpack_from("<I", data, at)[0]
        words.append(data[at + 4 : at + 4 + size].decode())
        at += 4 + size
    return words[0], dict(zip(words[1::2], words[2::2], strict=True))


# -- replies of RFC 3161 ---------------------------------------------------------------------------------------------


@cache
def authority() -> tuple[bytes, tuple[Any, ...]]:
    """A reply about ``DIGEST``, and the certificates that confirm it."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-tsa-"))
    try:
        made = new_authority(folder / "authority", "Clock")
        return made.reply(DIGEST.hex()).read_bytes(), load_authorities([made.root])
    finally:
        shutil.rmtree(folder)


def time_stamp(make: Maker) -> Files:
    """A reply: tag, length and content of each of its values in DER."""
    reply, _ = authority()
    return {"a.tsr": _der(make, "der", reply)}


def _der(make: Maker, place: str, data: bytes) -> bytes:
    made, at, number = b"", 0, 0
    while at < len(data):
        tag, size = data[at], data[at + 1]
        at += 2
        if size > 0x7F:
            more = size & 0x7F
            size = int.from_bytes(data[at : at + more], "big")
            at += more
        content, where = data[at : at + size], f"{place}.{number}"
        inner = _der(make, where, content) if tag & 0x20 else make.blob(f"{where}.bytes", content)
        length = make.length(f"{where}.length", len(inner), 64)
        made += bytes([make.number(f"{where}.tag", tag, "u8")]) + _length(length) + inner
        at, number = at + size, number + 1
    return made


def _length(size: int) -> bytes:
    if size < 0x80:
        return bytes([size])
    words = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes([0x80 | len(words)]) + words


def read_time_stamp(path: Path, _rng: Random) -> str:
    """The check of a reply."""
    found: TimeStamp = check_reply(path.read_bytes(), DIGEST, authority()[1])
    return "read" if not found.problem else "refused"

"""Messages of other implementations: read as their authors read them, written back bit for bit.

``data/corpus`` was encoded by the C++ library 3.1, with what it decodes beside it; ``data/captures`` is what its
example programs sent to each other.  ``vectors.py`` makes the C library's own test messages.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ChecksumMismatch, WireError
from igtl_gateway.base.stamp import fraction_to_ns
from igtl_gateway.wire import decode, describe, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.query import QUERIES
from igtl_gateway.wire.registry import BODIES
from tests.tables import all_hold
from tests.wire import handmade
from tests.wire.vectors import Vector, vectors

DATA = Path(__file__).parents[1] / "data"
CORPUS = DATA / "corpus"
CASES = {path.stem: path for path in sorted(CORPUS.glob("*.bin"))}
#: The C++ library's data about itself, and the place of the message in its file.
NOT_OURS = frozenset({"index", "offset"})
#: Names that are read and never written.
ALIASES = frozenset({"QTRANS", "COLORTABLE", "CAPABIL"})


def expected(path: Path) -> list[dict[str, Any]]:
    """The decoded messages beside a corpus file, without the library's own remarks."""
    rows = json.loads(path.with_suffix(".json").read_text("utf-8"))
    return [
        {key: value for key, value in row.items() if key not in NOT_OURS and not key.startswith("lib")} for row in rows
    ]


def byte_by_byte(data: bytes) -> Iterator[bytes]:
    framer = Framer()
    for at in range(len(data)):
        yield from map(bytes, framer.feed(data[at : at + 1]))
    assert framer.pending == 0


def framed(data: bytes) -> list[bytes]:
    framer = Framer()
    messages = [bytes(one) for one in framer.feed(data)]
    assert framer.pending == 0
    return messages


def test_the_corpus_is_here() -> None:
    """A file for every type that some library writes; of many queries the documents have the names only."""
    types = {path.stem.partition("_v")[0] for path in CORPUS.glob("*.bin")}
    assert types >= BODIES.keys() - QUERIES.keys() - ALIASES
    assert len(types & QUERIES.keys()) >= 15


def test_handmade_files() -> None:
    """The files of the types that the library of the corpus lacked are what their program makes."""
    for name, (data, meaning) in handmade.files().items():
        path = CORPUS / f"{name}.bin"
        assert path.read_bytes() == data
        assert json.loads(path.with_suffix(".json").read_text("utf-8")) == [meaning]


def test_decoded_as_the_library_does() -> None:
    def check(path: Path) -> None:
        messages = framed(path.read_bytes())
        wanted = expected(path)
        assert len(messages) == len(wanted)
        for data, want in zip(messages, wanted, strict=True):
            shown = describe(data)
            assert shown == want

    all_hold(CASES, check)


def test_written_back_bit_for_bit() -> None:
    def check(path: Path) -> None:
        for data in framed(path.read_bytes()):
            message = decode(data)
            assert join(encode(message)) == data
            assert type(message.content) is BODIES[message.type]

    all_hold(CASES, check)


def test_byte_by_byte_and_with_more_behind() -> None:
    def check(path: Path) -> None:
        data = path.read_bytes()
        assert list(byte_by_byte(data + data)) == framed(data) * 2
        framer = Framer()
        assert [bytes(one) for one in framer.feed(data + data[:30])] == framed(data)
        assert framer.pending == 30

    all_hold({name: path for name, path in CASES.items() if path.stat().st_size < 2000}, check)


def test_damage_is_noticed() -> None:
    """A flipped bit in any body breaks the CRC; one byte less or more is no message."""

    def check(path: Path) -> None:
        data = framed(path.read_bytes())[0]
        with pytest.raises(WireError):
            decode(data[:-1])
        with pytest.raises(WireError):
            decode(data + b"\x00")
        if len(data) > 58:
            bent = bytearray(data)
            bent[-1] ^= 1
            with pytest.raises(ChecksumMismatch):
                decode(bytes(bent))
            assert describe(bytes(bent))["crc_ok"] is False

    all_hold(CASES, check)


def test_captured_traffic() -> None:
    def check(path: Path) -> None:
        data = path.read_bytes()
        messages = framed(data)
        assert messages
        for one in messages:
            assert join(encode(decode(one))) == one
        assert b"".join(messages) == data

    all_hold({path.name: path for path in sorted((DATA / "captures").glob("*.igtl"))}, check)


def common(of: Any, other: Any) -> Any:
    """``of`` with those keys only that ``other`` has too: the vectors give some values in other words."""
    if isinstance(of, dict) and isinstance(other, dict):
        return {key: common(value, other[key]) for key, value in of.items() if key in other}
    if isinstance(of, list) and isinstance(other, list) and len(of) == len(other):
        return [common(*pair) for pair in zip(of, other, strict=True)]
    return of


def test_vectors_of_the_c_library() -> None:
    """What is made here is the library's message, and it means what the library's tests assert."""

    def check(vector: Vector) -> None:
        if vector.sha256 is not None:
            assert hashlib.sha256(vector.data).hexdigest() == vector.sha256
        message = decode(vector.data)
        shown = describe(vector.data)
        for key in ("type", "device_name", "header_version"):
            assert shown[key] == vector.facts[key]
        assert shown["crc_ok"] is True
        assert shown["timestamp"]["frac"] == vector.facts["frac"]
        assert shown.get("metadata") == vector.facts.get("metadata")
        assert join(encode(message)) == vector.data
        want = deepcopy(vector.facts["expected"])
        for element in want.get("elements", ()):
            if "timestamp_raw" in element:  # a tick word below one second
                element["timestamp"] = {"sec": 0, "nanosec": fraction_to_ns(element.pop("timestamp_raw"))}
        told = common(want, shown["content"])
        assert told == common(shown["content"], want) != {}

    all_hold({vector.name: vector for vector in vectors()}, check)

"""Notes: those of a file can be anything; the result is the note, or a note that it is invalid."""

from __future__ import annotations

import json
from typing import Any

import pytest

from igtl_gateway.gateway.log.note import UNREADABLE, Level, Note
from tests.tables import table

GOOD = {"level": "WARN", "code": "bad_crc", "text": "a fact", "stream": "IMAGE/probe", "data": {}}


#: Every digit; also the other case.
HEX = "0123456789abcdefABCDEF"


def packed(**changes: Any) -> bytes:
    return json.dumps(GOOD | changes).encode()


def test_a_note_comes_back() -> None:
    note = Note(Level.ERROR, "a", "b", "c", {"peer": "x", "dropped": {"a": 1}, "head": HEX, "other": [1, None]})
    assert Note.unpack(note.pack()) == Note.of(note.pack()) == note


@table(
    "payload",
    [
        b"", b"{}", b"[1]", b'"text"', b"\xff\0", b"5", b"[" * 100_000, b"9" * 5000,
        packed(level="LOUD"), packed(level=[]), packed(level=30), packed(code=5), packed(text=None), packed(stream={}),
        packed(data=[]), packed(data="x"), packed(data={"peer": 5}), packed(data={"received_bytes": "many"}),
        packed(data={"dropped": {"a": "b"}}), packed(data={"dropped": [1]}), packed(data={"head": "xyz"}),
        packed(data={"step_ns": 1.5}), packed(data={"count": True}), packed(data={"sent_messages": 10**40}),
    ],
)  # fmt: skip
def test_what_is_no_note_is_told_as_such(payload: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Note.unpack(payload)
    assert Note.of(payload) is UNREADABLE

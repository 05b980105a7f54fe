"""What a seal states: it is read as it was signed, its chain and its sizes must agree, other values are refused."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.seal.envelope import Envelope
from igtl_gateway.record.seal.keys import SigningKey, verifies
from igtl_gateway.record.seal.statement import (
    NO_HEAD,
    EndOfFile,
    PartPlace,
    Statement,
    UnitRow,
    head_after,
    next_head,
    parse,
    sign,
)
from tests.tables import table

KEY = SigningKey.generate()
UNITS = (UnitRow("header", 30, b"\1" * 32), UnitRow("chunk", 70, b"\2" * 32, 1, 9))
END = EndOfFile(500, b"\3" * 32, True)
ONE = Statement(
    "session.mcap", PartPlace("0" * 32), 0, 0, 100, NO_HEAD, head_after(NO_HEAD, UNITS), UNITS, 7, KEY.public, (), END
)


def test_the_chain_is_of_sha256() -> None:
    head = hashlib.sha256(bytes(32) + b"\1" * 32).digest()
    assert next_head(NO_HEAD, b"\1" * 32) == head
    assert head_after(NO_HEAD, UNITS) == hashlib.sha256(head + b"\2" * 32).digest()
    assert head_after(b"\5" * 32, ()) == b"\5" * 32


_digests = st.binary(min_size=32, max_size=32)
_units = st.builds(
    UnitRow, st.sampled_from(["chunk", "seal", "record 0x99"]), st.integers(1, 2**40), _digests,
    st.integers(-1, 2**32 - 1), st.integers(-1, 2**32 - 1),
)  # fmt: skip
_texts = st.text(max_size=12)


@st.composite
def statements(draw: st.DrawFn) -> Statement:
    units, before, start = tuple(draw(st.lists(_units, max_size=4))), draw(_digests), draw(st.integers(0, 2**40))
    previous = draw(st.just("") | _digests.map(bytes.hex))
    return Statement(
        draw(_texts), PartPlace(draw(st.binary(min_size=16, max_size=16)).hex(), draw(st.integers(0, 99)), previous),
        draw(st.integers(0, 99)), start, start + sum(unit.size for unit in units), before, head_after(before, units),
        units, draw(st.integers(0, 2**63 - 1)), KEY.public, tuple(draw(st.lists(_texts, max_size=2))),
        draw(st.none() | st.builds(EndOfFile, st.integers(0, 2**40), _digests, st.booleans())),
    )  # fmt: skip


@given(statements())
def test_what_was_signed_is_read(statement: Statement) -> None:
    envelope = sign(statement, KEY)
    assert verifies(envelope, KEY.public)
    assert envelope.payload.isascii()
    assert parse(envelope, "here") == statement


def document() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(sign(ONE, KEY).payload)
    return found


def read(changed: dict[str, Any]) -> Statement:
    return parse(Envelope(json.dumps(changed).encode(), KEY.id, b""), "here")


def test_other_tools_find_an_in_toto_statement() -> None:
    found = document()
    assert found["_type"] == "https://in-toto.io/Statement/v1"
    assert found["predicateType"] == "urn:igtl-gateway:seal:v1"
    assert found["subject"] == [{"name": "session.mcap", "digest": {"igtlGatewaySealHead": ONE.head.hex()}}]
    assert found["predicate"]["units"][1] == ["chunk", 70, "02" * 32, 1, 9]
    assert read(found) == ONE


def test_fields_of_others_are_passed_over_beside_the_predicate_only() -> None:
    assert read(document() | {"more": [1]}) == ONE


def predicate(**changes: Any) -> Callable[[dict[str, Any]], object]:
    return lambda found: found["predicate"].update(changes)


def unit(at: int, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda found: found["predicate"]["units"][1].__setitem__(at, value)


@table(
    ("change", "reason"),
    [
        (lambda found: found.update(predicateType="urn:other"), "here: found another statement, expected urn:igtl-"),
        (lambda found: found.update(subject=[]), "here: found another statement"),
        (lambda found: found.update(subject=[{}]), "here.subject[0]: found no field 'name'"),
        (lambda found: found.pop("predicate"), "here: found no field 'predicate'"),
        (lambda found: found["predicate"].pop("head"), "here.predicate: found no field 'head'"),
        (predicate(recording="0" * 31), "here.predicate.recording: found other text, expected 32 hexadecimal digits"),
        (predicate(recording="A" * 32), "expected 32 hexadecimal digits"),
        (predicate(part=-1), "here.predicate.part: found -1, expected an integer of 0 or more"),
        (predicate(previous_part="0"), "here.predicate.previous_part: found other text, expected 64 hexadecimal"),
        (predicate(previous_part=None), "here.predicate.previous_part: found null, expected a string"),
        (predicate(digest="sha256"), "here.predicate.digest: found another digest, expected"),
        (predicate(head="0" * 63), "here.predicate.head: found other text, expected 64 hexadecimal digits"),
        (predicate(key="g" * 64), "here.predicate.key: found other text"),
        (predicate(introductions="a"), 'here.predicate.introductions: found "a", expected an array'),
        (predicate(end_of_file={"size": 1}), "here.predicate.end_of_file: found no field 'digest'"),
        (predicate(end_of_file={"size": 1, "digest": "0" * 64, "last_part": 1}), "last_part: found 1, expected true"),
        (predicate(units=[[]]), "here.predicate.units[0]: found another value, expected kind, size, digest, first"),
        (unit(0, 5), "here.predicate.units[1]: found 5, expected a string"),
        (unit(1, -1), "here.predicate.units[1]: found -1, expected an integer"),
        (unit(2, ""), "here.predicate.units[1]: found other text, expected 64 hexadecimal digits"),
        (unit(3, -2), "here.predicate.units[1]: found -2, expected an integer"),
        (unit(4, True), "here.predicate.units[1]: found true, expected an integer"),
        # what contradicts itself
        (predicate(start=1), "here: found a statement that contradicts itself"),
        (predicate(end=101), "contradicts itself"),
        (predicate(head="0" * 64), "contradicts itself"),
        (predicate(head_before="1" * 64), "contradicts itself"),
        (unit(2, "4" * 64), "contradicts itself"),
        (unit(1, 71), "contradicts itself"),
        (lambda found: (unit(1, 0)(found), predicate(end=30)(found)), "contradicts itself"),
    ],
)
def test_another_statement_is_refused(change: Callable[[dict[str, Any]], object], reason: str) -> None:
    changed = copy.deepcopy(document())
    change(changed)
    with pytest.raises(DamagedRecording) as error:
        read(changed)
    assert reason in str(error.value)


def test_bytes_that_are_no_text() -> None:
    with pytest.raises(DamagedRecording, match="here: found other bytes, expected UTF-8"):
        parse(Envelope(b"\xff", KEY.id, b""), "here")


def test_a_statement_without_units_covers_nothing() -> None:
    empty = replace(ONE, units=(), end=0, head=NO_HEAD, end_of_file=None)
    assert parse(sign(empty, KEY), "here") == empty

"""Text of others on a terminal, and JSON of others within limits."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.text import json_line, parse_json, parse_toml, printable
from tests.tables import table


@table(
    ("text", "shown"),
    [
        ("Sonde Ü 探", "Sonde Ü 探"),
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("a\nb\r", "a\\x0ab\\x0d"),
        ("\x9b1m", "\\x9b1m"),
        ("\u202egnp.exe", "\\u202egnp.exe"),
        ("\u2028", "\\u2028"),
        ("\udcff", "\\udcff"),
        ("\x7f\U000e0001", "\\x7f\\U000e0001"),
        ("no\xa0break", "no\xa0break"),
    ],
)
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text(st.characters()))
def test_what_is_printed_stays_on_its_line(text: str) -> None:
    for shown in (printable(text), json_line({text: text})):
        assert len(shown.splitlines()) <= 1
        assert not set(shown) & {*map(chr, range(32)), *map(chr, range(127, 160))}
        shown.encode()


@given(st.text(st.characters()))
def test_json_means_the_same(text: str) -> None:
    assert json.loads(json_line({"a": text})) == {"a": text}


def test_json_that_nests_too_deep() -> None:
    with pytest.raises(LimitExceeded, match="depth"):
        parse_json("[" * 100_000, "ledger")
    assert parse_json("[" * 60 + "]" * 60, "ledger")
    assert parse_json("[[]," * 60 + "1" + "]" * 60, "ledger")


@pytest.mark.parametrize("text", ["", "{", "nope", "1" * 5000, '{"a":}'])
def test_what_is_no_json(text: str) -> None:
    with pytest.raises(DamagedRecording, match="ledger"):
        parse_json(text, "ledger")


def test_toml_within_the_limits() -> None:
    assert parse_toml(b"[gateway]\na.b = '1.2.3'  # ...\n", "x.toml") == {"gateway": {"a": {"b": "1.2.3"}}}
    frames = ", ".join(f'"a.{number}"' for number in range(500))
    assert len(parse_toml(f"a = [{frames}, 1.5, 2.5]".encode(), "x.toml")["a"]) == 502


@table(
    ("data", "told"),
    [
        (b"a = " + b"[" * 100_000, "x.toml: found 65, expected at most 64 .--limit depth=64"),
        (b".".join([b"a"] * 1000) + b" = 1", "--limit depth=64"),
        (b"[" + b".".join([b"'a'"] * 1000) + b"]", "--limit depth=64"),
        (b"a = 1\n" * 250_000, "--limit count=200000"),
        (b"a = '" + b"x" * (65 << 20) + b"'", "--limit free="),
        (b"a = ", "x.toml: is not valid TOML"),
        (b"a = '\xff'", "x.toml: is not valid TOML"),
        (b"b = 1\na = 0x" + b"f" * 20_000, "x.toml: byte 8: found a number of more than 1,000 digits"),
    ],
)
def test_toml_beyond_them(data: bytes, told: str) -> None:
    with pytest.raises(DamagedRecording, match=told):
        parse_toml(data, "x.toml")

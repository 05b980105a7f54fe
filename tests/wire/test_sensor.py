"""SENSOR: its bytes, and unit words and their text: the examples of the protocol, every code, the inverse."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.sensor import PREFIXES, UNITS, Sensor, parse_unit, unit_parts, unit_text, unit_word
from tests import strategies
from tests.tables import table
from tests.wire.contents import check_golden

NONE = (0, 0)

#: Prefix, parts, word, text: worked examples of the document and of the library's vectors.
EXAMPLES = [
    (0x0, [], 0x0000000000000000, ""),
    (0x0, [(0x01, 1), (0x03, -2)], 0x00443E0000000000, "m/s^2"),
    (0xB, [(0x01, 1), (0x03, -2)], 0xB0443E0000000000, "mm/s^2"),
    (0x0, [(0x0B, 1), (0x01, 1)], 0x02C4110000000000, "N.m"),
    (0x3, [(0x02, 1)], 0x3084000000000000, "kg"),
    (0xB, [(0x10, 1)], 0xB404000000000000, "mV"),
    (0x0, [(0x05, 1)], 0x0144000000000000, "K"),
    (0xB, [(0x01, 1)], 0xB044000000000000, "mm"),
    (0x3, [(0x02, 1), (0x01, 1), (0x03, -2)], 0x3084110F80000000, "kg.m/s^2"),
]


@table(("prefix", "parts", "word", "text"), EXAMPLES, ids=[case[3] or "none" for case in EXAMPLES])
def test_examples(prefix: int, parts: list[tuple[int, int]], word: int, text: str) -> None:
    assert unit_word(prefix, parts) == word
    assert unit_parts(word) == (prefix, (*parts, *[NONE] * (6 - len(parts))))
    assert unit_text(word) == text
    assert parse_unit(text) == word


def test_the_torque_of_the_document_is_shown_as_it_was_meant() -> None:
    """Its exponents are 0 by mistake; no unit at all would be the letter of it."""
    assert unit_parts(0x02C0100000000000) == (0, ((0x0B, 0), (0x01, 0), NONE, NONE, NONE, NONE))
    assert unit_text(0x02C0100000000000) == "N.m"
    assert parse_unit("N.m") == 0x02C4110000000000  # and never written so


@table(
    ("prefix", "parts", "text"),
    [
        (0x3, [(0x03, -1)], "10^3.s^-1"),  # ks^-1 would be 1/(1000 s)
        (0xB, [(0x01, 2)], "10^-3.m^2"),  # mm^2 would be 10⁻⁶ m²
        (0xB, [(0x01, 2), (0x03, -1)], "10^-3.m^2/s"),
        (0xB, [(0x01, 2), (0x02, 1)], "m^2.mg"),
        (0x3, [], "10^3"),
        (0x0, [(0x0D, 1), (0x02, -1), (0x05, -1)], "J/g/K"),
        (0x0, [(0x02, 1), (0x01, -1), (0x03, 1)], "g.m^-1.s"),  # g/m.s could be g/(m.s)
        (0x0, [(0x03, -1), (0x01, 1)], "s^-1.m"),
        (0xC, [(0x12, 1)], "uOhm"),
        (0x0, [(0x01, 7), (0x01, -7)], "m^7/m^7"),
    ],
)
def test_text_is_read_as_it_is_meant(prefix: int, parts: list[tuple[int, int]], text: str) -> None:
    assert unit_text(unit_word(prefix, parts)) == text
    assert parse_unit(text) == unit_word(prefix, parts)


@pytest.mark.parametrize(
    "word",
    [
        0x8044000000000000,  # prefix 8
        unit_word(0, [(0x1C, 1)]),
        unit_word(0, [(0x3F, 7)] * 6),
        unit_word(0, [(1, -8)]),
        unit_word(0, [(0, 1)]),  # an exponent of nothing
        unit_word(3, [(1, 1), (0, -1)]),
        2**64 - 1,
    ],
)
def test_codes_that_do_not_exist_are_shown_as_a_number(word: int) -> None:
    assert unit_text(word) == f"0x{word:016x}"
    assert parse_unit(unit_text(word)) == word


@table(
    ("text", "same"),
    [
        ("  m/s^2 ", "m/s^2"),
        ("m.s^-2", "m/s^2"),
        ("m·s^-2", "m/s^2"),
        ("m*s^-2", "m/s^2"),
        ("m/s²", "m/s^2"),
        ("m³", "m^3"),
        ("1/s", "s^-1"),
        ("1", ""),
        ("µV", "uV"),
        ("\u03bcV", "uV"),
        ("kΩ", "kOhm"),
        ("k\u2126", "kOhm"),
        ("N/mm^2", "MN/m^2"),  # a prefix is raised with its unit
        ("m/ms", "km/s"),
        ("mm^2", "10^-6.m^2"),
        ("10^-6.m^2", "mm^2"),
        ("km/ks", "m/s"),
        ("km.km", "Mm.m"),
        ("m/10^3", "mm"),
        ("0x0", ""),
        ("0x00443E0000000000", "m/s^2"),
    ],
)
def test_other_ways_to_write_a_unit(text: str, same: str) -> None:
    assert parse_unit(text) == parse_unit(same)


@table(
    "text",
    [
        "furlong",
        "Nm",  # a product has a sign
        "m m",
        "deg",
        "%",
        "M",  # a prefix alone
        "m^0",
        "m^8",
        "m^-8",
        "m^",
        "m^2^2",
        "m^1.5",
        "/s",
        "m/",
        "m//s",
        "m..s",
        ".",
        "2/s",
        "m/1",
        "J/g.K",  # is K below?
        "1/s.m",
        "cm^2",  # 10⁻⁴ has no prefix
        "mm^6",  # nor has 10⁻¹⁸
        "10^4",
        "m.m.m.m.m.m.m",
        "0x",
        "0x00000000000000000",
        "0xg",
        "１",
        "m^²",
    ],
)
def test_no_units(text: str) -> None:
    with pytest.raises(ValueError, match=r"found|expected"):
        parse_unit(text)


@table("prefix", sorted(PREFIXES))
@table("unit", range(1, len(UNITS) + 1))
def test_every_unit_with_every_prefix(prefix: int, unit: int) -> None:
    word = unit_word(prefix, [(unit, 1)])
    assert unit_text(word) == PREFIXES[prefix][0] + UNITS[unit - 1]
    assert parse_unit(unit_text(word)) == word


def test_codes_are_those_of_the_document() -> None:
    assert {symbol: code for code, (symbol, _) in PREFIXES.items()} == {
        "": 0, "da": 1, "h": 2, "k": 3, "M": 4, "G": 5, "T": 6, "P": 7, "d": 9, "c": 0xA, "m": 0xB, "u": 0xC, "n": 0xD,
        "p": 0xE, "f": 0xF,
    }  # fmt: skip
    assert [UNITS.index(name) + 1 for name in ("m", "cd", "rad", "Hz", "C", "V", "Ohm", "T", "Bq", "Sv")] == [
        0x01, 0x07, 0x08, 0x0A, 0x0F, 0x10, 0x12, 0x15, 0x19, 0x1B,
    ]  # fmt: skip


@given(st.integers(0, 2**64 - 1))
def test_parts_are_the_word(word: int) -> None:
    assert unit_word(*unit_parts(word)) == word


@given(strategies.unit_words)
def test_text_is_the_word(word: int) -> None:
    assert parse_unit(unit_text(word)) == word


def value(prefix: int, parts: tuple[tuple[int, int], ...]) -> tuple[Fraction, dict[int, int]]:
    """What a word means: a power of ten and the exponent of every unit (0 is taken as 1)."""
    exponents: dict[int, int] = {}
    for unit, exponent in parts:
        if unit:
            exponents[unit] = exponents.get(unit, 0) + (exponent or 1)
    return Fraction(10) ** PREFIXES[prefix][1], exponents


@given(
    st.builds(
        unit_word,
        st.sampled_from(sorted(PREFIXES)),
        st.lists(st.just(NONE) | st.tuples(st.integers(1, 27), st.integers(-7, 7)), max_size=6),
    )
)
def test_text_keeps_the_meaning_of_careless_words(word: int) -> None:
    """Gaps between the units and exponents 0."""
    assert value(*unit_parts(parse_unit(unit_text(word)))) == value(*unit_parts(word))


@given(st.integers(0, 2**64 - 1))
def test_any_word_has_a_text_that_is_understood(word: int) -> None:
    assert unit_text(parse_unit(unit_text(word))) == unit_text(word)


@given(st.text(max_size=12) | st.text(alphabet="mkgsN./^-120", max_size=12))
def test_any_text_is_a_unit_or_a_value_error(text: str) -> None:
    try:
        word = parse_unit(text)
    except ValueError:
        return
    assert 0 <= word < 2**64


@pytest.mark.parametrize(
    ("prefix", "parts"),
    [(16, []), (-1, []), (0, [(64, 1)]), (0, [(-1, 1)]), (0, [(1, 8)]), (0, [(1, -9)]), (0, [(1, 1)] * 7)],
)
def test_words_that_64_bits_cannot_hold(prefix: int, parts: list[tuple[int, int]]) -> None:
    with pytest.raises(ValueError, match=r"found .* expected"):
        unit_word(prefix, parts)


def test_values_are_a_view_and_compared_by_bits() -> None:
    data = join(Sensor(np.array([1.0, math.nan, -0.0])).pack())
    sensor = Sensor.unpack(memoryview(data))
    assert np.shares_memory(sensor.values, np.frombuffer(data, np.uint8))
    assert sensor == Sensor(np.array([1.0, math.nan, -0.0], "<f8"))
    assert sensor != Sensor(np.array([1.0, math.nan, 0.0]))
    assert sensor != Sensor(sensor.values, 1)
    assert sensor != Sensor(sensor.values, 0, 1)
    assert sensor != data
    signalling = bytes([1]) + bytes(9) + bytes.fromhex("7ff0000000000001")
    assert join(Sensor.unpack(memoryview(signalling)).pack()) == signalling


def test_golden_bytes() -> None:
    described = check_golden(
        Sensor(np.array([1.0, -2.5]), 0x00443E0000000000),
        b"\2\0" + bytes.fromhex("00443e0000000000") + struct.pack(">2d", 1.0, -2.5),
    )
    assert described["values"] == [1.0, -2.5]
    check_golden(Sensor(np.zeros(0)), bytes(10))


@table(
    ("content", "error", "named"),
    [
        (b"", TruncatedMessage, "at least 10"),
        (bytes(9), TruncatedMessage, "9 bytes"),
        (b"\x02" + bytes(17), MalformedBody, "26 bytes for 2 values"),
        (b"\x01" + bytes(18), MalformedBody, "18 bytes for 1 value"),
        (b"\xff" * 100, MalformedBody, "2050 bytes for 255 values"),
    ],
)
def test_bad_contents(content: bytes, error: type[WireError], named: str) -> None:
    with pytest.raises(WireError) as raised:
        Sensor.unpack(memoryview(content))
    assert type(raised.value) is error
    assert named in str(raised.value)


@table(
    "made",
    [Sensor(np.zeros(256)), Sensor(np.zeros(1), 1 << 64), Sensor(np.zeros(1), -1), Sensor(np.zeros(1), 0, 256)],
    ids=["values", "unit", "negative unit", "status"],
)
def test_what_the_layout_cannot_hold(made: Sensor) -> None:
    with pytest.raises(MalformedBody):
        made.pack()

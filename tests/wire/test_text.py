"""STRING and STATUS: encodings, the length field, the final NUL, names that do not fit."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.text import CODECS, CODES, MAX_STRING_BYTES, Status, String, mib_of, text_of
from tests.wire.contents import check_golden

#: Bytes before the message of a STATUS.
STATUS_HEAD = 30


def test_golden_bytes_of_strings() -> None:
    described = check_golden(String("é".encode(), 106), b"\x00\x6a\x00\x02\xc3\xa9")
    assert described == {"encoding": 106, "string": "é", "string_hex": "c3a9"}
    check_golden(String(b""), b"\x00\x03\x00\x00")


def test_golden_bytes_of_status() -> None:
    head = b"\x00\x0d" + b"\xff" * 7 + b"\xfe" + b"E".ljust(20, b"\0")
    described = check_golden(Status(13, -2, "E", "wait"), head + b"wait\0", lambda size: size >= STATUS_HEAD)
    assert described == {
        "code": 13,
        "subcode": -2,
        "error_name": "E",
        "status_string": "wait",
        "nul_terminated": True,
    }
    check_golden(Status(1, 0, "", "x", False), b"\x00\x01" + bytes(28) + b"x", lambda size: size >= STATUS_HEAD)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (String(b"abc"), "abc"),
        (String("é".encode()), "é"),  # Slicer and PLUS: UTF-8, whatever they name
        (String(b"\xe9", 4), "é"),
        (String("é".encode("utf-16-be"), 1013), "é"),
        (String(b"\xd8", 1013), "\ufffd"),  # half a character
        (String(b"\xff", 106), "\ufffd"),
        (String(b"abc", 9999), "abc"),
    ],
)
def test_encodings_of_strings(content: String, text: str) -> None:
    assert content.text == text


#: A string that each encoding has, as its standard writes it.
SPELLED = {
    3: (b"abc", "abc"),
    4: (b"\xfc", "ü"),
    106: (b"\xe6\x89\x8b", "手"),
    1013: (b"\x62\x4b", "手"),
    1014: (b"\x4b\x62", "手"),
    1015: (b"\xfe\xff\x62\x4b", "手"),
    17: (b"\x8e\xe8", "手"),
    18: (b"\xbc\xea", "手"),
    113: (b"\xca\xd6", "手"),
    2025: (b"\xca\xd6", "手"),
    2026: (b"\xa4\xe2", "手"),
    2252: (b"\x80", "€"),
}


def test_every_encoding_is_the_one_of_its_number() -> None:
    assert SPELLED.keys() == CODECS.keys()
    assert {mib: text_of(data, mib) for mib, (data, _) in SPELLED.items()} == {
        mib: text for mib, (_, text) in SPELLED.items()
    }


@given(st.text(max_size=20))
def test_what_is_made_of_a_text_is_that_text(text: str) -> None:
    string = String.of(text)
    assert string.text == text
    assert string.encoding == mib_of(text) == (3 if all(ord(letter) < 128 for letter in text) else 106)


def test_a_string_of_bytes_that_are_no_text_keeps_them() -> None:
    assert String.of("a\udcff") == String(b"a\xff", 106)


@pytest.mark.parametrize("size", [0, 1, 3])
def test_the_head_of_a_string_is_cut_off(size: int) -> None:
    with pytest.raises(
        TruncatedMessage, match=f"STRING content: found {counted(size, 'byte')}, expected at least 4 bytes"
    ):
        String.unpack(memoryview(bytes(size)))


@pytest.mark.parametrize("length", [0, 1, 3, 65535])
def test_the_length_of_a_string_must_be_true(length: int) -> None:
    with pytest.raises(MalformedBody, match=f"STRING, length: found {length}, expected 2, the bytes that follow"):
        String.unpack(memoryview(struct.pack(">HH", 3, length) + b"ab"))


def test_longest_string() -> None:
    assert MAX_STRING_BYTES == 65535
    assert len(join(String(bytes(65535)).pack())) == 65539
    with pytest.raises(MalformedBody, match="STRING: found 65536 bytes, expected at most 65535 bytes"):
        String(bytes(65536)).pack()


def test_status_codes_are_those_of_the_document() -> None:
    assert [CODES.index(name) for name in ("OK", "busy", "not ready", "shutting down")] == [1, 6, 13, 19]


def test_status_of_a_default_constructed_cpp_object() -> None:
    """PLUS's keep-alive: a newline and garbage in the error name."""
    data = b"\0\1" + bytes(8) + b"\n\x00garbage\xff\xfe".ljust(20, b"\0") + b"\0"
    status = Status.unpack(memoryview(data))
    assert join(status.pack()) == data
    assert status.describe()["error_name"] == "\n"


def test_one_nul_ends_a_status_and_more_are_its_message() -> None:
    data = b"\0\1" + bytes(28) + b"a\0b\0\0"
    status = Status.unpack(memoryview(data))
    assert (status.message, status.nul_terminated) == ("a\0b\0", True)
    assert join(status.pack()) == data
    assert status.describe()["status_string"] == "a"


@given(st.binary(min_size=STATUS_HEAD, max_size=STATUS_HEAD + 8))
def test_any_bytes_behind_the_head_are_a_status(data: bytes) -> None:
    assert join(Status.unpack(memoryview(data)).pack()) == data


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (Status(65536), "STATUS: found code 65536, sub-code 0"),
        (Status(-1), "STATUS: found code -1"),
        (Status(1, 2**63), "sub-code 9223372036854775808"),
        (Status(1, 0, "é" * 10 + "e"), "STATUS error name: found 'éééééééééée' .21 bytes., expected at most 20 bytes"),
    ],
)
def test_what_a_status_cannot_hold(status: Status, reason: str) -> None:
    with pytest.raises(MalformedBody, match=reason):
        status.pack()


def test_the_head_of_a_status_is_cut_off() -> None:
    with pytest.raises(TruncatedMessage, match="STATUS content: found 29 bytes, expected at least 30 bytes"):
        Status.unpack(memoryview(bytes(29)))

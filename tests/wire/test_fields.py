"""Text of fixed width: no byte is lost, what people read, what does not fit."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.wire.fields import cut_text, decode_text, encode_text, visible
from tests.tables import table


@given(st.binary(max_size=40))
def test_text_fields_lose_nothing(data: bytes) -> None:
    """Names are remembered, longer strings are not: both are read the same way."""
    assert encode_text(decode_text(data), 40, "x") == data.ljust(40, b"\0")
    assert decode_text(memoryview(data)) == decode_text(data) == decode_text(data + bytes(40))
    visible(decode_text(data)).encode("utf-8")


@table(
    ("data", "text", "shown"),
    [
        (b"Probe\0\0", "Probe", "Probe"),
        (b"a\0junk\0", "a\0junk", "a"),
        (b"\0junk", "\0junk", ""),
        (b"\xff\0", "\udcff", "\ufffd"),
        (b"\xc3", "\udcc3", "\ufffd"),
        ("Größe".encode(), "Größe", "Größe"),
        (b"x" * 60 + b"\0\xffy", "x" * 60 + "\0\udcffy", "x" * 60),
        (b"\xff" * 40, "\udcff" * 40, "\ufffd" * 40),
        (b"", "", ""),
    ],
)
def test_what_people_read(data: bytes, text: str, shown: str) -> None:
    assert decode_text(data) == text
    assert visible(text) == shown


def test_what_does_not_fit_is_refused() -> None:
    assert encode_text("é" * 10, 20, "header, device name") == "é".encode() * 10
    with pytest.raises(MalformedBody) as error:
        encode_text("é" * 10 + "e\0f", 20, "header, device name")
    assert str(error.value) == (
        "header, device name: found 'éééééééééée' (23 bytes), expected at most 20 bytes of UTF-8"
    )


@given(st.text(), st.integers(0, 12))
def test_cut_text(text: str, width: int) -> None:
    cut = cut_text(text, width)
    assert text.startswith(cut)
    assert len(cut.encode()) <= width
    if cut != text:  # the next character would not have fitted
        assert len(text[: len(cut) + 1].encode()) > width

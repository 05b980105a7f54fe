"""Strings of element lists: reading them, the bytes that fit, the warning when a string is cut."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.columns import MAX_ROWS, check_rows, fit_texts, set_text_fields, texts
from igtl_gateway.convert.context import ToIgtlContext

WIDTH = 8


def elements(*values: bytes) -> Any:
    return np.array([(value,) for value in values], [("name", f"S{WIDTH}")])


def test_texts_are_read_up_to_their_first_nul() -> None:
    assert texts(elements(b"abc", b"", b"12345678", b"a\x00b", b"\xff\xc3\xa9"), "name") == [
        "abc",
        "",
        "12345678",
        "a",
        "\ufffdé",
    ]


@pytest.mark.parametrize(
    ("text", "stored"),
    [
        ("", b""),
        ("1234567", b"1234567"),
        ("a\x00b", b"a"),
        ("éééé", "ééé".encode()),  # 8 bytes: the last one would have no room for its second half
        ("12345678", b"1234567"),
    ],
)
def test_texts_are_cut_between_characters(text: str, stored: bytes) -> None:
    array = elements(b"old", b"old")
    to = ToIgtlContext()
    set_text_fields(array, "name", ["x", text], to)
    assert array["name"].tolist() == [b"x", stored]
    cut = stored != text.encode()
    assert [code for code, _ in to.warnings] == ["text_cut"] * cut


def test_one_warning_tells_of_all() -> None:
    to = ToIgtlContext()
    set_text_fields(elements(b"", b"", b""), "name", ["first one", "ok", "second one"], to)
    assert to.warnings == [("text_cut", "name 'first one' is sent as 'first o', and 1 more are cut")]


def test_no_elements() -> None:
    set_text_fields(elements(), "name", [], ToIgtlContext())
    assert texts(elements(), "name") == []


@pytest.mark.parametrize(
    ("text", "kept"), [("", ""), ("1234", "1234"), ("a\x00bcdef", "a"), ("abcdé", "abcd"), ("abcé", "abc")]
)
def test_a_single_text_is_cut_by_the_same_rule(text: str, kept: str) -> None:
    to = ToIgtlContext()
    assert fit_texts((text,), 4, "name of a thing", to) == [kept]
    cut = kept != text
    assert to.warnings == [("text_cut", f"name of a thing {text!r} is sent as {kept!r}")] * cut


def test_rows_end_somewhere() -> None:
    rows = np.zeros(MAX_ROWS + 1, [("name", "S8")])
    check_rows(rows[:-1], "LIST")
    with pytest.raises(ConversionError, match=f"^LIST: found {MAX_ROWS + 1} elements, expected at most {MAX_ROWS}$"):
        check_rows(rows, "LIST")

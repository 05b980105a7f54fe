"""Shapes of JSON: each refuses with place, value and expectation, and accepts what it is for."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import shape
from igtl_gateway.base.untrusted.shape import Shape
from tests.tables import table

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)

ROW = shape.fields({"name": shape.text, "sizes": shape.list_of(shape.number)}, needed=("name",), other=shape.unexpected)


@table(
    ("check", "value"),
    [
        (shape.text, ""), (shape.truth, False), (shape.number, 0), (shape.number, 2**63 - 1), (shape.digits, "0"),
        (shape.digits, str(2**64 - 1)), (shape.map_of(shape.text), {}), (shape.map_of(shape.text), {"a": "b"}),
        (shape.list_of(shape.truth), [True, False]), (ROW, {"name": "a"}), (ROW, {"name": "a", "sizes": [1]}),
        (shape.fields({}), {"any": [None]}),
    ],
)  # fmt: skip
def test_what_fits(check: Shape, value: object) -> None:
    check(value, "here")


@table(
    ("check", "value", "text"),
    [
        (shape.text, 5, "here: found 5, expected a string"),
        (shape.text, None, "here: found null, expected a string"),
        (shape.truth, 1, "here: found 1, expected true or false"),
        (shape.truth, "true", 'here: found "true", expected true or false'),
        (shape.number, -1, "here: found -1, expected an integer of 0 or more"),
        (shape.number, 2**63, "here: found 9223372036854775808, expected an integer of 0 or more"),
        (shape.number, True, "here: found true, expected an integer of 0 or more"),
        (shape.number, 1.0, "here: found 1.0, expected an integer of 0 or more"),
        (shape.digits, "1.5", 'here: found "1.5", expected a number of at most 64 bits'),
        (shape.digits, str(2**64), f'here: found "{2**64}", expected a number of at most 64 bits'),
        (shape.digits, 7, "here: found 7, expected a number of at most 64 bits"),
        (shape.map_of(shape.text), [], "here: found [], expected an object"),
        (shape.map_of(shape.text), {"a": 1}, "here.a: found 1, expected a string"),
        (shape.list_of(shape.text), {"a": 1}, 'here: found {"a": 1}, expected an array'),
        (shape.list_of(shape.text), ["a", 1], "here[1]: found 1, expected a string"),
        (ROW, "a", 'here: found "a", expected an object'),
        (ROW, {}, "here: found no field 'name', expected one"),
        (ROW, {"name": "a", "sizes": [1, -1]}, "here.sizes[1]: found -1, expected an integer of 0 or more"),
        (ROW, {"name": "a", "nam": "b"}, "here.nam: found an unknown field, expected none of this name"),
    ],
)
def test_what_does_not_fit(check: Shape, value: object, text: str) -> None:
    with pytest.raises(DamagedRecording) as error:
        check(value, "here")
    assert str(error.value) == text


def test_long_values_and_keys_are_cut() -> None:
    with pytest.raises(DamagedRecording) as error:
        shape.number("x" * 1000, "here")
    assert str(error.value) == f'here: found "{"x" * 39}…, expected an integer of 0 or more'
    with pytest.raises(DamagedRecording) as error:
        shape.map_of(shape.text)({"k" * 1000: 1}, "here")
    assert str(error.value) == f"here.{'k' * 40}: found 1, expected a string"
    with pytest.raises(DamagedRecording) as error:
        shape.fields({"a": shape.text}, other=shape.unexpected)({"k" * 1000: 1}, "here")
    assert str(error.value).startswith(f"here.{'k' * 40}: found")


def test_a_value_that_cannot_be_written_is_named_by_its_type() -> None:
    endless: list[Any] = []
    endless.append(endless)
    assert str(shape.wrong("here", endless, "a string")) == "here: found list, expected a string"
    assert "found [[[" in str(shape.wrong("here", [[[]]], "a string"))


@given(JSON)
def test_any_document_fits_or_is_refused_in_one_line(value: Any) -> None:
    for check in (shape.text, shape.truth, shape.number, shape.digits, shape.map_of(shape.list_of(shape.text)), ROW):
        try:
            check(value, "here")
        except DamagedRecording as error:
            assert str(error).startswith("here") and "expected" in str(error)
    shape.anything(value, "here")

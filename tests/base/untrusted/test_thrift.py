"""Thrift in the compact protocol: structures as the document describes them, and lies that end at a limit."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.base.untrusted.thrift import Fields, Incomplete, ThriftReader
from tests.base.untrusted.thrift_bytes import structure, varint
from tests.tables import table


def read(data: bytes) -> Fields:
    reader = ThriftReader(data, "footer")
    found = reader.struct()
    assert reader.at == len(data)
    return found


_integers = st.integers(-(2**63), 2**63 - 1)
_values = st.recursive(
    _integers | st.binary(max_size=20) | st.booleans() | st.lists(_integers, max_size=20)
    | st.lists(st.binary(max_size=3), max_size=3),
    lambda inner: st.dictionaries(st.integers(-(2**15), 2**15 - 1), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@given(st.dictionaries(st.integers(-(2**15), 2**15 - 1), _values, max_size=4))
def test_structures_are_read_as_the_document_describes(fields: dict[int, Any]) -> None:
    assert read(structure(fields)) == fields


@table(
    ("data", "fields"),
    [
        (b"\0", {}),
        (b"\x15\x02\x16\x03\x14\x04\0", {1: 1, 2: -2, 3: 2}),  # i32, i64, i16
        (b"\x11\x12\0", {1: True, 2: False}),
        (b"\x13\x05\0", {1: 5}),  # i8
        (b"\x17" + bytes(8) + b"\x15\x02\0", {1: None, 2: 1}),  # a number with a fraction
        (b"\x05\xc8\x01\x02\0", {100: 1}),  # a number of a field in long form
        (b"\x1a\x25\x02\x04\0", {1: [1, 2]}),  # a set
        (b"\x19\x21\x01\x02\0", {1: [1, 2]}),  # true and false in a list
        (b"\x18\x02ab\0", {1: b"ab"}),
    ],
)
def test_golden_bytes(data: bytes, fields: Fields) -> None:
    assert read(data) == fields
    for size in range(len(data)):
        with pytest.raises(Incomplete):
            ThriftReader(data[:size], "footer").struct()


@table(
    ("data", "text"),
    [
        (b"\x1b\x01\x88\x02\0", "footer: byte 1: found a field of type 11, expected a structure of Parquet"),  # a map
        (b"\x1d\0", "found a field of type 13"),
        (b"\x15" + b"\xff" * 10, "byte 11: found an integer of more than 64 bits"),
        (b"\x1c" * 20, "found structures in more than 16 levels"),
        (b"\x19" + b"\x19" * 40, "found lists in more than 16 levels"),
    ],
)
def test_what_is_no_structure_of_parquet(data: bytes, text: str) -> None:
    with pytest.raises(DamagedRecording) as error:
        ThriftReader(data, "footer").struct()
    assert text in str(error.value)


def test_sixteen_levels_are_read() -> None:
    found: Fields = read(b"\x1c" * 16 + b"\0" * 17)
    for _ in range(16):
        inner = found[1]
        assert isinstance(inner, dict)
        found = inner
    assert found == {}


def test_elements_of_all_lists_count_before_there_is_memory_for_them() -> None:
    with limits_in_force(FileLimits(count=20)):
        assert read(b"\x19\xa1" + b"\1" * 10 + b"\x19\xa1" + b"\1" * 10 + b"\0") == {1: [1] * 10, 2: [1] * 10}
        with pytest.raises(DamagedRecording, match=r"footer: elements: found 21, expected at most 20 \(--limit count"):
            read(b"\x19\xa1" + b"\1" * 10 + b"\x19\xb1" + b"\1" * 11 + b"\0")
        with pytest.raises(DamagedRecording, match="elements: found 4294967295"):
            ThriftReader(b"\x19\xf1" + varint(2**32 - 1), "footer").struct()


@given(st.binary(max_size=60))
def test_any_bytes_are_a_structure_or_refused(data: bytes) -> None:
    reader = ThriftReader(data, "footer")
    try:
        reader.struct()
    except (Incomplete, DamagedRecording):
        return
    assert 0 < reader.at <= len(data)

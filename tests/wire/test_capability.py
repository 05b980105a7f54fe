"""CAPABILITY: names of twelve bytes each, as many as there may be."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.wire.capability import MAX_TYPES, Capability
from tests.tables import table
from tests.wire.contents import check_golden


def test_golden_bytes() -> None:
    data = b"IMAGE" + bytes(7) + b"GET_POLYDATA"
    described = check_golden(Capability(("IMAGE", "GET_POLYDATA")), data, lambda size: size in (0, 12))
    assert described == {"types": ["IMAGE", "GET_POLYDATA"]}


@table(
    ("content", "named"),
    [
        (bytes(11), "CAPABILITY content: found 11 bytes, expected a multiple of 12"),
        (bytes(25), "found 25 bytes"),
        (bytes(12 * (MAX_TYPES + 1)), f"found {MAX_TYPES + 1} type names, expected at most {MAX_TYPES}"),
    ],
)
def test_bad_contents(content: bytes, named: str) -> None:
    with pytest.raises(MalformedBody) as raised:
        Capability.unpack(memoryview(content))
    assert named in str(raised.value)


@table(
    ("types", "named"),
    [
        (("GET_POLYDATA_",), "CAPABILITY type name: found 'GET_POLYDATA_' (13 bytes), expected at most 12 bytes"),
        (("é" * 7,), "(14 bytes)"),
        (("X",) * (MAX_TYPES + 1), f"expected at most {MAX_TYPES}"),
    ],
)
def test_what_the_layout_cannot_hold(types: tuple[str, ...], named: str) -> None:
    with pytest.raises(MalformedBody) as raised:
        Capability(types).pack()
    assert named in str(raised.value)


def test_as_many_names_as_there_may_be() -> None:
    assert MAX_TYPES == 65_535
    assert len(Capability.unpack(memoryview(bytes(12 * MAX_TYPES))).types) == MAX_TYPES


def test_without_types() -> None:
    assert Capability.unpack(memoryview(b"")) == Capability(())
    assert Capability(()).pack() == []
    assert Capability(("A\0junk", "\udcff")).describe() == {"types": ["A", "\ufffd"]}

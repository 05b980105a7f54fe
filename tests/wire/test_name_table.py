"""The table of names of BIND: sizes that lie, padding that other libraries omit, names that it cannot hold."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.name_table import MAX_NAME_TABLE, need, pack_names, read_count, read_names
from tests.tables import table


def read(content: bytes, count: int, offset: int = 0) -> tuple[list[str], bytes | None, int]:
    return read_names(memoryview(content), offset, count, "BIND")


def sized(data: bytes) -> bytes:
    return len(data).to_bytes(2, "big") + data


NAMES = st.lists(
    st.binary(max_size=9).filter(lambda data: 0 not in data).map(lambda data: data.decode("utf-8", "surrogateescape")),
    max_size=4,
)


@given(NAMES, st.binary(max_size=3), st.binary(max_size=3))
def test_what_was_packed_is_read(names: list[str], before: bytes, behind: bytes) -> None:
    data = pack_names(names)
    assert len(data) % 2 == 0
    found = read(before + sized(data) + behind, len(names), len(before))
    assert found == (names, None, len(before) + 2 + len(data))


@table(
    ("count", "data", "names"),
    [
        (2, b"a\0b\0", ["a", "b"]),
        (1, b"ab\0\0", ["ab"]),  # padded to an even size
        (0, b"", []),
        (2, b"\0\0", ["", ""]),
        (1, b"\xff\0", ["\udcff"]),
    ],
)
def test_golden_bytes(count: int, data: bytes, names: list[str]) -> None:
    assert pack_names(names) == data
    assert read(sized(data), count) == (names, None, 2 + len(data))


@table(
    ("count", "data", "names"),
    [
        (1, b"ab\0", ["ab"]),  # the C++ library omits the padding in places
        (1, b"ab", ["ab"]),  # a last name without NUL
        (1, b"ab\0c\0d\0", ["ab"]),
        (0, b"ab\0\0", []),
        (2, b"a\0b", ["a", "b"]),
    ],
)
def test_another_spelling_is_kept_as_it_was(count: int, data: bytes, names: list[str]) -> None:
    assert read(sized(data), count) == (names, data, 2 + len(data))


@table(
    ("count", "data", "found"),
    [(3, b"a\0b\0", "2 names"), (2, b"a\0", "1 name"), (1, b"", "0 names"), (3, b"a\0b", "1 name")],
)
def test_fewer_names_than_children(count: int, data: bytes, found: str) -> None:
    with pytest.raises(MalformedBody) as error:
        read(sized(data), count)
    assert str(error.value) == f"BIND table of names: found {found}, expected {counted(count, 'name')}"


@table(
    ("content", "named"),
    [
        (b"", "BIND table of names: found 0 bytes of content, expected at least 2 bytes"),
        (b"\0", "found 1 byte of content, expected at least 2 bytes"),
        (b"\0\5a\0b\0", "found 6 bytes of content, expected at least 7 bytes"),
        (b"\xff\xff", "found 2 bytes of content, expected at least 65537 bytes"),
    ],
)
def test_a_table_that_is_cut_off(content: bytes, named: str) -> None:
    with pytest.raises(TruncatedMessage) as error:
        read(content, 1)
    assert named in str(error.value)


def test_counts() -> None:
    content = memoryview(b"x\1\2")
    assert read_count(content, 1, "BIND") == 0x0102
    with pytest.raises(TruncatedMessage, match="STT_BIND: found 3 bytes of content, expected at least 4 bytes"):
        read_count(content, 2, "STT_BIND")
    need(content, 3, "BIND")


def test_what_the_table_cannot_hold() -> None:
    with pytest.raises(MalformedBody, match=r"name of a child: found 'a\\x00b', expected no NUL"):
        pack_names(["a\0b"])
    assert MAX_NAME_TABLE == 65_535
    assert len(pack_names(["x" * 65_533])) == 65_534
    with pytest.raises(MalformedBody, match="table of names: found 65536 bytes, expected at most 65535 bytes"):
        pack_names(["x" * 65_534])

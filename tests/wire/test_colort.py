"""COLORT: types and sizes that contradict each other, and the entries of each kind of table."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.base.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.colort import ColorTable
from tests.tables import table
from tests.wire.contents import check_golden


def test_golden_bytes() -> None:
    described = check_golden(ColorTable(3, 19, bytes(range(256)) * 3), b"\3\x13" + bytes(range(256)) * 3)
    assert (described["index_type"], described["map_type"], described["table"]["count"]) == (3, 19, 768)


@table(
    ("content", "error", "named"),
    [
        (b"\x03", TruncatedMessage, "COLORT content: found 1 byte, expected at least 2 bytes"),
        (b"\x04\x03" + bytes(256), MalformedBody, "offset 0, index type: found 4, expected one of [3, 5]"),
        (b"\x03\x04" + bytes(256), MalformedBody, "offset 1, map type: found 4, expected one of [3, 5, 19]"),
        (b"\x03\x03" + bytes(255), MalformedBody, "COLORT table: found 255 bytes, expected 256 bytes"),
        (b"\x03\x05" + bytes(513), MalformedBody, "found 513 bytes, expected 512"),
        (b"\x05\x13" + bytes(256), MalformedBody, "expected 196608"),
    ],
)
def test_bad_contents(content: bytes, error: type[WireError], named: str) -> None:
    with pytest.raises(WireError) as raised:
        ColorTable.unpack(memoryview(content))
    assert type(raised.value) is error
    assert named in str(raised.value)


@table("made", [ColorTable(3, 3, bytes(255)), ColorTable(4, 3, bytes(256)), ColorTable(3, 300, bytes(256))])
def test_what_the_layout_cannot_hold(made: ColorTable) -> None:
    with pytest.raises(MalformedBody):
        made.pack()


def test_entries() -> None:
    assert ColorTable(3, 3, bytes(range(256))).array.tolist() == list(range(256))
    assert ColorTable(3, 5, b"\1\2" * 256).array.tolist() == [0x0102] * 256
    assert ColorTable(3, 19, b"\1\2\3" * 256).array.tolist() == [[1, 2, 3]] * 256
    assert ColorTable(5, 3, bytes(65536)).describe()["table"] == {"count": 65536, "crc64": "0" * 16}


def test_entries_are_not_copied() -> None:
    data = np.frombuffer(b"\3\x13" + bytes(768), np.uint8)
    assert np.shares_memory(ColorTable.unpack(data.data).array, data)

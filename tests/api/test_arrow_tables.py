"""Tables of one stream: what pyarrow must be there for, and what has no row."""

from __future__ import annotations

import json
import sys

import numpy as np
import pyarrow as pa
import pytest

from igtl_gateway.api.arrow_tables import TableMaker, joined, side_by_side
from igtl_gateway.base.errors import Unavailable
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.bulk import block_of
from igtl_gateway.wire.message import Message, encode
from igtl_gateway.wire.text import String


def test_messages_that_cannot_be_decoded_have_no_row_but_a_reason() -> None:
    data = b"".join(bytes(part) for part in encode(Message("STRING", "A", String(b"text"))))
    broken = bytearray(data)
    broken[-1] ^= 1
    entries = [
        Entry(number, 10 * number, Kind.IGTL_IN, "STRING/A", "STRING", (bytes(each),))
        for number, each in enumerate((data, broken, data), 1)
    ]
    maker = TableMaker(Kind.IGTL_IN, "STRING", "STRING/A\udcff", {}, MessageDecoder(lambda _: ""), "mm")
    table = joined([maker.table(block_of(entries[:2])), maker.table(block_of(entries[2:]))])
    assert table["entry"].to_pylist() == [1, 3]
    assert table["string"].to_pylist() == ["text", "text"]
    assert table["source_ns"].to_pylist() == [None, None]
    assert table.schema.metadata[b"stream"].decode() == "STRING/A\ufffd"
    (why,) = json.loads(table.schema.metadata[b"left_out"])
    assert "CRC-64" in why
    assert joined([]).num_rows == 0


def test_rows_without_message_are_null() -> None:
    table = pa.table({"time_ns": [10, 10], "a": ["x", "y"]})
    wanted = np.array([3, 0, 2, -1])  # the messages 0 and 3 have a row
    found = side_by_side({"t": (wanted, "ns")}, {"S": (table, np.array([0, 3]), wanted)})
    assert found["S.a"].to_pylist() == ["y", "x", None, None]
    assert found.schema.field("t").metadata == {b"unit": b"ns"}


def test_without_pyarrow_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "igtl_gateway.api.arrow_tables")
    with pytest.raises(Unavailable, match=r'pyarrow .*pip install "igtl-gateway\[arrow\]"'):
        __import__("igtl_gateway.api.arrow_tables")

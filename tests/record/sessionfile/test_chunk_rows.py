"""The index of a chunk in C and in Python; what add_rows refuses.  tests/record/test_worker.py has files with rows."""

from __future__ import annotations

import importlib.util
import struct
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.record.sessionfile import chunk_rows, records
from igtl_gateway.record.sessionfile.records import MESSAGE, MESSAGE_HEAD, MESSAGE_RECORD, SCHEMA

compiled: Any = pytest.importorskip("igtl_gateway.native._chunk", reason="installed without the C part")

_MESSAGES = st.tuples(st.integers(1, 3) | st.integers(0, 65535), st.integers(0, 2**64 - 1), st.binary(max_size=20))


def _without_c() -> Any:
    """The module as it is without the C part."""
    spec = importlib.util.find_spec(chunk_rows.__name__)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, compiled.__name__, None)
        spec.loader.exec_module(module)
    return module


PYTHON = _without_c()


def message(channel: int, time: int, data: bytes, missing: int = 0) -> bytes:
    return MESSAGE_RECORD.pack(MESSAGE, MESSAGE_HEAD.size + len(data) + missing, channel, 7, time, 9) + data


@given(messages=st.lists(_MESSAGES, max_size=60), missing=st.integers(0, 10_000))
def test_both_find_the_same(messages: list[tuple[int, int, bytes]], missing: int) -> None:
    chunk = bytearray(records.HEAD.pack(SCHEMA, 3) + b"abc")
    assert compiled.index_messages(chunk) == (0, 0, b"", ())
    for place, each in enumerate(messages, 1):
        chunk += message(*each, missing=missing if place == len(messages) else 0)
    found = compiled.index_messages(chunk)
    assert found == PYTHON.index_messages(chunk)
    if messages:
        times = [time for _, time, _ in messages]
        assert found[:2] == (min(times), max(times))
        assert sum(count for _, _, count in found[3]) == len(messages)


def test_without_the_c_part_there_are_no_rows() -> None:
    assert PYTHON.add_rows is None


def row(stream: int, payload: bytes, stamp_ns: int = 5, source_ns: int = 0) -> bytes:
    data = struct.pack("=QQQQQ", stream, len(payload), 1, stamp_ns, source_ns) + payload
    return data + bytes(-len(data) % 16)


def test_it_stops_where_it_cannot_go_on() -> None:
    good = row(0, b"payload")
    streams: list[Any] = [(1, -1, b""), None, (2, 1, b"same")]
    for stop in (
        row(1, b""),  # a stream that is not known
        row(3, b""),
        row(10_000, b""),  # a mark
        row(1 << 32, b""),  # a payload that is being copied
        row(0, bytes(64 << 10)),  # a large one
        row(2, b"", stamp_ns=2**31 * 10**9),  # beyond the seconds of ROS
        row(2, b"", source_ns=2**31 * 10**9),
        good[:47],
        good[:39],
    ):
        room = memoryview(bytes(100) + good + good + stop)
        chunk = bytearray(b"before")
        place, *told = compiled.add_rows(chunk, room, 100, len(room), streams, 1 << 20)
        assert (place, told) == (100 + 2 * len(good), [2, 14, 5, 5])
        assert chunk == b"before" + 2 * (MESSAGE_RECORD.pack(MESSAGE, 29, 1, 1, 5, 5) + b"payload")


def test_it_stops_when_the_chunk_has_its_size() -> None:
    chunk = bytearray()
    room = memoryview(row(0, bytes(100)) * 50)
    place, rows, size, _, _ = compiled.add_rows(chunk, room, 0, len(room), [(1, -1, b"")], 1000)
    assert (place, rows, size) == (8 * len(room) // 50, 8, 800)
    assert compiled.add_rows(chunk, room, place, len(room), [(1, -1, b"")], 1000) == (place, 0, 0, 0, 0)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        (b"chunk", b"", 0, 0, [], 0),
        (bytearray(), b"", 0, 0, (), 0),
        (bytearray(), None, 0, 0, [], 0),
        (bytearray(), b"", 0, 1, [], 0),
        (bytearray(), b"", -1, 0, [], 0),
        (bytearray(), b"", "0", 0, [], 0),
    ],
)
def test_other_arguments(arguments: tuple[Any, ...]) -> None:
    with pytest.raises((TypeError, ValueError)):
        compiled.add_rows(*arguments)


def _columns(**changed: Any) -> list[Any]:
    names = ("which", "idents", "numbers", "times", "publish_times", "sources", "begins", "ends")
    given: dict[str, Any] = {name: np.zeros(2, np.int64) for name in names}
    given |= {"which": np.zeros(2, np.uint16), "idents": np.zeros(2, np.int32), "ends": np.array([3, 4])} | changed
    return [given[name] for name in names]


@pytest.mark.skipif(chunk_rows.add_columns is None, reason="installed without the C part")
def test_columns_outside_of_the_data_or_of_other_lengths_are_refused() -> None:
    """Nothing is read there, and the chunk keeps what it had and whole messages."""
    add, chunk = chunk_rows.add_columns, bytearray()
    assert add
    rest = (0, [(1, -1, b"")], 1 << 20, 1 << 20)
    assert add(chunk, (b"abcd",), *_columns(), *rest) == 2
    assert chunk.endswith(b"abcd") and len(chunk) == 2 * (9 + 22) + 3 + 4
    for name, values in (
        ("which", np.array([0, 1], np.uint16)),
        ("ends", np.array([3, 5])),
        ("begins", np.array([0, -1])),
        ("begins", np.array([0, 5])),
        ("times", np.zeros(1, np.int64)),
        ("idents", np.zeros(2, np.int64)),
    ):
        with pytest.raises(ValueError, match="found"):
            add(bytearray(), (b"abcd",), *_columns(**{name: values}), *rest)
    for ident in (-1, 1, 1 << 30):
        assert add(bytearray(), (b"abcd",), *_columns(idents=np.full(2, ident, np.int32)), *rest) == 0
    assert add(bytearray(), (b"abcd",), *_columns(), 0, [None], 1 << 20, 1 << 20) == 0
    assert add(bytearray(), (b"abcd",), *_columns(), 0, [(1, -1, b"")], 1 << 20, 4) == 1

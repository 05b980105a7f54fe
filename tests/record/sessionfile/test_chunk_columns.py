"""The messages of a chunk in columns: in C, in Python, and as `records.records` finds them; any bytes."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.quantities import counted
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import chunk_columns, records
from igtl_gateway.record.sessionfile.chunk_columns import Columns
from igtl_gateway.record.sessionfile.columns import WireHeads
from igtl_gateway.record.sessionfile.messages import pack_message
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, Malformed

compiled: Any = pytest.importorskip("igtl_gateway.native._columns", reason="installed without the C part")


def _without_c() -> Any:
    """The module as it is without the C part."""
    spec = importlib.util.find_spec(chunk_columns.__name__)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, compiled.__name__, None)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
    return module


PYTHON = _without_c()

_TIMES = st.integers(0, 9) | st.integers(0, 2**64 - 1)
_MESSAGE = st.builds(
    lambda data, *numbers: (MESSAGE, MESSAGE_HEAD.pack(*numbers) + data),
    st.binary(max_size=9), st.integers(0, 65535), st.integers(0, 2**32 - 1), _TIMES, _TIMES,
)  # fmt: skip
_OTHER = st.tuples(st.integers(0, 255), st.binary(max_size=30))


@st.composite
def chunks(draw: st.DrawFn) -> bytes:
    """Records, which nearly always fit, and are sometimes cut off."""
    data = b""
    for opcode, content in draw(st.lists(_MESSAGE | _OTHER, max_size=20)):
        length = draw(st.just(len(content)) | st.sampled_from((0, 21, 22, 31, 2**63, 2**64 - 1)))
        data += HEAD.pack(opcode, length if draw(st.integers(0, 9)) == 0 else len(content)) + content
    return data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data


def expected(data: bytes) -> tuple[list[tuple[int, ...]], int]:
    """Rows by `records.records`, and where the records end."""
    rows, end = [], 0
    try:
        for opcode, at, stop in records.records(data, "chunk"):
            if opcode == MESSAGE:
                if stop - at < MESSAGE_HEAD.size:
                    break
                rows.append((*MESSAGE_HEAD.unpack_from(data, at), at + MESSAGE_HEAD.size, stop))
            end = stop
    except Malformed:
        pass
    return rows, end


def taken(module: ModuleType, data: bytes, count: int, step: int) -> list[tuple[int, ...]]:
    rows, at = [], 0
    while count:
        columns = Columns.empty(min(step, count))
        at = module.take(data, at, *columns)
        rows += list(zip(*(column.tolist() for column in columns), strict=True))
        count -= len(columns.times)
    return rows


@given(data=chunks(), step=st.integers(1, 5))
def test_all_find_the_same(data: bytes, step: int) -> None:
    rows, end = expected(data)
    times = [row[2] for row in rows]
    late = 0
    for row in rows:
        late |= row[2] | row[3]
    assert compiled.count_of(data) == PYTHON.count_of(data) == (len(rows), times == sorted(times), end, late)
    with_data = [(*row, data) for row in rows]
    assert compiled.rows_of(data) == PYTHON.rows_of(data) == (with_data, times == sorted(times), end)
    for module in (compiled, PYTHON):
        assert taken(module, data, len(rows), step) == rows
        with pytest.raises(ValueError, match=f"found {counted(len(rows), 'message')}, expected {len(rows) + 1}"):
            module.take(data, 0, *Columns.empty(len(rows) + 1))


def test_a_place_or_an_array_that_is_not_right_is_refused() -> None:
    for at in (-1, 1, 1 << 60):
        with pytest.raises(ValueError, match="found 0 messages"):
            compiled.take(b"", at, *Columns.empty(1))
    with pytest.raises(ValueError, match="found an array of 8 bytes, expected 16"):
        compiled.take(b"", 0, *Columns.empty(2)._replace(times=np.empty(1, np.uint64)))
    with pytest.raises(TypeError):
        compiled.take(b"")
    with pytest.raises(TypeError):
        compiled.rows_of(bytearray())


# -- RawMessages -----------------------------------------------------------------------------------------------------


@st.composite
def wire_chunks(draw: st.DrawFn) -> tuple[bytes, list[tuple[int, int, int]]]:
    """RawMessages of a few heads, some with wrong bytes: channel, begin and end of each."""
    data, places = b"", []
    for number in range(draw(st.integers(0, 30))):
        name = draw(st.sampled_from(("A", "Probe", "a name of some length")))
        links = tuple(range(draw(st.integers(0, 3))))
        entry = Entry(
            number, 5 + number, draw(st.sampled_from((Kind.IGTL_IN, Kind.IGTL_OUT))), f"STRING/{name}", "STRING",
            (bytes(draw(st.integers(0, 60))),), links, draw(st.sampled_from((0, 5, 7_000_000_000))),
        )  # fmt: skip
        raw = bytearray(pack_message(entry))
        if draw(st.integers(0, 40)) == 0:
            raw[draw(st.integers(0, len(raw) - 1))] ^= 1 << draw(st.integers(0, 7))
        if draw(st.integers(0, 40)) == 0:
            del raw[draw(st.integers(0, len(raw) - 1)) :]
        places.append((draw(st.integers(0, 2)), len(data), len(data) + len(raw)))
        data += raw
    return data, places


@given(given=wire_chunks())
def test_raw_messages_are_unwrapped_alike(given: tuple[bytes, list[tuple[int, int, int]]]) -> None:
    data, places = given
    results = []
    for unwrap in (compiled.unwrap, PYTHON.unwrap):
        channels, begins, ends = (
            np.array([place[i] for place in places], dtype) for i, dtype in enumerate((np.uint16, np.int64, np.int64))
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("igtl_gateway.record.sessionfile.columns.unwrap", unwrap)
            known = WireHeads()
            heads, flags, row, error = known.unwrap(data, channels, begins, ends)
        found = [known.known[head] for head in heads[:row]]
        results.append((found, flags[:row].tolist(), begins[:row].tolist(), row, str(error)))
    assert results[0] == results[1]
    assert (results[0][3] < len(places)) == (results[0][4] != "None")


def test_messages_and_heads_outside_of_their_bytes_are_refused() -> None:
    def arrays(begin: int, end: int) -> list[Any]:
        columns = (np.zeros(1, np.uint16), np.array([begin]), np.array([end]), np.zeros(1, np.int32))
        return [b"abc", *columns, np.zeros(1, np.uint8), 0]

    last = np.full(1 << 16, -1, np.int32)
    right = [b"head", np.array([0, 4]), np.zeros(1, np.int32), last]
    assert compiled.unwrap(*arrays(0, 3), *right) == 0
    for begin, end in ((-1, 3), (2, 1), (0, 4), (1 << 62, 1 << 62)):
        with pytest.raises(ValueError, match="outside of the data"):
            compiled.unwrap(*arrays(begin, end), *right)
    for offsets, following in (([0, 5], [0]), ([1, 4], [0]), ([0, 4], [1]), ([0, 4], [-1])):
        wrong = [b"head", np.array(offsets), np.array(following, np.int32), last]
        with pytest.raises(ValueError, match="heads outside of their bytes"):
            compiled.unwrap(*arrays(0, 3), *wrong)


@given(
    buffers=st.lists(st.binary(max_size=12), min_size=1, max_size=3),
    places=st.lists(st.tuples(*[st.integers(-1, 13)] * 6), max_size=8),
)
def test_ranges_are_compared_alike(buffers: list[bytes], places: list[tuple[int, ...]]) -> None:
    columns = [np.array([place[i] for place in places], np.int64) for i in range(6)]
    one, other = (
        (buffers, (column[0] % 4).astype(np.int32), column[1], column[2]) for column in (columns[:3], columns[3:])
    )
    results: list[object] = []
    for equal_ranges in (compiled.equal_ranges, PYTHON.equal_ranges):
        equal = np.zeros(len(places), np.bool_)
        try:
            equal_ranges(*one, *other, equal)
            results.append(equal.tolist())
        except ValueError as error:
            results.append(str(error))
    assert results[0] == results[1]


@given(st.binary(max_size=40), st.data())
def test_heads_before_payloads(data: bytes, draw: st.DataObject) -> None:
    places = draw.draw(st.lists(st.tuples(*[st.integers(-1, len(data) + 1)] * 2), max_size=5))
    if draw.draw(st.booleans()):  # most places are right
        places = [(min(pair), max(pair)) for pair in places if 0 <= min(pair) and max(pair) <= len(data)]
    heads = draw.draw(st.binary(max_size=3)) * len(places) + draw.draw(st.sampled_from((b"", b"", b"x")))
    begins, ends = (np.array([pair[at] for pair in places], np.int64) for at in (0, 1))
    found = [made(module.interleaved, data, heads, begins, ends) for module in (compiled, PYTHON)]
    assert found[0] == found[1]
    size = len(heads) // len(places) if places else 0
    if found[0] is not None:
        parts = enumerate(places)
        assert found[0] == b"".join(heads[at * size : (at + 1) * size] + data[begin:end] for at, (begin, end) in parts)


def made(function: Any, *given: Any) -> bytes | None:
    try:
        return bytes(function(*given))
    except ValueError:
        return None

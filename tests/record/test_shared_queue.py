"""The queue between two processes: order, bounds, the end of the ring, memory that goes back, and what is random."""

from __future__ import annotations

import array
import mmap
import os
import random
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.record import shared_queue
from igtl_gateway.record.shared_queue import ENTRY_BYTES, QueueReader, QueueWriter, shared_memory
from igtl_gateway.session.entry import Entry, Kind
from tests.record import samples


class Pair:
    """Both ends, in one process."""

    def __init__(self, max_entries: int = 1000, max_bytes: int = 1 << 20, largest: int = 1 << 20) -> None:
        self.memory = shared_memory(max_bytes, largest)
        self.putter = QueueWriter(mmap.mmap(self.memory, 0), max_entries, max_bytes)
        self.getter = QueueReader(mmap.mmap(self.memory, 0))

    def get(self) -> Entry | tuple[object, ...] | None:
        item = self.getter.get()
        if item is not None:
            self.getter.done()
        return item


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    """A ring so small that its end comes soon."""
    monkeypatch.setattr(shared_queue, "_SLACK_BYTES", 4096)
    monkeypatch.setattr(shared_queue, "_KEPT_BYTES", 8192)
    monkeypatch.setattr(shared_queue, "_FREE_BYTES", 5000)
    monkeypatch.setattr(shared_queue, "_ENOUGH_BYTES", 12_000)
    pair = Pair(max_bytes=20_000, largest=10_000)
    yield pair
    os.close(pair.memory)


def test_entries_and_commands_come_in_their_order() -> None:
    pair = Pair()
    entries = [*samples.every_kind(20), Entry(-1, -1, Kind.ROS_IN, "/\udc80", "x", (), (), 2**70)]
    for number, entry in enumerate(entries):
        assert pair.putter.put(entry)
        assert pair.putter.command("now", number)
    for number, entry in enumerate(entries):
        assert pair.get() == samples.flat(entry)
        assert pair.get() == ("now", number)
    assert pair.get() is None


def test_streams_beyond_those_that_have_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_queue, "_MAX_STREAMS", 3)
    pair = Pair()
    entries = [replace(samples.ros(seq), channel=f"/topic_{seq % 7}") for seq in range(1, 30)]
    for entry in entries:
        assert pair.putter.put(entry)
    assert [pair.get() for _ in entries] == [samples.flat(entry) for entry in entries]
    assert pair.get() is None and pair.putter.waiting == (0, 0)


ROWS = np.arange(12, dtype=np.uint8).reshape(3, 4)


@pytest.mark.parametrize(
    ("part", "data"),
    [
        (memoryview(array.array("H", [1, 2, 3])), array.array("H", [1, 2, 3]).tobytes()),
        (memoryview(b"\x01\xff").cast("b"), b"\x01\xff"),
        (memoryview(bytes(range(9)))[::2], bytes([0, 2, 4, 6, 8])),
        (ROWS.data, ROWS.tobytes()),
        (ROWS.T.data, ROWS.T.tobytes()),
        (memoryview(array.array("H")), b""),
        (np.array(5, dtype=np.uint8).data, b"\x05"),
        (np.arange(2, dtype=np.float32), np.arange(2, dtype=np.float32).tobytes()),
    ],
    ids=["items", "signed", "strided", "rows", "transposed", "empty", "scalar", "array"],
)
def test_buffers_of_any_shape_and_items(part: Any, data: bytes) -> None:
    pair = Pair()
    assert pair.putter.put(replace(samples.ros(1), payload=(b"a", part, b"z")))
    found = pair.get()
    assert isinstance(found, Entry) and found.data() == b"a" + data + b"z"
    assert pair.putter.waiting == (0, 0)


def test_what_only_passes_for_a_number_or_a_text_is_made_one() -> None:
    class Text(str):
        __slots__ = ()

    odd: Any = {
        "seq": np.int64(7), "stamp_ns": np.uint64(8), "channel": Text("T/a"), "type": Text("T"),
        "links": [np.int64(1)], "source_ns": np.int64(9),
    }  # fmt: skip
    pair = Pair()
    assert pair.putter.put(replace(samples.igtl(1), **odd))
    assert pair.get() == replace(samples.flat(samples.igtl(1)), **{**odd, "links": (1,)})


@pytest.mark.parametrize("wrong", [{"channel": 5}, {"type": b"T"}, {"seq": 1.5}, {"payload": ("text",)}])
def test_what_is_no_entry_is_refused_and_counted(wrong: dict[str, Any]) -> None:
    pair = Pair()
    with pytest.raises(TypeError):
        pair.putter.put(replace(samples.igtl(1), **wrong))
    assert (pair.getter.refused, pair.putter.waiting, pair.get()) == (1, (0, 0), None)
    assert pair.putter.put(samples.igtl(2)) and pair.get() == samples.flat(samples.igtl(2))


def test_what_was_got_counts_until_it_is_done() -> None:
    pair = Pair(max_entries=2)
    assert pair.putter.put(samples.igtl(1)) and pair.putter.put(samples.igtl(2))
    assert not pair.putter.put(samples.igtl(3))
    assert pair.getter.get() is not None
    assert not pair.putter.put(samples.igtl(4))
    assert pair.getter.refused == 2
    assert pair.putter.command("a command finds room in any case")
    pair.getter.done()
    assert pair.putter.waiting == (1, samples.igtl(2).size + ENTRY_BYTES)
    assert pair.putter.put(samples.igtl(5))


def test_that_a_peer_came_or_went_finds_room_in_any_case() -> None:
    pair = Pair(max_entries=1)
    assert pair.putter.put(samples.igtl(1))
    link = replace(samples.igtl(2), kind=Kind.LINK)
    assert pair.putter.put(link)
    assert not pair.putter.put(samples.igtl(3))
    assert [pair.get(), pair.get(), pair.get()] == [samples.flat(samples.igtl(1)), samples.flat(link), None]


def test_large_ones_give_way_first() -> None:
    pair = Pair(max_bytes=8 << 20)
    picture, pose = samples.igtl(1, body=bytes(512 << 10)), samples.igtl(2)
    taken = 0
    while pair.putter.put(picture):
        taken += 1
    assert taken == 13  # 6.5 of the 7 MiB for large ones, and what they count beside their payload
    assert pair.putter.put(pose)
    assert not pair.putter.put(picture)
    small = 0
    while pair.putter.put(samples.igtl(3, body=bytes(32 << 10))):
        small += 1
    assert small > 40
    assert sum(pair.get() is not None for _ in range(taken + 1 + small)) == taken + 1 + small
    assert pair.putter.put(picture)


def test_streams_have_numbers_however_many_there_were() -> None:
    pair = Pair(max_entries=100_000, max_bytes=100 << 20)
    first = samples.igtl(1)
    crowd = [replace(first, links=(1, number)) for number in range(shared_queue._MAX_STREAMS + 500)]
    for entries in (crowd[:100], crowd, crowd[-100:], crowd[:100]):
        for entry in entries:
            assert pair.putter.put(entry)
        known = pair.putter._streams
        assert len(known) <= shared_queue._MAX_STREAMS
        assert (entries[-1].kind, entries[-1].channel, entries[-1].type, entries[-1].links) in known
        assert [pair.get() for _ in entries] == [samples.flat(entry) for entry in entries]
    assert pair.get() is None


def test_one_entry_larger_than_the_bound_but_none_larger_than_the_ring() -> None:
    pair = Pair(max_bytes=1000, largest=1 << 20)
    assert pair.putter.put(samples.igtl(1, body=bytes(1 << 20)))
    assert not pair.putter.put(samples.igtl(2))
    assert pair.get() is not None
    assert not pair.putter.put(samples.igtl(3, body=bytes(200 << 20)))


@pytest.mark.parametrize("seed", range(5))
def test_around_the_end_of_the_ring(small: Pair, seed: int) -> None:
    chance = random.Random(seed)
    waiting: deque[Entry] = deque()
    for seq in range(1, 3000):
        if chance.random() < 0.6:
            entry = samples.igtl(seq, body=chance.randbytes(chance.choice((0, 7, 500, 3000, 9000))))
            if small.putter.put(entry):
                waiting.append(samples.flat(entry))
        elif waiting:
            assert small.get() == waiting.popleft()
        else:
            assert small.get() is None
    while waiting:
        assert small.get() == waiting.popleft()
    assert small.get() is None


def test_what_a_burst_took_goes_back_to_the_system() -> None:
    pair = Pair(max_bytes=256 << 20)
    picture = samples.igtl(1, body=bytes(8 << 20))

    def taken() -> int:
        return os.fstat(pair.memory).st_blocks * 512

    for _ in range(16):
        assert pair.putter.put(picture)
    assert taken() > 128 << 20
    while pair.get():
        pass
    for _ in range(100):
        assert pair.putter.put(picture) and pair.get()
    assert taken() < 100 << 20


def test_under_a_load_that_never_ends_the_same_memory_serves_again() -> None:
    pair = Pair(max_bytes=256 << 20)
    picture = samples.igtl(1, body=bytes(1 << 20))
    for _ in range(8):
        assert pair.putter.put(picture)
    for _ in range(100):
        assert pair.putter.put(picture) and pair.get()
    assert os.fstat(pair.memory).st_blocks * 512 < 40 << 20


def test_after_going_back_the_whole_bound_fits() -> None:
    pair = Pair(max_bytes=64 << 20)
    picture = samples.igtl(1, body=bytes(1 << 20))
    for _ in range(20):
        assert pair.putter.put(picture) and pair.putter.put(picture) and pair.get()
    while pair.putter.waiting[1] < 54 << 20:
        assert pair.putter.put(picture)
    while pair.putter.waiting[1] < 62 << 20:
        assert pair.putter.put(samples.igtl(2, body=bytes(32 << 10)))


def test_what_is_lent_is_the_memory_of_the_queue() -> None:
    pair = Pair()
    pair.getter.lends = True
    for body in (bytes(100_000), b"small"):
        assert pair.putter.put(samples.igtl(1, body=body))
    large, small = pair.getter.get(), pair.getter.get()
    assert isinstance(large, Entry) and isinstance(small, Entry)
    assert (type(large.payload[0]), type(small.payload[0])) == (memoryview, bytes)
    kept = shared_queue.owned(large)
    assert kept == samples.flat(samples.igtl(1, body=bytes(100_000))) and type(kept.payload[0]) is bytes
    assert shared_queue.owned(small) is small


def test_the_bell_rings_once() -> None:
    pair = Pair()
    assert [pair.putter.signal(), pair.putter.signal()] == [True, False]
    pair.getter.clear_signal()
    assert pair.putter.signal()

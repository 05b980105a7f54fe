"""The queue between two processes: order, bounds, the end of the ring, memory that goes back; its native writer."""

from __future__ import annotations

import array
import ctypes
import errno
import mmap
import os
import random
import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record import shared_queue
from igtl_gateway.record.shared_queue import ENTRY_BYTES, QueueReader, QueueSlot, QueueWriter, copy_parts, shared_memory
from tests.record import samples
from tests.record.native_queue import HEADER, native_library
from tests.tables import table


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


def shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the end of the ring come soon."""
    monkeypatch.setattr(shared_queue, "_SLACK_BYTES", 4096)
    monkeypatch.setattr(shared_queue, "_KEPT_BYTES", 8192)
    monkeypatch.setattr(shared_queue, "_FREE_BYTES", 5000)
    monkeypatch.setattr(shared_queue, "_ENOUGH_BYTES", 12_000)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    """A ring so small that its end comes soon."""
    shrink(monkeypatch)
    pair = Pair(max_bytes=20_000, largest=10_000)
    yield pair
    os.close(pair.memory)


class LargePages:
    """The memory of a queue on a system whose pages have 16 KiB: it takes back whole pages only."""

    PAGE = 16 << 10

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self.pages = 0

    def madvise(self, _advice: int, start: int, length: int) -> None:
        if start % self.PAGE:
            raise OSError(errno.EINVAL, "not a page")
        end = start - -length // self.PAGE * self.PAGE  # Linux rounds up
        self._memory[start:end] = bytes(len(self._memory[start:end]))  # the last page of the file is a part
        self.pages += (end - start) // self.PAGE

    def __len__(self) -> int:
        return len(self._memory)


def test_pages_of_16_kib_go_back_whole_and_take_nothing_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, the rest of the page that a record ended in was emptied, with the records in it; or no page went back."""
    shrink(monkeypatch)
    monkeypatch.setattr(shared_queue, "_ENOUGH_BYTES", 1 << 20)
    monkeypatch.setattr(shared_queue, "_FREE_BYTES", 40_000)
    monkeypatch.setattr(mmap, "PAGESIZE", LargePages.PAGE)
    pair = Pair(max_bytes=200_000, largest=10_000)
    pages = LargePages(pair.getter._map)
    monkeypatch.setattr(pair.getter, "_map", pages)
    draw = random.Random(4)
    waiting: deque[bytes] = deque()
    for seq in range(1, 800):
        payload = draw.randbytes(draw.randrange(4000))
        if pair.putter.put(replace(samples.igtl(seq), payload=(payload,))):
            waiting.append(payload)
        while len(waiting) > draw.randrange(1, 30):
            entry = pair.get()
            assert isinstance(entry, Entry) and entry.data() == waiting.popleft()
    assert pages.pages > 20
    released = LargePages(pair.putter._map)
    monkeypatch.setattr(pair.putter, "_map", released)
    pair.putter.release()
    assert released.pages == -(-len(released) // LargePages.PAGE) - 1, "all but the page with the counters"
    os.close(pair.memory)


def test_memory_that_is_locked_stays(small: Pair) -> None:
    """The system refuses to take it back, which must not end the reader."""
    memory = small.getter._map
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    assert ctypes.CDLL(None).mlock(ctypes.c_void_p(address), ctypes.c_size_t(len(memory))) == 0
    with pytest.raises(OSError, match="Invalid argument"):
        memory.madvise(mmap.MADV_REMOVE, 0, mmap.PAGESIZE)
    entries = [replace(each, payload=(bytes(9000),)) for each in samples.every_kind(30)]
    for first in range(0, len(entries), 2):  # beyond the memory that is kept
        some = entries[first : first + 2]
        assert all(map(small.putter.put, some))
        assert [small.get() for _ in some] == list(map(samples.flat, some))


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


@table(
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


def test_what_follows_from_an_input_that_is_there_has_room_beyond_the_bound() -> None:
    pair = Pair(max_bytes=100_000, largest=1 << 20)
    large = bytes(80_000)
    outputs = [replace(samples.igtl(seq, body=large), kind=Kind.IGTL_OUT) for seq in (2, 3)]
    assert pair.putter.put(samples.igtl(1, body=large))
    assert all(map(pair.putter.put, outputs))
    assert not pair.putter.put(samples.igtl(4, body=large))
    assert not pair.putter.put(outputs[0]), "its input is not there"
    assert [pair.get() is not None for _ in range(4)] == [True, True, True, False]


def test_the_getter_tells_that_it_waits_for_a_payload() -> None:
    pair = Pair(max_bytes=1 << 20, largest=1 << 20)
    slot = pair.putter.reserve(samples.igtl(1, body=bytes(100_000)))
    assert isinstance(slot, QueueSlot) and pair.get() is None
    waits = [pair.putter.is_awaited]
    slot()
    assert pair.get() is not None
    assert [*waits, pair.putter.is_awaited] == [True, False]
    assert pair.putter.done_bytes == pair.getter.done_bytes > 100_000


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


LARGE = bytes(range(200)) * 1000


def test_the_reader_waits_for_a_payload_that_is_copied_later() -> None:
    pair = Pair()
    assert pair.putter.reserve(samples.igtl(1)) is True
    slot = pair.putter.reserve(replace(samples.igtl(2, body=LARGE), payload=(b"head", b"", memoryview(LARGE)[::2])))
    assert isinstance(slot, QueueSlot)
    assert pair.putter.put(samples.igtl(3))
    assert pair.get() == samples.flat(samples.igtl(1))
    assert (pair.get(), pair.getter.filling) == (None, True)
    slot()
    found = pair.get()
    assert isinstance(found, Entry) and found.data() == b"head" + LARGE[::2]
    assert pair.get() == samples.flat(samples.igtl(3))
    assert (pair.get(), pair.getter.filling) == (None, False)
    assert pair.putter.waiting == (0, 0)


def test_a_payload_that_is_never_copied_is_lost() -> None:
    pair = Pair()
    slot = pair.putter.reserve(samples.igtl(1, body=LARGE))
    assert slot and pair.putter.put(samples.igtl(2))
    assert pair.get() is None
    del slot
    assert pair.get() == samples.flat(samples.igtl(2))
    assert (pair.get(), pair.getter.filling) == (None, False)
    assert pair.getter.lost == {samples.igtl(1).channel: 1}
    assert pair.putter.waiting == (0, 0)


@pytest.mark.parametrize("place", [-1, 90, 101, 2**63])
def test_nothing_is_copied_beyond_the_room(place: int) -> None:
    room = bytearray(100)
    with pytest.raises((ValueError, OverflowError)):
        copy_parts(memoryview(room), place, [memoryview(b"five "), memoryview(b"and six")])
    copy_parts(memoryview(room), 88, [memoryview(b"five "), memoryview(b""), memoryview(b"and six")])
    assert room == bytes(88) + b"five and six"


def test_what_the_putter_did_not_copy_before_its_end_is_lost() -> None:
    pair = Pair()
    slots = [pair.putter.reserve(samples.igtl(seq, body=LARGE)) for seq in (1, 2, 3)]
    assert isinstance(slots[1], QueueSlot)
    slots[1]()
    assert pair.get() is None
    pair.getter.abandoned = True
    assert pair.get() == samples.flat(samples.igtl(2, body=LARGE))
    assert pair.get() is None
    assert pair.getter.lost.total() == 2 and pair.putter.waiting == (0, 0)


# --- the native writer -----------------------------------------------------------------------------------------


class Native:
    """The native writer of a pair."""

    def __init__(self, library: ctypes.CDLL, pair: Pair) -> None:
        self._library, self._pair = library, pair
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(pair.putter.memory))

    def put(self, stream: int, entry: Entry) -> bool:
        data = entry.data()
        numbers = (ctypes.c_uint64(word) for word in (stream, entry.seq, entry.stamp_ns, entry.source_ns))
        return bool(self._library.put(ctypes.c_void_p(self._address), *numbers, data, ctypes.c_uint64(len(data))))

    def fits(self, entries: int, payload_bytes: int) -> bool:
        words = ctypes.c_uint64(entries), ctypes.c_uint64(payload_bytes)
        return bool(self._library.fits(ctypes.c_void_p(self._address), *words))

    def stream(self, entry: Entry) -> int:
        return self._pair.putter.stream_number(entry.kind, entry.channel, entry.type, entry.links)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return native_library(tmp_path_factory.mktemp("native"))


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    os.close(pair.memory)


def test_the_constants_are_those_of_the_header() -> None:
    names = dict(re.findall(r"^#define QUEUE_(\w+) ([^/\n]+)", HEADER.read_text(), re.MULTILINE))
    assert len(names) > 20
    for name, words in names.items():
        value = eval(words.replace("ULL", ""), {})
        ours = getattr(shared_queue, name if name in ("ENTRY_BYTES", "LARGE_BYTES") else f"_{name}")
        assert ours == value, name


def test_what_is_put_is_got(library: ctypes.CDLL, pair: Pair) -> None:
    native = Native(library, pair)
    stream = native.stream(samples.igtl(1))
    assert pair.putter.put(samples.igtl(1))
    entries = [samples.flat(samples.igtl(seq, body=bytes(seq), source_ns=seq)) for seq in range(2, 100)]
    assert all(native.put(stream, entry) for entry in entries)
    assert pair.putter.entries_put == 99
    assert pair.putter.waiting == (99, samples.igtl(1).size + sum(each.size for each in entries) + 99 * ENTRY_BYTES)
    assert [pair.get() for _ in range(100)] == [samples.flat(samples.igtl(1)), *entries, None]
    assert pair.putter.waiting == (0, 0)


def test_what_it_leaves_to_python(library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    def new() -> tuple[Pair, Native, int]:
        pair = Pair(max_entries=2, max_bytes=100_000)
        assert pair.putter.put(samples.igtl(1)) and pair.get()
        native = Native(library, pair)
        return pair, native, native.stream(samples.igtl(1))

    _, native, stream = new()
    assert native.put(stream, samples.igtl(2)) and native.put(stream, samples.igtl(3))
    assert not native.put(stream, samples.igtl(4))  # the bound of entries
    _, native, stream = new()
    large, medium = samples.igtl(2, body=bytes(64 << 10)), samples.igtl(2, body=bytes(60_000))
    assert not native.put(stream, large)
    assert native.put(stream, medium) and not native.put(stream, medium)  # the bound of bytes
    _, native, _ = new()
    assert native.fits(2, 60_000) and native.fits(2, 80_000) and not native.fits(3, 0)
    assert not native.fits(2, 90_000)  # what may be large leaves an eighth to the small ones
    pair, native, stream = new()
    pair.putter.close()
    assert not native.put(stream, samples.igtl(2))
    assert pair.getter.refused == 0


def test_it_does_not_wake_the_reader(library: ctypes.CDLL) -> None:
    pair = Pair(max_entries=10_000, max_bytes=8 << 20)
    assert pair.putter.put(samples.igtl(1))
    native = Native(library, pair)
    stream = native.stream(samples.igtl(1))
    put = 1
    while native.put(stream, samples.igtl(2, body=b"")):
        put += 1
    assert put == shared_queue._WAKE_ENTRIES
    assert pair.putter.put(samples.igtl(3)) and pair.putter.pressing and pair.putter.signal()
    assert native.put(stream, samples.igtl(4, body=b""))


def test_room_that_was_found_ahead_is_the_native_writers(library: ctypes.CDLL, small: Pair) -> None:
    entry = samples.flat(samples.igtl(1, body=bytes(3000)))
    native = Native(library, small)
    stream = native.stream(entry)
    for _ in range(20):  # three times the ring
        assert not small.putter.look_ahead(3200)
        assert native.put(stream, entry)
        assert small.get() == entry


def test_a_number_of_a_stream_ends_when_numbers_start_again(
    library: ctypes.CDLL, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_queue, "_MAX_STREAMS", 2)
    native = Native(library, pair)
    first = samples.ros(1)
    stream = native.stream(first)
    assert stream == native.stream(first)
    assert pair.putter.put(replace(first, channel="/second"))
    assert native.put(stream, first)
    assert pair.putter.put(replace(first, channel="/third"))
    assert not native.put(stream, first)
    assert native.put(native.stream(first), first)
    found = [pair.get() for _ in range(4)]
    assert [each.channel for each in found if isinstance(each, Entry)] == ["/second", "/chatter", "/third", "/chatter"]


def test_there_is_no_number_without_room(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair.putter, "_reserve", lambda need: False)
    assert pair.putter.stream_number(Kind.ROS_IN, "/chatter", "std_msgs/msg/String", ()) == -1


def test_what_is_put_from_python_in_c() -> None:
    put_entry = shared_queue.put_entry
    if put_entry is None:
        pytest.skip("installed without the C part")
    pair = Pair(max_entries=3)
    entry = replace(samples.igtl(1), payload=(b"two ", b"parts"))

    def put(entry: Any) -> bool:
        return put_entry(pair.putter.memory, pair.putter._streams, entry)

    assert not put(entry)  # a new stream
    assert pair.putter.put(entry)
    assert put(entry) and put(replace(entry, payload=()))
    assert [pair.get(), pair.get(), pair.get()] == [*[samples.flat(entry)] * 2, replace(entry, payload=(b"",))]
    odd: list[dict[str, Any]] = [
        {"payload": [b"a list"]}, {"payload": (memoryview(b"a view"),)}, {"payload": (bytes(64 << 10),)},
        {"links": [1]}, {"links": (2,)}, {"seq": 2**64}, {"stamp_ns": -1}, {"source_ns": 1.5}, {"kind": None},
    ]  # fmt: skip
    assert not any(put(replace(entry, **fields)) for fields in odd)
    assert not put(None) and pair.get() is None
    assert [put(entry) for _ in range(4)] == [True, True, True, False]
    with pytest.raises(TypeError):
        put_entry(pair.putter.memory, [], entry)  # type: ignore[arg-type]


STEPS = st.lists(
    st.tuples(
        st.sampled_from(("native", "python", "command", "reserve", "fill", "ahead", "get", "get", "get")),
        st.integers(0, 3),
        st.sampled_from((0, 1, 50, 700, 3000, 7000)),
    ),
    min_size=20,
    max_size=200,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)
@given(steps=STEPS, compiled=st.booleans())
def test_both_writers_alternate(library: ctypes.CDLL, steps: list[tuple[str, int, int]], compiled: bool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        if not compiled:
            patch.setattr(shared_queue, "put_entry", None)
        patch.setattr(shared_queue, "LARGE_BYTES", 2000)
        patch.setattr(shared_queue, "_MAX_STREAMS", 3)
        pair = Pair(max_bytes=20_000, largest=10_000)
        try:
            _alternate(pair, Native(library, pair), steps)
        finally:
            os.close(pair.memory)


def _alternate(pair: Pair, native: Native, steps: list[tuple[str, int, int]]) -> None:
    waiting: deque[tuple[int, Entry | tuple[object, ...]]] = deque()
    unfilled: deque[tuple[int, Callable[[], None]]] = deque()
    lost = 0

    def get() -> None:
        found = pair.get()
        if not waiting or (unfilled and waiting[0][0] == unfilled[0][0]):
            assert found is None
            assert pair.getter.filling == bool(waiting)
        else:
            assert found == waiting.popleft()[1]

    for number, (step, device, size) in enumerate(steps, 1):
        entry = samples.flat(samples.igtl(number, device=f"device {device}", body=bytes([number % 256]) * size))
        match step:
            case "native":
                if native.put(native.stream(entry), entry) or pair.putter.put(entry):
                    waiting.append((number, entry))
                else:
                    lost += 1
            case "python":
                if pair.putter.put(entry):
                    waiting.append((number, entry))
                else:
                    lost += 1
            case "reserve":
                slot = pair.putter.reserve(entry)
                if slot is False:
                    lost += 1
                    continue
                waiting.append((number, entry))
                if not isinstance(slot, bool):
                    unfilled.append((number, slot))
            case "fill" if unfilled:
                unfilled.popleft()[1]()
            case "command":
                assert pair.putter.command("now", number)
                waiting.append((number, ("now", number)))
            case "ahead":
                pair.putter.look_ahead(2 * size)
            case "get":
                get()
    while unfilled:
        unfilled.popleft()[1]()
    while waiting:
        get()
    get()
    assert pair.getter.refused == lost
    assert pair.putter.waiting == (0, 0)


def test_what_lies_before_the_end_of_the_ring_goes_back_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last stretch of memory, which is left when the writer begins again at the front."""
    shrink(monkeypatch)
    monkeypatch.setattr(shared_queue, "_FREE_BYTES", 1 << 20)
    monkeypatch.setattr(shared_queue, "_ENOUGH_BYTES", 1 << 20)
    pair = Pair(max_bytes=100_000, largest=10_000)
    advice: list[tuple[int, int]] = []
    reader = pair.getter
    memory = SimpleNamespace(madvise=lambda _advice, start, length: advice.append((start, start + length)))
    monkeypatch.setattr(reader, "_map", memory)
    stretches: list[tuple[int, int]] = []
    seq = 0
    while not stretches:
        waiting = 0
        while waiting < 6:
            seq += 1
            assert pair.putter.put(replace(samples.igtl(seq), payload=(bytes(4000),)))
            waiting += 1
        for _ in range(waiting):
            before = reader._place
            assert isinstance(reader.get(), Entry)
            if reader._place < before:  # it went on at the front
                stretches.append((reader._gone[0][0], before))
            reader.done()
    (begin, end) = stretches[0]
    assert any(start <= begin + 2 * mmap.PAGESIZE and end - mmap.PAGESIZE <= stop for start, stop in advice), advice
    os.close(pair.memory)

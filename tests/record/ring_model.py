"""A model of the recorder's ring: what was put comes out once, in order, with equal bytes.

``RingModel`` applies one step at a time to a real writer, a real reader and the native code of both sides, and compares
each result with a queue of Python objects.  ``snapshot`` and ``restore`` let a search try every step from every state.
"""

from __future__ import annotations

import ctypes
import mmap
import zlib
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import pytest

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record import shared_queue
from igtl_gateway.record.sessionfile.chunk_rows import add_rows
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_RECORD
from igtl_gateway.record.shared_queue import ENTRY_BYTES, QueueReader, QueueSlot, QueueWriter

#: Payloads from this size on are large in the model: copied in a second step, and lent.
LARGE_BYTES = 64
#: The rows of a call end when a chunk has more than these bytes.
ONE_ROW, ALL_ROWS = 0, 1 << 30

#: More than the heads of an entry, of its stream and of two marks take.
_HEADS_BYTES = 300

State = Literal["ready", "filling", "void"]

#: What the two ends remember outside of their memory.
_OF_WRITER = ("_run", "_runs", "_streams", "pressing")
_OF_READER = (
    "filling", "lost", "_position", "_place", "_head", "_entries", "_done", "_free", "_begin", "_gone", "_streams",
    "row_streams", "stream",
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """The constants of a small ring.  ``room``: of the records; ``streams``: number of streams that have numbers."""

    room: int
    max_entries: int = 1000
    max_bytes: int = 1 << 20
    enough: int = 0
    free: int = 1
    kept: int = 0
    streams: int = 2


@contextmanager
def small_ring(sizes: Sizes, *, compiled: bool) -> Iterator[None]:
    """Context manager: the queue has these constants; ``compiled``: Python's writer uses its C part."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_queue, "_ENOUGH_BYTES", sizes.enough)
        patch.setattr(shared_queue, "_FREE_BYTES", sizes.free)
        patch.setattr(shared_queue, "_KEPT_BYTES", sizes.kept)
        patch.setattr(shared_queue, "_MAX_STREAMS", sizes.streams)
        patch.setattr(shared_queue, "LARGE_BYTES", LARGE_BYTES)
        if not compiled:
            patch.setattr(shared_queue, "put_entry", None)
        yield


@dataclass
class Waiting:
    """An item that was put: an entry with its state, or the words of a command."""

    item: Entry | tuple[object, ...]
    state: State = "ready"
    slot: QueueSlot | None = None
    begin: int = -1


@dataclass
class Expected:
    """What the model knows."""

    waiting: deque[Waiting] = field(default_factory=deque)
    seq: int = 0
    put: int = 0
    put_bytes: int = 0
    got: int = 0
    got_bytes: int = 0
    done: int = 0
    done_bytes: int = 0
    refused: int = 0
    lost: int = 0
    lent: tuple[memoryview, bytes] | None = None

    def copy(self) -> Expected:
        """A copy without the slots, of which there is only one each."""
        waiting = deque(Waiting(one.item, one.state, None, one.begin) for one in self.waiting)
        return replace(self, waiting=waiting)


class RingModel:
    """One ring.  Args: ``library``: the native writer, with ``put`` and ``fits`` (see test_shared_queue.py)."""

    def __init__(self, library: ctypes.CDLL, sizes: Sizes) -> None:
        self.sizes = sizes
        self._memory = mmap.mmap(-1, mmap.PAGESIZE + sizes.room)
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self._library = library
        self.writer = QueueWriter(self._memory, sizes.max_entries, sizes.max_bytes)
        self.reader = QueueReader(self._memory)
        self.reader.lends = True
        self.expected = Expected()

    # -- steps of the writers --------------------------------------------------------------------------------

    def put(self, stream: int, size: int) -> None:
        """Put an entry from Python, a large one in two steps at once."""
        self.reserve(stream, size)
        last = self.expected.waiting[-1] if self.expected.waiting else None
        if last and last.slot:
            self._fill(last)

    def reserve(self, stream: int, size: int) -> None:
        """Put an entry from Python; a large one waits for its payload."""
        entry = self._next(stream, size)
        slot = self.writer.reserve(entry)
        if slot is False:
            self.expected.refused += 1
            self._check_refusal(size)
        elif isinstance(slot, QueueSlot):
            self._was_put(Waiting(entry, "filling", slot, slot._begin), size)
        else:
            self._was_put(Waiting(entry), size)

    def native(self, stream: int, size: int) -> None:
        """Put an entry with the native writer, or from Python if it leaves that to it."""
        entry = self._next(stream, size)
        number = self.writer.stream_number(entry.kind, entry.channel, entry.type, entry.links)
        words = (ctypes.c_uint64(word & 2**64 - 1) for word in (number, entry.seq, entry.stamp_ns, entry.source_ns))
        address, data = ctypes.c_void_p(self._address), entry.data()
        if number >= 0 and self._library.put(address, *words, data, ctypes.c_uint64(len(data))):
            self._was_put(Waiting(entry), size)
        else:
            self.expected.seq -= 1
            self.put(stream, size)

    def fill(self, index: int) -> None:
        """Copy the payload of one of the entries that wait for it."""
        filling = self._filling()
        if filling:
            self._fill(filling[index % len(filling)])

    def void(self, index: int) -> None:
        """Give up the payload of one of the entries that wait for it."""
        filling = self._filling()
        if filling:
            one = filling[index % len(filling)]
            one.state, one.slot = "void", None  # the last reference

    def command(self) -> None:
        """Put a command."""
        if self.writer.command("now", self.expected.seq):
            self.expected.waiting.append(Waiting(("now", self.expected.seq)))

    # -- steps of the reader ---------------------------------------------------------------------------------

    def get(self) -> None:
        """Take the next item."""
        expected = self.expected
        self._drop_lost()
        expected.lent = None
        found = self.reader.get()
        if not expected.waiting or expected.waiting[0].state == "filling":
            assert found is None
            assert self.reader.filling == bool(expected.waiting)
            return
        item = expected.waiting.popleft().item
        if isinstance(item, Entry):
            assert isinstance(found, Entry)
            part = found.payload[0]
            if isinstance(part, memoryview):
                expected.lent = part, item.data()
            assert shared_queue.owned(found) == item
            self._was_got(item)
            known = self.reader.row_streams
            if self.reader.stream >= 0 and known[self.reader.stream] is None:
                known[self.reader.stream] = _channel(item), -1, b""
        else:
            assert found == item

    def done(self) -> None:
        """Give back what was got."""
        self.expected.lent = None
        self._settle()
        self.reader.done()

    def rows(self, chunk_bytes: int) -> None:
        """Take the next entries as rows."""
        assert add_rows is not None
        self.expected.lent = None
        room, begin, end = self.reader.rows()
        assert 0 <= begin <= end <= len(room)
        chunk = bytearray()
        place, rows, size, _, _ = add_rows(chunk, room, begin, end, self.reader.row_streams, chunk_bytes)
        found = _messages(chunk)
        assert len(found) == rows and place <= end
        for message in found:
            next_one = self.expected.waiting.popleft()
            item = next_one.item
            assert isinstance(item, Entry) and next_one.state == "ready"
            assert message == (_channel(item), item.seq, item.stamp_ns, item.data())
            self._was_got(item)
        if rows:
            self._settle()
            self.reader.take_rows(place, rows, size)

    # -- a search over all states ----------------------------------------------------------------------------

    def snapshot(self) -> tuple[Any, ...]:
        """Everything, for :meth:`restore`."""
        writer, reader = self.writer.__dict__, self.reader.__dict__
        return (
            zlib.compress(self._memory, 1),  # a search keeps hundreds of thousands of them
            [copy(writer[name]) for name in _OF_WRITER],
            [copy(reader[name]) for name in _OF_READER],
            self.expected.copy(),
        )

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Be as at a snapshot."""
        for one in self.expected.waiting:
            if one.slot:
                one.slot._begin = -1  # of a state that is left
        packed, writer, reader, expected = snapshot
        self._memory[:] = zlib.decompress(packed)
        self.writer.__dict__.update(zip(_OF_WRITER, map(copy, writer), strict=True))
        self.reader.__dict__.update(zip(_OF_READER, map(copy, reader), strict=True))
        self.expected = expected.copy()
        for one in self.expected.waiting:
            if one.state == "filling" and isinstance(one.item, Entry):
                one.slot = QueueSlot(self.writer._room, one.item.payload)
                one.slot.place_at(one.begin)

    def key(self) -> tuple[Any, ...]:
        """What later steps depend on: positions and numbers relative to the latest ones."""
        counters, writer, reader = self.writer._counters, self.writer, self.reader
        head = counters[shared_queue._HEAD]
        return (
            counters[shared_queue._PLACE],
            counters[shared_queue._LIMIT],
            head - counters[shared_queue._TAIL],
            counters[shared_queue._RESTART] == reader._position,
            writer._run[0] - head,
            writer._run[1],
            tuple((position - head, place, end) for position, place, end in writer._runs),
            tuple(writer._streams),
            self.writer.waiting,
            reader._position - head,
            reader._place,
            reader._head - head,
            reader._free - head,
            reader._begin,
            tuple(reader._gone),
            tuple(reader._streams),
            tuple(row is None for row in reader.row_streams),
            reader.filling,
            tuple((type(one.item), getattr(one.item, "channel", ""), one.state) for one in self.expected.waiting),
            tuple(getattr(one.item, "size", 0) for one in self.expected.waiting),
            self.expected.lent is not None,
        )

    # -- what has to hold ------------------------------------------------------------------------------------

    def check(self) -> None:
        """What has to hold after each step."""
        expected = self.expected
        if expected.lent:
            lent, data = expected.lent
            assert lent == data, "what is lent was overwritten"
        assert self.reader.refused == expected.refused
        assert self.writer.waiting == (expected.put - expected.done, expected.put_bytes - expected.done_bytes)
        assert self.reader.lost.total() == expected.lost

    def drain(self) -> None:
        """Take everything, then put what has to find room in a ring that is empty."""
        while self._filling():
            self.fill(0)
        while self.expected.waiting:
            self.get()
            self.done()
        self.get()
        self.done()
        self.check()
        assert self.writer.waiting == (0, 0)

    def _check_refusal(self, size: int) -> None:
        """An entry is refused for a bound, or because the room is taken."""
        expected, sizes = self.expected, self.sizes
        waiting = expected.put - expected.done
        counted = expected.put_bytes - expected.done_bytes + size + ENTRY_BYTES
        if waiting >= sizes.max_entries or (waiting and counted > sizes.max_bytes - sizes.max_bytes // 8):
            return
        taken = self.reader._counters[shared_queue._HEAD] - self.reader._counters[shared_queue._TAIL]
        assert taken or size + _HEADS_BYTES > sizes.room, "an empty ring has no room"

    def _next(self, stream: int, size: int) -> Entry:
        self.expected.seq += 1
        seq = self.expected.seq
        payload = (seq.to_bytes(4, "little") * (size // 4 + 1))[:size]
        # the C part of Python's writer takes bytes only, and has a bound of its own
        part = payload if size < LARGE_BYTES else memoryview(payload)
        return Entry(seq, seq + 1, Kind.ROS_IN, f"/{stream}", "T", (part,))

    def _was_put(self, one: Waiting, size: int) -> None:
        self.expected.waiting.append(one)
        self.expected.put += 1
        self.expected.put_bytes += size + ENTRY_BYTES

    def _was_got(self, item: Entry) -> None:
        self.expected.got += 1
        self.expected.got_bytes += item.size + ENTRY_BYTES

    def _settle(self) -> None:
        self.expected.done, self.expected.done_bytes = self.expected.got, self.expected.got_bytes

    def _filling(self) -> list[Waiting]:
        return [each for each in self.expected.waiting if each.state == "filling"]

    def _fill(self, one: Waiting) -> None:
        assert one.slot
        one.slot()
        one.state, one.slot = "ready", None

    def _drop_lost(self) -> None:
        """The reader goes on behind what is lost, and settles it."""
        waiting = self.expected.waiting
        while waiting and waiting[0].state == "void":
            item = waiting.popleft().item
            assert isinstance(item, Entry)
            self._was_got(item)
            self._settle()
            self.expected.lost += 1


def _channel(entry: Entry) -> int:
    """The MCAP channel of the stream of an entry."""
    return int(entry.channel[1:]) + 1


def _messages(chunk: bytearray) -> list[tuple[int, int, int, bytes]]:
    """Channel, sequence, time and payload of the messages of a chunk."""
    found, at = [], 0
    while at < len(chunk):
        opcode, length, channel, seq, stamp_ns, _ = MESSAGE_RECORD.unpack_from(chunk, at)
        end = at + HEAD.size + length
        assert opcode == MESSAGE
        found.append((channel, seq, stamp_ns, bytes(chunk[at + MESSAGE_RECORD.size : end])))
        at = end
    return found

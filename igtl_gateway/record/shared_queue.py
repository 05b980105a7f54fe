"""A queue of entries in memory that two processes share: one puts, the other one gets, and neither waits.

To put an entry is to copy it: no lock is shared, no system call is made, no thread has to run.  So what was put is
safe from whatever happens to the process that did, and costs it microseconds.

``_queue.h`` documents the layout, and is a second writer for native code.  What all entries of a stream have in common
is written once, in a record before the first of them; an entry is the number of that stream, three numbers of its own,
and the payload.  Commands, and what does not fit into that, are marshalled.

Large payloads are copied in two steps: the first one takes the place in the order of the log, the second one copies
without the interpreter lock, and with ``reserve`` without the caller's lock.

Records follow each other, until a mark has the place of the next one: where the room ends, where
something waits still, and as soon as there is room at the beginning, so that the same few pages, which are there
already, serve again and again.  A large entry in an empty queue begins at the beginning without a mark, so that it has
all of the room.  Positions count the bytes of records and marks and only grow; the putter knows the
place of each that waits.
"""

from __future__ import annotations

import marshal
import mmap
import os
import struct
import sys
import tempfile
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import index
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.chunk_rows import RowStream

#: Kind, channel, type and links of entries.
_Stream = tuple[Kind, str, str, tuple[int, ...]]

_PAGE = 4096
_MARSHAL = 2  # the version without references, which a head has no use for
#: What a record is, and the size of its payload; of an entry then its number, stamp and source stamp.
_RECORD = struct.Struct("=QQQQQ")
_RECORD_BYTES = _RECORD.size
_WORD = struct.Struct("=Q")
#: Streams that have numbers at once.
_MAX_STREAMS = 10_000
#: What a record is: an entry of the stream of this number, or one of these.  A mark has the place instead of the size,
#: the others the length of the words before the payload in place of the entry's number.
_MARK, _COMMAND, _STREAM, _ENTRY = range(_MAX_STREAMS, _MAX_STREAMS + 4)
_ALIGN = 16
_KINDS = tuple(Kind)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}

#: Slots of the page of counters, as ``_queue.h`` has them: of the writers, of the reader, and of both.
_HEAD, _REFUSED, _RESTART = 0, 1, 2
_TAIL, _DONE_ENTRIES, _DONE_BYTES, _AWAITS, _FLUSHED = 8, 9, 10, 11, 12
_BELL = 16
#: What only the writers know; it is in the page because the native writer shares it.
_PLACE, _LIMIT, _ENTRIES, _TAKEN = 32, 33, 34, 35
_MAX_ENTRIES, _MAX_BYTES, _GENERATION, _CLOSED = 40, 41, 42, 43
#: Place, limit, entries and bytes at once: one access instead of four.
_STATE = struct.Struct("=QQQQ")
_STATE_AT = 8 * _PLACE
#: Entries and bytes that the reader is done with.
_DONE = struct.Struct("=QQ")
_DONE_AT = 8 * _DONE_ENTRIES

#: Added to what a record is while its payload is copied, or if that failed.
_FILLING, _VOID = 1 << 32, 1 << 33

#: Memory that stays with the queue when it is empty; of what a burst took, the rest goes back to the system.
_KEPT_BYTES = 64 << 20

#: From here on it goes back to the beginning as soon as there is room.
_ENOUGH_BYTES = 16 << 20

#: Advice to the system that knows it (Linux): this memory holds nothing any more.
_REMOVE = getattr(mmap, "MADV_REMOVE", None)

#: Another: that it will be needed (Linux 5.14; not named in every Python).
_POPULATE = 23

#: So much is made free at a time, unless nothing else waits.
_FREE_BYTES = 1 << 20

#: What the bound has to leave for lengths, heads, skipped ends, commands and what is not free yet.
_SLACK_BYTES = 64 << 20

#: What an entry counts beside its payload.
ENTRY_BYTES = 500

#: The getter's attention is asked for when so much waits.
_WAKE_BYTES = 8 << 20
_WAKE_ENTRIES = 2_000

#: Payloads from this size on find no room in the last eighth of the bound, are copied in a second step, and
#: may be lent.
LARGE_BYTES = 64 << 10


#: Puts a small entry of a known stream, like ``QueueWriter.put``; False if that has to do it.
#: Arguments: the memory of the queue, the numbers of the streams, the entry.
put_entry: Callable[[mmap.mmap, dict[_Stream, int], Entry], bool] | None = None

_turns = threading.Lock()


def barrier() -> None:
    """Have the other process see what was read and written before this, before what is read and written after it.

    The compiled one is a fence.  A lock that is taken once orders nothing on ARM: what is around may move into it from
    both sides.  Its second taking does not pass its first release (docs/adr/0010-weak-memory.md).
    """
    with _turns:
        pass
    with _turns:
        pass


def copy_parts(room: memoryview, place: int, parts: list[memoryview]) -> None:
    """Copy the parts, one after the other, to a place in the room.  The compiled one does not need the interpreter."""
    for part in parts:
        room[place : place + len(part)] = part
        place += len(part)


if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._queue import barrier, copy_parts, put_entry
    except ImportError:  # pragma: no cover - installed without the C part
        pass


def memory(queue_bytes: int, largest: int) -> mmap.mmap:
    """Memory for a queue of ``queue_bytes`` between threads, in which the largest entry alone fits, too.

    Nothing is taken from the system before it is used.  Raises OSError.
    """
    return mmap.mmap(-1, _size(queue_bytes, largest))


def shared_memory(queue_bytes: int, largest: int) -> int:
    """The same for processes: a file descriptor to be mapped."""
    size = _size(queue_bytes, largest)
    if hasattr(os, "memfd_create"):
        handle: int = os.memfd_create("igtl-gateway recorder")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    try:
        os.ftruncate(handle, size)
    except OSError:
        os.close(handle)
        raise
    return handle


def _size(queue_bytes: int, largest: int) -> int:
    return _PAGE + queue_bytes + largest + _SLACK_BYTES


class _QueueEnd:
    """What both ends know.  Args: ``place``: from ``memory``, or mapped from ``shared_memory``."""

    def __init__(self, place: mmap.mmap) -> None:
        self._map = place
        self._counters = memoryview(self._map)[:_PAGE].cast("Q")
        self._room = memoryview(self._map)[_PAGE:]
        self._size = len(self._room)


class QueueSlot:
    """The place of an entry whose payload is still to be copied: call it, without a lock, as soon as possible.

    The reader waits for it.  If it is never called the reader counts the entry as lost.

    Args:
        room: that of the queue.
        parts: the payload.

    Raises BufferError or the like for what is no payload.
    """

    __slots__ = ("_begin", "_parts", "_room")

    def __init__(self, room: memoryview, parts: Sequence[Buffer]) -> None:
        self._begin = -1
        self._room = room
        self._parts = [memoryview(part) for part in parts]  # none of them can change its size

    def place_at(self, begin: int) -> None:
        """Set the place of its record, which is there now."""
        self._begin = begin

    def __call__(self) -> None:
        """Copy the payload, which must not have changed, and hand the entry to the reader; once."""
        if self._begin < 0:
            return
        copy_parts(self._room, self._begin + _RECORD_BYTES, self._parts)
        self._end(0)

    def __del__(self) -> None:
        if self._begin >= 0:
            self._end(_VOID)

    def _end(self, mark: int) -> None:
        begin, self._begin = self._begin, -1
        self._parts.clear()
        (what,) = _WORD.unpack_from(self._room, begin)
        barrier()  # as for the position: the payload is there before the record is complete
        _WORD.pack_into(self._room, begin, what & ~_FILLING | mark)


class QueueWriter(_QueueEnd):
    """The end that puts.  Its caller ensures that only one thread at a time uses it, the native writer included.

    Args:
        place: as for both ends.
        max_entries, max_bytes: the bound; one input with its outputs always fits.
    """

    def __init__(self, place: mmap.mmap, max_entries: int, max_bytes: int) -> None:
        super().__init__(place)
        self._counters[_MAX_ENTRIES], self._counters[_MAX_BYTES] = max_entries, max_bytes
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._max_large = max_bytes - max_bytes // 8
        self._run = (0, 0)  # position and place of the first record since the last mark
        self._runs: deque[tuple[int, int, int]] = deque()  # those before, with the place of their end
        self._streams: dict[_Stream, int] = {}
        #: Whether so much waits, after the last entry, that the getter should look.
        self.pressing = False
        self._has_input = False  # the last input was taken

    @property
    def memory(self) -> mmap.mmap:
        """What ``queue_open`` of the native writer needs the address of."""
        return self._map

    def warm_up(self) -> None:
        """Have the system provide the memory that serves most, so that no entry waits for it page by page."""
        if sys.platform == "linux":
            with suppress(OSError):
                self._map.madvise(_POPULATE, 0, min(_ENOUGH_BYTES, self._size))

    @property
    def waiting(self) -> tuple[int, int]:
        """Entries and bytes that were put and are not done with."""
        counters = self._counters
        return counters[_ENTRIES] - counters[_DONE_ENTRIES], counters[_TAKEN] - counters[_DONE_BYTES]

    @property
    def max_large_bytes(self) -> int:
        """The bound of what waits, for a large entry."""
        return self._max_large

    @property
    def done_bytes(self) -> int:
        """What the entries that the getter is done with counted."""
        return self._counters[_DONE_BYTES]

    @property
    def is_awaited(self) -> bool:
        """Whether the getter waits for a payload that is being copied."""
        return bool(self._counters[_AWAITS])

    @property
    def entries_flushed(self) -> int:
        """Of the entries that were put, how many the getter is done with for good: a kill does not lose them."""
        return self._counters[_FLUSHED]

    @property
    def entries_put(self) -> int:
        """Entries that were put so far."""
        return self._counters[_ENTRIES]

    def close(self) -> None:
        """Have the native writer put nothing any more."""
        self._counters[_CLOSED] = 1

    def release(self) -> None:
        """Give the memory of the records back to the system: there is no getter any more, so no entry is read.

        To be called after ``close``.  The counters stay.
        """
        if sys.platform != "win32" and _REMOVE is not None:
            with suppress(OSError):  # --lock-memory locks it
                self._map.madvise(_REMOVE, mmap.PAGESIZE, len(self._map) - mmap.PAGESIZE)

    def stream_number(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        """The stream by which the native writer names the entries with these fields; -1 if there is no room for it.

        It is valid until all numbers are taken; the native writer detects that, and asks again.
        """
        number = self._streams.get((kind, channel, type_name, links), -1)
        if number < 0:
            number = self._new_stream(kind, channel, type_name, links)
        return -1 if number == _ENTRY else self._counters[_GENERATION] << 32 | number

    def put(self, entry: Entry) -> bool:
        """Add an entry; False if there is no room for it.  Raises TypeError or the like for other objects."""
        slot = self.reserve(entry)
        if type(slot) is QueueSlot:
            slot()
        return slot is not False

    def reserve(self, entry: Entry) -> bool | QueueSlot:
        """Add an entry, except for a large payload: the slot copies that.  False if there is no room.

        That a peer came or went finds room beyond the bound, as commands do: without it every later output to the peers
        would be another one than that of the recording.  So do the outputs of an input that was taken.  Large ones give
        way first: pictures fill a queue in seconds, and what the gateway learns from, such as a query, is small.

        Raises TypeError or the like for other objects.
        """
        if put_entry and put_entry(self._map, self._streams, entry):
            self.pressing = False  # or the getter's attention was asked for already
            self._has_input = True  # or it is an output that found room
            return True
        taken: bool | QueueSlot = False
        counters = self._counters
        try:
            payload = entry.payload
            if len(payload) == 1 and type(payload[0]) is bytes:
                size = len(payload[0])
            else:
                payload = [part if type(part) in _FLAT else _flat(part) for part in payload]
                size = sum(map(len, payload))
            if size >= LARGE_BYTES and counters[_TAIL] == counters[_HEAD]:
                self._restart()
            try:
                stream = self._streams.get((entry.kind, entry.channel, entry.type, entry.links), -1)
                if stream < 0:
                    _, _, kind, channel, type_name, links, _ = _fields_of(entry)
                    stream = self._new_stream(_KINDS[kind], channel, type_name, links)
            except TypeError:  # a list of links
                stream = _ENTRY
            done_entries, done_bytes = _DONE.unpack_from(self._map, _DONE_AT)
            _, _, entries, counted = _STATE.unpack_from(self._map, _STATE_AT)
            waiting_entries, waiting = entries - done_entries, counted - done_bytes + size + ENTRY_BYTES
            most = self._max_bytes if size < LARGE_BYTES else self._max_large
            fits = waiting_entries < self._max_entries and (waiting <= most or not waiting_entries)
            if entry.kind.is_input:
                self._has_input = fits = fits or entry.kind is Kind.LINK
            if fits or self._has_input:
                try:
                    if stream < _MAX_STREAMS:
                        numbers = entry.seq, entry.stamp_ns, entry.source_ns
                        if size < LARGE_BYTES:
                            taken = self._add(stream, size, numbers, payload, size, size + ENTRY_BYTES) >= 0
                        else:
                            slot = QueueSlot(self._room, payload)
                            begin = self._add(stream | _FILLING, size, numbers, (), size, size + ENTRY_BYTES)
                            if begin >= 0:
                                slot.place_at(begin)
                                taken = slot
                except struct.error:  # beyond 64 bits
                    stream = _ENTRY
                if stream == _ENTRY:
                    taken = self._add_fields(_ENTRY, _fields_of(entry), payload, size, size + ENTRY_BYTES)
        finally:
            if taken is False:
                counters[_REFUSED] += 1
                self._has_input = False
        self.pressing = waiting > _WAKE_BYTES or waiting_entries >= _WAKE_ENTRIES
        return taken

    def _new_stream(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        """The number of a new stream, which the other end gets; ``_ENTRY`` where there is no room for that.

        When all numbers are taken both ends start again: each set of peers that gets a message is a stream, and peers
        come and go.
        """
        if not self._add_fields(_STREAM, (_NUMBERS[kind], channel, type_name, links)):
            return _ENTRY
        if len(self._streams) == _MAX_STREAMS:
            self._streams.clear()
            self._counters[_GENERATION] += 1
        number = len(self._streams)
        self._streams[kind, channel, type_name, links] = number
        return number

    def command(self, name: str, *words: Any) -> bool:
        """Add a command, whatever waits already; False if even the room for commands is taken."""
        return self._add_fields(_COMMAND, (name, *words))

    def signal(self) -> bool:
        """Ask for the getter's attention; False if it was asked already, and has not looked since."""
        barrier()  # the position is there before this looks whether the getter slept
        if self._counters[_BELL]:
            return False
        self._counters[_BELL] = 1
        return True

    def _add_fields(
        self, what: int, words: tuple[Any, ...], payload: Sequence[Buffer] = (), size: int = 0, counted: int = 0
    ) -> bool:
        encoded = marshal.dumps(words, _MARSHAL)
        parts, length = (encoded, *payload), len(encoded) + size
        return self._add(what, size, (len(encoded), 0, 0), parts, length, counted) >= 0

    def _add(
        self,
        what: int,
        size: int,
        numbers: tuple[int, int, int],
        parts: Sequence[Buffer],
        length: int,
        counted: int,
    ) -> int:
        """Add a record with these bytes, for which there are ``length``; its place, or -1 if there is no room.

        ``counted``: what it counts if it is an entry, otherwise 0.
        """
        memory = self._map
        need = (_RECORD_BYTES + length + _ALIGN - 1) & -_ALIGN
        place, limit, entries, taken = _STATE.unpack_from(memory, _STATE_AT)
        if place + need > limit:
            if not self._reserve(need):
                return -1
            place, limit, entries, taken = _STATE.unpack_from(memory, _STATE_AT)
        room = self._room
        _RECORD.pack_into(room, place, what, size, *numbers)
        end = place + _RECORD_BYTES
        for part in parts:
            at = end
            end = at + len(part)
            room[at:end] = part
        _STATE.pack_into(memory, _STATE_AT, place + need, limit, entries + (counted > 0), taken + counted)
        self._publish(need)
        return int(place)

    def _restart(self) -> None:
        """Have the next record of an empty queue at the beginning: a mark would keep a part of the room."""
        counters = self._counters
        position = counters[_HEAD]
        counters[_RESTART] = position
        counters[_PLACE] = counters[_LIMIT] = 0
        self._run = position, 0
        self._runs.clear()

    def _publish(self, need: int) -> None:
        """Have the position include a record or mark of this size."""
        barrier()  # on processors that reorder writes, the record is there before the position includes it
        self._counters[_HEAD] += need

    def look_ahead(self, room: int) -> bool:
        """Have ``room`` bytes at the place of the next records, if possible; return whether the getter should look."""
        counters = self._counters
        if counters[_PLACE] + room > counters[_LIMIT]:
            self._reserve(room, max(_ENOUGH_BYTES, 2 * room))
        entries, waiting = self.waiting
        return waiting > _WAKE_BYTES or entries >= _WAKE_ENTRIES

    def _reserve(self, need: int, used: int = _ENOUGH_BYTES) -> bool:
        """Make room for a record of this size at the place of the next one; False if there is none.

        ``used``: as far as records should reach before it goes back.
        """
        counters = self._counters
        tail, last = counters[_TAIL], counters[_PLACE]
        while self._runs and self._runs[0][0] + self._runs[0][2] - self._runs[0][1] <= tail:
            self._runs.popleft()
        taken = [(place + max(0, tail - position), end) for position, place, end in self._runs]
        position, place = self._run
        taken.append((min(place + max(0, tail - position), last), last + _RECORD_BYTES))
        taken.sort()
        free, begin = [], 0
        for start, end in taken:
            free.append((begin, start))
            begin = end
        free.append((begin, self._size))
        need += _RECORD_BYTES  # behind each record there is room for a mark
        obstacle = next((start for start, _ in taken if start > last), self._size)
        fits = last + need <= obstacle
        enough = need + _FREE_BYTES if fits else need  # not to go back for a few bytes
        there = next((gap for gap in free if gap[1] - gap[0] >= enough), None)
        if there and (not fits or there[0] + enough <= min(used, last)):
            _RECORD.pack_into(self._room, last, _MARK, there[0], 0, 0, 0)
            self._runs.append((*self._run, last + _RECORD_BYTES))
            last, obstacle = there
            counters[_PLACE] = last
            self._publish(_RECORD_BYTES)
            self._run = counters[_HEAD], last
        elif not fits:
            return False
        wish = max(used, last + need + _FREE_BYTES)  # up to where not to ask again
        counters[_LIMIT] = min(obstacle, wish) - _RECORD_BYTES
        return True


_FLAT = frozenset({bytes, bytearray})


def _flat(part: Buffer) -> Buffer:
    """The same bytes as a row of bytes, of whatever shape and items the buffer is."""
    view = memoryview(part)
    return view if view.format == "B" and view.ndim == 1 and view.c_contiguous else view.tobytes()


def _fields_of(entry: Entry) -> tuple[int, int, int, str, str, tuple[int, ...], int]:
    """All except the payload.  Values that only behave like numbers or strings become such: marshal needs it."""
    return (
        index(entry.seq),
        index(entry.stamp_ns),
        _NUMBERS[entry.kind],
        "" + entry.channel,
        "" + entry.type,
        tuple(map(index, entry.links)),
        index(entry.source_ns),
    )


def owned(entry: Entry) -> Entry:
    """The entry, without what was lent to it."""
    return replace(entry, payload=(entry.data(),)) if any(type(part) is memoryview for part in entry.payload) else entry


class QueueReader(_QueueEnd):
    """The end that gets."""

    def __init__(self, place: mmap.mmap) -> None:
        super().__init__(place)
        #: Whether the large payloads of entries are the queue's own memory, which is theirs until :meth:`done` only.
        self.lends = False
        #: Whether the putter has ended: what it did not copy to the end is lost.
        self.abandoned = False
        #: Whether the next record is there, except that its payload is being copied.
        self.filling = False
        #: Entries whose payload was not copied, by stream.
        self.lost: Counter[str] = Counter()
        self._position = self._place = 0
        self._head = 0  # position up to which there is something, as far as this has looked
        self._entries = self._done = 0
        self._free = 0  # position up to which the putter has its room back
        self._begin = 0  # place from which on it has not
        self._gone: list[tuple[int, int]] = []  # what it has not, before the last mark
        self._streams: list[_Stream] = []
        #: For each stream that has a number, what the caller needs to take its entries as rows; None at first.
        self.row_streams: list[RowStream | None] = []
        #: The number of the stream of the last entry that :meth:`get` returned; -1 if it has none.
        self.stream = -1

    def flushed(self) -> None:
        """State that the file has what was taken so far."""
        self._counters[_FLUSHED] = self._counters[_DONE_ENTRIES]

    @property
    def refused(self) -> int:
        """Entries for which there was no room."""
        return self._counters[_REFUSED]

    @property
    def done_bytes(self) -> int:
        """What the entries that this is done with counted."""
        return self._counters[_DONE_BYTES]

    @property
    def waiting_bytes(self) -> int:
        """About as much waits to be got."""
        return self._counters[_HEAD] - self._position

    def clear_signal(self) -> None:
        """From here on it may be rung again."""
        self._counters[_BELL] = 0
        barrier()  # what was put without ringing is seen by the next look

    def get(self) -> Entry | tuple[Any, ...] | None:
        """The next entry or the words of the next command; None if nothing waits.  To be followed by :meth:`done`."""
        while True:
            if self._position == self._head and not self._poll():
                return None
            room, place = self._room, self._place
            what, size, number, stamp_ns, source_ns = _RECORD.unpack_from(room, place)
            if what >= _FILLING:
                self.filling = what < _VOID and not self.abandoned
                if self.filling:
                    self._counters[_AWAITS] = 1
                    return None
                self._lose(what, size)
                continue
            if what < _MAX_STREAMS:
                if size >= LARGE_BYTES:
                    barrier()  # as for the position
                begin = place + _RECORD_BYTES
                kind, channel, type_name, links = self._streams[what]
                self.stream = what
                break
            if what == _MARK:
                self._gone.append((self._begin, place + _RECORD_BYTES))
                self._position += _RECORD_BYTES
                self._begin = self._place = size
                continue
            begin = place + _RECORD_BYTES + number
            words = marshal.loads(room[place + _RECORD_BYTES : begin])
            if what == _ENTRY:
                number, stamp_ns, kind_number, channel, type_name, links, source_ns = words
                kind = _KINDS[kind_number]
                self.stream = -1
                break
            self._advance(place, begin)
            if what == _COMMAND:
                return tuple(words)
            kind_number, channel, type_name, links = words
            if len(self._streams) == _MAX_STREAMS:
                self._streams.clear()
                self.row_streams.clear()
            self._streams.append((_KINDS[kind_number], channel, type_name, links))
            self.row_streams.append(None)
        end = begin + size
        self._advance(place, end)
        self._entries += 1
        self._done += size + ENTRY_BYTES
        payload = room[begin:end]
        lent = size >= LARGE_BYTES and self.lends
        return Entry(
            number, stamp_ns, kind, channel, type_name, (payload if lent else bytes(payload),), links, source_ns
        )

    def rows(self) -> tuple[memoryview, int, int]:
        """The records that wait: the room, their begin, and the last place at which they can end.

        The first mark ends them.  What waits behind it lies elsewhere, so the end of the room limits that place, too.
        """
        if self._position == self._head:
            self._poll()
        return self._room, self._place, min(self._place + self._head - self._position, self._size)

    def take_rows(self, end: int, entries: int, size: int) -> None:
        """Go on behind rows of :meth:`rows` that were written, with these numbers of entries and payload bytes."""
        self._position += end - self._place
        self._place = end
        self._entries += entries
        self._done += size + entries * ENTRY_BYTES
        self.done()

    def _lose(self, what: int, size: int) -> None:
        """Go on behind an entry whose payload was not copied."""
        kind, channel, _, _ = self._streams[what & ~(_FILLING | _VOID)]
        self.lost[channel or kind.value] += 1
        self._advance(self._place, self._place + _RECORD_BYTES + size)
        self._entries += 1
        self._done += size + ENTRY_BYTES
        self.done()

    def _advance(self, place: int, end: int) -> None:
        """Go on behind a record."""
        need = (end - place + _ALIGN - 1) & -_ALIGN
        self._position += need
        self._place = place + need

    def _poll(self) -> bool:
        """Whether there is more than was there when this looked last."""
        self._head = self._counters[_HEAD]
        barrier()
        if self._position != self._head:
            if self._counters[_RESTART] == self._position:
                self._begin = self._place = 0
            return True
        self.filling = False
        if self._free != self._head:
            self._release()
        return False

    def done(self) -> None:
        """What was got need not be kept any longer."""
        self._counters[_DONE_ENTRIES] = self._entries
        self._counters[_DONE_BYTES] = self._done
        self._counters[_AWAITS] = 0
        if self._position - self._free >= _FREE_BYTES or self._position == self._head:
            self._release()

    def _release(self) -> None:
        """Give the putter its room back, and the system the memory that only a burst needs: before, not after."""
        for begin, end in (*self._gone, (self._begin, self._place)):
            # whole pages of the system: it would also empty the rest of a page that the end is in
            start = -(-(_PAGE + max(begin, _KEPT_BYTES)) // mmap.PAGESIZE) * mmap.PAGESIZE
            length = (_PAGE + end) // mmap.PAGESIZE * mmap.PAGESIZE - start
            if sys.platform != "win32" and length > 0 and _REMOVE is not None:
                with suppress(OSError):  # --lock-memory locks it where the getter is a thread of the bridge
                    self._map.madvise(_REMOVE, start, length)
        self._gone.clear()
        self._begin = self._place
        self._free = self._position
        barrier()  # what was read is read before the putter may write there again
        self._counters[_TAIL] = self._free

"""A queue of entries in memory that two processes share: one puts, the other one gets, and neither waits.

To put an entry is to copy it: no lock is shared, no system call is made, no thread has to run.  So what was put is
safe from whatever happens to the process that did, and costs it microseconds.

Layout: a page of counters, then room for records.  A record is five numbers and bytes; it is never split.  What all
entries of a stream have in common is written once, in a record before the first of them; an entry is the number of that
stream, three numbers of its own, and the payload.  Commands, and what does not fit into that, are marshalled.

Records follow each other, until a mark has the place of the next one: where the room ends, where
something waits still, and as soon as there is room at the beginning, so that the same few pages, which are there
already, serve again and again.  Positions count the bytes of records and marks and only grow; the putter knows the
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
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from operator import index
from typing import Any

from igtl_gateway.buffers import Buffer
from igtl_gateway.session.entry import Entry, Kind

_PAGE = 4096
_MARSHAL = 2  # the version without references, which a head has no use for
#: What a record is, and the size of its payload; of an entry then its number, stamp and source stamp.
_RECORD = struct.Struct("=QQQQQ")
_RECORD_BYTES = _RECORD.size
#: Streams that have numbers at once.
_MAX_STREAMS = 10_000
#: What a record is: an entry of the stream of this number, or one of these.  A mark has the place instead of the size,
#: the others the length of the words before the payload in place of the entry's number.
_MARK, _COMMAND, _STREAM, _ENTRY = range(_MAX_STREAMS, _MAX_STREAMS + 4)
_ALIGN = 16
_KINDS = tuple(Kind)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}

#: Places in the page of counters: of the putter, of the getter, and of both.
_HEAD, _REFUSED = 0, 1
_TAIL, _DONE_ENTRIES, _DONE_BYTES = 8, 9, 10
_BELL = 16

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

#: Payloads from this size on find no room in the last eighth of the bound.
_LARGE_BYTES = 64 << 10

#: Payloads from this size on may be lent.
_LENT_BYTES = 64 << 10


def memory(queue_bytes: int, largest: int) -> mmap.mmap:
    """Memory for a queue of ``queue_bytes`` between threads, in which the largest entry alone fits, too.

    Nothing is taken from the system before it is used.  Raises OSError.
    """
    return mmap.mmap(-1, _size(queue_bytes, largest))


def shared_memory(queue_bytes: int, largest: int) -> int:
    """The same for processes: a file descriptor to be mapped."""
    size = _size(queue_bytes, largest)
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("igtl-gateway recorder")
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


class QueueWriter(_QueueEnd):
    """The end that puts.  Its caller ensures that only one thread at a time uses it.

    Args:
        place: as for both ends.
        max_entries, max_bytes: the bound; one entry alone always fits.
    """

    def __init__(self, place: mmap.mmap, max_entries: int, max_bytes: int) -> None:
        super().__init__(place)
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._max_large = max_bytes - max_bytes // 8
        self._entries = self._taken = 0
        self._position = self._place = 0  # of the next record
        self._run = (0, 0)  # position and place of the first record since the last mark
        self._runs: deque[tuple[int, int, int]] = deque()  # those before, with the place of their end
        self._limit = 0  # the place up to which nothing is in the way
        self._barrier = threading.Lock()
        self._streams: dict[tuple[Kind, str, str, tuple[int, ...]], int] = {}
        #: Whether so much waits, after the last entry, that the getter should look.
        self.pressing = False

    def warm_up(self) -> None:
        """Have the system provide the memory that serves most, so that no entry waits for it page by page."""
        if sys.platform == "linux":
            with suppress(OSError):
                self._map.madvise(_POPULATE, 0, min(_ENOUGH_BYTES, self._size))

    @property
    def waiting(self) -> tuple[int, int]:
        """Entries and bytes that were put and are not done with."""
        return self._entries - self._counters[_DONE_ENTRIES], self._taken - self._counters[_DONE_BYTES]

    @property
    def entries_put(self) -> int:
        """Entries that were put so far."""
        return self._entries

    def put(self, entry: Entry) -> bool:
        """Add an entry; False if there is no room for it.  Raises TypeError or the like for other objects.

        That a peer came or went finds room beyond the bound, as commands do: without it every later output to the peers
        would be another one than that of the recording.  Large ones give way first: pictures fill a queue in seconds,
        and what the gateway learns from, such as a query, is small.
        """
        taken = False
        counters = self._counters
        try:
            payload = entry.payload
            if len(payload) == 1 and type(payload[0]) is bytes:
                size = len(payload[0])
            else:
                payload = [part if type(part) in _FLAT else _flat(part) for part in payload]
                size = sum(map(len, payload))
            try:
                stream = self._streams.get((entry.kind, entry.channel, entry.type, entry.links), -1)
                if stream < 0:
                    stream = self._new_stream(entry)
            except TypeError:  # a list of links
                stream = _ENTRY
            entries = self._entries - counters[_DONE_ENTRIES]
            waiting = self._taken - counters[_DONE_BYTES] + size + ENTRY_BYTES
            most = self._max_bytes if size < _LARGE_BYTES else self._max_large
            if (entries < self._max_entries and (waiting <= most or not entries)) or entry.kind is Kind.LINK:
                try:
                    taken = stream < _MAX_STREAMS and self._add(
                        stream, size, (entry.seq, entry.stamp_ns, entry.source_ns), payload, size
                    )
                except struct.error:  # beyond 64 bits
                    stream = _ENTRY
                if stream == _ENTRY:
                    taken = self._add_fields(_ENTRY, _fields_of(entry), payload, size)
        finally:
            if not taken:
                counters[_REFUSED] += 1
        self.pressing = waiting > _WAKE_BYTES or entries >= _WAKE_ENTRIES
        if taken:
            self._entries += 1
            self._taken += size + ENTRY_BYTES
        return taken

    def _new_stream(self, entry: Entry) -> int:
        """The number of an entry's stream, which the other end gets; ``_ENTRY`` where there is no room for that.

        When all numbers are taken both ends start again: each set of peers that gets a message is a stream, and peers
        come and go.
        """
        _, _, kind, channel, type_name, links, _ = _fields_of(entry)
        if not self._add_fields(_STREAM, (kind, channel, type_name, links)):
            return _ENTRY
        if len(self._streams) == _MAX_STREAMS:
            self._streams.clear()
        number = len(self._streams)
        self._streams[entry.kind, channel, type_name, links] = number
        return number

    def command(self, name: str, *words: Any) -> bool:
        """Add a command, whatever waits already; False if even the room for commands is taken."""
        return self._add_fields(_COMMAND, (name, *words))

    def signal(self) -> bool:
        """Ask for the getter's attention; False if it was asked already, and has not looked since."""
        if self._counters[_BELL]:
            return False
        self._counters[_BELL] = 1
        return True

    def _add_fields(self, what: int, words: tuple[Any, ...], payload: Sequence[Buffer] = (), size: int = 0) -> bool:
        encoded = marshal.dumps(words, _MARSHAL)
        return self._add(what, size, (len(encoded), 0, 0), (encoded, *payload), len(encoded) + size)

    def _add(self, what: int, size: int, numbers: tuple[int, int, int], parts: Sequence[Buffer], length: int) -> bool:
        """Add a record with these bytes, ``length`` of them together; False if there is no room."""
        need = (_RECORD_BYTES + length + _ALIGN - 1) & -_ALIGN
        if self._place + need > self._limit and not self._reserve(need):
            return False
        room, place = self._room, self._place
        _RECORD.pack_into(room, place, what, size, *numbers)
        end = place + _RECORD_BYTES
        for part in parts:
            at = end
            end = at + len(part)
            room[at:end] = part
        self._place = place + need
        self._position += need
        with self._barrier:  # on processors that reorder writes, the record is there before the position includes it
            pass
        self._counters[_HEAD] = self._position
        return True

    def _reserve(self, need: int) -> bool:
        """Make room for a record of this size at the place of the next one; False if there is none."""
        tail = self._counters[_TAIL]
        while self._runs and self._runs[0][0] + self._runs[0][2] - self._runs[0][1] <= tail:
            self._runs.popleft()
        taken = [(place + max(0, tail - position), end) for position, place, end in self._runs]
        position, place = self._run
        taken.append((min(place + max(0, tail - position), self._place), self._place + _RECORD_BYTES))
        taken.sort()
        free, begin = [], 0
        for start, end in taken:
            free.append((begin, start))
            begin = end
        free.append((begin, self._size))
        need += _RECORD_BYTES  # behind each record there is room for a mark
        obstacle = next((start for start, _ in taken if start > self._place), self._size)
        fits = self._place + need <= obstacle
        enough = need + _FREE_BYTES if fits else need  # not to go back for a few bytes
        there = next((gap for gap in free if gap[1] - gap[0] >= enough), None)
        if there and (not fits or there[0] + enough <= min(_ENOUGH_BYTES, self._place)):
            _RECORD.pack_into(self._room, self._place, _MARK, there[0], 0, 0, 0)
            self._runs.append((*self._run, self._place + _RECORD_BYTES))
            self._position += _RECORD_BYTES
            self._place, obstacle = there
            self._run = self._position, self._place
        elif not fits:
            return False
        wish = max(_ENOUGH_BYTES, self._place + need + _FREE_BYTES)  # up to where not to ask again
        self._limit = min(obstacle, wish) - _RECORD_BYTES
        return True


_FLAT = frozenset({bytes, bytearray})


def _flat(part: Buffer) -> Buffer:
    """The same bytes as a row of bytes, of whatever shape and items the buffer is."""
    view = memoryview(part)
    return view if view.format == "B" and view.ndim == 1 else view.tobytes()


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
        self._position = self._place = 0
        self._head = 0  # position up to which there is something, as far as this has looked
        self._entries = self._done = 0
        self._free = 0  # position up to which the putter has its room back
        self._begin = 0  # place from which on it has not
        self._gone: list[tuple[int, int]] = []  # what it has not, before the last mark
        self._barrier = threading.Lock()
        self._streams: list[tuple[Kind, str, str, tuple[int, ...]]] = []

    @property
    def refused(self) -> int:
        """Entries for which there was no room."""
        return self._counters[_REFUSED]

    @property
    def waiting_bytes(self) -> int:
        """About as much waits to be got."""
        return self._counters[_HEAD] - self._position

    def clear_signal(self) -> None:
        """From here on it may be rung again."""
        self._counters[_BELL] = 0

    def get(self) -> Entry | tuple[Any, ...] | None:
        """The next entry or the words of the next command; None if nothing waits.  To be followed by :meth:`done`."""
        while True:
            if self._position == self._head and not self._poll():
                return None
            room, place = self._room, self._place
            what, size, number, stamp_ns, source_ns = _RECORD.unpack_from(room, place)
            if what < _MAX_STREAMS:
                begin = place + _RECORD_BYTES
                kind, channel, type_name, links = self._streams[what]
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
                break
            self._advance(place, begin)
            if what == _COMMAND:
                return tuple(words)
            kind_number, channel, type_name, links = words
            if len(self._streams) == _MAX_STREAMS:
                self._streams.clear()
            self._streams.append((_KINDS[kind_number], channel, type_name, links))
        end = begin + size
        self._advance(place, end)
        self._entries += 1
        self._done += size + ENTRY_BYTES
        payload = room[begin:end]
        lent = size >= _LENT_BYTES and self.lends
        return Entry(
            number, stamp_ns, kind, channel, type_name, (payload if lent else bytes(payload),), links, source_ns
        )

    def _advance(self, place: int, end: int) -> None:
        """Go on behind a record."""
        need = (end - place + _ALIGN - 1) & -_ALIGN
        self._position += need
        self._place = place + need

    def _poll(self) -> bool:
        """Whether there is more than was there when this looked last."""
        self._head = self._counters[_HEAD]
        with self._barrier:
            pass
        if self._position != self._head:
            return True
        if self._free != self._head:
            self._release()
        return False

    def done(self) -> None:
        """What was got need not be kept any longer."""
        self._counters[_DONE_ENTRIES] = self._entries
        self._counters[_DONE_BYTES] = self._done
        if self._position - self._free >= _FREE_BYTES:
            self._release()

    def _release(self) -> None:
        """Give the putter its room back, and the system the memory that only a burst needs: before, not after."""
        for begin, end in (*self._gone, (self._begin, self._place)):
            start = -(-(_PAGE + max(begin, _KEPT_BYTES)) // _PAGE) * _PAGE
            length = (_PAGE + end) // _PAGE * _PAGE - start
            if length > 0 and _REMOVE is not None:
                self._map.madvise(_REMOVE, start, length)
        self._gone.clear()
        self._begin = self._place
        self._free = self._position
        self._counters[_TAIL] = self._free

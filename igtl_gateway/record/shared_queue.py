"""A queue of entries in memory that two processes share: one puts, the other one gets, and nobody waits.

To put an entry is to copy it: no lock is shared, no system call is made, no thread has to run.  So what was put is
safe from whatever happens to the process that did, and costs it microseconds.

Layout: a page of counters, then the bytes of the records, in a ring.  A record is two lengths, a head (marshalled)
and the payload; it is never split: where it does not fit before the end, a mark says to go on at the beginning.
Positions only grow; their place in the ring is the remainder.
"""

from __future__ import annotations

import marshal
import mmap
import os
import struct
import tempfile
import threading
from operator import index
from typing import Any

from igtl_gateway.buffers import Buffer
from igtl_gateway.session.entry import Entry, Kind

_PAGE = 4096
_LENGTHS = struct.Struct("=QQ")
_SKIP = (1 << 64) - 1
_ALIGN = 16
_KINDS = tuple(Kind)
_NUMBERS = {kind: number for number, kind in enumerate(_KINDS)}

#: Places in the page of counters: of the putter, of the getter, and of both.
_HEAD, _REFUSED = 0, 1
_TAIL, _DONE_ENTRIES, _DONE_BYTES = 8, 9, 10
_BELL = 16

#: Memory that stays with the ring when it is empty; of what a burst took, the rest goes back to the system.
_KEPT_BYTES = 32 << 20

#: Advice to the system that knows it (Linux): this memory holds nothing any more.
_REMOVE = getattr(mmap, "MADV_REMOVE", None)

#: So much is made free at a time, unless nothing else waits.
_FREE_BYTES = 1 << 20

#: What the bound has to leave for lengths, heads, skipped ends, commands and what is not free yet.
_SLACK_BYTES = 64 << 20

#: What an entry counts beside its payload.
ENTRY_BYTES = 500


def memory(queue_bytes: int, largest: int) -> mmap.mmap:
    """Memory for a queue of so many bytes between threads, in which the largest entry alone fits, too.

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


class _End:
    """What both ends know.  Args: ``place``: from ``memory``, or mapped from ``shared_memory``."""

    def __init__(self, place: mmap.mmap) -> None:
        self._map = place
        self._counters = memoryview(self._map)[:_PAGE].cast("Q")
        self._ring = memoryview(self._map)[_PAGE:]
        self._size = len(self._ring)


class Putter(_End):
    """The end that puts.  Its caller sees to it that one thread at a time does.

    Args:
        place: as for both ends.
        max_entries, max_bytes: the bound; one entry alone always fits.
    """

    def __init__(self, place: mmap.mmap, max_entries: int, max_bytes: int) -> None:
        super().__init__(place)
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._entries = self._taken = 0
        self._position = 0
        self._barrier = threading.Lock()

    @property
    def waiting(self) -> tuple[int, int]:
        """Entries and bytes that were put and are not done with."""
        return self._entries - self._counters[_DONE_ENTRIES], self._taken - self._counters[_DONE_BYTES]

    @property
    def given(self) -> int:
        """Entries that were put so far."""
        return self._entries

    def put(self, entry: Entry) -> bool:
        """Add an entry; False if there is no room for it.  Raises TypeError or the like for what is none."""
        taken = False
        try:
            payload = [part if type(part) in _FLAT else _flat(part) for part in entry.payload]
            size = sum(map(len, payload))
            entries, waiting = self.waiting
            full = entries >= self._max_entries or (entries and waiting + size + ENTRY_BYTES > self._max_bytes)
            taken = not full and self._add(_head(entry), payload, size)
        finally:
            if not taken:
                self._counters[_REFUSED] += 1
        if taken:
            self._entries += 1
            self._taken += size + ENTRY_BYTES
        return taken

    def command(self, name: str, *words: Any) -> bool:
        """Add a command, whatever waits already; False if even the room for commands is taken."""
        return self._add(marshal.dumps((name, *words)), (), 0)

    def ring_bell(self) -> bool:
        """Ask for the getter's attention; False if it was asked already, and has not looked since."""
        if self._counters[_BELL]:
            return False
        self._counters[_BELL] = 1
        return True

    def _add(self, head: bytes, payload: Any, size: int) -> bool:
        need = -(-(_LENGTHS.size + len(head) + size) // _ALIGN) * _ALIGN
        position, tail = self._position, self._counters[_TAIL]
        place = position % self._size
        # at the end, and wherever nothing waits: at the beginning are the pages that were used last
        restart = place + need > self._size or (position == tail and place > _KEPT_BYTES // 2)
        beyond = position - place + self._size if restart else position
        if beyond + need - tail > self._size:
            return False
        ring = self._ring
        if restart:
            if place + _LENGTHS.size <= self._size:
                _LENGTHS.pack_into(ring, place, _SKIP, 0)
            place = 0
        _LENGTHS.pack_into(ring, place, len(head), size)
        at = place + _LENGTHS.size
        ring[at : at + len(head)] = head
        at += len(head)
        for part in payload:
            end = at + len(part)
            ring[at:end] = part
            at = end
        self._position = beyond + need
        with self._barrier:  # on processors that reorder writes, the record is there before the position says so
            pass
        self._counters[_HEAD] = self._position
        return True


_FLAT = frozenset({bytes, bytearray})


def _flat(part: Buffer) -> Buffer:
    """The same bytes as a row of bytes, of whatever shape and items the buffer is."""
    view = memoryview(part)
    return view if view.format == "B" and view.ndim == 1 else view.tobytes()


def _head(entry: Entry) -> bytes:
    """All but the payload.  What only passes for a number or a text is made one: marshal takes it for bytes, or not."""
    return marshal.dumps(
        (
            index(entry.seq),
            index(entry.stamp_ns),
            _NUMBERS[entry.kind],
            "" + entry.channel,
            "" + entry.type,
            tuple(map(index, entry.links)),
            index(entry.source_ns),
        )
    )


class Getter(_End):
    """The end that gets."""

    def __init__(self, place: mmap.mmap) -> None:
        super().__init__(place)
        self._position = 0
        self._entries = self._done = 0
        self._free = 0  # position up to which the putter has its room back
        self._barrier = threading.Lock()

    @property
    def refused(self) -> int:
        """Entries for which there was no room."""
        return self._counters[_REFUSED]

    def answer_bell(self) -> None:
        """From here on it may be rung again."""
        self._counters[_BELL] = 0

    def get(self) -> Entry | tuple[Any, ...] | None:
        """The next entry or the words of the next command; None if nothing waits.  To be followed by :meth:`done`."""
        head = self._counters[_HEAD]
        with self._barrier:
            pass
        if self._position == head:
            if self._free != head:
                self._make_free()
            return None
        place = self._position % self._size
        lengths = _LENGTHS.unpack_from(self._ring, place) if place + _LENGTHS.size <= self._size else (_SKIP, 0)
        if lengths[0] == _SKIP:
            self._position += self._size - place
            place = 0
            lengths = _LENGTHS.unpack_from(self._ring, 0)
        head_size, size = lengths
        at = place + _LENGTHS.size
        words = marshal.loads(self._ring[at : at + head_size])
        self._position += -(-(_LENGTHS.size + head_size + size) // _ALIGN) * _ALIGN
        if isinstance(words[0], str):
            return tuple(words)
        seq, stamp_ns, kind, channel, type_name, links, source_ns = words
        self._entries += 1
        self._done += size + ENTRY_BYTES
        payload = bytes(self._ring[at + head_size : at + head_size + size])
        return Entry(seq, stamp_ns, _KINDS[kind], channel, type_name, (payload,), links, source_ns)

    def done(self) -> None:
        """What was got need not be kept any longer."""
        self._counters[_DONE_ENTRIES] = self._entries
        self._counters[_DONE_BYTES] = self._done
        if self._position - self._free >= _FREE_BYTES:
            self._make_free()

    def _make_free(self) -> None:
        """Give the putter its room back, and the system the memory that only a burst needs: before, not after."""
        first, last = self._free % self._size, self._position % self._size
        for begin, end in ((first, last),) if first <= last else ((first, self._size), (0, last)):
            start = -(-(_PAGE + max(begin, _KEPT_BYTES)) // _PAGE) * _PAGE
            length = (_PAGE + end) // _PAGE * _PAGE - start
            if length > 0 and _REMOVE is not None:
                self._map.madvise(_REMOVE, start, length)
        self._free = self._position
        self._counters[_TAIL] = self._free

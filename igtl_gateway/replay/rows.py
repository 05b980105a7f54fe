"""The entries of a recording as rows: arrays of heads, times and places of payloads.

Rows come from the columns of a file, or from entries one by one; both have the same contents.  What of a file cannot be
read comes as the error of ``SessionFile.entries``, behind the rows before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.columns import EntryColumns, Unfit
from igtl_gateway.record.sessionfile.stream_rows import StreamNumbers

Array = npt.NDArray[Any]
Numbers = npt.NDArray[np.int64]

#: Entries of one batch where they come one by one, and bytes of it.
_BATCH, _BATCH_BYTES = 256, 1 << 20
_FAR_NS = 1 << 63


@dataclass(frozen=True, slots=True)
class Head:
    """What messages have in common; ``group`` is the number that the reader gives their stream."""

    kind: Kind
    channel: str
    type: str
    links: tuple[int, ...]
    group: int


class Heads:
    """Numbers the heads of some recordings.

    Attributes:
        known: the heads.
        groups: int32, the group of each.
        forms: int32, heads with the same type and links have the same.

    Args:
        group_of: returns the number of the stream of entries of a kind and channel.
    """

    def __init__(self, group_of: Callable[[Kind, str], int] = lambda _kind, _channel: 0) -> None:
        self.known: list[Head] = []
        self.groups, self.forms = np.zeros(0, np.int32), np.zeros(0, np.int32)
        self._group_of = group_of
        self._numbers: dict[tuple[Kind, str, str, tuple[int, ...]], int] = {}
        self._forms: dict[tuple[str, tuple[int, ...]], int] = {}

    def number(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        key = (kind, channel, type_name, links)
        found = self._numbers.get(key)
        if found is None:
            found = self._numbers[key] = len(self.known)
            self.known.append(Head(*key, self._group_of(kind, channel)))
            if found >= len(self.groups):
                room = np.zeros(len(self.groups) + 64, np.int32)
                self.groups, self.forms = np.append(self.groups, room), np.append(self.forms, room)
            self.groups[found] = self.known[found].group
            self.forms[found] = self._forms.setdefault((type_name, links), len(self._forms))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Entries in order; each array has one element per entry.

    Attributes:
        buffers: bytes with the payloads.
        which: int32, the buffer of each.
        begins, ends: int64, places in it.
        heads: int32, numbers of ``Heads``.
        numbers: int64, entry numbers.
        times: gateway time, UTC ns: int64, or objects where one is after 2262.
        stamps: the sender's stamps, likewise; 0 = unset.
    """

    buffers: tuple[bytes, ...]
    which: npt.NDArray[np.int32]
    begins: Numbers
    ends: Numbers
    heads: npt.NDArray[np.int32]
    numbers: Numbers
    times: Array
    stamps: Array

    def __len__(self) -> int:
        return len(self.numbers)

    @classmethod
    def none(cls) -> Rows:
        no, few = np.zeros(0, np.int64), np.zeros(0, np.int32)
        return cls((), few, no, no, few, no, no, no)

    def where(self, rows: Array | slice) -> Rows:
        """Those of a mask, of indices or of a slice."""
        return Rows(self.buffers, *(getattr(self, name)[rows] for name in _ARRAYS))

    def with_others(self, others: Rows) -> Rows:
        """These, and others behind them."""
        if not len(self):
            return others
        joined = [np.concatenate((getattr(self, name), getattr(others, name))) for name in _ARRAYS[1:]]
        which = np.concatenate((self.which, others.which + np.int32(len(self.buffers))))
        return Rows((*self.buffers, *others.buffers), which, *joined)

    def payload(self, row: int) -> memoryview:
        return memoryview(self.buffers[self.which[row]])[int(self.begins[row]) : int(self.ends[row])]

    def entry(self, row: int, heads: Heads) -> Entry:
        """The object, as ``SessionFile.entries`` makes it."""
        head = heads.known[self.heads[row]]
        numbers = int(self.numbers[row]), int(self.times[row])
        payload = (bytes(self.payload(row)),)
        return Entry(*numbers, head.kind, head.channel, head.type, payload, head.links, int(self.stamps[row]))

    def entries(self, heads: Heads) -> Iterator[Entry]:
        """The objects of all of them."""
        known, buffers = heads.known, self.buffers
        columns = (self.numbers, self.times, self.heads, self.which, self.begins, self.ends, self.stamps)
        for number, time, head, which, begin, end, stamp in zip(*(each.tolist() for each in columns), strict=True):
            its = known[head]
            yield Entry(number, time, its.kind, its.channel, its.type, (buffers[which][begin:end],), its.links, stamp)

    def compact(self, first: int, most_buffers: int) -> Rows:
        """The same with own copies of the payloads in buffers from ``first`` on, so that these can be released.

        With more than ``most_buffers``, or with buffers that are mostly of other rows, all become one.
        """
        used = np.unique(self.which)
        size = sum(len(self.buffers[number]) for number in used.tolist() if number < first)
        kept = self.which < first
        held = int((self.ends - self.begins)[kept].sum())
        if len(used) > most_buffers or size > 2 * held + _BATCH_BYTES:
            kept = np.zeros(len(self), np.bool_)
        moved = np.flatnonzero(~kept)
        old = np.unique(self.which[kept])
        data = b"".join([self.payload(row) for row in moved.tolist()])
        sizes = (self.ends - self.begins)[moved]
        which, begins, ends = self.which.copy(), self.begins.copy(), self.ends.copy()
        which[kept] = np.searchsorted(old, self.which[kept])
        which[moved] = len(old)
        ends[moved] = np.cumsum(sizes)
        begins[moved] = ends[moved] - sizes
        buffers = (*(self.buffers[number] for number in old.tolist()), data)
        return Rows(buffers, which, begins, ends, self.heads, self.numbers, self.times, self.stamps)


class Readable(Protocol):
    """An open session file; see ``SessionFile``."""

    def entries(self) -> Iterator[Entry]: ...
    def columns(self) -> Iterator[EntryColumns]: ...


_ARRAYS = tuple(each.name for each in fields(Rows))[1:]


def rows_of_entries(entries: Iterable[Entry], heads: Heads) -> Iterator[Rows]:
    """The rows of entries that come one by one."""
    some: list[Entry] = []
    size = 0
    try:
        for entry in entries:
            some.append(entry)
            size += entry.size
            if len(some) >= _BATCH or size >= _BATCH_BYTES:
                batch, some, size = some, [], 0
                yield _of_entries(batch, heads)
                del batch
    except Exception:
        if some:
            yield _of_entries(some, heads)
        raise
    if some:
        yield _of_entries(some, heads)


def _of_entries(entries: list[Entry], heads: Heads) -> Rows:
    payloads = [entry.data() for entry in entries]
    sizes = np.array([len(payload) for payload in payloads], np.int64)
    ends = np.cumsum(sizes)
    numbers = np.array([heads.number(each.kind, each.channel, each.type, each.links) for each in entries], np.int32)
    seqs = np.array([entry.seq for entry in entries], np.int64)
    times, stamps = ([getattr(entry, name) for entry in entries] for name in ("stamp_ns", "source_ns"))
    which = np.zeros(len(entries), np.int32)
    return Rows((b"".join(payloads),), which, ends - sizes, ends, numbers, seqs, _times(times), _times(stamps))


def _times(values: Any) -> Array:
    """Times of 64 bits as int64, where none is too late for it; else as objects."""
    if isinstance(values, np.ndarray) and values.dtype == np.int64:
        return values
    found: Array = np.empty(len(values), object)
    found[:] = values if isinstance(values, list) else values.tolist()
    return found if len(found) and max(found) >= _FAR_NS else found.astype(np.int64)


def rows_of(file: Readable, heads: Heads) -> Iterator[Rows]:
    """The rows of a file: by columns where it has these, else of its entries.  Raises as ``SessionFile.entries``."""
    try:
        return rows_of_columns(file.columns(), heads)
    except Unfit:
        return rows_of_entries(file.entries(), heads)


def rows_of_columns(blocks: Iterable[EntryColumns], heads: Heads) -> Iterator[Rows]:
    """The rows of the columns of a file."""
    streams = StreamNumbers(heads.number)
    for columns in blocks:
        try:
            rows = _rows(columns, heads, streams)
        except GatewayError:
            # the same columns one by one: the rows before the first fault, and its error
            yield from rows_of_entries(columns.entries(), heads)
            raise
        yield rows


def _rows(columns: EntryColumns, heads: Heads, streams: StreamNumbers) -> Rows:
    """The rows of columns.  Raises DamagedRecording."""
    found = streams.of(columns)
    numbers, begins, ends, stamps = found.idents, found.begins, found.ends, found.sources
    which = np.zeros(len(columns), np.int32)
    buffers: tuple[bytes, ...] = (columns.data,)
    notes = np.flatnonzero(numbers < 0)
    if len(notes):
        made = _of_entries(list(columns.where(notes).entries()), heads)
        buffers = (*buffers, *made.buffers)
        which[notes], begins[notes], ends[notes], numbers[notes] = 1, made.begins, made.ends, made.heads
        stamps[notes] = 0
    return Rows(buffers, which, begins, ends, numbers, columns.numbers, _times(columns.times), _times(stamps))

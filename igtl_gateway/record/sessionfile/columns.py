"""Entries in bulk: columns over the records of a chunk, and an object only for what is looked into.

:meth:`SessionFile.columns` has the order and the checks of :meth:`SessionFile.entries`.  It does not look into
payloads: :meth:`EntryColumns.wire` does, for OpenIGTLink, and :meth:`EntryColumns.entry` for one entry.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.channels import SEQUENCES, Decode
from igtl_gateway.record.sessionfile.chunk_columns import OUTGOING, STAMPED, Columns, unwrap
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.messages import raw_head, unpack_raw
from igtl_gateway.record.sessionfile.records import Malformed

Numbers = npt.NDArray[np.int64]
#: int64; uint64 where one of them is after 2262.
Times = npt.NDArray[np.int64] | npt.NDArray[np.uint64]

#: After all times.
END_NS = 1 << 64
_CHANNELS = 1 << 16
#: Heads that are compared in C; a head that is not among them costs what an entry object costs.
_LEARNED_HEADS = 1000
_LATE = 1 << 63


class Unfit(Exception):
    """Only :meth:`SessionFile.entries` reads the file: it is of an older version."""


@dataclass(frozen=True, slots=True)
class Stream:
    """What the record of an MCAP channel states of its entries.

    Attributes:
        kind: of its entries; a message of OpenIGTLink may state the other direction.
        channel, type: of its entries; ``""`` for notes, and where streams of OpenIGTLink share the channel.
        topic: in the file.
    """

    kind: Kind
    channel: str
    type: str
    topic: str


@dataclass(frozen=True, slots=True)
class WireHead:
    """Channel, type and links of the entries of some messages of OpenIGTLink."""

    channel: str
    type: str
    links: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class WireColumns:
    """Messages of OpenIGTLink among entries; each array has one element per message.

    Attributes:
        rows: of the EntryColumns, int64.
        begins, ends: places of the OpenIGTLink messages in ``data``, int64.
        outgoing: whether the kind is IGTL_OUT, not IGTL_IN: the direction that the message itself states.
        source_times: the sender's stamp, UTC ns; 0 = unset; dtype as of the times.
        heads: int32, indices into ``known``.
        known: channels, types and links; it may have more than those of these messages.
    """

    rows: Numbers
    begins: Numbers
    ends: Numbers
    outgoing: npt.NDArray[np.bool_]
    source_times: Times
    heads: npt.NDArray[np.int32]
    known: Sequence[WireHead]

    def __len__(self) -> int:
        return len(self.rows)


class WireHeads:
    """The heads of RawMessages that a file had so far; see :func:`.chunk_columns.unwrap`."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        """Begin again: the columns of earlier calls keep the heads that they know."""
        self.known: list[WireHead] = []
        self._numbers: dict[tuple[int, bytes], int] = {}
        self._bytes = b""
        self._offsets = np.zeros(1, np.int64)
        self._next = np.zeros(0, np.int32)
        self._last = np.full(_CHANNELS, -1, np.int32)

    def unwrap(
        self, data: bytes, channels: npt.NDArray[np.uint16], begins: Numbers, ends: Numbers
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8], int, LayoutError | None]:
        """Find the OpenIGTLink messages in RawMessages; ``begins`` becomes their places.

        Returns the heads, the flags, and the row of the first invalid RawMessage, with the error of it.
        """
        if len(self.known) > _LEARNED_HEADS:
            self._forget()
        count = len(channels)
        heads, flags = np.empty(count, np.int32), np.empty(count, np.uint8)
        row = 0
        while True:
            row = unwrap(
                data, channels, begins, ends, heads, flags, row, self._bytes, self._offsets, self._next, self._last
            )
            if row == count:
                return heads, flags, row, None
            raw = memoryview(data)[int(begins[row]) : int(ends[row])]
            try:
                entry = unpack_raw(raw, 0, 1, 1)  # a source stamp becomes 1
            except LayoutError as error:
                return heads, flags, row, error
            number = self._number_of(int(channels[row]), raw_head(raw, entry), entry)
            if number >= _LEARNED_HEADS:  # a file in which no head is like another
                heads[row], begins[row] = number, ends[row] - entry.size
                flags[row] = (OUTGOING if entry.kind is Kind.IGTL_OUT else 0) | (STAMPED if entry.source_ns else 0)
                row += 1

    def _number_of(self, channel: int, same: bytes, entry: Entry) -> int:
        """The number of a head, which the next call knows, first of its channel, if it is one of the first ones."""
        number = self._numbers.get((channel, same))
        if number is None:
            number = self._numbers[channel, same] = len(self.known)
            self.known.append(WireHead(entry.channel, entry.type, entry.links))
            if number < _LEARNED_HEADS:
                self._bytes += same
                self._offsets = np.append(self._offsets, np.int64(len(self._bytes)))
                last = int(self._last[channel])
                self._next = np.append(self._next, np.int32(number if last < 0 else self._next[last]))
                if last >= 0:
                    self._next[last] = number
        if number < _LEARNED_HEADS:
            self._last[channel] = number
        return number


class _Table:
    """What a file knows of its channels, and how its entries are decoded."""

    def __init__(
        self,
        streams: Mapping[int, Stream],
        decoders: Mapping[int, Decode],
        digests: Collection[int],
        name: str,
        remedy: str,
    ) -> None:
        self.streams, self.decoders, self.digests = streams, decoders, digests
        self.name, self.remedy = name, remedy
        self.wire_heads = WireHeads()

    def damaged(self, number: int, error: LayoutError) -> DamagedRecording:
        return DamagedRecording(f"{self.name}: entry {number}: {error}{self.remedy}")


@dataclass(frozen=True, slots=True, eq=False)
class EntryColumns:
    """Consecutive entries of a file in order; each array has one element per entry.

    Attributes:
        data: bytes with all payloads: the records of the chunk, or payloads in a row.
        channels: uint16, numbers of MCAP channels: keys of ``streams``.
        numbers: entry numbers, int64; in files of other programs counted from 1.
        times: gateway time, UTC ns.
        publish_times: publish_time as it is in the file, ns: equals the time where the sender set no stamp.
        begins, ends: places of the payloads of the MCAP messages in ``data``, int64.
        chunk: the chunk that they are of; None where chunks overlap, or blocks are joined.
        complete: they are all messages of the chunk.
    """

    data: bytes
    channels: npt.NDArray[np.uint16]
    numbers: Numbers
    times: Times
    publish_times: Times
    begins: Numbers
    ends: Numbers
    chunk: ChunkEntry | None
    complete: bool
    table: _Table

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def streams(self) -> Mapping[int, Stream]:
        """MCAP channel → what it states of its entries."""
        return self.table.streams

    def digests(self) -> npt.NDArray[np.bool_] | None:
        """Mask of the entries whose payload is the digest of an output; None: there is none."""
        return mask_of(self.channels, self.table.digests) if self.table.digests else None

    def where(self, rows: npt.NDArray[Any] | slice) -> EntryColumns:
        """The entries of a mask, of indices or of a slice."""
        names = ("channels", "numbers", "times", "publish_times", "begins", "ends")
        columns = {name: getattr(self, name)[rows] for name in names}
        complete = self.complete and len(columns["numbers"]) == len(self)
        return replace(self, **columns, complete=complete)

    def of(self, wanted: Callable[[Stream], bool]) -> npt.NDArray[np.bool_]:
        """Mask of the entries of the wanted streams."""
        return mask_of(self.channels, {number for number, stream in self.streams.items() if wanted(stream)})

    def payload(self, row: int) -> memoryview:
        """Payload of one MCAP message, not copied."""
        return memoryview(self.data)[int(self.begins[row]) : int(self.ends[row])]

    def source_times(self) -> Times:
        """Of ROS: the sender's stamps, UTC ns; 0 = unset.  Those of OpenIGTLink: :meth:`wire`."""
        publish = self.publish_times
        return np.where(publish == self.times, publish.dtype.type(0), publish)

    def entry(self, row: int) -> Entry:
        """One entry, as SessionFile.entries makes it.  Raises DamagedRecording."""
        return next(self.where(slice(row, row + 1)).entries())

    def entries(self) -> Iterator[Entry]:
        """All entries, as SessionFile.entries makes them.  Raises DamagedRecording."""
        decoders, data = self.table.decoders, self.data
        columns = (self.channels, self.numbers, self.times, self.publish_times, self.begins, self.ends)
        for channel, number, *rest in zip(*(column.tolist() for column in columns), strict=True):
            try:
                entry = decoders[channel]((channel, number % SEQUENCES, *rest, data), number)
            except LayoutError as error:
                raise self.table.damaged(number, error) from None
            yield entry

    def wire(self, rows: Numbers | None = None) -> WireColumns:
        """The messages of OpenIGTLink: all, or those of some rows.

        Raises DamagedRecording at the first that is not as its fields state, or at an entry before it, as a note.
        """
        if rows is None:
            rows = np.flatnonzero(self.of(is_wire))
        begins, ends = self.begins[rows], self.ends[rows]
        heads, flags, row, error = self.table.wire_heads.unwrap(self.data, self.channels[rows], begins, ends)
        if error:
            for _ in self.where(slice(int(rows[row]))).entries():
                pass  # an earlier entry may be the first that is not right, such as a note
            raise self.table.damaged(int(self.numbers[rows[row]]), error)
        times, publish = self.times[rows], self.publish_times[rows]
        # publish_time equals log_time where the sender set no stamp; the message itself shows whether by coincidence
        stamped = (publish != times) | (flags & STAMPED != 0)
        sources = np.where(stamped, publish, publish.dtype.type(0))
        known = self.table.wire_heads.known
        return WireColumns(rows, begins, ends, flags & OUTGOING != 0, sources, heads, known)


def in_larger_blocks(blocks: Iterable[EntryColumns], most: int, most_bytes: int) -> Iterator[EntryColumns]:
    """Join the blocks of a file that follow each other: work that is done for each block is done less often.

    Args:
        blocks: what SessionFile.columns yields.
        most, most_bytes: a block that has more entries or bytes is joined with none.

    Raises what ``blocks`` raises, after what it has yielded.
    """
    waiting: list[EntryColumns] = []
    try:
        for block in blocks:
            count, size = len(block), len(block.data)
            alone = size > _LARGE_ENTRIES * count
            if waiting and (
                alone
                or sum(map(len, waiting)) + count > most
                or sum(len(each.data) for each in waiting) + size > most_bytes
                or _dtypes(block) != _dtypes(waiting[0])
            ):
                yield _joined(waiting)
                waiting = []
            if alone:
                yield block
            else:
                waiting.append(block)
    except Exception:
        if waiting:
            yield _joined(waiting)
        raise
    if waiting:
        yield _joined(waiting)


#: Mean size of entries above which copying them is more work than their blocks.
_LARGE_ENTRIES = 8192


def _dtypes(block: EntryColumns) -> tuple[Any, Any]:
    return block.times.dtype, block.publish_times.dtype


def _joined(blocks: Sequence[EntryColumns]) -> EntryColumns:
    if len(blocks) == 1:
        return blocks[0]
    columns = {
        name: np.concatenate([getattr(block, name) for block in blocks])
        for name in ("channels", "numbers", "times", "publish_times")
    }
    offsets = np.cumsum([0, *(len(block.data) for block in blocks[:-1])]).tolist()
    for name in ("begins", "ends"):
        places = [getattr(block, name) + offset for block, offset in zip(blocks, offsets, strict=True)]
        columns[name] = np.concatenate(places)
    data = b"".join(block.data for block in blocks)
    return EntryColumns(data=data, **columns, chunk=None, complete=False, table=blocks[0].table)


def is_wire(stream: Stream) -> bool:
    """Whether the entries are messages of OpenIGTLink."""
    return stream.kind in layout.WIRE_TOPICS


def mask_of(channels: npt.NDArray[np.uint16], numbers: Iterable[int]) -> npt.NDArray[np.bool_]:
    """Mask of the messages of some MCAP channels."""
    return table_of(numbers)[channels]


def table_of(numbers: Iterable[int]) -> npt.NDArray[np.bool_]:
    """For each possible MCAP channel, whether it is one of these."""
    table = np.zeros(_CHANNELS, np.bool_)
    table[list(numbers)] = True
    return table


class ColumnsReader:
    """Makes entry columns of messages, with the checks of SessionFile.entries.

    Args:
        name: of the file, for errors.
        remedy: the end of a sentence about damage.
        streams, decoders: by MCAP channel; of those that are read.
        known: MCAP channels of which there is a record.
        counted: entries are numbered as read.
        digests: MCAP channels of the digests of outputs, which are not computed.
    """

    def __init__(
        self,
        name: str,
        remedy: str,
        streams: Mapping[int, Stream],
        decoders: Mapping[int, Decode],
        known: frozenset[int],
        *,
        counted: bool,
        digests: Collection[int] = (),
    ) -> None:
        self._table = _Table(streams, decoders, digests, name, remedy)
        self._known, self._read = table_of(known), table_of(streams)
        self._counted = counted
        self._seq, self._first = 0, True

    def columns(
        self, chunk: ChunkEntry | None, data: bytes, found: Columns, *, whole: bool
    ) -> tuple[EntryColumns, str]:
        """The entries in messages that follow those of the last call; in full, or up to a number that is not right.

        Args:
            chunk, data, found: as of `message_columns`.
            whole: they are all messages of the chunk.

        Returns them, and what is wrong with the number behind them, or ``""``.  Raises Malformed.
        """
        is_known = self._known[found.channels]
        if not is_known.all():
            unknown = int(found.channels[~is_known].min())
            raise Malformed(f"found a message of channel {unknown}, of which there is no record")
        count = len(found.channels)
        read = self._read[found.channels]
        if not read.all():
            found = found.where(read)
        numbers, right = self._numbers(found.sequences)
        fault = ""
        if right < len(numbers):
            before = int(numbers[right - 1]) if right else self._seq
            fault = f"found entry number {found.sequences[right]}, expected one above {before % SEQUENCES}"
            found, numbers = found.where(slice(right)), numbers[:right]
        if right:
            self._seq, self._first = int(numbers[-1]), False
        times, publish = _signed(found.times), _signed(found.publish_times)
        complete = whole and len(numbers) == count
        return EntryColumns(
            data, found.channels, numbers, times, publish, found.begins, found.ends, chunk, complete, self._table
        ), fault  # fmt: skip

    def _numbers(self, sequences: npt.NDArray[np.uint32]) -> tuple[Numbers, int]:
        """Entry numbers that MCAP's sequences stand for, and how many of them are right."""
        count = len(sequences)
        if self._counted:
            return np.arange(self._seq + 1, self._seq + 1 + count, dtype=np.int64), count
        after = sequences.astype(np.int64)
        before = np.concatenate((np.array([self._seq % SEQUENCES]), after[:-1])) if count else after
        steps = (after - before) % SEQUENCES
        wrong = (steps == 0) | (steps >= SEQUENCES // 2)
        if self._first and count:  # entries before the first one may have been left out
            wrong[0] = steps[0] == 0
        right = int(np.argmax(wrong)) if wrong.any() else count
        return self._seq + np.cumsum(steps), right


def _signed(times: npt.NDArray[np.uint64]) -> Times:
    return times.view(np.int64) if not len(times) or int(times.max()) < _LATE else times

"""The messages of one stream in blocks of arrays: places and times instead of an object for each message.

The message index of a chunk has the place of each message of a channel, so a chunk without the stream is not read, and
numpy finds the times and payloads of the others.  A chunk is under a checksum and its index is not: the sizes of the
index records are compared with the summary, and channel and end of each message with the index.

A file without usable index, or whose chunks overlap in time, is read entry by entry; the blocks are the same.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.chunk_columns import Columns
from igtl_gateway.record.sessionfile.chunks import packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, work_of
from igtl_gateway.record.sessionfile.records import (
    HEAD,
    MESSAGE,
    MESSAGE_INDEX,
    MESSAGE_INDEX_HEAD,
    MESSAGE_RECORD,
    Malformed,
)

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.derived import DerivedOutputs

Numbers = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

#: Unpacked chunks that are kept, as several streams have messages in the same chunk.
_KEPT_BYTES = 64 << 20
#: Entries of one block where a file is read entry by entry.
_BATCH, _BATCH_BYTES = 10_000, 8 << 20
_LAST = (1 << 63) - 1  #: of the times in a block
_WIRE = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})

_RECORD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class MessageBlock:
    """Messages of one stream in order; each array has one element per message.

    Attributes:
        data: bytes, uint8, with all payloads.
        begins, ends: places of the payloads in ``data``.  Of OpenIGTLink the whole message, of ROS the CDR message.
        numbers: entry numbers; 0 in files of other programs.
        times: gateway time, UTC ns.
        source_times: the sender's stamp, UTC ns; 0 = unset.
        links: of OpenIGTLink number of the first link that a message came from or went to; 0 = none.  None for ROS.
    """

    data: Bytes
    begins: Numbers
    ends: Numbers
    numbers: Numbers
    times: Numbers
    source_times: Numbers
    links: Numbers | None = None

    def __len__(self) -> int:
        return len(self.times)

    def payload(self, index: int) -> memoryview:
        """Payload of one message, not copied."""
        return self.data.data[int(self.begins[index]) : int(self.ends[index])]

    def where(self, rows: npt.NDArray[Any] | slice) -> MessageBlock:
        """The messages of a mask, of indices or of a slice."""
        arrays = (self.begins, self.ends, self.numbers, self.times, self.source_times)
        begins, ends, numbers, times, sources = (array[rows] for array in arrays)
        links = None if self.links is None else self.links[rows]
        return MessageBlock(self.data, begins, ends, numbers, times, sources, links)

    def compact(self) -> MessageBlock:
        """The same with a copy of the payloads alone, one after the other."""
        sizes = self.ends - self.begins
        size = int(sizes[0]) if len(sizes) else 0
        if size <= _SMALL_BYTES and (sizes == size).all():
            data = gathered(self.data, self.begins, size).reshape(-1)
        else:
            data = np.frombuffer(b"".join([self.payload(row) for row in range(len(self))]), np.uint8)
        ends = np.cumsum(sizes)
        return replace(self, data=data, begins=ends - sizes, ends=ends)


#: Messages up to this size are copied at once.
_SMALL_BYTES = 1 << 12


class Unusable(Exception):
    """The file must be read entry by entry."""


class ChunkReader:
    """Reads chunks by the index of a file and keeps the last ones unpacked."""

    def __init__(self, stream: IO[bytes], index: Index, path: str) -> None:
        self._stream, self._index, self._path = stream, index, path
        #: Of a file with digests: what computes the outputs.
        self.derived: DerivedOutputs | None = None
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._size = 0
        chunks = index.chunks
        self._fit = (
            not index.scanned
            and all(not chunk.loose and chunk.start_ns <= chunk.end_ns for chunk in chunks)
            and all(one.end_ns <= two.start_ns for one, two in pairwise(chunks))
        )

    @cached_property
    def is_usable(self) -> bool:
        """Whether, by the summary, a message is read without those before it."""
        return self._fit and all(chunk.places or not chunk.size for chunk in self._index.chunks)

    @cached_property
    def _spans(self) -> tuple[list[int], list[int]]:
        """Times of the first and of the last message of each chunk."""
        return [each.start_ns for each in self._index.chunks], [each.end_ns for each in self._index.chunks]

    def blocks(
        self, channels: Collection[int], start_ns: int, end_ns: int, *, whole: bool, is_wire: bool
    ) -> Iterator[MessageBlock]:
        """The messages of some MCAP channels from ``start_ns`` on and before ``end_ns`` (UTC).

        Args:
            whole: the times include all messages, so their number must be that of the summary.
            is_wire: messages are RawMessages, and the payload is the OpenIGTLink message in it.

        Raises Unusable before the first block, or Malformed, LimitExceeded, UnsupportedRecording (a time after 2262).
        """
        if not self.is_usable:
            raise Unusable
        wanted = set(channels)
        starts, ends = self._spans
        near = slice(bisect_left(ends, start_ns), bisect_left(starts, end_ns))
        chunks = [chunk for chunk in self._index.chunks[near] if not wanted.isdisjoint(chunk.channels)]
        check_work(self._index.size, work_of(chunks), self._path)
        places = [self._places(chunk, wanted)[1] for chunk in chunks]
        count = 0
        for chunk, offsets in zip(chunks, places, strict=True):
            block = self._block(chunk, offsets, wanted, start_ns, end_ns)
            count += len(block)
            inside = (block.times >= start_ns) & (block.times < end_ns)
            if not inside.all():
                block = block.where(inside)
            if is_wire:
                block = _unwrapped(block)
            if len(block):
                yield block
        expected = sum(self._index.counts.get(number, 0) for number in wanted)
        if whole and count != expected:
            raise Malformed(f"found {count_text(count, 'message')} by the indexes of the chunks, expected {expected}")

    def forget(self) -> None:
        """Free the unpacked chunks that are kept."""
        self._kept.clear()
        self._size = 0

    def span(self, channels: Collection[int]) -> tuple[int, int]:
        """Times of the first and the last message of some MCAP channels; reads no message.  Raises as `blocks`."""
        wanted = set(channels)
        if not self._fit:
            raise Unusable
        chunks = [chunk for chunk in self._index.chunks if not wanted.isdisjoint(chunk.channels)]
        if not chunks:
            raise Unusable
        first, last = (self._places(chunk, wanted)[0] for chunk in (chunks[0], chunks[-1]))
        if not len(first) or not len(last):
            raise Unusable
        return int(first.min()), int(last.max())

    def _places(self, chunk: ChunkEntry, wanted: set[int]) -> tuple[Numbers, Numbers]:
        """Times and offsets of the messages of some channels, by the index of a chunk.  Raises Unusable."""
        indexes = chunk.message_indexes
        found = [self._pairs(chunk, number, indexes) for number in sorted(wanted & indexes.keys())]
        pairs = np.concatenate(found)
        return pairs[:, 0], pairs[:, 1]

    def _pairs(self, chunk: ChunkEntry, channel: int, indexes: Mapping[int, int]) -> Numbers:
        """(n, 2): time and offset of the messages of a channel.  Raises Unusable."""
        at = indexes[channel]
        end = chunk.at + chunk.length + chunk.index_length
        self._stream.seek(at)
        size = HEAD.size + MESSAGE_INDEX_HEAD.size
        head = self._stream.read(size)
        if len(head) < size:
            raise Unusable
        opcode, length = HEAD.unpack_from(head)
        number, pairs_size = MESSAGE_INDEX_HEAD.unpack_from(head, HEAD.size)
        # where the next index begins is in the summary, which has a checksum: a wrong size would lose messages
        is_whole = (
            at + HEAD.size + length in {*indexes.values(), end} and length == MESSAGE_INDEX_HEAD.size + pairs_size
        )
        if (
            (opcode, number) != (MESSAGE_INDEX, channel)
            or not is_whole
            or at + size + pairs_size > end
            or pairs_size % 16
        ):
            raise Unusable
        pairs = np.frombuffer(self._stream.read(pairs_size), "<u8")
        if pairs.nbytes != pairs_size:
            raise Unusable
        return pairs.reshape(-1, 2).astype(np.int64)

    def _unpacked(self, chunk: ChunkEntry) -> bytes:
        data = self._kept.get(chunk.at)
        if data is not None:
            self._kept.move_to_end(chunk.at)
            return data
        data = packed_chunk(self._stream, chunk, self._path).unpack()
        self._kept[chunk.at] = data
        self._size += len(data)
        while self._size > _KEPT_BYTES and len(self._kept) > 1:
            self._size -= len(self._kept.popitem(last=False)[1])
        return data

    def _block(self, chunk: ChunkEntry, places: Numbers, wanted: set[int], start_ns: int, end_ns: int) -> MessageBlock:
        """The messages at some places in a chunk, in order of time."""
        data = np.frombuffer(self._unpacked(chunk), np.uint8)
        places = np.sort(places)
        head = MESSAGE_RECORD.size
        if len(places) and (places[0] < 0 or places[-1] + head > len(data) or (places[1:] == places[:-1]).any()):
            raise Malformed(f"chunk at offset {chunk.at:,}: found a message outside of it")
        records = gathered(data, places, head).view(_RECORD).reshape(-1)
        ends = places + HEAD.size + records["length"].astype(np.int64)
        last = max(int(records["log_ns"].max()), int(records["publish_ns"].max())) if len(places) else 0
        check_time(last, f"chunk at offset {chunk.at:,}")
        times = records["log_ns"].astype(np.int64)
        right = (records["opcode"] == MESSAGE) & np.isin(records["channel"], list(wanted)) & (ends <= len(data))
        if not (right & (ends >= places + head)).all():
            raise Malformed(f"chunk at offset {chunk.at:,}: found another record, expected a message of the index")
        publish = records["publish_ns"].astype(np.int64)
        # in MCAP, publish_time = log_time means "not set"
        source = np.where(publish == times, 0, publish)
        numbers = records["sequence"].astype(np.int64)
        block = MessageBlock(data, places + head, ends, numbers, times, source)
        if self.derived and not wanted.isdisjoint(self.derived.numbers):
            block = self._derived_block(self.derived, block, records, start_ns, end_ns)
        if (times[1:] < times[:-1]).any():
            block = block.where(np.argsort(times, kind="stable"))
        return block

    @staticmethod
    def _derived_block(
        derived: DerivedOutputs, block: MessageBlock, records: npt.NDArray[Any], start_ns: int, end_ns: int
    ) -> MessageBlock:
        """A block of messages, some of which are digests, with the outputs in their place."""
        # the columns have no inputs, so the cause of each is looked up
        columns = Columns(
            records["channel"], records["sequence"], records["log_ns"], records["publish_ns"], block.begins, block.ends
        )
        inside = (block.times >= start_ns) & (block.times < end_ns)
        data, found = derived.columns(block.data.tobytes(), columns, inside)
        return replace(block, data=np.frombuffer(data, np.uint8), begins=found.begins, ends=found.ends)


def check_time(found: int, what: str) -> None:
    """Refuse a time without 63 bits, which would be before 1970."""
    if found > _LAST:
        raise UnsupportedRecording(f"{what}: found {found}, expected times up to 2^63 - 1 ns")


def gathered(data: Bytes, begins: Numbers, size: int) -> Bytes:
    """(n, size) bytes from each of n places in ``data``; the caller has checked that they are inside."""
    if not len(begins) or not size:
        return np.zeros((len(begins), size), np.uint8)
    # one item of ``size`` bytes at every offset: numpy copies items of this form faster than rows of bytes
    items: npt.NDArray[np.void] = np.ndarray((len(data) - size + 1,), np.dtype((np.void, size)), data, 0, (1,))
    return items[begins].view(np.uint8).reshape(-1, size)


def numbers_at(data: Bytes, places: Numbers, dtype: str) -> npt.NDArray[Any]:
    """One number from each of n places; places outside of ``data`` raise Malformed."""
    kind = np.dtype(dtype)
    if len(places) and (int(places.min()) < 0 or int(places.max()) + kind.itemsize > len(data)):
        raise Malformed("found the end of a message, expected a number")
    return gathered(data, places, kind.itemsize).view(kind).reshape(-1)


#: In a RawMessage: the places of the stamp of the sender and of the links, and the smallest head.
_RAW_SOURCE_AT, _RAW_LINKS_AT, _RAW_HEAD = 12, 32, 52


def _unwrapped(block: MessageBlock) -> MessageBlock:
    """RawMessages → the OpenIGTLink messages in them.  Raises Malformed."""
    data, begins, ends = block.data, block.begins, block.ends
    if not len(block):
        return block
    if (ends - begins < _RAW_HEAD).any():
        raise Malformed("found no RawMessage")
    size = int(_payload_places(data, begins[:1], ends[:1])[0] - begins[0])
    same = (ends - begins >= size).all()
    heads = gathered(data, begins, size if same else _RAW_HEAD)
    # nearly always all messages have the links and names of the first one, so its layout
    if same and (heads[:, _RAW_LINKS_AT:-4] == heads[0, _RAW_LINKS_AT:-4]).all():
        at = begins + size
        sizes = _column(heads, size - 4, "<u4").astype(np.int64)
    else:
        at = _payload_places(data, begins, ends)
        sizes = numbers_at(data, at - 4, "<u4").astype(np.int64)
    if (at + sizes != ends).any() or (_column(heads, 0, ">u2") != 1).any():
        raise Malformed("found a RawMessage of another size than its fields, or not in CDR, little-endian")
    stamped = _column(heads, _RAW_SOURCE_AT, "<u8") != 0
    # a stamp of the sender that equals the gateway time: the message itself has it
    source = np.where((block.source_times == 0) & stamped, block.times, block.source_times)
    # behind the number of links is the first one, or the length of the type
    links = numbers_at(data, begins + _RAW_LINKS_AT + 4, "<u4").astype(np.int64)
    links[_column(heads, _RAW_LINKS_AT, "<u4") == 0] = 0
    return MessageBlock(data, at, ends, block.numbers, block.times, source, links)


def _payload_places(data: Bytes, begins: Numbers, ends: Numbers) -> Numbers:
    """Places of the payloads of RawMessages.  Raises Malformed."""
    at = begins + _RAW_LINKS_AT
    at = at + 4 + 4 * numbers_at(data, at, "<u4").astype(np.int64)
    for _ in range(2):  # type and device name
        at = at + 4 + numbers_at(data, np.minimum(at, ends - 4), "<u4").astype(np.int64)
        at = at + -(at - begins) % 4
    return at + 4


def _column(rows: Bytes, place: int, dtype: str) -> npt.NDArray[Any]:
    """One number of each row."""
    return np.ascontiguousarray(rows[:, place : place + np.dtype(dtype).itemsize]).view(dtype).reshape(-1)


def blocks_of_entries(entries: Iterable[Entry]) -> Iterator[MessageBlock]:
    """Blocks of entries, which have to be of one stream."""
    batch: list[Entry] = []
    size = 0
    for entry in entries:
        batch.append(entry)
        size += entry.size
        if len(batch) >= _BATCH or size >= _BATCH_BYTES:
            yield block_of(batch)
            batch, size = [], 0
    if batch:
        yield block_of(batch)


def joined_blocks(blocks: Sequence[MessageBlock]) -> MessageBlock:
    """The messages of some blocks of a stream as one block."""
    if len(blocks) == 1:
        return blocks[0]
    offsets = np.cumsum([0, *(len(block.data) for block in blocks[:-1])]).tolist()
    begins, ends = (
        np.concatenate([getattr(block, name) + offset for block, offset in zip(blocks, offsets, strict=True)])
        for name in ("begins", "ends")
    )
    data, numbers, times, sources = (
        np.concatenate([getattr(block, name) for block in blocks])
        for name in ("data", "numbers", "times", "source_times")
    )
    links = [block.links for block in blocks if block.links is not None]
    return MessageBlock(data, begins, ends, numbers, times, sources, np.concatenate(links) if links else None)


def block_of(entries: Collection[Entry]) -> MessageBlock:
    """One block of entries: their payloads in one piece.  Raises UnsupportedRecording for times after 2262."""
    payloads = [entry.data() for entry in entries]
    ends = np.cumsum([len(payload) for payload in payloads], dtype=np.int64)
    begins = np.concatenate((np.zeros(1, np.int64), ends[:-1])) if payloads else ends
    for entry in entries:
        check_time(max(entry.seq, entry.stamp_ns, entry.source_ns), f"entry {entry.seq}")
    numbers, times, source = (
        np.array([getattr(entry, name) for entry in entries], np.int64) for name in ("seq", "stamp_ns", "source_ns")
    )
    links = None
    if any(entry.kind in _WIRE for entry in entries):
        links = np.array([entry.links[0] if entry.links else 0 for entry in entries], np.int64)
    return MessageBlock(np.frombuffer(b"".join(payloads), np.uint8), begins, ends, numbers, times, source, links)

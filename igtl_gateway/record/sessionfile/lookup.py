"""Starting in the middle of a file: the entries that the latched state follows from are located, not read up to.

The index of a chunk has channel, time and place of each message in it, and the channel the kind of its entries.
So the last message of each latched channel before a moment is found, with its group (the input that caused it, and the
earlier outputs of that input), without unpacking a chunk.  Then the few chunks that hold one of them are unpacked.
Chunks without a latched channel, by the summary, are skipped together with their index.

The index of a chunk has no checksum.  But it holds the order of the messages twice, by time and by place, with its ends
in the summary, which has one; and a message that is taken from a chunk must have the channel and the time of the index.
So a damaged index either is detected or makes no difference.  Where anything is not as expected (an index that is
damaged or absent, chunks that overlap in time) there is no result: then the file must be read from its beginning.
"""

from __future__ import annotations

import struct
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.gateway.log.entry import MESSAGES, Kind
from igtl_gateway.record.sessionfile.chunk_columns import Row
from igtl_gateway.record.sessionfile.chunks import packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, work_of
from igtl_gateway.record.sessionfile.records import (
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    MESSAGE_INDEX_HEAD,
    Malformed,
)

#: Looking up more messages than this is more work than reading the file.
_MAX_PLACES = 1_000_000

Flags = npt.NDArray[np.bool_]
Numbers = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class LatchedStateRule:
    """Which entries the latched state follows from; the outputs of such an input belong to it, too.

    Attributes:
        is_state: whether the entries of a stream (kind, channel, type) are a state.
        by_content: whether a message of the channel might not replace the one before it.
    """

    is_state: Callable[[Kind, str, str], bool]
    by_content: Callable[[str], bool]


@dataclass(frozen=True, slots=True)
class LookupResult:
    """The messages that were looked up.

    Attributes:
        rows: messages in order; each with the number of messages (of streams that are read) before it.
        rest_ns: time of the first message in the chunks that were not searched; None if there is none.
        count: messages (of streams that are read) before that; only where they were to be counted.
    """

    rows: list[tuple[Row, int]]
    rest_ns: int | None
    count: int


@dataclass(frozen=True, slots=True, order=True)
class _MessagePlace:
    """Of a message: number of its chunk, offset in it, channel, time, messages before it."""

    chunk: int
    offset: int
    channel: int
    time_ns: int
    before: int


class _Unfit(Exception):
    """The index is not usable."""


def look_up(
    stream: IO[bytes],
    file: Index,
    start_ns: int,
    streams: Mapping[int, tuple[Kind, str, str]],
    rule: LatchedStateRule,
    *,
    counted: bool,
) -> LookupResult | None:
    """The messages before ``start_ns`` (UTC) that have to be read; None where the index is not usable.

    Args:
        file: the index of the file.
        streams: kind, channel and type of the entries of each MCAP channel that is read.
        counted: the messages before are to be counted.
    """
    try:
        chunks = file.chunks
        if any(one.end_ns >= two.start_ns for one, two in pairwise(chunks)):
            raise _Unfit
        before = [index for index in chunks if index.end_ns < start_ns]
        check_work(file.size, work_of(before), "")
        search = _Search(streams, rule)
        concerned = range(len(before)) if counted else _concerned(search, before)
        for at, index in enumerate(before):
            if at in concerned:
                search.chunk(at, *chunk_messages(stream, index))
            else:
                search.skip()
        rows, size, most = [], 0, limits.current_limits().unpacked(file.size)
        for row, number in _messages(stream, before, sorted(search.places())):
            rows.append((row, number))
            size += len(row[6])
            if size > most:
                raise _Unfit
    except (_Unfit, Malformed, LimitExceeded, struct.error, ValueError, LookupError):  # anything unexpected
        return None
    rest_ns = chunks[len(before)].start_ns if len(before) < len(chunks) else None
    return LookupResult(rows, rest_ns, search.count)


def _concerned(search: _Search, chunks: list[ChunkEntry]) -> set[int]:
    """Which of the chunks may hold state, or a part of a group that does."""
    inputs = [at for at, index in enumerate(chunks) if search.has_input(index)]
    if not inputs:
        return set(range(len(chunks)))
    # the beginning, whose causes are not in this file, and the group that the moment may lie in
    found = {*range(inputs[0] + 1), *range(inputs[-1], len(chunks))}
    for at, index in enumerate(chunks):
        if search.has_state(index):
            # its first outputs may belong to the last input before it, and its last input have outputs behind it
            here = bisect_left(inputs, at)
            first = inputs[max(here - 1, 0)]
            last = inputs[min(bisect_right(inputs, at), len(inputs) - 1)]
            found |= {*range(first, max(at, last) + 1)}
    return found


class _Search:
    """Visits the chunks in order and remembers the last message of each latched channel."""

    def __init__(self, streams: Mapping[int, tuple[Kind, str, str]], rule: LatchedStateRule) -> None:
        self.count = self._looked_at = 0
        size = max(streams, default=0) + 1
        self._known, self._inputs, self._messages, self._state, self._by_content = (
            np.zeros(size, np.bool_) for _ in range(5)
        )
        for number, (kind, channel, type_name) in streams.items():
            self._known[number] = True
            self._inputs[number] = kind.is_input
            self._messages[number] = kind in MESSAGES
            self._state[number] = rule.is_state(kind, channel, type_name)
            self._by_content[number] = rule.by_content(channel)
        self._kept: set[_MessagePlace] = set()
        self._last: dict[int, list[_MessagePlace]] = {}  # by channel: the message and its group
        self._group: list[_MessagePlace] = []  # the last input and what follows
        self._cause_is_state: bool | None = None  # of that input; None: there was none yet

    def has_input(self, index: ChunkEntry) -> bool:
        return bool(self._inputs[self._channels(index)].any())

    def has_state(self, index: ChunkEntry) -> bool:
        return bool(self._state[self._channels(index)].any())

    def skip(self) -> None:
        """Skip a chunk of no concern; nor are outputs in the next one that its inputs cause."""
        self._group, self._cause_is_state = [], False

    def places(self) -> set[_MessagePlace]:
        """All messages that have to be read."""
        return {*self._kept, *self._group, *(place for group in self._last.values() for place in group)}

    def chunk(self, number: int, channels: Numbers, times: Numbers, offsets: Numbers) -> None:
        """The messages of a chunk, in order."""
        known = self._of(self._known, channels)
        channels, times, offsets = channels[known], times[known], offsets[known]
        count = len(channels)
        is_input = self._inputs[channels]
        causes = np.maximum.accumulate(np.where(is_input, np.arange(count), -1))
        state = self._state[channels]
        # outputs before the first input have their cause in another file: the caller has to judge
        begun: Flags = np.asarray(causes >= 0)
        orphan: Flags = ~begun if self._cause_is_state is None else np.zeros(count, np.bool_)
        caused = np.where(begun, state[causes], bool(self._cause_is_state))
        wanted = np.flatnonzero((state | caused | orphan) & self._messages[channels])

        def group(at: int) -> list[_MessagePlace]:
            """The message and the part of its group before it."""
            here = range(max(int(causes[at]), 0), at + 1)
            self._looked_at += len(here)
            if self._looked_at > _MAX_PLACES:
                raise _Unfit
            places = [
                _MessagePlace(number, int(offsets[i]), int(channels[i]), int(times[i]), self.count + i) for i in here
            ]
            return places if begun[at] else self._group + places

        each = orphan[wanted] | self._by_content[channels[wanted]]
        for at in wanted[each].tolist():
            self._kept.update(group(at))
        backwards = wanted[~each][::-1]
        for at in backwards[np.unique(channels[backwards], return_index=True)[1]].tolist():
            self._last[int(channels[at])] = group(at)
        if count:
            self._group = group(count - 1)
            if begun[-1]:
                self._cause_is_state = bool(state[causes[-1]])
        self.count += count

    def _channels(self, index: ChunkEntry) -> Numbers:
        """The channels of a chunk that are read."""
        channels = np.array(index.channels, np.int64)
        return channels[self._of(self._known, channels)]

    @staticmethod
    def _of(flags: Flags, channels: Numbers) -> Flags:
        """A flag of each; of numbers that are too large: False."""
        return np.asarray(flags[np.minimum(channels, len(flags) - 1)] & (channels < len(flags)))


def chunk_times(stream: IO[bytes], file: Index) -> Iterator[tuple[Numbers, Numbers]] | None:
    """Channels and times of the messages of each chunk, in order; None where the index is not usable.

    Raises ValueError where it turns out to be so.
    """
    if file.scanned or any(one.end_ns >= two.start_ns for one, two in pairwise(file.chunks)):
        return None
    return _chunk_times(stream, file.chunks)


def _chunk_times(stream: IO[bytes], chunks: list[ChunkEntry]) -> Iterator[tuple[Numbers, Numbers]]:
    for index in chunks:
        try:
            channels, times, _ = chunk_messages(stream, index)
        except (_Unfit, Malformed, struct.error, LookupError) as error:
            raise ValueError(str(error)) from None
        yield channels, times


def chunk_messages(stream: IO[bytes], index: ChunkEntry) -> tuple[Numbers, Numbers, Numbers]:
    """Channels, times and offsets of the messages of a chunk, in order.  Raises _Unfit, Malformed and others."""
    start = index.at + index.length
    stream.seek(start)
    data = stream.read(index.index_length)
    parts = []
    at = 0
    places = {}
    while at < len(data):
        opcode, _ = HEAD.unpack_from(data, at)
        channel, size = MESSAGE_INDEX_HEAD.unpack_from(data, at + HEAD.size)
        if opcode != MESSAGE_INDEX or channel in places:
            raise _Unfit
        places[channel] = start + at
        at += HEAD.size + MESSAGE_INDEX_HEAD.size
        pairs = np.frombuffer(data, "<u8", size // 8, at).reshape(-1, 2)
        parts.append((np.full(len(pairs), channel, np.int64), pairs[:, 0], pairs[:, 1]))
        at += size
    if at != index.index_length or places != index.message_indexes or not parts:
        raise _Unfit
    channels, times, offsets = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(offsets)
    channels, times, offsets = channels[order], times[order], offsets[order]
    ends = (int(times[0]), int(times[-1]), int(offsets[-1]) < index.size)
    if ends != (index.start_ns, index.end_ns, True):
        raise _Unfit
    if (times[1:] < times[:-1]).any() or (offsets[1:] == offsets[:-1]).any():
        raise _Unfit
    return channels, times, offsets


def _messages(stream: IO[bytes], chunks: list[ChunkEntry], places: list[_MessagePlace]) -> Iterator[tuple[Row, int]]:
    """The messages at these places; one chunk is held at a time."""
    for number, inside in groupby(places, key=lambda place: place.chunk):
        data = packed_chunk(stream, chunks[number], "").unpack()
        for place in inside:
            opcode, length = HEAD.unpack_from(data, place.offset)
            at, end = place.offset + HEAD.size, place.offset + HEAD.size + length
            channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, at)
            if (opcode, channel, log_time) != (MESSAGE, place.channel, place.time_ns) or end > len(data):
                raise _Unfit
            payload = data[at + MESSAGE_HEAD.size : end]
            yield (channel, sequence, log_time, publish_time, 0, len(payload), payload), place.before

"""The messages of an MCAP file, chunk by chunk, as the index tells: a row of numbers each, not an object.

Chunks that do not overlap in time, as ours never do, are read one after the other, and the messages in each are put in
order of time.  Chunks that overlap are merged; those that overlap at one moment are held together, within the limits.
Either way every chunk is checked against its checksum.

While the messages of one chunk are taken, the next small ones are unpacked and checked in a thread beside, which needs
the interpreter for neither.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from operator import itemgetter
from typing import IO

import numpy as np

from igtl_gateway.sessionfile.index import ChunkEntry, Index, check_work, message_bound, packed_chunk, work_of
from igtl_gateway.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, Malformed
from igtl_gateway.untrusted import limits

#: Channel, sequence, log_time, publish_time; first and last offset of the payload in the bytes that follow.
Row = tuple[int, int, int, int, int, int, bytes]

_BOTH_HEADS = struct.Struct("<BQHIQQ")

#: So many chunks are read before they are needed, among them, in pairs of input and output, one to be unpacked.
_AHEAD = 2
#: Chunks above this are not read before they are needed, and their rows are made in batches.
_SMALL = 8 << 20
_BATCH = 10_000

_log_time = itemgetter(2)


def in_order(chunks: Sequence[ChunkEntry]) -> bool:
    """Whether the order of chunks in the file is their order in time."""
    return not any(one.end_ns > two.start_ns for one, two in pairwise(chunks))


def message_rows(
    stream: IO[bytes],
    index: Index,
    path: str,
    from_ns: int = 0,
    is_wanted: Callable[[ChunkEntry], bool] = lambda _chunk: True,
) -> Iterator[tuple[ChunkEntry | None, list[Row] | None]]:
    """The messages of a file in order of time, in lists.

    Args:
        path: of the file, for errors.
        from_ns: messages before that are left out.
        is_wanted: whether a chunk is to be read; where chunks overlap it is not asked.

    Yields a chunk with some of its messages; with None: one that is not wanted; None with messages of several chunks.
    Raises Malformed, LimitExceeded.
    """
    chunks = [chunk for chunk in index.chunks if chunk.end_ns >= from_ns]
    check_work(index.size, work_of(chunks), path)
    count, most = 0, message_bound(index.size)
    found: Iterator[tuple[ChunkEntry | None, list[Row] | None]]
    found = _in_turn(stream, chunks, path, is_wanted) if in_order(chunks) else _merged(stream, index, chunks, path)
    for chunk, rows in found:
        count += len(rows or ())
        limits.check_limit("count", count, f"{path}: messages", most)
        if rows and rows[0][2] < from_ns:
            yield chunk, [row for row in rows if row[2] >= from_ns]
        else:
            yield chunk, rows


def _in_turn(
    stream: IO[bytes], chunks: Sequence[ChunkEntry], path: str, is_wanted: Callable[[ChunkEntry], bool]
) -> Iterator[tuple[ChunkEntry, list[Row] | None]]:
    """One chunk after the other."""
    waiting: deque[tuple[ChunkEntry, Future[bytes] | None]] = deque()
    with ThreadPoolExecutor(1, "igtl-unpack") as beside:
        for chunk in chunks:
            while waiting and (len(waiting) > _AHEAD or chunk.size > _SMALL):
                yield from _taken(*waiting.popleft())
            unpacking = None
            if is_wanted(chunk):
                # read here: the position in the stream is not the thread's
                unpacking = beside.submit(packed_chunk(stream, chunk, path).unpack)
            waiting.append((chunk, unpacking))
            if chunk.size > _SMALL:
                yield from _taken(*waiting.popleft())
        while waiting:
            yield from _taken(*waiting.popleft())


def _taken(chunk: ChunkEntry, unpacking: Future[bytes] | None) -> Iterator[tuple[ChunkEntry, list[Row] | None]]:
    if unpacking is None:
        yield chunk, None
        return
    for rows in _batches(unpacking.result()):
        yield chunk, rows


def _merged(
    stream: IO[bytes], index: Index, chunks: Sequence[ChunkEntry], path: str
) -> Iterator[tuple[None, list[Row]]]:
    """Chunks that overlap: of the same time, the message that stands first in the file."""
    waiting = deque(sorted(chunks, key=lambda chunk: (chunk.start_ns, chunk.at)))
    most, held = limits.current_limits().unpacked(index.size), 0
    # next message of each open chunk: time, offset of the chunk (no two are equal), and the rest
    heads: list[tuple[int, int, Row, Iterator[Row], int]] = []
    rows: list[Row] = []
    while waiting or heads:
        while waiting and (not heads or waiting[0].start_ns <= heads[0][0]):
            chunk = waiting.popleft()
            data = packed_chunk(stream, chunk, path).unpack()
            limits.check_limit("ratio", held + len(data), f"{path}: chunks that overlap", most)
            if _push(heads, chunk.at, (row for batch in _batches(data) for row in batch), len(data)):
                held += len(data)
        if not heads:
            continue
        _, at, row, rest, size = heapq.heappop(heads)
        rows.append(row)
        ended = not _push(heads, at, rest, size)
        # a row keeps the bytes of its chunk
        if ended or len(rows) >= _BATCH:
            held -= size if ended else 0
            del row, rest
            yield None, rows
            rows = []
    if rows:
        yield None, rows


def _push(heads: list[tuple[int, int, Row, Iterator[Row], int]], at: int, rows: Iterator[Row], size: int) -> bool:
    """Open a chunk, or go on with it; whether there is another message in it."""
    row = next(rows, None)
    if row is None:
        return False
    heapq.heappush(heads, (row[2], at, row, rows, size))
    return True


def _batches(data: bytes) -> Iterator[list[Row]]:
    """The messages in the bytes of a chunk, in order of time; of a large one in several lists."""
    if len(data) <= _SMALL:
        yield _rows(data)
        return
    starts, stamps = array("Q"), array("Q")
    for at, stamp_ns in _heads(data):
        starts.append(at)
        stamps.append(stamp_ns)
    # stable: of the same time, the one that stands first
    order = np.argsort(np.frombuffer(stamps, np.uint64), kind="stable") if starts else np.zeros(0, np.intp)
    for first in range(0, len(order), _BATCH):
        rows: list[Row] = []
        for i in order[first : first + _BATCH].tolist():
            at = starts[i]
            _, length, *numbers = _BOTH_HEADS.unpack_from(data, at)
            rows.append((*numbers, at + _BOTH_HEADS.size, at + HEAD.size + length, data))
        yield rows


def _heads(data: bytes) -> Iterator[tuple[int, int]]:
    """Offset and time of each message."""
    at, size = 0, len(data)
    while at < size:
        opcode, length = _head(data, at)
        if opcode == MESSAGE:
            yield at, MESSAGE_HEAD.unpack_from(data, at + HEAD.size)[2]
        at += HEAD.size + length


def _rows(data: bytes) -> list[Row]:
    """The messages in the bytes of a chunk."""
    rows: list[Row] = []
    at, last_ns, sorted_by_time = 0, 0, True
    size, heads, unpack = len(data), _BOTH_HEADS.size, _BOTH_HEADS.unpack_from
    while at < size:
        if size - at < heads:
            _, length = _head(data, at)
            end = at + HEAD.size + length
        else:
            opcode, length, channel, sequence, log_ns, publish_ns = unpack(data, at)
            end = at + HEAD.size + length
            if end > size or (opcode == MESSAGE and length < MESSAGE_HEAD.size):
                _head(data, at)
            if opcode == MESSAGE:
                rows.append((channel, sequence, log_ns, publish_ns, at + heads, end, data))
                if log_ns < last_ns:
                    sorted_by_time = False
                last_ns = log_ns
        at = end
    if not sorted_by_time:
        rows.sort(key=_log_time)  # stable: of the same time, the one that stands first
    return rows


def _head(data: bytes, at: int) -> tuple[int, int]:
    """Opcode and length of the record at ``at``.  Raises Malformed where it does not fit."""
    size = len(data) - at
    opcode, length = HEAD.unpack_from(data, at) if size >= HEAD.size else (0, -1)
    least = MESSAGE_HEAD.size if opcode == MESSAGE else 0
    if not least <= length <= size - HEAD.size:
        raise Malformed(f"found {size} bytes at the end of a chunk, which are no whole record")
    return opcode, length

"""The messages of a file in order of time, chunk by chunk.

Chunks that do not overlap in time, as those of our writer never do, are read one after the other.  Chunks that overlap
are merged; those that overlap at one moment are held together, within the limits.  Either way every chunk is checked
against its checksum.

While the messages of one chunk are taken, a thread unpacks and checks the next small ones: neither needs the
interpreter.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import chain, pairwise
from typing import IO, TypeVar

import numpy as np

from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row, count_of
from igtl_gateway.record.sessionfile.chunks import (
    BATCH,
    SMALL_BYTES,
    PackedChunk,
    batches,
    column_batches,
    packed_chunk,
)
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, message_bound, work_of

#: Number of chunks that are read ahead; they come in pairs of input and output, so one of them is to be unpacked.
_AHEAD = 2
#: After all times.
_END_NS = 1 << 64


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
        from_ns: earlier messages are left out; chunks that have no later ones are not read.
        is_wanted: whether a chunk is to be read; not asked where chunks overlap.

    Yields a chunk with some of its messages; a chunk with None where it is not wanted; None with messages of several
    chunks.  Raises Malformed, LimitExceeded.
    """
    chunks, overlap = _chosen(index, path, from_ns, _END_NS)
    check_count = _counter(index, path)
    found: Iterator[tuple[ChunkEntry | None, list[Row] | None]]
    if overlap:
        found = _merged(stream, index, chunks, path)
    else:
        found = _rows_in_turn(stream, chunks, path, is_wanted)
    for chunk, rows in found:
        check_count(len(rows or ()))
        if rows and rows[0][2] < from_ns:
            yield chunk, [row for row in rows if row[2] >= from_ns]
        else:
            yield chunk, rows


def message_columns(
    stream: IO[bytes],
    index: Index,
    path: str,
    from_ns: int = 0,
    to_ns: int = _END_NS,
    is_wanted: Callable[[ChunkEntry], bool] = lambda _chunk: True,
) -> Iterator[tuple[ChunkEntry | None, bytes, Columns, bool]]:
    """The messages of a file in order of time, in columns.

    Arguments as of :func:`message_rows`; chunks that begin at ``to_ns`` or later are not read, their messages may be
    there.  Chunks that are not wanted are left out.

    Yields a chunk, its records, some of its messages, and whether these are all; or None, payloads in a row, messages
    of several chunks, and False.  Raises Malformed, LimitExceeded.
    """
    chunks, overlap = _chosen(index, path, from_ns, to_ns)
    check_count = _counter(index, path)
    if overlap:
        for _, rows in _merged(stream, index, chunks, path):
            check_count(len(rows))
            yield from _joined([row for row in rows if row[2] >= from_ns])
        return
    for chunk, found in _in_turn(stream, chunks, path, is_wanted, _in_columns):
        if found is None:
            continue
        data, some = found
        for columns in [some] if some else column_batches(data):
            check_count(len(columns.times))
            is_late = columns.times >= from_ns
            whole = some is not None and not chunk.loose and bool(is_late.all())
            yield chunk, data, columns if is_late.all() else columns.where(is_late), whole


def _in_columns(chunk: PackedChunk) -> tuple[bytes, Columns | None]:
    """The records of a chunk, and all its messages if they are not too many for one batch."""
    data = chunk.unpack()
    if len(data) > SMALL_BYTES and count_of(data)[0] > BATCH:
        return data, None
    return data, next(column_batches(data))


def _joined(rows: Sequence[Row]) -> Iterator[tuple[None, bytes, Columns, bool]]:
    """Messages of several chunks, with their payloads in a row."""
    parts: list[Row] = []
    size = 0
    for row in chain(rows, (None,)):
        if parts and (row is None or size >= SMALL_BYTES):
            found = Columns.empty(len(parts))
            for number, values in enumerate(list(zip(*parts, strict=True))[:4]):
                found[number][:] = values
            ends = np.cumsum([stop - start for _, _, _, _, start, stop, _ in parts])
            found.ends[:] = ends
            found.begins[0], found.begins[1:] = 0, ends[:-1]
            yield None, b"".join(data[start:stop] for _, _, _, _, start, stop, data in parts), found, False
            parts, size = [], 0
        if row is not None:
            parts.append(row)
            size += row[5] - row[4]


def _chosen(index: Index, path: str, from_ns: int, to_ns: int) -> tuple[list[ChunkEntry], bool]:
    """The chunks to be read, and whether some overlap.  Raises LimitExceeded."""
    chunks = [chunk for chunk in index.chunks if chunk.end_ns >= from_ns and chunk.start_ns < to_ns]
    check_work(index.size, work_of(chunks), path)
    return chunks, any(one.end_ns > two.start_ns for one, two in pairwise(chunks))


def _counter(index: Index, path: str) -> Callable[[int], None]:
    """What is called with the number of messages that are taken.  It raises LimitExceeded."""
    count, most = 0, message_bound(index.size)

    def check(messages: int) -> None:
        nonlocal count
        count += messages
        limits.check_limit("count", count, f"{path}: messages", most)

    return check


_Found = TypeVar("_Found")


def _in_turn(
    stream: IO[bytes],
    chunks: Sequence[ChunkEntry],
    path: str,
    is_wanted: Callable[[ChunkEntry], bool],
    work: Callable[[PackedChunk], _Found],
) -> Iterator[tuple[ChunkEntry, _Found | None]]:
    """One chunk after the other, with what a thread makes of it; None for those that are not wanted."""

    def first() -> tuple[ChunkEntry, _Found | None]:
        chunk, made = waiting.popleft()
        return chunk, None if made is None else made.result()

    waiting: deque[tuple[ChunkEntry, Future[_Found] | None]] = deque()
    thread = ThreadPoolExecutor(1, "igtl-unpack")
    try:
        for chunk in chunks:
            while waiting and (len(waiting) > _AHEAD or chunk.size > SMALL_BYTES):
                yield first()
            made = None
            if is_wanted(chunk):
                # read here: the position of the stream belongs to this thread
                made = thread.submit(work, packed_chunk(stream, chunk, path))
            waiting.append((chunk, made))
            if chunk.size > SMALL_BYTES:
                yield first()
        while waiting:
            yield first()
    finally:
        # the garbage collection may do this in any thread, under any lock of the interpreter: nothing is waited for
        thread.shutdown(wait=False, cancel_futures=True)


def _rows_in_turn(
    stream: IO[bytes], chunks: Sequence[ChunkEntry], path: str, is_wanted: Callable[[ChunkEntry], bool]
) -> Iterator[tuple[ChunkEntry, list[Row] | None]]:
    for chunk, data in _in_turn(stream, chunks, path, is_wanted, PackedChunk.unpack):
        if data is None:
            yield chunk, None
            continue
        for rows in batches(data):
            yield chunk, rows


def _merged(
    stream: IO[bytes], index: Index, chunks: Sequence[ChunkEntry], path: str
) -> Iterator[tuple[None, list[Row]]]:
    """Chunks that overlap: of equal times, the order in the file."""
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
            if _push(heads, chunk.at, (row for batch in batches(data) for row in batch), len(data)):
                held += len(data)
        if not heads:
            continue
        _, at, row, rest, size = heapq.heappop(heads)
        rows.append(row)
        ended = not _push(heads, at, rest, size)
        # a row keeps the bytes of its chunk
        if ended or len(rows) >= BATCH:
            held -= size if ended else 0
            del row, rest
            yield None, rows
            rows = []
    if rows:
        yield None, rows


def _push(heads: list[tuple[int, int, Row, Iterator[Row], int]], at: int, rows: Iterator[Row], size: int) -> bool:
    """Push the next message of a chunk; return whether there is one."""
    row = next(rows, None)
    if row is None:
        return False
    heapq.heappush(heads, (row[2], at, row, rows, size))
    return True

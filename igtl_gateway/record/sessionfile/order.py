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
from itertools import pairwise
from typing import IO

from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile.chunks import BATCH, SMALL_BYTES, Row, batches, packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, message_bound, work_of

#: Number of chunks that are read ahead; they come in pairs of input and output, so one of them is to be unpacked.
_AHEAD = 2


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
    chunks = [chunk for chunk in index.chunks if chunk.end_ns >= from_ns]
    check_work(index.size, work_of(chunks), path)
    count, most = 0, message_bound(index.size)
    found: Iterator[tuple[ChunkEntry | None, list[Row] | None]]
    if any(one.end_ns > two.start_ns for one, two in pairwise(chunks)):
        found = _merged(stream, index, chunks, path)
    else:
        found = _in_turn(stream, chunks, path, is_wanted)
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
    thread = ThreadPoolExecutor(1, "igtl-unpack")
    try:
        for chunk in chunks:
            while waiting and (len(waiting) > _AHEAD or chunk.size > SMALL_BYTES):
                yield from _taken(*waiting.popleft())
            unpacking = None
            if is_wanted(chunk):
                # read here: the position of the stream belongs to this thread
                unpacking = thread.submit(packed_chunk(stream, chunk, path).unpack)
            waiting.append((chunk, unpacking))
            if chunk.size > SMALL_BYTES:
                yield from _taken(*waiting.popleft())
        while waiting:
            yield from _taken(*waiting.popleft())
    finally:
        # the garbage collection may do this in any thread, under any lock of the interpreter: nothing is waited for
        thread.shutdown(wait=False, cancel_futures=True)


def _taken(chunk: ChunkEntry, unpacking: Future[bytes] | None) -> Iterator[tuple[ChunkEntry, list[Row] | None]]:
    if unpacking is None:
        yield chunk, None
        return
    for rows in batches(unpacking.result()):
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

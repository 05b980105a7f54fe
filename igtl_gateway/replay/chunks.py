"""The messages of an MCAP file, chunk by chunk, as the index tells: a row of numbers each, not an object.

Chunks that do not overlap in time, as ours never do, are read one after the other, and the messages in each are put in
order of time: the order that the library gives, without its queue of all messages.  Chunks that overlap are left to
the library.  Either way every chunk is checked against its checksum.

While the messages of one chunk are taken, the next is unpacked and checked in a thread beside, which needs the
interpreter for neither.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from operator import itemgetter
from typing import IO

from fastcrc.crc32 import iso_hdlc
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream

#: Channel, sequence, log_time, publish_time; first and last offset of the payload in the bytes that follow.
Row = tuple[int, int, int, int, int, int, bytes]

_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time
_BOTH_HEADS = struct.Struct("<BQHIQQ")
_MESSAGE = 5

#: So many chunks are read before they are needed, among them, in pairs of input and output, one to be unpacked.
_AHEAD = 2

_log_time = itemgetter(2)


def in_order(indexes: Sequence[ChunkIndex]) -> list[ChunkIndex] | None:
    """The chunks in the order of the file, if that is their order in time; None if they overlap."""
    chunks = sorted(indexes, key=lambda index: index.chunk_start_offset)
    if any(one.message_end_time > two.message_start_time for one, two in pairwise(chunks)):
        return None
    return chunks


def chunk_rows(
    stream: IO[bytes], chunks: Sequence[ChunkIndex], is_wanted: Callable[[ChunkIndex], bool]
) -> Iterator[tuple[ChunkIndex, list[Row] | None]]:
    """The messages of each of these chunks, in order of time; None: of one that is not wanted, and not read.

    Raises what the library does for damaged ones.
    """
    waiting: deque[tuple[ChunkIndex, Future[bytes] | None]] = deque()
    with ThreadPoolExecutor(1, "igtl-unpack") as beside:
        for index in chunks:
            unpacked = None
            if is_wanted(index):
                # read here: the position in the stream is not the thread's
                stream.seek(index.chunk_start_offset + _RECORD_HEAD.size)
                unpacked = beside.submit(_unpacked, Chunk.read(ReadDataStream(stream)))
            waiting.append((index, unpacked))
            while len(waiting) > _AHEAD:
                yield _taken(*waiting.popleft())
        while waiting:
            yield _taken(*waiting.popleft())


def _taken(index: ChunkIndex, unpacked: Future[bytes] | None) -> tuple[ChunkIndex, list[Row] | None]:
    return index, None if unpacked is None else _rows(unpacked.result())


def _unpacked(chunk: Chunk) -> bytes:
    stream, size = get_chunk_data_stream(chunk)
    data = stream.read(size)
    # as the library would, three times as fast
    if chunk.uncompressed_crc:
        found = iso_hdlc(data)
        if found != chunk.uncompressed_crc:
            raise CRCValidationError(expected=chunk.uncompressed_crc, actual=found, record=chunk)
    return data


def _rows(data: bytes) -> list[Row]:
    """The messages in the bytes of a chunk."""
    rows: list[Row] = []
    at, last_ns, sorted_by_time = 0, 0, True
    size, heads, unpack = len(data), _BOTH_HEADS.size, _BOTH_HEADS.unpack_from
    while at < size:
        if size - at < heads:
            opcode, length = _RECORD_HEAD.unpack_from(data, at)
            end = at + _RECORD_HEAD.size + length
            if opcode == _MESSAGE or end > size:
                raise EndOfFile
        else:
            opcode, length, channel, sequence, log_ns, publish_ns = unpack(data, at)
            end = at + _RECORD_HEAD.size + length
            if end > size:
                raise EndOfFile
            if opcode == _MESSAGE:
                if length < _MESSAGE_HEAD.size:
                    raise EndOfFile
                rows.append((channel, sequence, log_ns, publish_ns, at + heads, end, data))
                if log_ns < last_ns:
                    sorted_by_time = False
                last_ns = log_ns
        at = end
    if not sorted_by_time:
        rows.sort(key=_log_time)  # stable: of the same time, the one that stands first
    return rows

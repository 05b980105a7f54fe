"""What stands around chunks, and has no checksum: whether it is what the summary states.

That is the message indexes behind a chunk, and the schemas and channels before it.  No entry depends on them: a reader
that starts in the middle of a file notices a damaged index and reads from the start, and the summary has all schemas
and channels.  Other programs use them.
"""

from __future__ import annotations

from typing import IO

import numpy as np
import numpy.typing as npt

from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index
from igtl_gateway.record.sessionfile.records import (
    ATTACHMENT,
    DEFINITIONS,
    HEAD,
    HEADER,
    MAGIC,
    MESSAGE_INDEX,
    MESSAGE_INDEX_HEAD,
    MESSAGE_RECORD,
    METADATA,
    PRIVATE,
    Malformed,
)

#: Records that may stand between chunks.
_BESIDE = {HEADER, *DEFINITIONS, MESSAGE_INDEX, ATTACHMENT, METADATA}
#: Longer definitions are not compared: they are refused where they are read.
_COMPARED_BYTES = 16 << 20


def damaged_indexes(stream: IO[bytes], index: Index) -> int:
    """Return the number of chunks around which something is damaged.  Raises OSError."""
    if any(chunk.loose for chunk in index.chunks):  # messages stand between the chunks, too
        return sum(not _is_sound(stream, chunk) for chunk in index.chunks if not chunk.loose and chunk.places)
    ends = [len(MAGIC), *(chunk.at + chunk.length + chunk.index_length for chunk in index.chunks)]
    return sum(
        not (_is_declared(stream, index, at, chunk.at) and (not chunk.places or _is_sound(stream, chunk)))
        for at, chunk in zip(ends, index.chunks, strict=False)
    )


def _is_declared(stream: IO[bytes], index: Index, at: int, end: int) -> bool:
    """Whether there are records from one place to another, and among them no other schemas and channels than stated."""
    while at < end:
        if end - at < HEAD.size:
            return False
        stream.seek(at)
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        at += HEAD.size + length
        if at > end or not (opcode in _BESIDE or opcode >= PRIVATE):
            return False
        compared = opcode in DEFINITIONS and length <= _COMPARED_BYTES
        if compared and not _is_stated(index, opcode, stream.read(length)):
            return False
    return True


def _is_stated(index: Index, opcode: int, content: bytes) -> bool:
    found = Index(0)
    try:
        found.define(opcode, content)
    except Malformed:
        return False
    return found.schemas.items() <= index.schemas.items() and found.channels.items() <= index.channels.items()


def _is_sound(stream: IO[bytes], chunk: ChunkEntry) -> bool:
    start = chunk.at + chunk.length
    stream.seek(start)
    data = stream.read(chunk.index_length)
    if len(data) < chunk.index_length:
        return False
    found_offsets = []
    for channel, place in chunk.message_indexes.items():
        at = place - start
        if not 0 <= at <= len(data) - HEAD.size - MESSAGE_INDEX_HEAD.size:
            return False
        opcode, length = HEAD.unpack_from(data, at)
        found, size = MESSAGE_INDEX_HEAD.unpack_from(data, at + HEAD.size)
        at += HEAD.size + MESSAGE_INDEX_HEAD.size
        fits = length == MESSAGE_INDEX_HEAD.size + size and size % 16 == 0 and at + size <= len(data)
        if opcode != MESSAGE_INDEX or found != channel or not fits:
            return False
        pairs = np.frombuffer(data, "<u8", size // 8, at)
        times = pairs[::2]
        if len(times) and not chunk.start_ns <= int(times.min()) <= int(times.max()) <= chunk.end_ns:
            return False
        found_offsets.append(pairs[1::2])
    return not found_offsets or _is_possible(np.concatenate(found_offsets), chunk.size)


def _is_possible(offsets: npt.NDArray[np.uint64], size: int) -> bool:
    """Whether messages can be at all these offsets of a chunk: none overlap, and the last one is in it."""
    # one after the other in nearly all files; times out of order in those of other programs
    order = np.sort(offsets)
    if len(order) and int(order[-1]) > size - MESSAGE_RECORD.size:
        return False
    return bool((np.diff(order) >= MESSAGE_RECORD.size).all())

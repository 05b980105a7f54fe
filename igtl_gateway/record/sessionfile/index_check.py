"""The message indexes of chunks, which have no checksum: whether they are what the summary states.

No entry depends on them: a reader that starts in the middle of a file notices a damaged one and reads from the start.
"""

from __future__ import annotations

from typing import IO

import numpy as np
import numpy.typing as npt

from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE_INDEX, MESSAGE_INDEX_HEAD, MESSAGE_RECORD


def damaged_indexes(stream: IO[bytes], index: Index) -> int:
    """Return the number of chunks whose message indexes are damaged.  Raises OSError."""
    return sum(not _is_sound(stream, chunk) for chunk in index.chunks if not chunk.loose and chunk.places)


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

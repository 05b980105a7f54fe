"""The messages of a chunk in batches: the index of them, and small entries that are added without an object each.

``_chunk.c`` has the compiled functions.  ``index_messages`` also exists here, with an equal result; without
``add_rows`` and ``add_columns`` every entry goes through ``SessionWriter.write``, which writes the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, pack_message_index

#: How the entries of a stream become messages: channel; direction (0 from, 1 to a peer, -1 where the payload is the
#: message); and what the heads of all have in common, from the links to the device name.
RowStream = tuple[int, int, bytes]

#: First and last time in nanoseconds; the message index records, one per channel in the order of its first message;
#: for each of them channel, offset, and number of messages.
ChunkIndex = tuple[int, int, bytes, tuple[tuple[int, int, int], ...]]


def index_messages(chunk: bytearray | bytes) -> ChunkIndex:
    """The index of the records of a chunk; of the last one, the end may be missing."""
    found: dict[int, list[int]] = {}
    at, size = 0, len(chunk)
    while at < size:
        opcode, length = HEAD.unpack_from(chunk, at)
        if opcode == MESSAGE:
            channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(chunk, at + HEAD.size)
            if channel in found:
                found[channel] += (log_time, at)
            else:
                found[channel] = [log_time, at]
        at += HEAD.size + length
    if not found:
        return 0, 0, b"", ()
    index, rows = bytearray(), []
    for channel, pairs in found.items():
        rows.append((channel, len(index), len(pairs) // 2))
        index += pack_message_index(channel, pairs)
    first = min(min(pairs[::2]) for pairs in found.values())
    last = max(max(pairs[::2]) for pairs in found.values())
    return first, last, bytes(index), tuple(rows)


#: Adds rows (records of the recorder's queue, see ``native/kernel/_queue.h``) to a chunk.
#:
#: Arguments: the chunk; the room of the queue; begin of the rows in it, and the last place at which they can end;
#: for each number of a stream a RowStream or None; the size above which the chunk takes no more.  Result: the end of
#: the last row that it took, the number of these rows, the bytes of their payloads, and the first and the last stamp.
#: It stops before a row that it cannot add, and before a mark.
AddRows = Callable[[bytearray, memoryview, int, int, list[RowStream | None], int], tuple[int, int, int, int, int]]

add_rows: AddRows | None = None


class MessageRows(NamedTuple):
    """Messages to be added to chunks; each array has one element per message.

    Attributes:
        data: pieces of bytes that have the payloads.
        which: uint16, the piece of each.
        idents: int32, indices into a list of RowStream or None.
        numbers: int64; the file has their lower 32 bits.
        times, publish_times: of the MCAP message, ns; 64 bits.
        sources: source stamp in a RawMessage, ns; 64 bits; 0 = unset.
        begins, ends: int64, places of the payloads.
    """

    data: tuple[bytes, ...]
    which: Any
    idents: Any
    numbers: Any
    times: Any
    publish_times: Any
    sources: Any
    begins: Any
    ends: Any


#: Adds messages to a chunk.
#:
#: Arguments: the chunk; the items of a MessageRows; the row of the first message; for each ident a RowStream or None;
#: the size above which the chunk takes no more; the size from which on a message is left.  Result: the row behind the
#: last one that it took.
add_columns: Callable[..., int] | None = None

if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._chunk import add_columns, add_rows, index_messages  # noqa: F401
    except ImportError:  # pragma: no cover - installed without the C part
        pass

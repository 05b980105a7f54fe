"""The messages in the bytes of a chunk as columns: an array for each field, not an object for each message.

``_columns.c`` has the compiled functions; they also exist here, with an equal result.  What they read is untrusted.

Other readers were weighed for this: small-mcap and pybag make an object of each message, as the ``mcap`` library does;
the crates mcap and re_mcap are Rust, and no wheel gives their records as columns.  All of them trust what this
folder checks (sizes, counts, limits), and none reads the head of a RawMessage.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.quantities import counted
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, MESSAGE_RECORD, U32

Array = npt.NDArray[Any]
#: Channel, sequence, log_time, publish_time; first and last offset of the payload in the bytes that follow.
Row = tuple[int, int, int, int, int, int, bytes]

#: Flags of :func:`unwrap`.
OUTGOING, STAMPED = 1, 2

_CDR_LE = b"\0\1"
# Of a RawMessage: encapsulation, stamp, source_stamp, source_ticks, direction; see messages.py.
_RAW_HEAD, _RAW_SOURCE_AT, _RAW_DIRECTION_AT = 32, 12, 28
_MOST_HEADS = 64


class Columns(NamedTuple):
    """Messages in the order of the file or of time; one element per message.

    Attributes:
        channels: uint16.
        sequences: uint32.
        times, publish_times: log_time and publish_time in ns; uint64.
        begins, ends: places of the payloads; int64.
    """

    channels: Array
    sequences: Array
    times: Array
    publish_times: Array
    begins: Array
    ends: Array

    @classmethod
    def empty(cls, count: int) -> Columns:
        """Columns to be filled."""
        dtypes = (np.uint16, np.uint32, np.uint64, np.uint64, np.int64, np.int64)
        return cls(*(np.empty(count, dtype) for dtype in dtypes))

    def where(self, rows: Array | slice) -> Columns:
        """The messages of a mask, of indices or of a slice."""
        return Columns(*(column[rows] for column in self))


def channels_of(columns: Columns) -> list[int]:
    """The channels that messages have, rising."""
    found: list[int] = np.flatnonzero(np.bincount(columns.channels)).tolist()
    return found


def count_of(data: bytes) -> tuple[int, bool, int, int]:
    """Count the messages in the records of a chunk.

    Returns their number; whether no time is less than the one before; the end of the last record that fits, which is
    the size unless one does not fit; and the bits that any of the times has.
    """
    count, last, in_order, late, end = 0, 0, True, 0, 0
    for at, end, time_ns, publish_ns in _messages(data):  # noqa: B007
        if at < 0:
            continue
        in_order = in_order and time_ns >= last
        last = time_ns
        late |= time_ns | publish_ns
        count += 1
    return count, in_order, end, late


def take(
    data: bytes, at: int, channels: Any, sequences: Any, times: Any, publish_times: Any, begins: Any, ends: Any
) -> int:
    """Fill columns with the messages from the record at ``at`` on; return the place behind the last one.

    Raises ValueError if there are fewer messages than elements.
    """
    row, most = 0, len(channels)
    while row < most:
        if at >= len(data) or not (end := _record_end(data, at)):
            raise ValueError(f"take: found {counted(row, 'message')}, expected {most}")
        if data[at] == MESSAGE:
            _, _, channels[row], sequences[row], times[row], publish_times[row] = MESSAGE_RECORD.unpack_from(data, at)
            begins[row], ends[row] = at + MESSAGE_RECORD.size, end
            row += 1
        at = end
    return at


def rows_of(data: bytes) -> tuple[list[Row], bool, int]:
    """The messages in the order of the file; whether no time is less than the one before; the end as of `count_of`."""
    rows: list[Row] = []
    end, last, in_order = 0, 0, True
    for at, end, time_ns, _ in _messages(data):
        if at >= 0:
            _, _, *numbers = MESSAGE_RECORD.unpack_from(data, at)
            rows.append((*numbers, at + MESSAGE_RECORD.size, end, data))
            in_order = in_order and time_ns >= last
            last = time_ns
    return rows, in_order, end


def unwrap(
    data: bytes, channels: Any, begins: Any, ends: Any, heads: Any, flags: Any,
    row: int, known: bytes, offsets: Any, following: Any, last: Any,
) -> int:  # fmt: skip
    """Find the payloads of RawMessages whose heads are known: the bytes from the links to the device name.

    Args:
        data: the records of a chunk.
        channels, begins, ends: uint16, int64, int64: columns of the messages.  ``begins`` becomes the places of the
            payloads.
        heads, flags: int32, uint8: are filled with the number of the head, and OUTGOING and STAMPED (the message states
            a source stamp).
        row: of the first message.
        known, offsets: the heads one after the other; int64 (n + 1) where each begins.
        following: int32 (n): heads of one channel are a ring.
        last: int32 (65536): of each channel the head that its last message had; -1: none.  It is kept up to date.

    Returns the row of the first message of another head, or whose bytes are not as its fields state; else their number.
    """
    for number in range(row, len(channels)):
        begin, end, channel = int(begins[number]), int(ends[number]), int(channels[number])
        first = at = int(last[channel])
        for _ in range(_MOST_HEADS if at >= 0 else 0):
            head = known[offsets[at] : offsets[at + 1]]
            place = begin + _RAW_HEAD + len(head) + U32.size
            if (
                place <= end
                and data.startswith(_CDR_LE, begin)
                and data.startswith(head, begin + _RAW_HEAD)
                and U32.unpack_from(data, place - U32.size)[0] == end - place
            ):
                break
            at = int(following[at])
            if at == first:
                return number
        else:
            return number
        last[channel] = heads[number] = at
        begins[number] = place
        stamped = any(data[begin + _RAW_SOURCE_AT : begin + _RAW_SOURCE_AT + 8])
        flags[number] = (OUTGOING if data[begin + _RAW_DIRECTION_AT] else 0) | (STAMPED if stamped else 0)
    return len(channels)


def equal_ranges(
    buffers: Sequence[bytes], which: Any, begins: Any, ends: Any,
    others: Sequence[bytes], other_which: Any, other_begins: Any, other_ends: Any,
    equal: Any,
) -> None:  # fmt: skip
    """Fill ``equal`` (bool, n): whether two ranges have the same bytes.

    Args:
        buffers: those that ``which`` (int32, n) numbers; ``begins`` and ``ends`` (int64, n) are places in them.
        others: likewise of the other ranges.

    Raises ValueError for a range outside of its buffer.
    """
    for row in range(len(equal)):
        one = _range(buffers, which[row], begins[row], ends[row])
        equal[row] = one == _range(others, other_which[row], other_begins[row], other_ends[row])


def _range(buffers: Sequence[bytes], which: int, begin: int, end: int) -> memoryview:
    if not (0 <= which < len(buffers) and 0 <= begin <= end <= len(buffers[which])):
        raise ValueError("equal_ranges: found a range outside of its buffer")
    return memoryview(buffers[which])[begin:end]


def interleaved(data: bytes, heads: bytes, begins: Any, ends: Any) -> bytes:
    """Heads, each before the payload of its message.

    Args:
        data: the records of a chunk.
        heads: one after the other, of equal size.
        begins, ends: int64, places of the payloads.

    Raises ValueError for places outside of the data, and heads of other sizes.
    """
    count = len(begins)
    size = len(heads) // count if count else 0
    if size * count != len(heads) or ((begins < 0) | (begins > ends) | (ends > len(data))).any():
        raise ValueError("interleaved: found a message outside of the data, or heads of other sizes")
    places = enumerate(zip(begins.tolist(), ends.tolist(), strict=True))
    return b"".join(heads[at * size : at * size + size] + data[begin:end] for at, (begin, end) in places)


def _messages(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Place, end, log_time and publish_time of each message; of other records, the end behind -1."""
    at = 0
    while at < len(data) and (end := _record_end(data, at)):
        if data[at] == MESSAGE:
            yield (at, end, *MESSAGE_HEAD.unpack_from(data, at + HEAD.size)[2:])
        else:
            yield -1, end, 0, 0
        at = end


def _record_end(data: bytes, at: int) -> int:
    """Where a record ends; 0 if it does not fit."""
    room = len(data) - at - HEAD.size
    if room < 0:
        return 0
    opcode, length = HEAD.unpack_from(data, at)
    least = MESSAGE_HEAD.size if opcode == MESSAGE else 0
    return at + HEAD.size + int(length) if least <= length <= room else 0


if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._columns import (  # noqa: F401
            count_of,
            equal_ranges,
            interleaved,
            rows_of,
            take,
            unwrap,
        )
    except ImportError:  # pragma: no cover - installed without the C part
        pass

"""Bytes as they travel: one message is a sequence of buffers, sent one after the other (scatter-gather)."""

from __future__ import annotations

from collections.abc import Sequence

#: Anything with the buffer protocol; numpy views are passed as memoryviews of bytes.
Buffer = bytes | bytearray | memoryview


def join(buffers: Sequence[Buffer]) -> bytes:
    """One ``bytes`` object of several buffers; no copy where there is one ``bytes`` already."""
    if len(buffers) == 1 and isinstance(buffers[0], bytes):
        return buffers[0]
    return b"".join(buffers)


def total_size(buffers: Sequence[Buffer]) -> int:
    """Bytes in all buffers together."""
    if len(buffers) == 1 and type(buffers[0]) is bytes:  # as most messages are
        return len(buffers[0])
    return sum([memoryview(part).nbytes for part in buffers])

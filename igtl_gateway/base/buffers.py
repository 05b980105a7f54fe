"""Buffers of bytes: one message is a sequence of buffers, which are sent together (scatter-gather)."""

from __future__ import annotations

from collections.abc import Sequence

#: Anything with the buffer protocol; numpy views are passed as memoryviews of bytes.
Buffer = bytes | bytearray | memoryview


def join(buffers: Sequence[Buffer]) -> bytes:
    """Return the buffers as one ``bytes`` object; a single ``bytes`` object is not copied."""
    if len(buffers) == 1 and isinstance(buffers[0], bytes):
        return buffers[0]
    return b"".join(buffers)


def total_size(buffers: Sequence[Buffer]) -> int:
    """Return the total size of the buffers in bytes."""
    if len(buffers) == 1 and type(buffers[0]) is bytes:  # most messages
        return len(buffers[0])
    return sum([memoryview(part).nbytes for part in buffers])

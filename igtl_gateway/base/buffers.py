"""Buffers of bytes: one message is a sequence of buffers, which are sent together (scatter-gather)."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

#: Anything with the buffer protocol; numpy views are passed as memoryviews of bytes.
Buffer = bytes | bytearray | memoryview

#: From this size on bytes are joined in steps of this size.
MANY_BYTES, _STEP = 4 << 20, 512 << 10
#: Small buffers, which are joined many at once.
_SMALL, _MANY_SMALL = 1 << 10, 1 << 10


def join(buffers: Sequence[Buffer]) -> bytes:
    """Return the buffers as one ``bytes`` object; a single ``bytes`` object is not copied."""
    if len(buffers) == 1 and isinstance(buffers[0], bytes):
        return buffers[0]
    return join_in_steps(buffers) if total_size(buffers) >= MANY_BYTES else b"".join(buffers)


def join_in_steps(buffers: Sequence[Buffer]) -> bytes:
    """Return many bytes as one object, as ``join``; other threads get their turn meanwhile.

    One call that copies a hundred megabytes holds the interpreter for a twentieth of a second.
    """
    joined = BytesIO()
    small: list[Buffer] = []
    for buffer in buffers:
        if type(buffer) is bytes and len(buffer) <= _SMALL:
            small.append(buffer)
            if len(small) < _MANY_SMALL:
                continue
        if small:
            joined.write(b"".join(small))
            small.clear()
        if type(buffer) is not bytes or len(buffer) > _SMALL:
            view = memoryview(buffer)
            view = view.cast("B") if view.nbytes else memoryview(b"")
            for begin in range(0, view.nbytes, _STEP):
                joined.write(view[begin : begin + _STEP])
    joined.write(b"".join(small))
    return joined.getvalue()  # its own object, not a copy


def total_size(buffers: Sequence[Buffer]) -> int:
    """Return the total size of the buffers in bytes."""
    if len(buffers) == 1 and type(buffers[0]) is bytes:  # most messages
        return len(buffers[0])
    return sum([memoryview(part).nbytes for part in buffers])

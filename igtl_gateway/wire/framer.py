"""Cut a byte stream into whole OpenIGTLink messages.  No sockets, no decoding.

Strategy: bytes are received straight into storage that the framer offers (``buffer``), so nothing is copied
that need not be.  Small messages arrive many at a time in one 64 KiB chunk and are cut out of it as ``bytes``.
A message that does not fit the chunk gets storage of its own, as soon as its header is there, and the rest of
it is received in place.  Storage above 16 MiB grows with the bytes that really arrive.

The framer reads only the body size of the header, and the type if the size exceeds the least limit.  Version, type and
CRC-64 are checked where the message is decoded, so that a corrupt message can be recorded as received.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from igtl_gateway.base.errors import MessageTooLarge
from igtl_gateway.base.globs import matches
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.header import BODY_SIZE_AT, DEFAULT_MAX_BODY, HEADER_SIZE, TYPE, U64

# Several hundred transforms at one system call, and copying it once (a few µs) is cheaper than a system call.
_CHUNK = 64 * 2**10

# What a peer can make us reserve by a header alone.  Images (6 MB in full HD) stay below and never move.
_EAGER = 16 * 2**20


class Framer:
    """Whole messages out of a byte stream, in pieces of any size.

    Call ``buffer``, let the socket write there, call ``received`` with the number of bytes.  Messages are
    ``bytes`` (small) or a read-only ``memoryview`` with storage of its own; neither is ever written to again.

    A header that announces a body above ``max_body`` bytes raises MessageTooLarge before anything is reserved;
    ``rows`` of types (globs) and bytes set other limits for these types; the first match counts.
    Messages that came whole before that header are returned first: then it is the next call, of any of
    ``buffer``, ``received`` and ``feed``, that raises.  From there on the place of the next header is unknown,
    so every further call raises again.
    """

    def __init__(self, max_body: int = DEFAULT_MAX_BODY, rows: Sequence[tuple[str, int]] = ()) -> None:
        self._max_body = max_body
        self._rows = tuple(rows)
        self._least = min([max_body, *(size for _, size in rows)])  # no body up to here needs a look at its type
        self._chunk = memoryview(bytearray(_CHUNK))
        # the unfinished message begins at 0 of the storage: the chunk, or storage of its own
        self._storage = self._chunk
        self._filled = 0
        self._need = HEADER_SIZE  # nothing can be decided below this many bytes
        self._total = 0  # size of the message that has storage of its own
        self._too_large: tuple[str, str, str] | None = None  # what ended it all: place, found and expected

    @property
    def pending(self) -> int:
        """Bytes of the unfinished message; 0 means between two messages."""
        return self._filled

    def pending_head(self) -> bytes:
        """The first 58 bytes of the unfinished message, or as many as there are."""
        return bytes(self._storage[: min(self._filled, HEADER_SIZE)])

    def buffer(self) -> memoryview:
        """Where the next bytes belong: writable and never empty.  Raises MessageTooLarge."""
        self._check()
        return self._storage[self._filled :]

    def received(self, count: int) -> list[bytes | memoryview]:
        """The messages that are whole now that ``count`` bytes were written into ``buffer()``.

        Raises MessageTooLarge; ValueError for a count that the buffer cannot hold.
        """
        self._check()
        if not 0 <= count <= len(self._storage) - self._filled:
            raise ValueError(f"{counted(count, 'byte')} received, the buffer holds {len(self._storage) - self._filled}")
        self._filled += count
        if self._filled < self._need:
            return []
        if self._storage is self._chunk:
            return self._cut()
        if len(self._storage) < self._total:
            self._reserve(self._storage)
            return []
        message = self._storage.toreadonly()
        self._storage, self._filled, self._need = self._chunk, 0, HEADER_SIZE
        return [message]

    def feed(self, data: bytes | bytearray | memoryview) -> list[bytes | memoryview]:
        """The messages that are whole once ``data`` is added (copied).  Raises MessageTooLarge."""
        messages: list[bytes | memoryview] = []
        rest = memoryview(data).cast("B")
        while rest and not (messages and self._too_large is not None):
            room = self.buffer()
            count = min(len(room), len(rest))
            room[:count] = rest[:count]
            messages += self.received(count)
            rest = rest[count:]
        return messages

    def _check(self) -> None:
        if self._too_large is not None:
            raise MessageTooLarge(*self._too_large)

    def _cut(self) -> list[bytes | memoryview]:
        """Take the whole messages out of the chunk and leave the unfinished one at its start."""
        chunk, filled = self._chunk, self._filled
        messages: list[bytes | memoryview] = []
        whole = b""
        start, total = 0, HEADER_SIZE
        while filled - start >= HEADER_SIZE:
            (body,) = U64.unpack_from(chunk, start + BODY_SIZE_AT)
            if body > self._least and self._exceeds(body, bytes(chunk[start : start + HEADER_SIZE])):
                break
            total = HEADER_SIZE + body
            if filled - start < total:
                break
            # one copy of the chunk and slices of it: half the time of a memoryview for each message
            whole = whole or bytes(chunk[:filled])
            messages.append(whole[start : start + total])
            start += total
            total = HEADER_SIZE
        self._filled = filled - start
        self._need = total
        if total > _CHUNK:
            self._total = total
            self._reserve(chunk[start:filled])
        elif start:
            chunk[: filled - start] = chunk[start:filled]
        if not messages:
            self._check()
        return messages

    def _exceeds(self, body: int, header: bytes) -> bool:
        """Whether a body is too long for its type: then there is nothing to be read any more."""
        name = header[TYPE].partition(b"\0")[0].decode("utf-8", "replace")
        limit = next((size for glob, size in self._rows if matches(glob, name)), self._max_body)
        if body > limit:
            self._too_large = (
                f"header of {name!r}, body size",
                counted(body, "byte"),
                f"at most {counted(limit, 'byte')}",
            )
        return body > limit

    def _reserve(self, have: memoryview) -> None:
        """Larger storage for the unfinished message, of which ``have`` is there."""
        size = min(self._total, max(_EAGER, 2 * len(have)))
        # np.empty: no time lost on zeros that the socket overwrites
        self._storage = np.empty(size, np.uint8).data
        self._storage[: len(have)] = have
        self._need = size

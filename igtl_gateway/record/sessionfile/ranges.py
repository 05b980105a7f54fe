"""Files read by ranges: only the bytes that are needed are requested."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import GatewayError

#: Blocks that are kept.
_KEPT = 64


class RangeFile(io.RawIOBase, ABC):
    """A large read is one request, small ones share blocks that are kept; put a buffer of ``block`` before it.

    Args:
        size: bytes of the file.
        block: bytes of one request for small reads.

    Attributes:
        requests: number of requests so far.
        bytes_read: number of bytes received so far.
    """

    def __init__(self, size: int, block: int) -> None:
        self.block = block
        self._size = size
        self._at = self.requests = self.bytes_read = 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()

    @abstractmethod
    def fetch(self, start: int, count: int) -> bytes:
        """Return these bytes of the file, all of them.  Raises GatewayError."""

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        """Fill a buffer, or its beginning.  Raises GatewayError."""
        count = min(len(buffer), self._size - self._at)
        if count <= 0:
            return 0
        if count >= self.block:
            data = self._counted(self._at, count)
        else:
            number, inside = divmod(self._at, self.block)
            data = self._block(number)[inside : inside + count]  # the rest at the next call
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def _block(self, number: int) -> bytes:
        data = self._blocks.pop(number, None)
        if data is None:
            start = number * self.block
            data = self._counted(start, min(self.block, self._size - start))
            while len(self._blocks) >= _KEPT:
                self._blocks.popitem(last=False)
        self._blocks[number] = data
        return data

    def _counted(self, start: int, count: int) -> bytes:
        data = self.fetch(start, count)
        self.requests += 1
        self.bytes_read += len(data)
        return data


@contextmanager
def named(path: Path, url: str) -> Iterator[None]:
    """Name a URL in the errors about a path that stands for it."""
    try:
        yield
    except GatewayError as error:
        raise type(error)(str(error).replace(str(path), url)) from None

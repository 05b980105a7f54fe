"""A file of a web server, read by ranges: only the bytes that are needed are requested."""

from __future__ import annotations

import io
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.untrusted.numbers import whole_number

#: Seconds without an answer after which a request fails.
_TIMEOUT_S = 30
_SCHEMES = ("http", "https")


def is_url(path: str) -> bool:
    """Return whether a path is a URL of a web server."""
    return path.partition("://")[0].lower() in _SCHEMES and "://" in path


class RemoteFile(io.RawIOBase):
    """A file behind a URL; a context manager.  Put a buffer of :data:`BLOCK` bytes before it.

    Args:
        url: ``http://`` or ``https://``; the server must answer requests for ranges.

    Attributes:
        requests: number of requests so far.
        bytes_read: number of bytes received so far.

    Raises UnsupportedRecording if the server does not have the file or does not send ranges.
    """

    #: Bytes of one request for small reads.
    BLOCK = 256 << 10

    def __init__(self, url: str) -> None:
        self._url = url
        self._at = 0
        self.requests = self.bytes_read = 0
        _, size = self._range(0, 1)
        self._size = size

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
        """Fill a buffer.  Raises DamagedRecording where the server does not send the bytes."""
        count = min(len(buffer), self._size - self._at)
        if count <= 0:
            return 0
        try:
            data, size = self._range(self._at, count)
        except UnsupportedRecording as error:
            raise DamagedRecording(str(error)) from None
        if len(data) != count or size != self._size:
            raise DamagedRecording(
                f"{self._url}: found {len(data)} bytes of {size} at {self._at}, expected {count} of {self._size}"
            )
        buffer[:count] = data
        self._at += count
        return count

    def _range(self, start: int, count: int) -> tuple[bytes, int]:
        """Bytes of a range, and the size of the file."""
        request = urllib.request.Request(self._url, headers={"Range": f"bytes={start}-{start + count - 1}"})
        try:
            with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
                found = answer.headers.get("Content-Range", "")
                total = whole_number(found.rpartition("/")[2])
                if answer.status != 206 or total is None:
                    raise UnsupportedRecording(
                        f"{self._url}: found an answer without ranges (status {answer.status}), expected a server that "
                        "sends ranges of a file; download the file and open it"
                    )
                data = answer.read(count)
        except urllib.error.HTTPError as error:
            if error.code == 416:  # a file of no bytes has no range
                return b"", 0
            raise UnsupportedRecording(f"{self._url}: {error.code} {error.reason}") from None
        except (urllib.error.URLError, OSError, ValueError) as error:
            raise UnsupportedRecording(f"{self._url}: {getattr(error, 'reason', error)}") from None
        self.requests += 1
        self.bytes_read += len(data)
        return bytes(data), total

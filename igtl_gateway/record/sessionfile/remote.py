"""A file of a web server, read by ranges."""

from __future__ import annotations

import urllib.error
import urllib.parse
import urllib.request

from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.record.sessionfile.ranges import RangeFile

#: Seconds without an answer after which a request fails.
_TIMEOUT_S = 30
#: Bytes of one request for small reads.
_BLOCK = 256 << 10
_SCHEMES = ("http", "https")


def is_url(path: str) -> bool:
    """Return whether a path is a URL of a web server."""
    return path.partition("://")[0].lower() in _SCHEMES and "://" in path


class RemoteFile(RangeFile):
    """A file behind a URL; a context manager.

    Args:
        url: ``http://`` or ``https://``; the server must answer requests for ranges.

    Raises UnsupportedRecording if the server does not have the file or does not send ranges.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        _, size = self._range(0, 1)
        super().__init__(size, _BLOCK)

    def fetch(self, start: int, count: int) -> bytes:
        """Raises DamagedRecording where the server does not send the bytes."""
        try:
            data, size = self._range(start, count)
        except UnsupportedRecording as error:
            raise DamagedRecording(str(error)) from None
        if len(data) != count or size != self._size:
            raise DamagedRecording(
                f"{self._url}: found {counted(len(data), 'byte')} of {size} at {start}, expected {count} of "
                f"{self._size}"
            )
        return data

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
        return bytes(data), total

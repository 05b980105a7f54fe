"""Files of tests."""

from __future__ import annotations

import errno
import os
from io import BufferedReader, BytesIO, FileIO
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.untrusted import files

#: What the example programs of the C++ library sent to each other, see ``data/README.md``.
CAPTURES = Path(__file__).parent / "data" / "captures"


def write_anew(path: Path, data: Buffer) -> None:
    """Write a file that may be there: for loops that damage a file in a thousand ways.

    As a new file: one that is cut to nothing and written again is flushed to the disk when it is closed (ext4 does so
    in case that the power fails in between), which takes 4 ms each time.
    """
    path.unlink(missing_ok=True)
    path.write_bytes(data)


class BytesRead:
    """Counts the bytes that are read from recordings, by replacing the function that opens them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        monkeypatch.setattr(files, "open_file", self._open)

    def _open(self, path: Path) -> BufferedReader:
        return BufferedReader(_Counted(path, self))


class _Counted(FileIO):
    def __init__(self, path: Path, total: BytesRead) -> None:
        super().__init__(path)
        self._total = total

    def readinto(self, buffer: Any) -> int | None:
        size = super().readinto(buffer)
        self._total.count += size or 0
        return size


class RefusingStream(BytesIO):
    """A file on a disk that refuses to read beyond an offset (EIO)."""

    def __init__(self, data: bytes, refuses_from: int) -> None:
        super().__init__(data)
        self.refuses_from = refuses_from

    def read(self, size: int | None = -1, /) -> bytes:
        end = len(self.getbuffer()) if size is None or size < 0 else self.tell() + size
        if end > self.refuses_from:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(size)

"""Files of tests."""

from __future__ import annotations

from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.buffers import Buffer
from igtl_gateway.untrusted import files


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

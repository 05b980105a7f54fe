"""The log of the retention: one JSON object a line, only ever extended, in the folder of the recordings."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from igtl_gateway.base.stamp import utc_text
from igtl_gateway.base.systems.files import open_plain
from igtl_gateway.base.untrusted import limits

LOG_NAME = "igtl-gateway-retention.jsonl"


class RetentionLog:
    """The log of a folder, readable by its owner only.

    The time of the last pass is that of the last change of the file.

    Args:
        folder: the folder.

    Attributes:
        path: the file.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOG_NAME

    def add(self, now_ns: int, event: str, **facts: Any) -> None:
        """Append a line.  Raises OSError."""
        line = json.dumps({"time": utc_text(now_ns), "event": event} | facts, default=str) + "\n"
        file = self._open(os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        try:
            data = line.encode("ascii")
            if os.write(file, data) != len(data):
                raise OSError(0, "the disk is full", str(self.path))
        finally:
            os.close(file)

    def has_deleted(self, name: str) -> bool:
        """Return whether a recording of this name was deleted, or is about to be.

        The log is read from its end, as far back as the limit ``free`` allows.
        """
        most = limits.current_limits().free
        try:
            with os.fdopen(self._open(os.O_RDONLY), "rb") as file:
                file.seek(max(file.seek(0, os.SEEK_END) - most, 0))
                lines = file.read(most).split(b"\n")
        except OSError:
            return False
        named = f'"file": {json.dumps(name)}'.encode("ascii")
        return any(b'"event": "delete"' in line and named in line for line in lines)

    def check(self) -> None:
        """Raise OSError if no line can be added."""
        os.close(self._open(os.O_WRONLY | os.O_APPEND | os.O_CREAT))

    def mark(self, now_ns: int) -> None:
        """Keep the time of a pass.  Raises OSError."""
        file = self._open(os.O_WRONLY)
        try:
            os.utime(file, ns=(now_ns, now_ns))
        finally:
            os.close(file)

    def last_pass_ns(self) -> int:
        """Return the time of the last pass, UTC ns; 0: there was none."""
        try:
            return os.stat(self.path, follow_symlinks=False).st_mtime_ns
        except OSError:
            return 0

    def _open(self, flags: int) -> int:
        return open_plain(self.path, flags)

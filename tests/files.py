"""Files of tests."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.buffers import Buffer


def write_anew(path: Path, data: Buffer) -> None:
    """Write a file that may be there: for loops that damage a file in a thousand ways.

    As a new file: one that is cut to nothing and written again is flushed to the disk when it is closed (ext4 does so
    in case that the power fails in between), which takes 4 ms each time.
    """
    path.unlink(missing_ok=True)
    path.write_bytes(data)

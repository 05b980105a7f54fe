"""The one place where files of others are opened: ordinary files only, and what a header names only beside it."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import BinaryIO

from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.untrusted import limits

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def size_of(path: Path) -> int:
    """Bytes of an ordinary file.  Raises UnsupportedRecording for what is missing or no ordinary file."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UnsupportedRecording(f"{path}: {reason}") from None
    for is_kind, name in _KINDS:
        if is_kind(found.st_mode):
            raise UnsupportedRecording(f"{path}: found {name}, expected a file")
    return found.st_size


def open_file(path: Path) -> BinaryIO:
    """An ordinary file, open for reading.  Raises UnsupportedRecording; never waits for a FIFO or a device."""
    size_of(path)
    try:
        return path.open("rb")
    except OSError as error:
        raise UnsupportedRecording(f"{path}: {error.strerror or error}") from None


def read_bytes(path: Path) -> bytes:
    """All of a small file.  Raises UnsupportedRecording, or LimitExceeded above the limit ``free``."""
    with open_file(path) as stream:
        data = stream.read(limits.current().free + 1)
    limits.check("free", len(data), str(path))
    return data


def beside(path: Path, name: str) -> Path:
    """The file ``name`` that the file ``path`` refers to: a plain name in the same folder, no link out of it.

    Raises DamagedRecording, or UnsupportedRecording where there is no such ordinary file.
    """
    folder = path.parent
    if not name or name in {".", ".."} or Path(name).name != name or "\\" in name or "\0" in name:
        raise DamagedRecording(f"{path}: found a reference to the file {name!r}, expected a name in the same folder")
    target = folder / name
    if target.is_symlink() and target.resolve().parent != folder.resolve():
        raise DamagedRecording(f"{path}: found a reference to {name!r}, a link out of the folder")
    size_of(target)
    return target

"""Creating a file: what stands in the way, its mode, the lock of its writer, and the errors.

Recordings are data of patients: new files are for their owner only, unless :func:`files_with_mode` states another mode.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import Literal, TextIO

from igtl_gateway.base.errors import DiskRefused, RecordingError
from igtl_gateway.base.systems.files import lock, set_mode
from igtl_gateway.base.untrusted.files import obstacle

#: Errors of the system about a path that cannot have been intended; all others are the disk's.
_WRONG_PATH = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL})


#: Mode of a new file without another one.
PRIVATE = 0o600
_MODE: ContextVar[int] = ContextVar("mode of new files", default=PRIVATE)


@contextmanager
def files_with_mode(mode: int, *, umask: bool) -> Iterator[None]:
    """Context manager: new files have this mode.

    Args:
        mode: of files; of a directory with execute for those who may read.
        umask: also those that other libraries and child processes create.  This changes the whole process.
    """
    token = _MODE.set(mode)
    before = os.umask(0o777 & ~folder_mode()) if umask else None
    try:
        yield
    finally:
        _MODE.reset(token)
        if before is not None:
            os.umask(before)


def folder_mode() -> int:
    """Return the mode of a new directory."""
    mode = _MODE.get()
    return mode | (mode & 0o444) >> 2


def write_text(path: Path, text: str) -> None:
    """Write a file (UTF-8) with the mode of new files.  Raises OSError."""
    with open_text(path, "w") as file:
        file.write(text)


def _open_new(path: str, flags: int) -> int:
    return os.open(path, flags, _MODE.get())


def open_new(path: Path, mode: Literal["xb", "wb", "ab"] = "xb") -> BufferedWriter:
    """Open a file for writing with the mode of new files; an older one of this name gets that mode.  Raises OSError."""
    file = open(path, mode, opener=_open_new)
    limit_mode(path)
    return file


def unbuffered(file: BufferedWriter) -> FileIO:
    """Return an open file again, without its buffer and with its lock; both are to be closed.  Raises OSError."""
    return FileIO(os.dup(file.fileno()), "wb")


def open_text(path: Path, mode: Literal["x", "w"] = "x", newline: str | None = None) -> TextIO:
    """Open a file as `open_new` does, for text (UTF-8); ``newline`` is as of ``open``.  Raises OSError."""
    file = open(path, mode, encoding="utf-8", newline=newline, opener=_open_new)
    limit_mode(path)
    return file


def limit_mode(path: Path) -> None:
    """Take from an existing file what the mode of new files does not allow."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) and stat.S_IMODE(mode) & ~_MODE.get():
        with suppress(OSError):  # of another owner, or a file system without modes
            path.chmod(_MODE.get())


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file with the mode of new files.  Raises OSError."""
    with open_new(path, "wb") as file:
        file.write(data)


def empty_file(path: Path, mode: Literal["xb", "wb"] = "wb") -> Path:
    """Make an empty file, for a library that opens it by its name; return the path.  Raises OSError."""
    open_new(path, mode).close()
    return path


def make_folder(path: Path, *, parents: bool = False, exist_ok: bool = False) -> None:
    """Make a directory with the mode of new ones, also those above it.  Raises OSError."""
    if parents and not path.parent.is_dir():
        make_folder(path.parent, parents=True, exist_ok=True)
    path.mkdir(folder_mode(), exist_ok=exist_ok)


def create_file(path: Path) -> BufferedWriter:
    """The new file, open, under the lock of its writer.  Raises RecordingError with the obstacle."""
    if found := obstacle(path):
        raise RecordingError(f"cannot record to {path}: {found}")
    try:
        file = open(path, "xb", opener=_open_appended)
        with suppress(OSError):  # a file system without locks
            lock(file.fileno())
        set_mode(file.fileno(), _MODE.get())  # whatever the umask is
        return file
    except FileExistsError:
        raise RecordingError(
            f"cannot record to {path}: the file exists already, and is not replaced without --overwrite"
        ) from None
    except (OSError, ValueError) as error:
        raise cannot_begin(path, error) from error


def try_file(path: Path, trial: Path) -> None:
    """Create a file beside that of a path and remove it, so that an obstacle is reported before that one is needed.

    Raises RecordingError, which names the path.
    """
    if found := obstacle(path):
        raise RecordingError(f"cannot record to {path}: {found}")
    try:
        open_new(trial).close()
        trial.unlink()
    except (OSError, ValueError) as error:
        raise cannot_begin(path, error) from error


def cannot_begin(path: Path, error: OSError | ValueError) -> RecordingError:
    """The error for a recording that cannot begin at ``path``: DiskRefused where the path itself is plausible."""
    kind = DiskRefused if isinstance(error, OSError) and error.errno not in _WRONG_PATH else RecordingError
    return kind(f"cannot record to {path}: {obstacle(path, error)}")


def os_error_text(error: Exception) -> str:
    """The system's text for a refused file."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _open_appended(path: str, flags: int) -> int:
    """Open a new file so that what is written goes to its end, also after another program has truncated it."""
    return os.open(path, flags | os.O_APPEND, _MODE.get())

"""Creating a file: what stands in the way, the lock of its writer, and the errors."""

from __future__ import annotations

import errno
import fcntl
import os
from io import BufferedWriter
from pathlib import Path

from igtl_gateway.errors import DiskRefused, RecordingError
from igtl_gateway.untrusted.files import obstacle

#: Errors of the system about a path that cannot have been intended; all others are the disk's.
_WRONG_PATH = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL})


def create_file(path: Path, overwrite: bool) -> BufferedWriter:
    """The open file, under the lock of its writer.  Raises RecordingError with the obstacle."""
    if found := obstacle(path):
        raise RecordingError(f"cannot record to {path}: {found}")
    try:
        file = open(path, "wb" if overwrite else "xb", opener=_open_untouched)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise RecordingError(f"cannot record to {path}: another process is recording to it") from None
        except OSError:
            pass  # a file system without locks
        file.truncate()
        return file
    except FileExistsError:
        raise RecordingError(
            f"cannot record to {path}: the file exists already, and is not replaced without --overwrite"
        ) from None
    except (OSError, ValueError) as error:
        raise cannot_begin(path, error) from error


def cannot_begin(path: Path, error: OSError | ValueError) -> RecordingError:
    """The error for a recording that cannot begin at ``path``: DiskRefused where the path itself is plausible."""
    kind = DiskRefused if isinstance(error, OSError) and error.errno not in _WRONG_PATH else RecordingError
    return kind(f"cannot record to {path}: {obstacle(path, error)}")


def os_error_text(error: Exception) -> str:
    """The system's text for a refused file."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power failure, too.  Raises OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _open_untouched(path: str, flags: int) -> int:
    """Open a file without emptying it: it might be the recording of another process."""
    return os.open(path, flags & ~os.O_TRUNC, 0o666)

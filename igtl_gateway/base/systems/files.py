"""Files: the lock of a writer, ordinary files without links, modes, folders on the disk, two folders exchanged.

On Windows the mode of a new file means nothing: it inherits the permissions of its folder.  A file that is open cannot
be removed or replaced there.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import sys
from contextlib import suppress
from pathlib import Path

if sys.platform == "win32":
    import ctypes
    import msvcrt

    _EXCLUSIVE, _AT_ONCE = 2, 1  # of LockFileEx
    #: Place of the locked byte.  A lock of Windows prevents reading, so it lies behind all bytes of any file.
    _LOCK_AT = 1 << 62
    _LOCK_VIOLATION, _NOT_LOCKED, _IO_PENDING = 33, 158, 997
    #: Flags of a descriptor: the bytes as they are; no child inherits it.
    _PLAIN = os.O_BINARY | os.O_NOINHERIT

    class _Overlapped(ctypes.Structure):
        """OVERLAPPED: a place in a file, as two halves."""

        _fields_ = (
            ("internal", ctypes.c_size_t),
            ("internal_high", ctypes.c_size_t),
            ("offset", ctypes.c_uint32),
            ("offset_high", ctypes.c_uint32),
            ("event", ctypes.c_void_p),
        )

    _KERNEL = ctypes.WinDLL("kernel32", use_last_error=True)

    def lock(handle: int, *, shared: bool = False) -> None:
        """Lock an open file until it is closed, without waiting.

        Args:
            handle: its descriptor.
            shared: other readers may have it, too; otherwise only one has it.

        Raises BlockingIOError if another open file has the lock, OSError if the file system has no locks.
        """
        flags = _AT_ONCE | (0 if shared else _EXCLUSIVE)
        place = _Overlapped(offset_high=_LOCK_AT >> 32)
        file = ctypes.c_void_p(msvcrt.get_osfhandle(handle))
        if not _KERNEL.LockFileEx(file, flags, 0, 1, 0, ctypes.byref(place)):
            error = ctypes.get_last_error()
            if error in (_LOCK_VIOLATION, _IO_PENDING):
                raise BlockingIOError(errno.EAGAIN, "another process has the lock")
            raise OSError(errno.EIO, f"no lock: {ctypes.FormatError(error).strip()}")

    def unlock(handle: int) -> None:
        """Release the lock of an open file.  Raises OSError."""
        place = _Overlapped(offset_high=_LOCK_AT >> 32)
        file = ctypes.c_void_p(msvcrt.get_osfhandle(handle))
        if not _KERNEL.UnlockFileEx(file, 0, 1, 0, ctypes.byref(place)):
            error = ctypes.get_last_error()
            if error != _NOT_LOCKED:
                raise OSError(errno.EIO, f"no lock: {ctypes.FormatError(error).strip()}")

    def sync_folder(folder: Path) -> None:
        """Make the names in a folder survive a power failure: Windows has no such call, its file systems do it."""

else:
    import fcntl

    _PLAIN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC

    def lock(handle: int, *, shared: bool = False) -> None:
        """Lock an open file until it is closed, without waiting.

        Args:
            handle: its descriptor.
            shared: other readers may have it, too; otherwise only one has it.

        Raises BlockingIOError if another open file has the lock, OSError if the file system has no locks.
        """
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)

    def unlock(handle: int) -> None:
        """Release the lock of an open file.  Raises OSError."""
        fcntl.flock(handle, fcntl.LOCK_UN)

    def sync_folder(folder: Path) -> None:
        """Make the names in a folder survive a power failure, too.  Raises OSError."""
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Return the descriptor of an ordinary file; links are refused, and a new file is for its owner only.

    Never waits for a FIFO or a device.  Raises OSError.
    """
    if sys.platform == "win32" and path.is_symlink():
        raise OSError(errno.ELOOP, "it is a link", str(path))
    handle = os.open(path, flags | _PLAIN, 0o600)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(0, "it is not an ordinary file", str(path))
    return handle


def set_mode(handle: int, mode: int) -> None:
    """Set the mode of an open file, where its file system has modes."""
    if sys.platform != "win32":
        with suppress(OSError):
            os.fchmod(handle, mode)


def remove_locked(path: Path, handle: int) -> None:
    """Remove a file whose lock this process has, and close its descriptor.  Raises OSError.

    On Windows it is closed first, and stays if another program has it open.
    """
    if sys.platform == "win32":
        os.close(handle)
        path.unlink()
        return
    try:
        path.unlink()
    finally:
        os.close(handle)


def remove_locked_folder(path: Path, handle: int) -> None:
    """Remove a folder, of which the file with this descriptor is the lock, and close it; what cannot be removed stays.

    On Windows the file is closed first.
    """
    if sys.platform == "win32":
        os.close(handle)
        shutil.rmtree(path, ignore_errors=True)
        return
    try:
        shutil.rmtree(path, ignore_errors=True)
    finally:
        os.close(handle)


def rename_new(old: Path, new: Path) -> None:
    """Rename a file or a folder to a name that is free.  Raises FileExistsError if it is not, OSError.

    A file never takes the place of one that another program has made in between, where the file system has hard links.
    """
    if sys.platform != "win32" and not old.is_dir():
        try:
            os.link(old, new, follow_symlinks=False)
            old.unlink()
            return
        except FileExistsError:
            raise
        except OSError:
            pass  # a file system without hard links
    if os.path.lexists(new):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(new))
    os.rename(old, new)


def exchange(one: Path, two: Path) -> bool:
    """Give each of two paths what the other one has, at one moment; return whether the file system can.

    Raises OSError.
    """
    if sys.platform != "linux":
        return False
    import ctypes  # here: few programs need it

    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:  # another C library
        return False
    if not call(_HERE, os.fsencode(one), _HERE, os.fsencode(two), ctypes.c_uint(_EXCHANGE)):
        return True
    error = ctypes.get_errno()
    if error in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(error, os.strerror(error), str(two))


#: Of renameat2: AT_FDCWD, RENAME_EXCHANGE.
_HERE, _EXCHANGE = -100, 2
#: Whether a file can be renamed, or another one take its place, while it is open.
RENAMES_OPEN_FILES = sys.platform != "win32"


class OpenFolder:
    """A folder whose files are named relative to it: it stays the same one, even if a link takes its place.

    On Windows it is only its path.

    Args:
        path: the folder, no link.

    Raises OSError.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if sys.platform == "win32":
            if path.is_symlink():
                raise OSError(errno.ELOOP, "it is a link", str(path))
        else:
            self._handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)

    def close(self) -> None:
        """Close it."""
        if sys.platform != "win32":
            os.close(self._handle)

    def open(self, name: str) -> int:
        """Return the descriptor of a file for reading; links are refused.  Raises OSError."""
        if sys.platform == "win32":
            return open_plain(self._path / name)
        return os.open(name, os.O_RDONLY | _PLAIN, dir_fd=self._handle)

    def stat(self, name: str) -> os.stat_result:
        """Return the state of a file; links are not followed.  Raises OSError."""
        if sys.platform == "win32":
            return os.lstat(self._path / name)
        return os.stat(name, dir_fd=self._handle, follow_symlinks=False)

    def remove_locked(self, name: str, handle: int) -> None:
        """Remove a file whose lock this process has, and close its descriptor.  Raises OSError.

        On Windows it is closed first, and stays if another program has it open.
        """
        if sys.platform == "win32":
            os.close(handle)
            os.unlink(self._path / name)
            return
        try:
            os.unlink(name, dir_fd=self._handle)
        finally:
            os.close(handle)

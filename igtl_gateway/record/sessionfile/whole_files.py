"""How every verb writes a file or a folder: beside its place, and moved there when it is complete.

A hidden folder ``.igtl-gateway-PID-N.part`` beside the target holds what is being written, under its final name, and a
lock of its writer.  So at any moment there is either what was there before or the complete new file.  After an error,
Ctrl-C or SIGTERM nothing is left.  After SIGKILL the hidden folder is left, without a lock: the next program that
writes into the same folder removes it.

A link at the target is replaced itself; what it leads to stays as it is.
"""

from __future__ import annotations

import errno
import itertools
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, GatewayError, RecordingError, UnsupportedRecording
from igtl_gateway.base.systems.files import (
    RENAMES_OPEN_FILES,
    lock,
    open_plain,
    remove_locked_folder,
    rename_new,
    sync_folder,
)
from igtl_gateway.base.untrusted.files import is_being_written, obstacle
from igtl_gateway.record.sessionfile.new_file import cannot_begin, limit_mode, make_folder

_START, _END = ".igtl-gateway-", ".part"
_LOCK = ".igtl-gateway.lock"
_NUMBERS = itertools.count()
_ATTEMPTS = 1000
#: Errors of a disk that takes nothing more; reading has none of them.
_DISK = frozenset({errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS})


def check_target(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigError for an existing file without --overwrite, GatewayError if the file cannot be written."""
    try:
        here = path.lstat()
        found = path.stat() if path.exists() else here  # a link to nothing is replaced as any other link
    except FileNotFoundError as error:
        if not path.parent.is_dir():
            raise write_error(path, error) from None
        return
    except (OSError, ValueError) as error:
        raise write_error(path, error) from None
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISLNK(found.st_mode)):
        raise GatewayError(f"cannot write to {path}: {obstacle(path)}")
    if not overwrite:
        raise ConfigError(f"{path}: exists already, expected a new file or --overwrite")
    _check_idle(path, here)


@contextmanager
def written(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Context manager: a free path of the same name, whose file goes to ``path`` if the ``with`` block succeeds.

    Errors of the ``with`` block name ``path``.  Without a file at the end nothing happens.

    Raises ConfigError if ``path`` exists and is not to be overwritten, GatewayError if it cannot be written.
    """
    check_target(path, overwrite=overwrite)
    with hidden_folder(path, path.parent, write_error) as folder:
        place = folder / _name(path)
        with naming(place, path):
            yield place
        with refused(path, write_error):
            if place.exists():
                _move(place, path, overwrite=overwrite)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Context manager: as ``written``, for a recording that goes on after the ``with`` block, in the open file.

    Where an open file cannot be renamed, the old one is removed first.  Raises RecordingError, DiskRefused.
    """
    try:
        check_target(path, overwrite=True)
    except GatewayError as error:
        raise RecordingError(str(error)) from None
    if not RENAMES_OPEN_FILES:
        with refused(path, cannot_begin):
            path.unlink()
        yield path
        return
    with hidden_folder(path, path.parent, cannot_begin) as folder:
        place = folder / _name(path)
        yield place
        with refused(path, cannot_begin):
            _move(place, path, overwrite=True)


@contextmanager
def written_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Context manager: an empty folder, whose files go to the folder ``path`` if the ``with`` block succeeds.

    If there is no ``path``, the folder is moved there; otherwise its files are moved into the folder that is there.
    Without a folder at the end nothing happens.

    Args:
        path: a new or empty folder.
        overwrite: it may have files; those of the same names are replaced.

    Raises UnsupportedRecording for a folder with files, GatewayError if it cannot be written.
    """
    is_new = not os.path.lexists(path)
    check_folder(path, overwrite=overwrite)
    with hidden_folder(path, path.parent if is_new else path, write_error) as folder:
        place = folder / _name(path)
        with refused(path, write_error):
            make_folder(place)
        with naming(place, path):
            yield place
        with refused(path, write_error):
            if is_new and place.exists():
                _move(place, path, overwrite=False)
            elif place.exists():
                for child in sorted(place.iterdir()):
                    _move(child, path / child.name, overwrite=overwrite)


def check_folder(path: Path, *, overwrite: bool = False) -> None:
    """Raise UnsupportedRecording or GatewayError if no files can be written into a new or empty folder."""
    try:
        if not os.path.lexists(path):
            if not path.absolute().parent.is_dir():
                raise GatewayError(f"cannot write to {path}: there is no folder {path.parent}")
        elif not path.is_dir():
            raise GatewayError(f"cannot write to {path}: it is not a folder, expected one or a new name")
        elif not overwrite and any(not _is_part(name) for name in os.listdir(path)):
            raise UnsupportedRecording(f"{path}: found a directory with files in it, expected a new or empty directory")
    except (OSError, ValueError) as error:
        raise write_error(path, error) from None


def write_error(path: Path, error: Exception) -> GatewayError:
    """What to raise where ``path`` cannot be written."""
    if isinstance(error, OSError) and os.path.isdir(path):  # a folder is what was expected
        why = error.strerror or ""
    else:
        why = obstacle(path, error) if isinstance(error, OSError | ValueError) else ""
    return GatewayError(f"cannot write to {path}: {why or error}")


def is_unfinished(path: Path) -> bool:
    """Return whether a path lies in a folder of something that is still being written, or was never completed."""
    return any(_is_part(name) for name in path.parts)


#: Makes the error of a path that the system refuses.
Refusal = Callable[[Path, OSError], GatewayError]


@contextmanager
def refused(path: Path, refusal: Refusal) -> Iterator[None]:
    """Context manager: errors of the system become this error."""
    try:
        yield
    except FileExistsError:
        raise ConfigError(f"{path}: exists already, expected a new file or --overwrite") from None
    except OSError as error:
        raise refusal(path, error) from None


@contextmanager
def hidden_folder(path: Path, where: Path, refusal: Refusal) -> Iterator[Path]:
    """Context manager: a hidden folder in ``where``, locked, which is removed at the end."""
    with refused(path, refusal):
        _remove_leftovers(where)
        folder, handle = _new_part(where)
    try:
        yield folder
    finally:
        remove_locked_folder(folder, handle)


def _new_part(where: Path) -> tuple[Path, int]:
    """Make a hidden folder; return it and the descriptor of its lock.  Raises OSError."""
    for _ in range(_ATTEMPTS):
        folder = where / f"{_START}{os.getpid()}-{next(_NUMBERS)}{_END}"
        try:
            make_folder(folder)
        except FileExistsError:  # of a program with the same number, perhaps on another machine
            continue
        try:
            handle = open_plain(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        except FileNotFoundError:  # another program has removed it as a leftover, before it was locked
            continue
        is_ours = True
        try:
            lock(handle)
        except BlockingIOError:  # the same
            is_ours = False
        except OSError:
            pass  # a file system without locks: there no program removes leftovers
        if is_ours and (folder / _LOCK).exists():
            return folder, handle
        os.close(handle)
    raise OSError(errno.EEXIST, f"found no free name for a hidden folder in {where}")


def _remove_leftovers(where: Path) -> None:
    """Remove the hidden folders of programs that were killed: their locks are free."""
    with os.scandir(where) as entries:
        found = [Path(entry) for entry in entries if _is_part(entry.name) and entry.is_dir(follow_symlinks=False)]
    for folder in found:
        with suppress(OSError):
            if not any(folder.iterdir()):  # killed before it made the lock
                folder.rmdir()
                continue
            handle = open_plain(folder / _LOCK, os.O_RDWR)
            try:
                lock(handle)
            except OSError:  # its program is at work, or a file system without locks
                os.close(handle)
            else:
                remove_locked_folder(folder, handle)


def _name(path: Path) -> str:
    """Return the name of a target, or another one if libraries cannot open a file of this name."""
    try:
        path.name.encode()
    except UnicodeEncodeError:
        return f"new{path.suffix if path.suffix.isascii() else ''}"
    return path.name or "new"


def _is_part(name: str) -> bool:
    return name.startswith(_START) and name.endswith(_END)


@contextmanager
def naming(place: Path, path: Path) -> Iterator[None]:
    """Errors of the code inside name the target instead of the hidden place; full disks become GatewayError."""
    try:
        yield
    except GatewayError as error:
        error.args = tuple(
            each.replace(str(place), str(path)) if isinstance(each, str) else each for each in error.args
        )
        raise
    except OSError as error:
        if error.errno in _DISK or str(error.filename or "").startswith(str(place)):
            raise write_error(path, error) from None
        raise


def _move(place: Path, path: Path, *, overwrite: bool) -> None:
    """Move a complete file or folder to its path.  Raises OSError, GatewayError if another process records to it."""
    if place.is_file():
        limit_mode(place)
    if not (overwrite and os.path.lexists(path)):
        rename_new(place, path)
        return
    _check_idle(path, path.lstat())
    sync_file(place)  # the old file is gone after this: the new one must survive a power failure
    os.replace(place, path)
    with suppress(OSError):
        sync_folder(path.parent)


def sync_file(place: Path) -> None:
    """Write a file to the disk, so that it survives a power failure.  Raises OSError."""
    handle = open_plain(place, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _check_idle(path: Path, found: os.stat_result) -> None:
    """Raise GatewayError if another process is recording to a file."""
    if not stat.S_ISREG(found.st_mode):
        return
    try:
        with path.open("rb") as file:
            busy = is_being_written(file)
    except OSError:  # not readable: it can be replaced all the same
        return
    if busy:
        raise GatewayError(f"cannot write to {path}: another process is recording to it")

"""A folder that is replaced by a newer one: at any moment the path has either of them, whole.

The newer one is made in a hidden folder beside it (``whole_files``), and the two are exchanged at one moment.  A file
system that cannot do this has the old one under a hidden name for the time between two renames; if the program is
killed then, the next one puts it back.  What is removed at the end is the old folder, in the hidden one.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.systems.files import exchange, lock, open_plain, remove_locked, sync_folder
from igtl_gateway.base.untrusted.files import near_file
from igtl_gateway.record.sessionfile.new_file import make_folder
from igtl_gateway.record.sessionfile.whole_files import hidden_folder, naming, refused, sync_file, write_error

_LOCK, _BEFORE = ".{}.igtl-gateway-lock", ".{}.igtl-gateway-before"


@contextmanager
def replaced_folder(path: Path) -> Iterator[Path]:
    """Context manager: an empty folder, which takes the place of a folder if the ``with`` block succeeds.

    The block may link files of the old folder into it; files that it writes are on the disk before the old ones go.
    What a killed program left is removed or put back first.

    Args:
        path: the folder, no link.

    Raises GatewayError if it cannot be replaced, is no folder, or another program is replacing it.
    """
    before = path.with_name(_BEFORE.format(path.name))
    with _locked(path):
        with refused(path, _refusal):
            _put_back(path, before)
            _check(path)
        with hidden_folder(path, path.parent, _refusal) as folder:
            place = folder / path.name
            with refused(path, _refusal):
                make_folder(place)
            with naming(place, path):
                yield place
            with refused(path, _refusal):
                _sync(place)
                if not exchange(place, path):
                    _rename(place, path, before)
                with suppress(OSError):  # a file system that has it at once
                    sync_folder(path.parent)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Context manager: no other program replaces the folder."""
    name = path.with_name(_LOCK.format(path.name))
    with refused(path, _refusal):
        handle = _lock(path, name)
    try:
        yield
    finally:
        with suppress(OSError):
            remove_locked(name, handle)


def _lock(path: Path, name: Path) -> int:
    while True:
        handle = open_plain(name, os.O_RDWR | os.O_CREAT)
        try:
            lock(handle)
        except BlockingIOError:
            os.close(handle)
            raise GatewayError(f"{path}: another program is writing to it; wait for its end") from None
        except OSError:
            return handle  # a file system without locks
        try:
            is_there = os.path.samestat(os.fstat(handle), name.lstat())
        except FileNotFoundError:
            is_there = False
        if is_there:
            return handle
        os.close(handle)  # of a program that has ended meanwhile, and has removed it


def _refusal(path: Path, error: OSError) -> GatewayError:
    """What to raise; the new folder is made beside the old one, in which all may be permitted."""
    is_beside = error.errno in (errno.EACCES, errno.EPERM, errno.EROFS) and os.path.isdir(path)
    return GatewayError(f"{write_error(path, error)}{f', in the folder {path.parent}' * is_beside}")


def _put_back(path: Path, before: Path) -> None:
    if not os.path.lexists(before):
        return
    if os.path.lexists(path):
        raise GatewayError(f"{path}: found {before}, too, of a program that was killed, expected one: remove the other")
    os.rename(before, path)


def _check(path: Path) -> None:
    if not os.path.lexists(path):
        raise GatewayError(f"{path}: No such folder{near_file(path)}")
    if path.is_symlink() or not path.is_dir():
        raise GatewayError(f"cannot write to {path}: it is not a folder, expected one")
    if os.path.ismount(path):  # Path has it on Windows from Python 3.12 on only
        raise GatewayError(f"cannot write to {path}: it is a mount point, expected a folder in it")
    if Path.cwd().is_relative_to(path.resolve()):  # it would be the one that is removed
        raise GatewayError(f"cannot write to {path}: the working directory is in it, expected one outside of it")
    for folder, _, _ in os.walk(path):  # neither could it be renamed, nor what is in it be removed
        if not os.access(folder, os.W_OK):
            raise GatewayError(f"cannot write to {path}: {folder} is read-only, expected a folder to write to")


def _rename(place: Path, path: Path, before: Path) -> None:
    """Exchange two folders by renaming them: between the first two of three, the path has none."""
    os.rename(path, before)
    try:
        os.rename(place, path)
    except OSError:
        os.rename(before, path)
        raise
    os.rename(before, place)


def _sync(place: Path) -> None:
    """Write new files to the disk: after a power failure they must be there, as the old ones will not be."""
    for folder, _, names in os.walk(place):
        for name in names:
            path = Path(folder, name)
            if path.lstat().st_nlink == 1:  # others are links to files of the old folder
                with suppress(PermissionError):  # a copy that is read-only
                    sync_file(path)
        with suppress(OSError):
            sync_folder(Path(folder))

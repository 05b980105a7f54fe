"""Opens untrusted files: ordinary files only, and files that a header names only in the same folder."""

from __future__ import annotations

import errno
import stat
import sys
from itertools import islice
from pathlib import Path
from typing import IO, BinaryIO

from igtl_gateway.base.errors import DamagedRecording, NoSuchRecording, UnsupportedRecording
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.systems.files import lock, unlock
from igtl_gateway.base.untrusted import cpu_time, limits

_SEEK_DATA = 3  # as lseek(2)

#: Files of a folder among which a name is looked for.
_MOST_NAMES = 2_000
_NOTHING, _UNSEEN = "nothing", "unseen"
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def size_of(path: Path) -> int:
    """Return the size of an ordinary file.  Raises NoSuchRecording if it is missing, else UnsupportedRecording."""
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise NoSuchRecording(f"{path}: {error.strerror}{near_file(path)}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UnsupportedRecording(f"{path}: {reason}") from None
    for is_kind, name in _KINDS:
        if is_kind(found.st_mode):
            raise UnsupportedRecording(f"{path}: found {name}, expected a file")
    return found.st_size


def near_file(path: Path) -> str:
    """Return what follows the message that there is no such file: the nearest names, of a missing folder its own."""
    missing = path if path.parent.is_dir() else path.parent
    names = [each for each in _names_in(missing.parent) if each != missing.name]  # a link to nothing has its own
    near = near_names(missing.name, names) if missing.name else []
    question = did_you_mean(str(missing.parent / each) for each in near)
    there = "" if missing is path else f": there is no folder {missing}"
    return there + (f"; {question}" if question else "")


def _names_in(folder: Path) -> list[str]:
    """Return the names of the files in a folder that are not hidden: the first ones of many."""
    try:
        return sorted(each.name for each in islice(folder.iterdir(), _MOST_NAMES) if not each.name.startswith("."))
    except (OSError, ValueError):
        return []


def open_file(path: Path) -> BinaryIO:
    """Open an ordinary file for reading.  Raises UnsupportedRecording; never waits for a FIFO or a device."""
    cpu_time.opened(path, stored_bytes(path, size_of(path)))
    try:
        return path.open("rb")
    except FileNotFoundError as error:  # deleted since
        raise NoSuchRecording(f"{path}: {error.strerror}{near_file(path)}") from None
    except OSError as error:
        raise UnsupportedRecording(f"{path}: {error.strerror or error}") from None


def stored_bytes(path: Path, size: int) -> int:
    """Return the number of the ``size`` bytes of a file that are on the disk: holes of a sparse file are not."""
    if sys.platform == "win32":  # its files have no count of blocks
        return size
    try:
        return min(size, path.stat().st_blocks * 512)
    except (OSError, ValueError):  # bytes in memory
        return size


def deadline_of(path: Path) -> limits.Deadline:
    """Return the deadline for reading a file, by its bytes on the disk.  Raises as :func:`size_of`."""
    return limits.Deadline(stored_bytes(path, size_of(path)))


def next_data(stream: IO[bytes], at: int) -> int:
    """Return the next offset from ``at`` on that is not in a hole of a sparse file; the end if there is none."""
    try:
        return stream.seek(at, _SEEK_DATA)
    except OSError as error:
        return stream.seek(0, 2) if error.errno == errno.ENXIO else at
    except ValueError:  # bytes in memory
        return at


def is_being_written(stream: IO[bytes]) -> bool:
    """Return whether another process holds a writer's lock on an open file."""
    try:
        lock(stream.fileno(), shared=True)
        unlock(stream.fileno())
    except BlockingIOError:
        return True
    except OSError:  # bytes in memory, or a file system without locks
        pass
    return False


def read_bytes(path: Path) -> bytes:
    """Read a small file.  Raises UnsupportedRecording, or LimitExceeded above the limit ``free``."""
    with open_file(path) as stream:
        data = stream.read(limits.current_limits().free + 1)
    limits.check_limit("free", len(data), str(path))
    return data


def sibling_file(path: Path, name: str) -> Path:
    """Return the file ``name`` that the file ``path`` refers to: a plain name in the same folder, no link out of it.

    Raises DamagedRecording, or UnsupportedRecording if there is no such ordinary file.
    """
    folder = path.parent
    if not name or name in {".", ".."} or Path(name).name != name or "\\" in name or "\0" in name:
        raise DamagedRecording(f"{path}: found a reference to the file {name!r}, expected a name in the same folder")
    target = folder / name
    try:
        is_outside = target.is_symlink() and target.resolve().parent != folder.resolve()
    except (OSError, RuntimeError):  # links in a circle
        is_outside = False
    if is_outside:
        raise DamagedRecording(f"{path}: found a reference to {name!r}, a link out of the folder")
    size_of(target)
    return target


def obstacle(path: Path, error: OSError | ValueError | None = None) -> str:
    """Return why no file can be created or replaced at ``path``; ``""`` if no reason is known.

    Args:
        error: the error of the attempt, for reasons that cannot be checked before.
    """
    kind, folder = _kind(path), path.parent
    if kind not in ("a file", _NOTHING, _UNSEEN):
        return f"it is {kind}, expected a file or a new name"
    above = _kind(folder)
    if above == _NOTHING:
        return f"there is no folder {folder}"
    if above not in ("a folder", _UNSEEN):
        return f"{folder} is {above}, expected a folder"
    if error is None:
        return ""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ENOENT:  # in an existing folder: a folder of the kernel, such as /proc
        return f"no file can be created in {folder} ({text})"
    if number == errno.ENAMETOOLONG:
        return f"{text}: {counted(len(bytes(Path(path.name))), 'byte')}"
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{text}, in the folder {folder}"
    return text


def is_same(path: Path, other: Path) -> bool:
    """Return whether both names are names of the same existing file."""
    try:
        return path.samefile(other)
    except (OSError, ValueError):
        return False


def _kind(path: Path) -> str:
    """Return the kind of the file at a path; links are followed."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        number = error.errno if isinstance(error, OSError) else None
        if number not in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            return _UNSEEN
        return "a link to nothing" if path.is_symlink() else _NOTHING
    return next((name for is_kind, name in _KINDS if is_kind(mode)), "a file")

"""The recordings in a folder: found by their contents, never by their names.

A folder has files, and folders of split recordings; nothing that lies deeper belongs to it.  Links, hidden files and
whatever is not an ordinary file are not looked at.  A file costs one pass over its summary; as long as it does not
change, later passes only ask the file system.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from igtl_gateway.base.errors import DamagedRecording, GatewayError
from igtl_gateway.base.systems.files import open_plain
from igtl_gateway.base.untrusted.files import is_being_written
from igtl_gateway.record.sessionfile import facts, layout, records
from igtl_gateway.record.sessionfile.contents import Index
from igtl_gateway.record.sessionfile.index import read_record, stated_index
from igtl_gateway.record.sessionfile.records import MAGIC, Malformed
from igtl_gateway.record.sessionfile.seals import ends_sealed

#: Maximum number of files that one pass looks at.
MOST_FILES = 20_000
#: Longest summary that is read: 100 times that of a day with 50 streams.
_MOST_SUMMARY = 256 << 20

#: Keys of the session metadata of files that a user made of a recording: these belong to the user.
_DERIVED = ("slice_of", "imported_format", "deidentified")


@dataclass(frozen=True, slots=True)
class StoredRecording:
    """A recording, or a part of a split one, in a folder.

    Attributes:
        folder: the folder that was searched.
        name: its path below the folder, with ``/``.
        size: bytes.
        identity: device and number of the file, size and time of the last change: equal as long as it is unchanged.
        modified_ns: UTC ns of the last change: when the recorder closed it.
        end_ns: UTC ns of its last entry; 0 without entries.
        part: number of the part; -1: it is not a part.
        sealed: whether it states that it is sealed to its end, which is not checked.
    """

    folder: Path
    name: str
    size: int
    identity: tuple[int, int, int, int]
    modified_ns: int
    end_ns: int = 0
    part: int = -1
    sealed: bool = False

    @property
    def path(self) -> Path:
        return self.folder / self.name

    @property
    def parent(self) -> Path:
        """The folder that it lies in."""
        return self.path.parent


@dataclass(frozen=True, slots=True)
class StoredFiles:
    """What one pass over a folder found.

    Attributes:
        closed: recordings that are closed.
        open_bytes: size of the recordings that are not.
        running_bytes: of that, of those that a recorder is writing now.
        running: folders of split recordings in which a recorder is writing one of these.
        complete: whether all files were looked at.
    """

    closed: list[StoredRecording] = field(default_factory=list)
    open_bytes: int = 0
    complete: bool = True
    running_bytes: int = 0
    running: frozenset[Path] = frozenset()


@dataclass(frozen=True, slots=True)
class _Contents:
    """What a file is: a closed recording, an open one or, for both False, something else."""

    closed: bool = False
    open: bool = False
    end_ns: int = 0
    part: int = -1
    sealed: bool = False


_FOREIGN, _OPEN = _Contents(), _Contents(open=True)


class RecordingFolder:
    """A folder of recordings, which may be searched again and again.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, tuple[tuple[int, int, int, int], _Contents]] = {}

    def search(self) -> StoredFiles:
        """Return what is in the folder now.  Raises OSError if the folder cannot be read."""
        closed: list[StoredRecording] = []
        known: dict[str, tuple[tuple[int, int, int, int], _Contents]] = {}
        open_bytes, running_bytes, complete = 0, 0, True
        running: set[Path] = set()
        for number, (name, found) in enumerate(_files(self.path)):
            if number >= MOST_FILES:
                complete = False
                break
            identity = identity_of(found)
            before = self._known.get(name)
            contents = before[1] if before and before[0] == identity else _contents(self.path / name, identity)
            known[name] = identity, contents
            if contents.closed:
                row = (contents.end_ns, contents.part, contents.sealed)
                closed.append(
                    StoredRecording(self.path, name, found.st_size, identity, found.st_mtime_ns, *row),
                )
            elif contents.open:
                open_bytes += found.st_size
                path = self.path / name
                if _is_running(path):
                    running_bytes += found.st_size
                    running |= set() if path.parent == self.path else {path.parent}
        self._known = known
        return StoredFiles(closed, open_bytes, complete, running_bytes, frozenset(running))


def identity_of(found: os.stat_result) -> tuple[int, int, int, int]:
    """Return what is equal as long as a file is unchanged: device, number, size, time of the last change."""
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def open_unlinked(path: Path) -> IO[bytes]:
    """Open an ordinary file for reading, but no link.  Raises OSError."""
    return os.fdopen(open_plain(path), "rb")


def _files(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Yield name and state of the files of a folder and of the folders in it.  Raises OSError for the folder itself."""
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda each: each.name):
            if entry.name.startswith("."):
                continue
            try:
                if entry.is_dir(follow_symlinks=False):
                    with os.scandir(entry.path) as below:
                        for each in sorted(below, key=lambda one: one.name):
                            if not each.name.startswith(".") and each.is_file(follow_symlinks=False):
                                yield f"{entry.name}/{each.name}", each.stat(follow_symlinks=False)
                elif entry.is_file(follow_symlinks=False):
                    yield entry.name, entry.stat(follow_symlinks=False)
            except OSError:  # it has just been removed, or it is not readable for us
                continue


def _contents(path: Path, identity: tuple[int, int, int, int]) -> _Contents:
    """Return what a file is.  Never raises: what cannot be read is something else."""
    try:
        with closing(open_unlinked(path)) as stream:
            if identity_of(os.fstat(stream.fileno())) != identity:
                return _OPEN  # it grows; the next pass looks again
            return _parsed(path, stream, identity[2])
    except (OSError, GatewayError, Malformed, layout.LayoutError, ValueError):
        return _FOREIGN


def _parsed(path: Path, stream: IO[bytes], size: int) -> _Contents:
    if stream.read(len(MAGIC)) != MAGIC:
        return _FOREIGN
    index = stated_index(path, stream, size, _MOST_SUMMARY)
    if index is None:  # it has no end yet, or lost it: its beginning decides whether it counts
        return _OPEN if _begins_as_ours(stream) else _FOREIGN
    session = _items(stream, index, layout.SESSION_METADATA, path)
    ledger_items = _items(stream, index, layout.LEDGER_METADATA, path)
    if session is None or ledger_items is None or any(key in session for key in _DERIVED):
        return _FOREIGN
    facts.check_session(session, str(path))
    if "recovered" in facts.ledger(ledger_items.get(layout.LEDGER_KEY, ""), str(path)):
        return _FOREIGN
    part = int(session.get(layout.PART_KEY, "-1"))
    return _Contents(True, False, index.end_ns, part, ends_sealed(path, stream, index, size))


def _items(stream: IO[bytes], index: Index, name: str, path: Path) -> dict[str, str] | None:
    place = next((each for each in index.metadata if each.name == name), None)
    if place is None:
        return None
    record = records.parse_metadata(read_record(stream, index, records.METADATA, place, str(path)))
    if record.name != name:
        raise DamagedRecording(f"{path}: found metadata {record.name!r}, expected {name!r}")
    return layout.unseal(record.metadata)


def _is_running(path: Path) -> bool:
    """Return whether a recorder is writing a file; False if it cannot be read."""
    try:
        with closing(open_unlinked(path)) as stream:
            return is_being_written(stream)
    except OSError:
        return False


def _begins_as_ours(stream: IO[bytes]) -> bool:
    """Return whether the metadata of a session are among the first records."""
    stream.seek(0)
    return layout.SESSION_METADATA.encode() in stream.read(1 << 20)

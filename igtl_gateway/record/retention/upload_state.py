"""What is known about the upload of a recording: a file beside it, one JSON object a line, only ever extended.

It has the place, and for each file its digest when it was closed, the upload that was begun, and the confirmation.  A
line that was cut off by a crash is not used.  Keys of the store are not in it.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.stamp import utc_text
from igtl_gateway.base.systems.files import lock, open_plain, remove_locked
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.record.retention.stored import StoredRecording, open_unlinked

SUFFIX = ".uploads.jsonl"
_MOST_BYTES = 64 << 20
_SNAPSHOT = r"_[0-9]{8}T[0-9]{6}Z(_[0-9]+)?\.mcap"


@dataclass(frozen=True, slots=True)
class FileState:
    """What is known about a file.

    Attributes:
        size, modified_ns: as it was when it was found closed.
        sha256: its digest, as hexadecimal digits.
        etag, checksum: what the store will state if it has the same bytes in parts of ``part_bytes``.
        part_bytes: size of the parts.
        upload: identifier of the upload that was begun, or "".
        confirmed: UTC time at which the store confirmed it, or "".
    """

    size: int = -1
    modified_ns: int = -1
    sha256: str = ""
    etag: str = ""
    checksum: str = ""
    part_bytes: int = 0
    upload: str = ""
    confirmed: str = ""

    def is_of(self, recording: StoredRecording) -> bool:
        """Return whether the file is the one that was found closed."""
        return (self.size, self.modified_ns) == (recording.size, recording.modified_ns)


def base_of(name: str) -> str:
    """Return the name of the recording that a file or a part belongs to, without ``.mcap``."""
    return name.partition("/")[0].removesuffix(".mcap")


def belongs(name: str, base: str) -> bool:
    """Return whether a file is of a recording: the file itself, a part of it, or a snapshot."""
    top, slash, _ = name.partition("/")
    if slash:
        return top == base
    return name in (base, f"{base}.mcap") or re.fullmatch(re.escape(base) + _SNAPSHOT, name) is not None


class UploadState:
    """The state of the upload of one recording; a context manager that has its lock.

    Args:
        folder: the folder of the recording.
        base: its name without ``.mcap``.

    Attributes:
        path: the file.
        place: URL of the store; "": it is not to be uploaded yet.
        files: what is known, by name.
    """

    def __init__(self, folder: Path, base: str) -> None:
        self.path = folder / f"{base}{SUFFIX}"
        self.base = base
        self.place = ""
        self.files: dict[str, FileState] = {}
        self._file: int | None = None
        self._read: tuple[int, int, int] | None = None  # device, number, and the bytes that were read
        self.refresh()

    def refresh(self) -> None:
        """Read what was added since the last time; everything if it is another file."""
        try:
            with closing(open_unlinked(self.path)) as stream:
                found = os.fstat(stream.fileno())
                if (
                    self._read is None
                    or self._read[:2] != (found.st_dev, found.st_ino)
                    or found.st_size < self._read[2]
                ):
                    self.place, self.files = "", {}
                    self._read = found.st_dev, found.st_ino, 0
                device, number, at = self._read
                if found.st_size == at:
                    return
                stream.seek(at)
                data = stream.read(_MOST_BYTES)
        except OSError:
            return
        whole = data.rfind(b"\n") + 1  # a line that was cut off is not used
        self._read = device, number, at + whole
        changed: dict[str, dict[str, Any]] = {}
        for line in data[:whole].splitlines():
            with suppress(DamagedRecording, ValueError):
                facts = parse_json(line.decode(), str(self.path))
                if not isinstance(facts, dict):
                    continue
                if isinstance(place := facts.get("to"), str):
                    self.place, self.files, changed = place, {}, {}
                elif isinstance(name := facts.get("file"), str) and (name in changed or belongs(name, self.base)):
                    changed.setdefault(name, {}).update(facts)
        for name, facts in changed.items():
            self._apply(name, facts)

    def _apply(self, name: str, facts: dict[str, Any]) -> None:
        more: dict[str, Any] = {key: value for key, value in facts.items() if type(value) is _KINDS.get(key)}
        self.files[name] = replace(self.files.get(name, FileState()), **more)

    def lock(self) -> bool:
        """Take the lock, until `close`; False: another process has it.  Raises OSError."""
        if self._file is None:
            file = open_plain(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT)
            try:
                lock(file)
                size = os.fstat(file).st_size
                if size:
                    os.lseek(file, size - 1, os.SEEK_SET)
                    if os.read(file, 1) != b"\n":  # a crash cut the last line off
                        os.write(file, b"\n")
            except BlockingIOError:
                os.close(file)
                return False
            except BaseException:
                os.close(file)
                raise
            self._file = file
            self.refresh()
        return True

    def close(self) -> None:
        """Release the lock."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def remove(self) -> None:
        """Remove the file, under the lock, and release that.  Raises OSError."""
        assert self._file is not None
        file, self._file = self._file, None
        remove_locked(self.path, file)

    def begin(self, place: str) -> None:
        """State where the recording goes; what is known about its files is void.  Raises OSError."""
        self._add({"to": place})
        self.place, self.files = place, {}

    def set(self, name: str, **facts: Any) -> FileState:
        """State facts about a file.  Raises OSError."""
        self._add({"file": name} | facts)
        self._apply(name, facts)
        return self.files[name]

    def confirm(self, name: str, now_ns: int) -> None:
        """State that the store has the file.  Raises OSError."""
        self.set(name, upload="", confirmed=utc_text(now_ns))

    def _add(self, facts: dict[str, Any]) -> None:
        assert self._file is not None
        data = json.dumps(facts).encode() + b"\n"
        if os.write(self._file, data) != len(data):
            raise OSError(0, "the disk is full", str(self.path))
        os.fsync(self._file)
        found = os.fstat(self._file)
        self._read = found.st_dev, found.st_ino, found.st_size  # what it has is known: another program does not write


#: Field of `FileState` → its type.
_KINDS: Mapping[str, type] = {each.name: type(each.default) for each in fields(FileState)}


class UploadStates:
    """The states of the recordings of a folder, which may be asked for again and again.

    Args:
        folder: the folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, UploadState] = {}

    def now(self) -> list[UploadState]:
        """Return the states as they are now; only what was added is read."""
        before, self._known = self._known, {}
        for path in sorted(self._folder.glob(f"*{SUFFIX}")):
            base = path.name.removesuffix(SUFFIX)
            if base in before:
                before[base].refresh()
            self._known[base] = before.get(base) or UploadState(self._folder, base)
        return list(self._known.values())


class UploadProtection:
    """Why recordings of a folder are kept until the store has them.

    Args:
        folder: the folder.
        all_files: recordings that no upload was begun for are kept, too.
    """

    def __init__(self, folder: Path, *, all_files: bool) -> None:
        self._all = all_files
        self._found = UploadStates(folder)
        self._states: list[UploadState] = []

    def refresh(self) -> None:
        """Read the states again."""
        self._states = self._found.now()

    def why(self, recording: StoredRecording) -> str:
        """Return why a recording is kept, or ""."""
        states = [state for state in self._states if state.place and belongs(recording.name, state.base)]
        if not states:
            return "the store has not confirmed it" if self._all else ""
        known = [state.files.get(recording.name, FileState()) for state in states]
        confirmed = any(each.confirmed and each.is_of(recording) for each in known)
        return "" if confirmed else "the store has not confirmed it"


def remove_finished(folder: Path, names: set[str]) -> None:
    """Remove the states of recordings of which no file is left; one that is in use stays."""
    for state in UploadStates(folder).now():
        if any(belongs(name, state.base) for name in names) or not state.files:
            continue
        with suppress(OSError):
            if state.lock():
                state.remove()
        state.close()

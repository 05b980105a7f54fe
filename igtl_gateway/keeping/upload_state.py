"""What is known about the upload of a recording: a file beside it, one JSON object a line, only ever extended.

It has the place, and for each file its digest when it was closed, the upload that was begun, and the confirmation.  A
line that was cut off by a crash is not used.  Keys of the store are not in it.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import stat
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.keeping.stored import StoredRecording, open_unlinked
from igtl_gateway.stamp import utc_text
from igtl_gateway.untrusted.text import parse_json

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
        self._load()

    def _load(self) -> None:
        try:
            with closing(open_unlinked(self.path)) as stream:
                lines = stream.read(_MOST_BYTES).splitlines()
        except OSError:
            return
        for line in lines:
            with suppress(DamagedRecording, ValueError):
                found = parse_json(line.decode(), str(self.path))
                if isinstance(found, dict):
                    self._apply(found)

    def _apply(self, facts: dict[str, Any]) -> None:
        if isinstance(place := facts.get("to"), str):
            self.place, self.files = place, {}
        elif isinstance(name := facts.get("file"), str) and belongs(name, self.base):
            usual = FileState()
            more: dict[str, Any] = {
                key: value for key, value in facts.items() if type(value) is type(getattr(usual, key, None))
            }
            self.files[name] = replace(self.files.get(name, usual), **more)

    def lock(self) -> bool:
        """Take the lock, until `close`; False: another process has it.  Raises OSError."""
        if self._file is None:
            flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            file = os.open(self.path, flags, 0o600)
            try:
                if not stat.S_ISREG(os.fstat(file).st_mode):
                    raise OSError(0, "it is not an ordinary file", str(self.path))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                size = os.fstat(file).st_size
                if size and os.pread(file, 1, size - 1) != b"\n":  # a crash cut the last line off
                    os.write(file, b"\n")
            except BlockingIOError:
                os.close(file)
                return False
            except BaseException:
                os.close(file)
                raise
            self._file = file
            self.files = {}
            self._load()
        return True

    def close(self) -> None:
        """Release the lock."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def begin(self, place: str) -> None:
        """State where the recording goes; what is known about its files is void.  Raises OSError."""
        self._add({"to": place})

    def set(self, name: str, **facts: Any) -> FileState:
        """State facts about a file.  Raises OSError."""
        self._add({"file": name} | facts)
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
        self._apply(facts)


def states_in(folder: Path) -> list[UploadState]:
    """Return the states of all recordings of a folder."""
    return [UploadState(folder, path.name.removesuffix(SUFFIX)) for path in sorted(folder.glob(f"*{SUFFIX}"))]


class UploadProtection:
    """Why recordings of a folder are kept until the store has them.

    Args:
        folder: the folder.
        all_files: recordings that no upload was begun for are kept, too.
    """

    def __init__(self, folder: Path, *, all_files: bool) -> None:
        self._folder = folder
        self._all = all_files
        self._states: dict[str, UploadState] = {}

    def refresh(self) -> None:
        """Read the states again."""
        self._states = {state.base: state for state in states_in(self._folder)}

    def why(self, recording: StoredRecording) -> str:
        """Return why a recording is kept, or ""."""
        states = [state for state in self._states.values() if state.place and belongs(recording.name, state.base)]
        if not states:
            return "the store has not confirmed it" if self._all else ""
        known = [state.files.get(recording.name, FileState()) for state in states]
        confirmed = any(each.confirmed and each.is_of(recording) for each in known)
        return "" if confirmed else "the store has not confirmed it"


def remove_finished(folder: Path, names: set[str]) -> None:
    """Remove the states of recordings of which no file is left; one that is in use stays."""
    for state in states_in(folder):
        if any(belongs(name, state.base) for name in names) or not state.files:
            continue
        with suppress(OSError):
            if state.lock():
                state.path.unlink()
        state.close()

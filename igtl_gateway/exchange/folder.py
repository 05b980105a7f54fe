"""The folder that an export writes: new or empty, with file names that the names in a session cannot lead out of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TypeVar

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import GatewayError, UnsupportedRecording
from igtl_gateway.exchange.account import ExportAccount
from igtl_gateway.exchange.recording import IGTL_KINDS, ROS_KINDS, Recording, chosen_entries
from igtl_gateway.session.entry import Entry, Kind

#: Characters of a stream's name that a file's name keeps.
_MAX_NAME = 100


class Folder:
    """The files of an export; see :func:`new_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made: list[Path] = []

    def create(self, name: str) -> BinaryIO:
        """A new file, open for writing.  Raises OSError."""
        path = self.path / name
        stream = path.open("xb")
        self._made.append(path)
        return stream

    def remove(self) -> None:
        """Remove the files that were created."""
        for path in self._made:
            path.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path, account: ExportAccount) -> Iterator[Folder]:
    """A folder for the files of an export: new, or empty.

    After an error, or where the account has no message that was written, it is as it was before.

    Raises UnsupportedRecording where there are files in it, GatewayError where it cannot be made.
    """
    is_new = not path.exists()
    try:
        path.mkdir(exist_ok=True)
        filled = any(path.iterdir())
    except OSError as error:
        raise GatewayError(f"cannot write to {path}: {error.strerror}") from None
    if filled:
        raise UnsupportedRecording(f"{path}: found a folder with files in it, expected a new or an empty one")
    folder, is_whole = Folder(path), False
    try:
        yield folder
        is_whole = any(row.taken for row in account.rows)
    finally:
        if not is_whole:
            folder.remove()
            if is_new:
                with suppress(OSError):
                    path.rmdir()


def file_name(entry: Entry) -> str:
    """Name for the files of an entry's stream: kind, type and device or topic; ASCII letters, digits, _ and -."""
    token = re.sub(r"[^A-Za-z0-9_-]+", "_", entry.channel).strip("_")[:_MAX_NAME]
    return f"{entry.kind.value}.{token or 'unnamed'}"


class FileNames:
    """Gives each stream a file name of its own, also where upper and lower case are the same."""

    def __init__(self) -> None:
        self._names: dict[tuple[Kind, str, str], str] = {}
        self._taken: set[str] = set()
        self._numbers: dict[str, int] = {}

    def of(self, entry: Entry) -> str:
        """Name without suffix; the same for all entries of a stream."""
        key = (entry.kind, entry.channel, entry.type)
        if key not in self._names:
            name = wanted = file_name(entry)
            number = self._numbers.get(wanted.lower(), 1)
            while name.lower() in self._taken:
                number += 1
                name = f"{wanted}_{number}"
            self._numbers[wanted.lower()] = number
            self._taken.add(name.lower())
            self._names[key] = name
        return self._names[key]


Content = TypeVar("Content")


def one_file_each(
    recording: Recording,
    out: Path,
    globs: Sequence[str],
    types: Container[str],
    suffix: str,
    read: Callable[[Entry], Content],
    parts: Callable[[Content], Iterable[Buffer]],
    count: Callable[[Content, Entry, ExportAccount], None] | None = None,
) -> ExportAccount:
    """Write the folder ``out`` with a file for each message of some types.

    Args:
        types: OpenIGTLink and ROS types of the messages.
        suffix: of the files.
        read: the content of a message; an error that it raises is the reason why the message is left out.
        parts: the bytes of a file.
        count: counts in the account the parts of a written message.

    Raises UnsupportedRecording where the folder is not empty; OSError.
    """
    account, names = ExportAccount(), FileNames()
    with new_folder(out, account) as folder:
        for entry in chosen_entries(recording, (*IGTL_KINDS, *ROS_KINDS), globs, account, types):
            row = account.row(entry)
            try:
                content = read(entry)
                buffers = list(parts(content))
            except Exception as error:  # whatever decoding makes of a damaged message costs that message
                row.fail(failure_text(error))
                continue
            with folder.create(f"{names.of(entry)}.{row.declared:06}.{suffix}") as stream:
                stream.writelines(buffers)
            if count is not None:
                count(content, entry, account)
            row.taken += 1
            account.files += 1
    return account


def failure_text(error: Exception) -> str:
    """Why a message is not written: the error's own words where it is ours, else with its type."""
    if isinstance(error, GatewayError | ValueError) and str(error):
        return str(error)
    return f"cannot be decoded: {type(error).__name__}: {error}"

"""The directory that an export writes: new or empty; no stream name in a session can place a file outside it."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TypeVar

from igtl_gateway.addon import failure_text
from igtl_gateway.addon.reading import Buffer, Entry, Kind
from igtl_gateway.addon.writing import open_new, written_folder
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, Channel, Recording, chosen_entries

#: Characters of a stream's name that a file name can contain.
_MAX_NAME = 100


class Folder:
    """The files of an export in a directory; see :func:`new_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def create(self, name: str) -> BinaryIO:
        """Create a file and return it, open for writing.  Raises OSError."""
        return open_new(self.path / name)


@contextmanager
def new_folder(path: Path, account: ExportAccount) -> Iterator[Folder]:
    """Context manager for the directory of an export: a new one, or one that is empty.

    After an error, or if the account has no written message, nothing is written.

    Raises UnsupportedRecording if the directory is not empty, GatewayError if it cannot be created.
    """
    with written_folder(path) as place:
        yield Folder(place)
        if not any(row.taken for row in account.rows):
            shutil.rmtree(place)


def file_name(kind: Kind, channel: str) -> str:
    """Return the file name of a stream: kind, type and device or topic; ASCII letters, digits, _ and -."""
    return f"{kind.value}.{_token(channel)}"


def _token(channel: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", channel).strip("_")[:_MAX_NAME] or "unnamed"


def _is_exact(kind: Kind, channel: str) -> bool:
    """Return whether the file name differs from the name of the stream in slashes only."""
    slashes = 1 if kind in IGTL_KINDS else -1
    return _token(channel) == channel.replace("/", "_", slashes).removeprefix("_")


class FileNames:
    """Assigns a unique file name to each stream, unique also if upper and lower case are equal.

    Args:
        channels: the streams of the recording: who has the name of its file keeps it.
    """

    def __init__(self, channels: Iterable[Channel] = ()) -> None:
        known = {(each.kind, each.stream or each.topic, each.entry_type) for each in channels}
        self._exact = {_token(channel): (kind, channel) for kind, channel, _ in known if _is_exact(kind, channel)}
        self._names: dict[tuple[Kind, str, str], str] = {}
        self._taken: set[str] = set()
        self._numbers: dict[str, int] = {}

    def of(self, entry: Entry) -> str:
        """Return the name without suffix of an entry's stream."""
        return self.of_stream(entry.kind, entry.channel, entry.type)

    def of_stream(self, kind: Kind, channel: str, type_name: str) -> str:
        """Return the name without suffix of a stream."""
        key = (kind, channel, type_name)
        if key not in self._names:
            name = wanted = file_name(kind, channel)
            number = self._numbers.get(wanted.lower(), 1)
            owner = self._exact.get(_token(channel))
            while name.lower() in self._taken or (name == wanted and owner and owner != key[:2] and owner[0] is key[0]):
                number += 1
                name = f"{wanted}_{number}"
            self._numbers[wanted.lower()] = number
            self._taken.add(name.lower())
            self._names[key] = name
        return self._names[key]

    def notes(self, suffix: str) -> Iterator[str]:
        """Yield which stream a file has, for each whose name does not show it: those that would have had one name."""
        several = Counter(_token(channel).lower() for _, channel, _ in self._names)
        for (_, channel, _), name in self._names.items():
            if several[_token(channel).lower()] > 1:
                yield f"{name}{suffix} has {channel}"


Content = TypeVar("Content")


def export_one_file_each(
    recording: Recording,
    out: Path,
    globs: Sequence[str],
    types: Container[str],
    suffix: str,
    read: Callable[[Entry], Content],
    parts: Callable[[Content], Iterable[Buffer]],
    count: Callable[[Content, Entry, ExportAccount], None] | None = None,
    *,
    once: bool = False,
) -> ExportAccount:
    """Write the directory ``out`` with one file for each message of some types.

    Args:
        recording: the session.
        out: a new or empty directory.
        globs: select streams; empty = all.
        types: OpenIGTLink and ROS types of the messages.
        suffix: suffix of the file names.
        read: returns the content of a message; if it raises an error, the message is left out with this reason.
        parts: returns the bytes of a file.
        count: counts the parts of a written message in the account.
        once: leave out the outputs of a written input, which have its content; ``globs`` can select them alone.

    Raises UnsupportedRecording if the directory is not empty; OSError.
    """
    account, names = ExportAccount(), FileNames(recording.channels)
    causes = _Causes()
    with new_folder(out, account) as folder:
        for entry in chosen_entries(
            recording, (*IGTL_KINDS, *ROS_KINDS), globs, account, types, on_input=causes.on_input
        ):
            row = account.row(entry)
            if once and not entry.kind.is_input and causes.written:
                row.leave_out(f"copies of {causes.written}; --streams selects them alone")
                continue
            try:
                content = read(entry)
                buffers = list(parts(content))
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                row.fail(failure_text(error))
                continue
            with folder.create(f"{names.of(entry)}.{row.declared:06}.{suffix}") as stream:
                stream.writelines(buffers)
            if count is not None:
                count(content, entry, account)
            if entry.kind.is_input:
                causes.written = entry.channel
            row.taken += 1
            account.files += 1
    account.notes += names.notes(f".*.{suffix}")
    return account


class _Causes:
    """The input that caused the next outputs.

    Attributes:
        written: its stream, if it is written.
    """

    def __init__(self) -> None:
        self.written = ""

    def on_input(self, _entry: Entry) -> None:
        """Note an input."""
        self.written = ""

"""What exporters need of a session file, and how they choose from it."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import ConversionError, GatewayError, UnsupportedRecording, WireError
from igtl_gateway.exchange.source import Row
from igtl_gateway.globs import matches
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind

IGTL_KINDS = (Kind.IGTL_IN, Kind.IGTL_OUT)
ROS_KINDS = (Kind.ROS_IN, Kind.ROS_OUT)


class Channel(Protocol):
    """A stream of the file; see ``replay.mcap_reader.ChannelSummary``."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def kind(self) -> Kind: ...
    @property
    def qos(self) -> Qos | None: ...


class Recording(Protocol):
    """An open session file; see ``replay.mcap_reader.SessionFile``."""

    @property
    def session(self) -> Mapping[str, str]: ...
    @property
    def channels(self) -> Sequence[Channel]: ...
    @property
    def definitions(self) -> Mapping[str, str]: ...
    def entries(self) -> Iterator[Entry]: ...


@dataclass(slots=True)
class Account:
    """What became of the streams that were asked for.

    Attributes:
        rows: by stream: what the session has, what was written, what was left out and why.
        files: number of files written.
        notes: what else people should know.
    """

    rows: list[Row] = field(default_factory=list)
    files: int = 0
    notes: list[str] = field(default_factory=list)
    _by_stream: dict[tuple[Kind, str, str], Row] = field(default_factory=dict)

    def row(self, entry: Entry) -> Row:
        """The row of an entry's stream, with the entry counted as one that the session has."""
        key = (entry.kind, entry.channel, entry.type)
        row = self._by_stream.get(key)
        if row is None:
            row = self._by_stream[key] = Row(entry.channel, 0, entry.type)
            self.rows.append(row)
        row.declared += 1
        return row


def chosen(recording: Recording, kinds: Iterable[Kind], globs: Sequence[str]) -> Iterator[Entry]:
    """Entries of some kinds whose stream fits a glob, if there is any: ``TYPE/device``, the device alone, or the topic.

    Of a message that went out in several header versions, the first form.
    """
    wanted, fitting = frozenset(kinds), dict[str, bool]()
    sent: set[str] = set()
    for entry in recording.entries():
        if entry.kind.is_input:
            sent = set()
        if entry.kind not in wanted:
            continue
        if entry.channel not in fitting:
            fitting[entry.channel] = fits(entry.channel, entry.kind, globs)
        if not fitting[entry.channel]:
            continue
        if entry.kind is Kind.IGTL_OUT:
            if entry.channel in sent:
                continue
            sent.add(entry.channel)
        yield entry


def fits(channel: str, kind: Kind, globs: Sequence[str]) -> bool:
    """Whether a stream fits a glob, or there is none.  Notes are of no stream and always do."""
    if not globs or not channel:
        return True
    names = (channel, channel.partition("/")[2]) if kind in IGTL_KINDS else (channel,)
    return any(matches(glob, name) for glob in globs for name in names)


def time_of(entry: Entry) -> int:
    """The sender's stamp, or else when it arrived; UTC ns."""
    return entry.source_ns or entry.stamp_ns


def left_out(row: Row, why: str) -> None:
    """Count an entry that is not written."""
    row.left_out += 1
    row.why = row.why or why


def new_folder(path: Path) -> Path:
    """A folder for the files of an export: new, or empty.  Raises UnsupportedRecording."""
    try:
        path.mkdir(exist_ok=True)
        filled = any(path.iterdir())
    except OSError as error:
        raise GatewayError(f"cannot write to {path}: {error.strerror}") from None
    if filled:
        raise UnsupportedRecording(f"{path}: found a folder with files in it, expected a new or an empty one")
    return path


def file_name(entry: Entry) -> str:
    """Name for the files of an entry's stream: kind, type and device or topic."""
    token = re.sub(r"[^A-Za-z0-9_-]+", "_", entry.channel).strip("_")[:100]
    return f"{entry.kind.value}.{token or 'unnamed'}"


class Names:
    """Gives each stream a file name of its own."""

    def __init__(self) -> None:
        self._names: dict[tuple[Kind, str, str], str] = {}

    def of(self, entry: Entry) -> str:
        """Name without suffix; the same for all entries of a stream."""
        key = (entry.kind, entry.channel, entry.type)
        if key not in self._names:
            wanted, number = file_name(entry), 1
            name = wanted
            while name.lower() in (taken.lower() for taken in self._names.values()):
                number += 1
                name = f"{wanted}_{number}"
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
) -> Account:
    """Write the folder ``out`` with a file for each message of some types.

    Args:
        types: OpenIGTLink and ROS types of the messages.
        suffix: of the files.
        read: the content of a message; where it raises WireError, ConversionError or ValueError, that is told instead.
        parts: the bytes of a file.

    Raises UnsupportedRecording where the folder is not empty; OSError.
    """
    account, names, folder = Account(), Names(), new_folder(out)
    for entry in chosen(recording, (*IGTL_KINDS, *ROS_KINDS), globs):
        if entry.type not in types:
            continue
        row = account.row(entry)
        try:
            content = read(entry)
        except (WireError, ConversionError, ValueError) as error:
            row.why = str(error)
            continue
        with (folder / f"{names.of(entry)}.{row.declared:06}.{suffix}").open("xb") as stream:
            stream.writelines(parts(content))
        row.taken += 1
        account.files += 1
    return account

"""The interface of a session file that exporters use, and the selection of its entries."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from hashlib import blake2b
from typing import Protocol

from mcap.records import Attachment, Metadata

from igtl_gateway.addon import WireError, matches
from igtl_gateway.addon.igtl import HEADER_SIZE, ExtendedHeader, Header
from igtl_gateway.addon.reading import Entry, EntryColumns, Kind, Qos, RecordedStamps, SessionFile
from igtl_gateway.addon.writing import Definition
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream

IGTL_KINDS = (Kind.IGTL_IN, Kind.IGTL_OUT)
ROS_KINDS = (Kind.ROS_IN, Kind.ROS_OUT)
_MESSAGES = frozenset({*IGTL_KINDS, *ROS_KINDS})
#: The link that a glob ends with.
_PEER = re.compile(r"@([0-9]{1,9})$")
REPEATED = "the same message in another header version"


class Channel(Protocol):
    """A stream of the file; see ``sessionfile.reader.ChannelSummary``."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def kind(self) -> Kind: ...
    @property
    def stream(self) -> str: ...
    @property
    def entry_type(self) -> str: ...
    @property
    def qos(self) -> Qos | None: ...


class Skipped(Protocol):
    """A channel that cannot be read; see ``sessionfile.reader.SkippedChannel``."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def why(self) -> str: ...


class Recording(Protocol):
    """An open session file; see ``sessionfile.reader.SessionFile``."""

    @property
    def session(self) -> Mapping[str, str]: ...
    @property
    def channels(self) -> Sequence[Channel]: ...
    def prologue(self) -> list[Entry]: ...
    @property
    def definitions(self) -> Mapping[str, str]: ...
    def definition_of(self, ros_type: str) -> Definition | None: ...
    def beside(self) -> Iterator[Attachment | Metadata]: ...
    @property
    def skipped(self) -> Sequence[Skipped]: ...
    def entries(self) -> Iterator[Entry]: ...
    def columns(self) -> Iterator[EntryColumns]: ...
    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]: ...


def chosen_entries(
    recording: Recording,
    kinds: Iterable[Kind],
    globs: Sequence[str],
    account: ExportAccount | None = None,
    types: Container[str] | None = None,
    on_input: Callable[[Entry], None] | None = None,
) -> Iterator[Entry]:
    """Yield the entries of some kinds whose stream matches a glob; see ``matches_stream``.

    Messages have the stamps that the recording states (``RecordedStamps``).  Of a message that was sent in both header
    versions only the first form is yielded; ``account`` counts the second form as left out.

    Args:
        recording: the session.
        kinds: kinds of entries.
        globs: select streams; empty = all.
        account: counts the entries that match a glob but are not yielded.
        types: select message types; None = all.
        on_input: called with each input of the recording, also those that are not selected: the cause of the outputs
            that follow.
    """
    wanted, fitting = frozenset(kinds), dict[tuple[Kind, str, tuple[int, ...]], bool]()
    by_link = names_links(globs)
    forms, stamps = VersionFilter(), RecordedStamps(recording)
    for entry in recording.entries():
        if entry.kind.is_input:
            forms = VersionFilter()
            if on_input is not None:
                on_input(entry)
        if entry.kind not in wanted and (account is None or entry.kind not in _MESSAGES):
            continue
        key = (entry.kind, entry.channel, entry.links if by_link else ())
        if key not in fitting:
            fitting[key] = matches_stream(entry.channel, entry.kind, globs, entry.links)
        if account is not None and not by_link:
            account.senders.see(entry, selected=fitting[key] and entry.kind in wanted)
        if not fitting[key]:
            continue
        if entry.kind not in wanted or (types is not None and entry.type not in types):
            if account is not None:
                account.others[entry.type] = account.others.get(entry.type, 0) + 1
            continue
        if entry.kind is Kind.IGTL_OUT and forms.repeat(entry):
            if account is not None:
                account.row(entry).leave_out(REPEATED)
            continue
        yield stamps.entry(entry)


def count_skipped(recording: Recording, globs: Sequence[str], account: ExportAccount) -> None:
    """Count as left out the channels of the file that cannot be read, such as those with an encoding other than CDR."""
    for channel in recording.skipped:
        if channel.count and matches_stream(channel.topic, Kind.ROS_IN, globs):
            row = ExportedStream(channel.topic, channel.count, channel.type)
            row.leave_out(channel.why, channel.count)
            account.rows.append(row)


class VersionFilter:
    """The messages that one input caused, to find those that were sent in both header versions."""

    def __init__(self) -> None:
        self._first: dict[str, Entry] = {}
        self._versions: dict[tuple[str, int, bytes], set[int]] = {}

    def repeat(self, entry: Entry) -> bool:
        """Return whether a message with this device, stamp and content was sent before in the other header version."""
        first = self._first.setdefault(entry.channel, entry)
        if first is entry:
            return False  # most inputs cause one message, which needs no comparison
        self._note(first)
        return len(self._note(entry)) > 1

    def _note(self, entry: Entry) -> set[int]:
        """Add a message; return the header versions in which it was sent so far."""
        data = memoryview(entry.data())
        try:
            header, body = Header.unpack(data), data[HEADER_SIZE:]
            content = ExtendedHeader.unpack(body).split(body)[0] if header.version > 1 else body
        except WireError:
            return set()  # a damaged message is not a second form of another one
        key = entry.channel, header.ticks, blake2b(content).digest()
        versions = self._versions.setdefault(key, set())
        versions.add(header.version)
        return versions


def matches_stream(channel: str, kind: Kind, globs: Sequence[str], links: Sequence[int] = ()) -> bool:
    """Return whether a stream matches a glob, or there are no globs.  Notes have no stream and always match.

    A glob is one of ``TYPE/device``, of the device or of the topic.  ``in:`` or ``out:`` before it selects what was
    received or sent, ``@N`` behind it what came from link N or went there.
    """
    if not globs or not channel:
        return True
    names = (channel, channel.partition("/")[2]) if kind in IGTL_KINDS else (channel,)
    return any(_fits(glob, name, kind, links) for glob in globs for name in names)


def sides_without_match(file: SessionFile, globs: Sequence[str]) -> list[str]:
    """Return the globs with a side or a link whose stream is recorded, but not on this side or by this link."""
    sided = [glob for glob in globs if bare_glob(glob) != glob]
    if not sided:
        return []
    none: tuple[int, ...] = ()
    streams = {(each.kind, each.stream or each.topic, none) for each in file.channels if each.count}
    if any(_PEER.search(glob) for glob in sided):
        streams |= {(each.kind, each.channel, each.links) for each in file.entries_of_kinds(IGTL_KINDS) if each.channel}
    return [
        glob
        for glob in sided
        if any(matches_stream(channel, kind, [bare_glob(glob)]) for kind, channel, _ in streams)
        and not any(matches_stream(channel, kind, [glob], links) for kind, channel, links in streams)
    ]


def names_links(globs: Sequence[str]) -> bool:
    """Return whether a glob selects what came from a link or went there."""
    return any(_PEER.search(glob) for glob in globs)


def bare_glob(glob: str) -> str:
    """Return a glob without the side before it and the link behind it."""
    side, colon, rest = _PEER.sub("", glob).partition(":")
    return rest if colon and side in ("in", "out") else _PEER.sub("", glob)


def _fits(glob: str, name: str, kind: Kind, links: Sequence[int]) -> bool:
    if matches(glob, name):
        return True
    if (peer := _PEER.search(glob)) and int(peer[1]) in links:
        glob = glob[: peer.start()]
    side, colon, rest = glob.partition(":")
    if colon and side in ("in", "out"):
        return kind.value.endswith(f"_{side}") and matches(rest, name)
    return peer is not None and matches(glob, name)


def message_time_ns(entry: Entry) -> int:
    """Return the source stamp of an entry, or its gateway time if that is unset; UTC ns."""
    return entry.source_ns or entry.stamp_ns

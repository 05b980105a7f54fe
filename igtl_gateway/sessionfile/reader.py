"""A session file being read: MCAP in, entries out, as ``docs/session-log.md`` says.

A file is either read right or refused: checksums are verified of the index, of our metadata and of every chunk,
and whatever the library below raises on damaged bytes leaves here as DamagedRecording.  MCAP files without our
metadata ("foreign", such as rosbag2 recordings) are read as what ROS nodes said.

Memory is bounded: a few chunks at a time, as long as chunks do not overlap in time, which ours never do.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Collection, Generator, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO

from mcap.records import Channel, Schema

from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.sessionfile import facts, layout, migrations, records
from igtl_gateway.sessionfile.chunks import Row, message_rows
from igtl_gateway.sessionfile.index import ChunkEntry, Index, RecordPlace, read_index, recover_hint
from igtl_gateway.sessionfile.layout import LayoutError
from igtl_gateway.sessionfile.lookup import LatchedStateRule, look_up
from igtl_gateway.sessionfile.records import HEAD, Malformed
from igtl_gateway.untrusted import files, limits
from igtl_gateway.untrusted.shape import digits

SEQUENCES = 1 << 32  # MCAP's sequence has 32 bits, entry numbers have no bound
#: A message is large that has at least this part of its chunk: it is not copied.
_LARGE_PART = 4
_ROS_TYPE = re.compile(r"\w+/msg/\w+", re.ASCII)

Decode = Callable[[Row, int], Entry]

_ALL_KINDS = frozenset(Kind)
#: What stands for inputs that are not wanted.
_UNWANTED = {kind: Entry(0, 0, kind) for kind in Kind if kind.is_input}

_UNREAD = _UNWANTED[Kind.EDGE_NOTE]


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """A channel of the file.

    Attributes:
        topic: its topic in the file.
        type: ROS message type in the file; ours for OpenIGTLink and notes.
        kind: kind of its entries.
        stream: the channel of its entries: the topic of ROS messages, ``TYPE/device name`` of OpenIGTLink; ``""``
            where streams share the channel, and for notes.
        count: messages.
        qos: as recorded; None where the file does not say.
    """

    topic: str
    type: str
    kind: Kind
    stream: str
    count: int
    qos: Qos | None


@dataclass(frozen=True, slots=True)
class SkippedChannel:
    """A channel that is not read, and why."""

    topic: str
    type: str
    count: int
    why: str


@dataclass(frozen=True, slots=True)
class PartSummary:
    """A file of a split recording: its size in bytes, its entries, UTC ns of the first and the last one (0: none)."""

    path: Path
    size: int
    entries: int
    start_ns: int
    end_ns: int


class SessionFile:
    """An open session file; a context manager.  Use :meth:`open`.

    Attributes:
        path: the file.
        session: what the recording says of itself; empty for foreign files.
        format_version: version of ``docs/session-log.md`` that it follows.
        ledger: what became of every message; None where the recording has none.
        foreign: not a recording of ours: every message is a ROS_IN entry, numbered as read.
        channels: what is in it.
        skipped: what is in it but is not read.
        definitions: ROS type → definition with all that it needs, where the file has one.
        entry_count: entries that :meth:`entries` gives.
        start_ns, end_ns: UTC nanoseconds of the first and the last one; 0 in an empty file.
        parts: the files of a split recording, in order; empty for a file.
    """

    parts: tuple[PartSummary, ...] = ()

    def __init__(self, path: Path, stream: IO[bytes]) -> None:
        self.path = path
        self._stream = stream
        self._index = index = read_index(path, stream)
        session = self._metadata(index, layout.SESSION_METADATA)
        ledger = self._metadata(index, layout.LEDGER_METADATA)
        self.format_version = format_version(path, session)
        facts.check_session(session or {}, str(path))
        try:
            self.session = migrations.session(self.format_version, session or {})
        except UnsupportedRecording as error:
            raise UnsupportedRecording(f"{path}: {error}") from None
        self.ledger = None if ledger is None else facts.ledger(ledger.get(layout.LEDGER_KEY, ""), str(path))
        marked = any(layout.KIND_KEY in channel.metadata for channel in index.channels.values())
        self.foreign = session is None and not marked
        self._decoders: dict[int, Decode] = {}
        self._streams: dict[int, tuple[Kind, str, str]] = {}  # kind, channel and type of a channel's entries
        self._known = frozenset(index.channels)
        told: list[ChannelSummary | SkippedChannel] = []
        for channel in index.channels.values():
            schema = index.schemas.get(channel.schema_id) if channel.schema_id else None
            if channel.schema_id and schema is None:
                raise self._damaged(f"channel {channel.topic}", f"found schema {channel.schema_id}, which is not there")
            told.append(self._open_channel(channel, schema, index.counts.get(channel.id, 0)))
        if unknown := index.counts.keys() - self._known:
            raise self._damaged("index", f"found messages of channel {min(unknown)}, of which there is no record")
        self.channels = tuple(channel for channel in told if isinstance(channel, ChannelSummary))
        self.skipped = tuple(channel for channel in told if isinstance(channel, SkippedChannel))
        self.definitions = {
            schema.name: schema.data.decode("utf-8", "replace")
            for schema in index.schemas.values()
            if schema.encoding == layout.SCHEMA_ENCODING
        }
        self.entry_count = sum(channel.count for channel in self.channels)
        self.start_ns, self.end_ns = index.start_ns, index.end_ns

    @classmethod
    def open(cls, path: Path | str) -> SessionFile:
        """Open a file, or the folder of a split recording, and read what it says of itself.

        The entries are read by :meth:`entries`.

        Raises UnsupportedRecording (no such file, not MCAP, of a newer version …) or DamagedRecording.
        """
        path = Path(path)
        if path.is_dir():
            return SessionParts(path)
        stream = files.open_file(path)
        try:
            return cls(path, stream)
        except BaseException:
            stream.close()
            raise

    def close(self) -> None:
        """Close the file.  Payloads that were read stay valid."""
        self._stream.close()

    def __enter__(self) -> SessionFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def entries(self) -> Iterator[Entry]:
        """All entries in their order.  Payloads are one buffer each, views of OpenIGTLink messages.

        Raises DamagedRecording where the file turns out to be damaged; what came before is right.
        """
        return migrations.entries(self.format_version, self._entries())

    def entries_of(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """The entries of these kinds; what other inputs there are is told by entries without number and content.

        Other outputs may be there or not.  Chunks that hold none of the kinds are not unpacked.  Raises as `entries`.
        """
        if self.foreign or self.format_version != layout.FORMAT_VERSION:
            yield from self.entries()
            return
        count = yield from self._numbered(self._rows(kinds=kinds), 0, kinds)
        self._check_count(count, sum(channel.count for channel in self.channels if channel.kind in kinds))

    def entries_from(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """The entries from ``start_ns`` (UTC) on, before them at least those that the latched state there follows from.

        Looked up by the index where there is one that tells; else all entries.  Raises DamagedRecording where what is
        read turns out to be damaged.
        """
        found = None
        # of streams that share a channel only the messages themselves tell which is which
        told = all(
            channel.stream or channel.kind not in layout.WIRE_TOPICS for channel in self.channels if channel.count
        )
        if told and self.format_version == layout.FORMAT_VERSION:
            found = look_up(self._stream, self._index, start_ns, self._streams, rule, counted=self.foreign)
        state: list[Entry] = []
        try:
            for message, before in found.messages if found else ():
                seq = before + 1 if self.foreign else _next(state[-1].seq if state else 0, message.sequence)
                row = (message.channel_id, message.sequence, message.log_time, message.publish_time, 0)
                entry = self._decoders[message.channel_id]((*row, len(message.data), message.data), seq)
                if entry.channel and self._streams[message.channel_id] != (entry.kind, entry.channel, entry.type):
                    found = None
                    break
                state.append(entry)
        except LayoutError:
            found = None
        if found is None:
            yield from self.entries()
            return
        yield from state
        if found.rest_ns is not None:
            seq = found.count if self.foreign else state[-1].seq if state else 0
            yield from self._numbered(self._rows(found.rest_ns), seq)

    def prologue(self) -> list[Entry]:
        """Inputs before the first entry, which the gateway's state follows from; for files that begin midway.

        Raises DamagedRecording.
        """
        place = next((each for each in self._index.attachments if each.name == layout.PROLOGUE_ATTACHMENT), None)
        if place is None:
            return []
        content = self._record(records.ATTACHMENT, place, "prologue")
        try:
            attachment, covered = records.parse_attachment(content)
            if zlib.crc32(content[:covered]) != int.from_bytes(content[covered : covered + 4], "little"):
                raise Malformed("its checksum is wrong")
        except Malformed as error:
            raise self._damaged("prologue", error) from None
        entries, size = [], 0
        most = limits.current_limits().unpacked(len(attachment.data))
        for entry in SessionFile(self.path, BytesIO(attachment.data)).entries():
            entries.append(entry)
            size += entry.size
            limits.check_limit("count", len(entries), f"{self.path}: prologue")
            limits.check_limit("ratio", size, f"{self.path}: prologue", most)
        return entries

    def _entries(self) -> Iterator[Entry]:
        count = yield from self._numbered(self._rows(), 0)
        self._check_count(count, self.entry_count)

    def _check_count(self, found: int, expected: int) -> None:
        if found != expected:
            raise DamagedRecording(f"{self.path}: found {found} entries, expected {expected}{recover_hint(self.path)}")

    def _numbered(
        self, rows: Iterator[list[Row] | None], seq: int, kinds: Collection[Kind] = _ALL_KINDS
    ) -> Generator[Entry, None, int]:
        """The entries in messages; ``seq`` is the number of one before them, or 0.  For the rest see `entries_of`.

        Returns how many there were, without those that are not of the kinds.
        """
        foreign = self.foreign
        decoders: dict[int, Decode | None] = {
            number: self._decoders[number] if kind in kinds else None for number, (kind, _, _) in self._streams.items()
        }
        unwanted = {
            number: _UNWANTED[kind]
            for number, (kind, _, _) in self._streams.items()
            if kind not in kinds and kind.is_input
        }
        first, count = True, 0
        for some in rows:
            if some is None:
                yield _UNREAD
                continue
            for row in some:
                channel, sequence = row[0], row[1]
                if channel not in decoders:
                    continue
                number = seq + 1
                if sequence != number and not foreign:
                    number = seq + (sequence - seq) % SEQUENCES
                    # what comes before the first one may have been left out
                    if number == seq or (number - seq >= SEQUENCES // 2 and not first):
                        raise DamagedRecording(
                            f"{self.path}: found entry number {sequence}, expected one above {seq % SEQUENCES}"
                            f"{recover_hint(self.path)}"
                        )
                seq, first = number, False
                decode = decoders[channel]
                if decode is None:
                    if channel in unwanted:
                        yield unwanted[channel]
                    continue
                try:
                    entry = decode(row, seq)
                except LayoutError as error:
                    raise DamagedRecording(f"{self.path}: entry {seq}: {error}{recover_hint(self.path)}") from None
                count += 1
                yield entry
        return count

    def _rows(self, from_ns: int = 0, kinds: Collection[Kind] = _ALL_KINDS) -> Iterator[list[Row] | None]:
        """All messages (from a moment on) in order, in lists.

        A chunk that holds nothing of these kinds is passed over: None if there are inputs in it, else nothing.
        """
        wanted = {number for number, (kind, _, _) in self._streams.items() if kind in kinds}
        inputs = {number for number, (kind, _, _) in self._streams.items() if kind.is_input}

        def is_wanted(chunk: ChunkEntry) -> bool:
            # without an index of its messages, a chunk may hold any
            return not chunk.places or not wanted.isdisjoint(chunk.channels)

        try:
            for chunk, rows in message_rows(self._stream, self._index, str(self.path), from_ns, is_wanted):
                if rows is not None:
                    unknown = {row[0] for row in rows} - self._known
                    if unknown:
                        raise Malformed(f"found a message of channel {min(unknown)}, of which there is no record")
                    yield rows
                elif chunk and not inputs.isdisjoint(chunk.channels):
                    yield None
        except Malformed as error:
            raise self._damaged("entries", error) from None
        except OSError as error:
            raise DamagedRecording(f"{self.path}: cannot be read: {error.strerror}") from None

    # -- opening ----------------------------------------------------------------------------------------------

    def _damaged(self, what: str, why: object) -> DamagedRecording:
        return DamagedRecording(f"{self.path}: {what}: {why}{recover_hint(self.path)}")

    def _record(self, opcode: int, place: RecordPlace, what: str) -> bytes:
        """The content of a record that the index names.  Raises DamagedRecording, LimitExceeded."""
        if place.at + place.length > self._index.size or place.length < HEAD.size:
            raise self._damaged(what, f"found {place.length} bytes at {place.at}, which the file does not have")
        limits.check_limit("memory", place.length, f"{self.path}: {what}")
        try:
            self._stream.seek(place.at)
            data = self._stream.read(place.length)
        except OSError as error:
            raise DamagedRecording(f"{self.path}: cannot be read: {error.strerror}") from None
        if HEAD.unpack_from(data) != (opcode, place.length - HEAD.size):
            raise self._damaged(what, f"found {data[: HEAD.size].hex(' ')} at {place.at}, expected the record")
        return data[HEAD.size :]

    def _metadata(self, index: Index, name: str) -> dict[str, str] | None:
        """Items of the first metadata record of that name, checked; None if there is none."""
        # by the index, which is under a checksum: a damaged name must not make the record disappear
        place = next((each for each in index.metadata if each.name == name), None)
        if place is None:
            return None
        what = f"metadata {name}"
        limits.check_limit("free", 8 * place.length, f"{self.path}: {what}")
        try:
            record = records.parse_metadata(self._record(records.METADATA, place, what))
            if record.name != name:
                raise Malformed(f"found the name {record.name!r}")
            return layout.unseal(record.metadata)
        except (Malformed, LayoutError) as error:
            raise self._damaged(what, error) from None

    def _open_channel(self, channel: Channel, schema: Schema | None, count: int) -> ChannelSummary | SkippedChannel:
        """Settle how a channel is read, or why it is not."""
        ros_type = schema.name if schema else ""
        kind, why = kind_of(channel, schema, self.foreign)
        if kind is None:
            return SkippedChannel(channel.topic, ros_type, count, why)
        self._decoders[channel.id] = decoder(kind, channel.topic, ros_type)
        stream = channel.metadata.get(layout.STREAM_KEY, "")
        stream = channel.topic if kind in layout.ROS_KINDS else layout.unescape(stream)
        entry_type = ros_type if kind in layout.ROS_KINDS else stream.partition("/")[0]
        self._streams[channel.id] = kind, stream, entry_type
        qos = layout.parse_qos_yaml(channel.metadata.get(layout.QOS_KEY, ""))
        return ChannelSummary(channel.topic, ros_type, kind, stream, count, qos)


class SessionParts(SessionFile):
    """The parts of a split recording as one session; see :meth:`SessionFile.open`.  One part is open at a time."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        found: dict[int, PartSummary] = {}
        channels: dict[tuple[str, str, Kind, str], ChannelSummary] = {}
        skipped: list[SkippedChannel] = []
        self.definitions = {}
        self.entry_count = self.start_ns = self.end_ns = 0
        for path in sorted(folder.glob("*.mcap")):
            with SessionFile.open(path) as part:
                number = part.session.get(layout.PART_KEY, "")
                if not (number.isascii() and number.isdigit()):
                    raise UnsupportedRecording(
                        f"{folder}: found a directory with {path.name}, expected parts of a split recording; "
                        "name the .mcap file in it"
                    )
                size = path.stat().st_size
                found[int(number)] = PartSummary(path, size, part.entry_count, part.start_ns, part.end_ns)
                for channel in part.channels:
                    key = (channel.topic, channel.type, channel.kind, channel.stream)
                    count = channels[key].count if key in channels else 0
                    channels[key] = replace(channel, count=channel.count + count)
                skipped += part.skipped
                self.definitions |= part.definitions
                self.entry_count += part.entry_count
        if not found:
            raise UnsupportedRecording(f"{folder}: found a directory, expected the .mcap file in it")
        missing = next((number for number in range(max(found) + 1) if number not in found), None)
        if missing is not None:
            raise DamagedRecording(f"{folder}: part {missing} of the recording is missing")
        self.parts = tuple(found[number] for number in sorted(found))
        with SessionFile.open(self.parts[0].path) as first, SessionFile.open(self.parts[-1].path) as last:
            own = (layout.PART_KEY, layout.PREVIOUS_KEY)
            self.session = {key: value for key, value in first.session.items() if key not in own}
            self.format_version = first.format_version
            self.ledger = last.ledger
        full = [part for part in self.parts if part.entries]
        if full:
            self.start_ns, self.end_ns = full[0].start_ns, full[-1].end_ns
        self.foreign = False
        self.channels, self.skipped = tuple(channels.values()), tuple(skipped)

    def close(self) -> None:
        """Nothing is open."""

    def entries(self) -> Iterator[Entry]:
        """All entries of all parts; as SessionFile.entries."""
        return self._of_parts(SessionFile.entries)

    def entries_of(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """As SessionFile.entries_of."""
        return self._of_parts(lambda part: part.entries_of(kinds))

    def entries_from(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """As SessionFile.entries_from."""
        return self._of_parts(lambda part: part.entries_from(start_ns, rule))

    def _of_parts(self, entries: Callable[[SessionFile], Iterator[Entry]]) -> Iterator[Entry]:
        seq = 0
        for each in self.parts:
            with SessionFile.open(each.path) as part:
                for entry in entries(part):
                    if entry.seq:
                        if entry.seq <= seq:
                            raise DamagedRecording(
                                f"{each.path}: found entry number {entry.seq}, expected one above {seq}"
                            )
                        seq = entry.seq
                    yield entry

    def prologue(self) -> list[Entry]:
        """Nothing: it begins at the beginning."""
        return []


def _next(seq: int, sequence: int) -> int:
    """The entry number behind ``seq`` that MCAP's ``sequence`` is short for; ``seq`` itself if it repeats."""
    return seq + (sequence - seq) % SEQUENCES


_KINDS = {kind.value: kind for kind in Kind}


def format_version(path: Path, session: dict[str, str] | None) -> int:
    """The version that a file has by its session metadata; raises if that is none, or newer than this reader."""
    if session is None:
        return layout.FORMAT_VERSION
    text = session.get(layout.FORMAT_VERSION_KEY, "")
    digits(text, f"{path}: format version")
    if int(text) > layout.FORMAT_VERSION:
        raise UnsupportedRecording(
            f"{path}: found format version {text}, expected at most {layout.FORMAT_VERSION}; "
            "read it with a newer igtl-gateway"
        )
    return int(text)


def kind_of(channel: Channel, schema: Schema | None, foreign: bool) -> tuple[Kind | None, str]:
    """Kind of a channel's entries; or None and why it cannot be read."""
    if channel.message_encoding != layout.MESSAGE_ENCODING:
        return None, f"found encoding {channel.message_encoding!r}, expected {layout.MESSAGE_ENCODING!r}"
    if schema is None or not _ROS_TYPE.fullmatch(schema.name):
        return None, f"found type {schema.name if schema else ''!r}, expected package/msg/Name"
    if b"\n---" in schema.data:
        return None, "a service, not a topic"
    if foreign:
        return Kind.ROS_IN, ""
    name = channel.metadata.get(layout.KIND_KEY, "")
    if name not in _KINDS:
        return None, f"found kind {name!r}: not written by the gateway"
    kind = _KINDS[name]
    expected = layout.type_of(kind)
    if expected and schema.name != expected:
        return None, f"found type {schema.name!r}, expected {expected!r}"
    return kind, ""


def decoder(kind: Kind, topic: str, ros_type: str) -> Decode:
    """What makes entries of a channel's messages and their entry numbers; it raises LayoutError."""
    if kind in layout.WIRE_TOPICS:
        return _raw_decoder()
    if kind in layout.NOTE_KINDS:
        return lambda row, seq: layout.unpack_note(row[6][row[4] : row[5]], seq, row[2])

    def ros(row: Row, seq: int) -> Entry:
        _, _, log_ns, publish_ns, start, end, data = row
        # MCAP says publish_time = log_time for "not set"
        source_ns = publish_ns if publish_ns != log_ns else 0
        return Entry(seq, log_ns, kind, topic, ros_type, (data[start:end],), (), source_ns)

    return ros


def _raw_decoder() -> Decode:
    """What makes entries of OpenIGTLink messages."""
    unpack = layout.RawUnpacker()

    def raw(row: Row, seq: int) -> Entry:
        _, _, log_ns, publish_ns, start, end, data = row
        # a small part of a chunk must not keep all of it
        large = (end - start) * _LARGE_PART >= len(data)
        return unpack(memoryview(data) if large else data, seq, log_ns, publish_ns, start, end)

    return raw

"""Reading a session file: MCAP in, entries out, as ``docs/reference/session-log.md`` specifies.

A file is either read correctly or refused: the checksums of the index, of our metadata and of every chunk are verified;
damage raises DamagedRecording.  MCAP files without our metadata ("foreign", such as rosbag2 recordings) are read as
messages from ROS.

Memory is bounded: a few chunks at a time, as long as chunks do not overlap in time; those of our writer never do.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema

from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import facts, layout, migrations, records
from igtl_gateway.record.sessionfile.bulk import ChunkReader, MessageBlock, Unusable, blocks_of_entries
from igtl_gateway.record.sessionfile.channels import (
    SEQUENCES,
    ChannelSummary,
    Decode,
    SkippedChannel,
    decoder,
    is_marked,
    joined,
    kind_of,
    next_seq,
)
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row, channels_of
from igtl_gateway.record.sessionfile.columns import END_NS, ColumnsReader, EntryColumns, Stream, Unfit, mask_of
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.definition import Definition, FileDefinitions, another_definition
from igtl_gateway.record.sessionfile.derived import DerivedOutputs, is_digested, output_channel
from igtl_gateway.record.sessionfile.index import read_index, read_record, recover_hint
from igtl_gateway.record.sessionfile.index_check import damaged_indexes
from igtl_gateway.record.sessionfile.large_outputs import DIGEST_NAME, digest_decoder
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.lookup import LatchedStateRule, Numbers, chunk_times, look_up
from igtl_gateway.record.sessionfile.merged import MERGE_METADATA, Definitions, Merge, extract_part, parse_merge
from igtl_gateway.record.sessionfile.order import message_columns, message_rows
from igtl_gateway.record.sessionfile.records import Malformed
from igtl_gateway.record.sessionfile.side_file import part_files

_ALL_KINDS = frozenset(Kind)
#: What stands for inputs that are not wanted.
_UNWANTED = {kind: Entry(0, 0, kind) for kind in Kind if kind.is_input}
_UNREAD = _UNWANTED[Kind.EDGE_NOTE]
#: Parts of a split recording that stay open.
_PARTS_OPEN = 4
#: After all times: of :meth:`SessionFile.blocks`.
_END_NS = (1 << 63) - 1


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
        size: bytes of it.
        session: the session metadata; empty for foreign files.
        format_version: version of ``docs/reference/session-log.md`` that it follows.
        ledger: the fate of every message; None where the recording has none.
        foreign: not a recording of the gateway: every message is a ROS_IN entry, numbered as read.
        channels: what is in it.
        skipped: what is in it but is not read.
        recorded_session, recorded_ledger: the items of both metadata records, as they are; empty without one.
        merge: of a merged session, which is foreign: what its parts are, and the offsets of their clocks.
        definitions: ROS type → definition with all that it needs, where the file has one.
        entry_count: entries that :meth:`entries` returns.
        start_ns, end_ns: UTC nanoseconds of the first and the last one; 0 in an empty file.
        parts: the files of a split recording, in order; empty for a file.
        missing_parts: first and last number of each row of parts before the last one that are not in its folder.
    """

    parts: tuple[PartSummary, ...] = ()
    missing_parts: tuple[tuple[int, int], ...] = ()

    def __init__(self, path: Path, stream: IO[bytes]) -> None:
        self.path = path
        self._stream = stream
        self._stored_index = self._index = index = read_index(path, stream)
        self.size = index.size
        session = self._metadata(layout.SESSION_METADATA)
        ledger = self._metadata(layout.LEDGER_METADATA)
        self.recorded_session, self.recorded_ledger = session or {}, ledger or {}
        self.format_version, self.session = migrations.read_session(path, session)
        digested = [channel for channel in index.channels.values() if is_digested(channel)]
        if digested:  # readers get the outputs
            for name in {channel.metadata[layout.DIGEST_KEY] for channel in digested} - {DIGEST_NAME}:
                raise UnsupportedRecording(f"{path}: found digests {name!r}, expected {DIGEST_NAME!r}")
            schemas = dict(index.schemas)
            outputs = {channel.id: output_channel(channel, schemas) for channel in digested}
            self._index = index = replace(index, schemas=schemas, channels=index.channels | outputs)
        merge = self._metadata(MERGE_METADATA)
        self.merge: Merge | None = None if merge is None else parse_merge(merge, str(path))
        self.ledger = None if ledger is None else facts.ledger(ledger.get(layout.LEDGER_KEY, ""), str(path))
        self.foreign = session is None and not any(map(is_marked, index.channels.values()))
        self._chunks = ChunkReader(stream, index, str(path))
        self._decoders: dict[int, Decode] = {}
        self._streams: dict[int, tuple[Kind, str, str]] = {}  # kind, channel and type of a channel's entries
        self._known = frozenset(index.channels)
        if unknown := index.counts.keys() - self._known:
            raise self._damaged("index", f"found messages of channel {min(unknown)}, of which there is no record")
        self._definitions = FileDefinitions()
        # those of messages before those of channels without any
        by_count = sorted(index.channels.values(), key=lambda channel: not index.counts.get(channel.id, 0))
        self._undecodable = {channel.id for channel in by_count if not self._takes_definition(channel)}
        found = [self._open_channel(channel) for channel in index.channels.values()]
        kinds = {channel.id: self._streams[channel.id][0] for channel in digested if channel.id in self._streams}
        self._digest_decoders = {each.id: digest_decoder(each, kinds[each.id]) for each in digested if each.id in kinds}
        self._derived: DerivedOutputs | None = None
        if kinds and not self.foreign:
            self._derived = self._chunks.derived = DerivedOutputs(
                str(path), stream, index, kinds, self._streams, self._decoders, self.session, self.prologue
            )
        self.channels = joined(channel for channel in found if isinstance(channel, ChannelSummary))
        self.skipped = tuple(channel for channel in found if isinstance(channel, SkippedChannel))
        self.definitions = self._definitions.texts()
        self.entry_count = sum(channel.count for channel in self.channels)
        self.start_ns, self.end_ns = index.start_ns, index.end_ns

    @classmethod
    def open(cls, path: Path | str, *, incomplete: bool = False) -> SessionFile:
        """Open a file, the folder of a split recording, or a part of a merged session (``FILE/NAME``), and read all but
        its entries.

        Args:
            path: its place.
            incomplete: parts may be missing between others of a split recording.

        Raises UnsupportedRecording (no such file, not MCAP, of a newer version …) or DamagedRecording.
        """
        path = Path(path)
        if path.is_dir():
            return SessionParts(path, incomplete=incomplete)
        stream: IO[bytes]
        if path.parent.is_file():
            stream = TemporaryFile()
            with SessionFile.open(path.parent) as merged:
                merged.extract(path.name, stream)
        else:
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

    def entries(self, *, computed: bool = True) -> Iterator[Entry]:
        """All entries in their order.  Payloads are one buffer each, views of OpenIGTLink messages.

        Args:
            computed: outputs of which the file has the digest are computed; else they are `DigestedOutput`.

        Raises DamagedRecording where the file turns out to be damaged; the entries before that are right.
        """
        return migrations.entries(self.format_version, self._entries(computed))

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """The entries of these kinds; entries without number and content stand for the other inputs.

        Other outputs may be there or not.  Chunks that hold none of the kinds are not unpacked.  Raises as `entries`.
        """
        if self.foreign or self.format_version not in layout.PRESENT_VERSIONS:
            yield from self.entries()
            return
        count = yield from self._numbered(self._rows(kinds=kinds), 0, kinds)
        self._check_count(count, sum(channel.count for channel in self.channels if channel.kind in kinds))

    def entries_with_state(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """The entries from ``start_ns`` (UTC) on, before them at least those that the latched state there follows from.

        The index locates them if it is usable; if not, this returns all entries.  Raises DamagedRecording where the
        read part of the file turns out to be damaged.
        """
        state, rest_ns, seq = self._looked_up(start_ns, rule)
        if seq is None:
            yield from self.entries()
            return
        yield from state
        if rest_ns is not None:
            yield from self._numbered(self._rows(rest_ns), seq)

    def entries_starting_at(self, start_ns: int, seq: int = 0) -> Iterator[Entry]:
        """The entries from ``start_ns`` (UTC) on; what comes before is not read.  Raises as `entries`.

        Args:
            seq: number of an earlier entry, from which the 32 bits that the file has of each number are extended.
        """
        if self.foreign or self.format_version not in layout.PRESENT_VERSIONS:
            return (entry for entry in self.entries() if entry.stamp_ns >= start_ns)
        return self._numbered(self._rows(start_ns), seq)

    def blocks(self, channel: ChannelSummary, start_ns: int = 0, end_ns: int = _END_NS) -> Iterator[MessageBlock]:
        """The messages of one of ``channels`` in blocks of arrays, from ``start_ns`` on and before ``end_ns`` (UTC).

        Only chunks with these messages are read, if the file has an index.  Raises as `entries`.
        """
        is_wire = channel.kind in layout.WIRE_TOPICS
        whole = start_ns <= self.start_ns and end_ns > self.end_ns
        numbers = self._numbers_of(channel)
        if self.format_version in layout.PRESENT_VERSIONS and channel.kind not in layout.NOTE_KINDS:
            try:
                with self._damage_in(f"entries of {channel.stream or channel.topic}"):
                    blocks = self._chunks.blocks(numbers, start_ns, end_ns, whole=whole, is_wire=is_wire)
                    yield from (
                        replace(block, numbers=0 * block.numbers) if self.foreign else block for block in blocks
                    )
                return
            except Unusable:
                pass
        named = {each.stream for each in self.channels if each.kind is channel.kind}
        yield from blocks_of_entries(
            entry
            for entry in self.entries_starting_at(start_ns)
            if entry.kind is channel.kind
            and entry.stamp_ns < end_ns
            and (entry.channel == channel.stream or (not channel.stream and entry.channel not in named))
            and (is_wire or entry.type == channel.type)
        )

    def columns(
        self,
        start_ns: int = 0,
        end_ns: int = END_NS,
        wanted: Callable[[Stream], bool] = lambda _: True,
        *,
        computed: bool = True,
    ) -> Iterator[EntryColumns]:
        """The entries of the wanted streams in columns, from ``start_ns`` on and before ``end_ns`` (UTC).

        ``computed``: as of `entries`; of outputs that are not, the payload is the digest.  Chunks outside of the times
        are not read, and those that hold none of the streams are not unpacked.  Raises
        `Unfit` at the call where only `entries` can read the file; then as `entries`, but payloads are not looked into.
        """
        if self.format_version not in layout.PRESENT_VERSIONS:
            raise Unfit
        return self._columns(start_ns, end_ns, wanted, computed)

    def _columns(
        self, start_ns: int, end_ns: int, wanted: Callable[[Stream], bool], computed: bool
    ) -> Iterator[EntryColumns]:
        streams = self._stated_streams()
        chosen = {number for number, stream in streams.items() if wanted(stream)}
        digests = {} if computed else self._digest_decoders
        reader = ColumnsReader(
            str(self.path),
            recover_hint(self.path),
            streams,
            self._decoders | digests,
            self._known,
            counted=self.foreign,
            digests=digests,
        )

        def is_wanted(chunk: ChunkEntry) -> bool:
            # without an index of its messages, a chunk may hold any
            return not chunk.places or self.foreign or not chosen.isdisjoint(chunk.channels)

        # entries of other programs are counted from the first one on
        first_ns, last_ns = (0, END_NS) if self.foreign else (start_ns, end_ns)
        count = 0
        with self._damage_in("entries"):
            found = message_columns(self._stream, self._index, str(self.path), first_ns, last_ns, is_wanted)
            for chunk, data, columns, whole in found:
                if self._derived and computed:
                    inside = mask_of(columns.channels, chosen)
                    inside &= (columns.times >= start_ns) & (columns.times < end_ns)
                    data, columns = self._derived.columns(data, columns, inside)  # noqa: PLW2901
                some, fault = reader.columns(chunk, data, columns, whole=whole)
                inside = mask_of(some.channels, chosen)
                inside &= (some.times >= start_ns) & (some.times < end_ns)
                some = some if inside.all() else some.where(inside)
                count += len(some)
                if len(some):
                    yield some
                if fault:
                    raise DamagedRecording(f"{self.path}: {fault}{recover_hint(self.path)}")
        if not start_ns and end_ns >= END_NS:
            self._check_count(count, sum(self._index.counts.get(number, 0) for number in chosen))

    def times(self) -> Iterator[tuple[Mapping[int, Stream], Numbers, Numbers]]:
        """Channels, as keys of what they are, and times (UTC ns) of the messages of each chunk, by its index, in order.

        No chunk is unpacked, so this is only what the file claims.  Raises Unfit where it has no usable index.
        """
        if self.format_version not in layout.PRESENT_VERSIONS or self.foreign:
            raise Unfit
        streams = self._stated_streams()
        with self._damage_in("index"):
            found = chunk_times(self._stream, self._index)
            if found is None:
                raise Unfit
            try:
                for channels, times in found:
                    yield streams, channels, times
            except ValueError:
                raise Unfit from None

    def _stated_streams(self) -> dict[int, Stream]:
        return {number: Stream(*each, self._index.channels[number].topic) for number, each in self._streams.items()}

    def span(self, channel: ChannelSummary) -> tuple[int, int]:
        """Times of the first and the last message of one of ``channels``, UTC ns; (0, 0) without any.

        Raises as `entries`.
        """
        if not channel.count:
            return 0, 0
        try:
            with self._damage_in(f"index of {channel.stream or channel.topic}"):
                return self._chunks.span(self._numbers_of(channel))
        except Unusable:
            first = last = 0
            for block in self.blocks(channel):
                first, last = first or int(block.times[0]), int(block.times[-1])
            return first, last

    def forget_chunks(self) -> None:
        """Free the unpacked chunks that `blocks` keeps."""
        self._chunks.forget()

    def _numbers_of(self, channel: ChannelSummary) -> list[int]:
        """The MCAP channels of one of ``channels``: those of rosbag2 may have several of a topic."""
        stream = channel.kind, channel.stream, channel.entry_type
        topics = self._index.channels
        return [
            number for number, each in self._streams.items() if each == stream and topics[number].topic == channel.topic
        ]

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Schema | None, Channel, Row]]:
        """All messages of the wanted channels as they are, also of those that are not read, in order.

        Raises as `entries`.
        """
        schemas, channels = self._index.schemas, self._index.channels
        numbers = frozenset(number for number, channel in channels.items() if wanted(channel))
        for rows in self._rows(numbers=numbers):
            for row in rows or ():
                if row[0] in numbers:
                    channel = channels[row[0]]
                    yield schemas.get(channel.schema_id), channel, row

    def all_columns(self) -> Iterator[tuple[Definitions, bytes, Columns]]:
        """All messages as :meth:`messages`, in columns; arguments of ``Digest.messages``.  Raises as `entries`."""
        schemas = self._index.schemas
        definitions = {
            number: (schemas.get(channel.schema_id), channel) for number, channel in self._index.channels.items()
        }
        with self._damage_in("entries"):
            for _, data, columns, _ in message_columns(self._stream, self._index, str(self.path)):
                if self._derived:
                    every = np.ones(len(columns.times), np.bool_)
                    data, columns = self._derived.columns(data, columns, every)  # noqa: PLW2901
                unknown = set(channels_of(columns)) - self._known
                if unknown:
                    raise Malformed(f"found a message of channel {min(unknown)}, of which there is no record")
                yield definitions, data, columns

    @property
    def has_digests(self) -> bool:
        """Whether the digest stands for some outputs in the file."""
        return self._derived is not None

    def keep_missing(self) -> set[int]:
        """From now on, outputs that cannot be computed are read as their digests; their numbers modulo 2³² are in this.

        Those that another version could compute are not among them.
        """
        found: set[int] = set()
        if self._derived:
            self._derived.missing = found
        return found

    def first_links(self, channel: ChannelSummary) -> tuple[int, ...]:
        """The links of the first message of one of ``channels``; () for ROS, or without any.  Raises as `entries`."""
        if channel.kind not in layout.WIRE_TOPICS:
            return ()
        found = next(self.messages(lambda each: each.topic == channel.topic), None)
        with self._damage_in(f"entries of {channel.stream or channel.topic}"):
            return decoder(channel.kind, channel.topic, channel.type)(found[2], 0).links if found else ()

    def attachments(self) -> Iterator[Attachment]:
        """All attachments, as they are.  Raises DamagedRecording."""
        for place in self._index.attachments:
            with self._damage_in(f"attachment {place.name}"):
                content = read_record(
                    self._stream, self._index, records.ATTACHMENT, place, f"{self.path}: {place.name}"
                )
                yield records.parse_attachment(content)

    def beside(self) -> Iterator[Attachment | Metadata]:
        """The attachments and metadata records of other programs, which an import has carried over.

        Raises DamagedRecording.
        """
        # those of a merged session belong to its parts
        for each in self.attachments() if self.merge is None else ():
            if each.name not in layout.ATTACHMENTS:
                yield each
        for place in self._index.metadata:
            if place.name.startswith(layout.OWN_METADATA) or place.name == layout.ROSBAG2_METADATA:
                continue
            what = f"metadata {place.name}"
            with self._damage_in(what):
                content = read_record(self._stream, self._index, records.METADATA, place, f"{self.path}: {what}")
                yield records.parse_metadata(content)

    def figures(self) -> dict[str, str] | None:
        """The items of the figures that its recorder wrote, which are to be compared with the file; None without any.

        Raises DamagedRecording, LimitExceeded.
        """
        return self._metadata(layout.FIGURES_METADATA)

    @property
    def is_indexed(self) -> bool:
        """Whether `blocks` reads a message by its time, without those before it."""
        return self.format_version in layout.PRESENT_VERSIONS and self._chunks.is_usable

    @property
    def is_sealed(self) -> bool:
        """Whether the index names a seal."""
        return any(place.name == layout.SEAL_METADATA for place in self._index.metadata)

    @property
    def most_bytes(self) -> int:
        """More bytes than all messages have together."""
        # what digests stand for shows only when it is computed
        return _END_NS if self._derived else sum(chunk.size for chunk in self._index.chunks)

    def damaged_indexes(self) -> int:
        """Chunks around which something is damaged: no entry is lost, but other programs may miss messages."""
        return damaged_indexes(self._stream, self._stored_index)

    def extract(self, name: str, out: IO[bytes]) -> None:
        """Write a part of a merged session as a session file of its own.

        Raises UnsupportedRecording if this is no merged session with such a part, DamagedRecording if the part is not
        as it was merged; OSError of ``out``.
        """
        if self.merge is None:
            raise UnsupportedRecording(
                f"{self.path / name}: found a part of {self.path.name}, which is not a merged session"
            )
        extract_part(self.merge, name, self.messages(), self.attachments(), out, str(self.path))

    def prologue(self) -> list[Entry]:
        """Inputs before the first entry, which the gateway's state follows from; for files that begin midway.

        Outputs after an input show the results of the commands to robots in it; see ``Session.restored``.

        Raises DamagedRecording.
        """
        attachment = self._prologue_attachment()
        return prologue_of(attachment, self.path) if attachment else []

    def prologue_file(self) -> SessionFile | None:
        """The prologue as a session of its own, in memory; None without one.  Raises DamagedRecording."""
        attachment = self._prologue_attachment()
        if attachment is None:
            return None
        prologue_of(attachment, self.path)  # within the limits of untrusted files
        return SessionFile(self.path, BytesIO(attachment.data))

    def _prologue_attachment(self) -> Attachment | None:
        place = next((each for each in self._index.attachments if each.name == layout.PROLOGUE_ATTACHMENT), None)
        if place is None:
            return None
        with self._damage_in("prologue"):
            content = read_record(self._stream, self._index, records.ATTACHMENT, place, f"{self.path}: prologue")
            return records.parse_attachment(content)

    # -- opening ----------------------------------------------------------------------------------------------

    def _damaged(self, what: str, why: object) -> DamagedRecording:
        return DamagedRecording(f"{self.path}: {what}: {why}{recover_hint(self.path)}")

    @contextmanager
    def _damage_in(self, what: str) -> Iterator[None]:
        """Around code that parses a part of the file: its errors become DamagedRecording."""
        try:
            yield
        except (Malformed, LayoutError) as error:
            raise self._damaged(what, error) from None
        except OSError as error:
            raise DamagedRecording(f"{self.path}: cannot be read: {error.strerror}") from None

    def _metadata(self, name: str) -> dict[str, str] | None:
        """Items of the first metadata record of that name, checked; None if there is none."""
        # by the index, which is under a checksum: a damaged name must not make the record disappear
        place = next((each for each in self._index.metadata if each.name == name), None)
        if place is None:
            return None
        what = f"metadata {name}"
        limits.check_limit("free", 8 * place.length, f"{self.path}: {what}")
        with self._damage_in(what):
            content = read_record(self._stream, self._index, records.METADATA, place, f"{self.path}: {what}")
            record = records.parse_metadata(content)
            if record.name != name:
                raise Malformed(f"found the name {record.name!r}")
            return layout.unseal(record.metadata)

    def _takes_definition(self, channel: Channel) -> bool:
        """Keep the definition of a channel's type, if the type has no other one."""
        schema = self._index.schemas.get(channel.schema_id)
        if schema is None:
            return True
        type_hash = channel.metadata.get(layout.TYPE_HASH_KEY, "")
        return self._definitions.takes(schema.name, Definition(bytes(schema.data), schema.encoding, type_hash))

    def definition_of(self, ros_type: str) -> Definition | None:
        """The definition of a type as the file has it; None if it has none, or one above the limit (it is cut off)."""
        found = self._definitions.known.get(ros_type)
        return None if found and len(found.data) > 4 * limits.current_limits().definition else found

    def _open_channel(self, channel: Channel) -> ChannelSummary | SkippedChannel:
        """Decide how a channel is read, or why it is not."""
        schema = self._index.schemas.get(channel.schema_id) if channel.schema_id else None
        if channel.schema_id and schema is None:
            raise self._damaged(f"channel {channel.topic}", f"found schema {channel.schema_id}, which is not there")
        count = self._index.counts.get(channel.id, 0)
        kind, why = kind_of(channel, schema, self.foreign)
        if schema and channel.id in self._undecodable:
            kind, why = None, another_definition(schema.name)
        if kind is None or schema is None:
            return SkippedChannel(channel.topic, schema.name if schema else "", count, why)
        found = ChannelSummary.of(channel, schema, kind, count)
        self._decoders[channel.id] = decoder(kind, channel.topic, schema.name)
        self._streams[channel.id] = kind, found.stream, found.entry_type
        return found

    # -- reading ----------------------------------------------------------------------------------------------

    def _entries(self, computed: bool) -> Iterator[Entry]:
        count = yield from self._numbered(self._rows(computed=computed), 0, computed=computed)
        self._check_count(count, self.entry_count)

    def _check_count(self, found: int, expected: int) -> None:
        if found != expected:
            raise DamagedRecording(
                f"{self.path}: found {counted(found, 'entry', 'entries')}, expected {expected}{recover_hint(self.path)}"
            )

    def _looked_up(self, start_ns: int, rule: LatchedStateRule) -> tuple[list[Entry], int | None, int | None]:
        """What :meth:`entries_with_state` needs: the entries of the state; the time from which on the rest has to be
        read (None: there is no rest); the entry number before that (None: the index is not usable)."""
        unusable: tuple[list[Entry], None, None] = [], None, None
        # streams that share a channel are distinguished by the messages only
        shared = any(
            channel.count and not channel.stream and channel.kind in layout.WIRE_TOPICS for channel in self.channels
        )
        if shared or self.format_version not in layout.PRESENT_VERSIONS:
            return unusable
        found = look_up(self._stream, self._index, start_ns, self._streams, rule, counted=self.foreign)
        if found is None:
            return unusable
        state: list[Entry] = []
        seq = 0
        looked_up = found.rows
        if self._derived:
            with self._damage_in("entries"):
                rows = self._derived.rows([row for row, _ in looked_up], self._derived.numbers)
            looked_up = [(row, before) for row, (_, before) in zip(rows, looked_up, strict=True)]
        for row, before in looked_up:
            seq = before + 1 if self.foreign else next_seq(seq, row[1])
            try:
                entry = self._decoders[row[0]](row, seq)
            except LayoutError:
                return unusable
            if entry.channel and self._streams[row[0]] != (entry.kind, entry.channel, entry.type):
                return unusable
            state.append(entry)
        return state, found.rest_ns, found.count if self.foreign else seq

    def _numbered(
        self,
        rows: Iterator[list[Row] | None],
        seq: int,
        kinds: Collection[Kind] = _ALL_KINDS,
        *,
        computed: bool = True,
    ) -> Generator[Entry, None, int]:
        """The entries in messages; ``seq`` is the number of one before them, or 0.  See also `entries_of_kinds`.

        Returns how many there were, without those that are not of the kinds.
        """
        foreign = self.foreign
        known = self._decoders if computed else self._decoders | self._digest_decoders
        decoders: dict[int, Decode | None] = {
            number: known[number] if kind in kinds else None for number, (kind, _, _) in self._streams.items()
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
                    number = next_seq(seq, sequence)
                    # entries before the first one may have been left out
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

    def _rows(
        self,
        from_ns: int = 0,
        kinds: Collection[Kind] = _ALL_KINDS,
        numbers: Collection[int] | None = None,
        *,
        computed: bool = True,
    ) -> Iterator[list[Row] | None]:
        """All messages (from a moment on) in order, in lists.

        A chunk that holds nothing of these kinds is not read: it gives None if there are inputs in it, else nothing.
        The numbers of channels, if there are any, take the place of the kinds.
        """
        wanted = {number for number, (kind, _, _) in self._streams.items() if kind in kinds}
        wanted = wanted if numbers is None else set(numbers)
        inputs = {number for number, (kind, _, _) in self._streams.items() if kind.is_input}

        def is_wanted(chunk: ChunkEntry) -> bool:
            # without an index of its messages, a chunk may hold any
            return not chunk.places or not wanted.isdisjoint(chunk.channels)

        with self._damage_in("entries"):
            for chunk, rows in message_rows(self._stream, self._index, str(self.path), from_ns, is_wanted):
                if rows is not None:
                    unknown = {row[0] for row in rows} - self._known
                    if unknown:
                        raise Malformed(f"found a message of channel {min(unknown)}, of which there is no record")
                    yield self._derived.rows(rows, wanted) if self._derived and computed else rows
                elif chunk and not inputs.isdisjoint(chunk.channels):
                    yield None


def prologue_of(attachment: Attachment, path: Path) -> list[Entry]:
    """The entries of a prologue in the file ``path``.  Raises DamagedRecording, UnsupportedRecording, LimitExceeded."""
    entries, size = [], 0
    most = limits.current_limits().unpacked(len(attachment.data))
    for entry in SessionFile(path, BytesIO(attachment.data)).entries():
        entries.append(entry)
        size += entry.size
        limits.check_limit("count", len(entries), f"{path}: prologue")
        limits.check_limit("ratio", size, f"{path}: prologue", most)
    return entries


class SessionParts(SessionFile):
    """The parts of a split recording as one session; see :meth:`SessionFile.open`.

    A part is open while it is read; the last ones whose blocks were read stay open for the next ones.
    """

    def __init__(self, folder: Path, *, incomplete: bool) -> None:
        self.path = folder
        found: dict[int, PartSummary] = {}
        channels: list[ChannelSummary] = []
        skipped: list[SkippedChannel] = []
        self.definitions, self._definitions = {}, FileDefinitions()
        self.entry_count = self.start_ns = self.end_ns = self._most_bytes = 0
        self._is_sealed = self._has_digests = False
        self._is_indexed = True
        shared: dict[str, str] = {}  # session metadata of all parts
        own = (layout.PART_KEY, layout.PREVIOUS_KEY)
        for path in sorted(part_files(folder), key=Path.is_symlink):
            try:
                opened = SessionFile.open(path)
            except UnsupportedRecording:
                if path.is_symlink():  # to anything
                    continue
                if not path.stat().st_size:
                    raise DamagedRecording(f"{path}: was cut off after 0 bytes{recover_hint(folder)}") from None
                raise
            except DamagedRecording as error:
                raise type(error)(str(error).replace(recover_hint(path), recover_hint(folder))) from None
            with opened as part:
                number = whole_number(part.session.get(layout.PART_KEY))
                items = {key: value for key, value in part.session.items() if key not in own}
                if path.is_symlink() and (number is None or number in found or items != (shared or items)):
                    continue  # to no part of this recording
                shared = shared or items
                if number in found:
                    raise DamagedRecording(
                        f"{folder}: found part {number} twice: {found[number].path.name}, {path.name}"
                    )
                if number is None:
                    raise UnsupportedRecording(
                        f"{folder}: found a directory with {path.name}, expected parts of a split recording; "
                        "name the .mcap file in it"
                    )
                size = path.stat().st_size
                found[number] = PartSummary(path, size, part.entry_count, part.start_ns, part.end_ns)
                channels += part.channels
                skipped += part.skipped
                self.definitions |= part.definitions
                self._definitions.known |= part._definitions.known
                self.entry_count += part.entry_count
                self._most_bytes += part.most_bytes
                self._is_sealed = self._is_sealed or part.is_sealed
                self._is_indexed = self._is_indexed and part.is_indexed
                self._has_digests = self._has_digests or part.has_digests
        if not found:
            raise UnsupportedRecording(f"{folder}: found a directory, expected the .mcap file in it")
        with SessionFile.open(found[min(found)].path) as first:  # without one before it if the recording waited
            before = -1 if layout.PREVIOUS_KEY in first.session else min(found) - 1
        numbers = (before, *sorted(found))
        self.missing_parts = tuple((one + 1, two - 1) for one, two in pairwise(numbers) if two - one > 1)
        # the retention deletes parts from the first one on: the first that is left has a prologue
        if gap := next((first for first, _ in self.missing_parts if first and not incomplete), 0):
            raise DamagedRecording(f"{folder}: part {gap} of the recording is missing")
        self.parts = tuple(found[number] for number in sorted(found))
        self.size = sum(part.size for part in self.parts)
        with SessionFile.open(self.parts[0].path) as first, SessionFile.open(self.parts[-1].path) as last:
            # a recording that lacks its first parts begins midway, and states it as a part does
            self.session = {key: value for key, value in first.session.items() if min(found) or key not in own}
            self.format_version = first.format_version
            goes_on = last.ledger is not None and layout.GOES_ON_KEY in last.ledger  # and its next part is not here
            self.ledger = (last.ledger or {}) | {layout.CUT_OFF_KEY: True} if goes_on else last.ledger
            self.recorded_session = {key: value for key, value in first.recorded_session.items() if key not in own}
            self.recorded_ledger = last.recorded_ledger
        self.merge = None
        full = [part for part in self.parts if part.entries]
        if full:
            self.start_ns, self.end_ns = full[0].start_ns, full[-1].end_ns
        self.foreign = False
        self.channels, self.skipped = joined(channels), tuple(skipped)
        self._kept: list[SessionFile] = []
        self._most_kept = _PARTS_OPEN

    def close(self) -> None:
        """Close the parts that are open."""
        self._most_kept = 0
        self._close_parts()

    def _close_parts(self) -> None:
        while len(self._kept) > self._most_kept:
            self._kept.pop(0).close()

    @contextmanager
    def _part(self, path: Path) -> Iterator[SessionFile]:
        """A part: one that is open and not being read, or else opened."""
        part = next((each for each in self._kept if each.path == path), None)
        if part is None:
            part = SessionFile.open(path)
        else:
            self._kept.remove(part)
        try:
            yield part
        finally:
            for each in self._kept:
                each.forget_chunks()
            self._kept.append(part)
            self._close_parts()

    def entries(self, *, computed: bool = True) -> Iterator[Entry]:
        """All entries of all parts; as SessionFile.entries."""
        return self._of_parts(lambda part: part.entries(computed=computed))

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """As SessionFile.entries_of_kinds."""
        return self._of_parts(lambda part: part.entries_of_kinds(kinds))

    def entries_with_state(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """As SessionFile.entries_with_state."""
        return self._of_parts(lambda part: part.entries_with_state(start_ns, rule))

    def entries_starting_at(self, start_ns: int, seq: int = 0) -> Iterator[Entry]:
        """As SessionFile.entries_starting_at; parts that end before are not opened."""
        return self._of_parts(lambda part: part.entries_starting_at(start_ns, seq), start_ns)

    def blocks(self, channel: ChannelSummary, start_ns: int = 0, end_ns: int = _END_NS) -> Iterator[MessageBlock]:
        """As SessionFile.blocks; parts outside of the times are not opened."""
        for each in self.parts:
            if each.entries and each.end_ns >= start_ns and each.start_ns < end_ns:
                with self._part(each.path) as part:
                    yield from part.blocks(channel, start_ns, end_ns)

    def columns(
        self,
        start_ns: int = 0,
        end_ns: int = END_NS,
        wanted: Callable[[Stream], bool] = lambda _: True,
        *,
        computed: bool = True,
    ) -> Iterator[EntryColumns]:
        """As SessionFile.columns; parts outside of the times are not opened."""
        if self.format_version not in layout.PRESENT_VERSIONS:
            raise Unfit
        return self._columns(start_ns, end_ns, wanted, computed)

    def _columns(
        self, start_ns: int, end_ns: int, wanted: Callable[[Stream], bool], computed: bool
    ) -> Iterator[EntryColumns]:
        seq = 0
        for each in self.parts:
            if each.end_ns < start_ns or (each.start_ns >= end_ns and each.entries):
                continue
            with SessionFile.open(each.path) as part:
                for columns in part.columns(start_ns, end_ns, wanted, computed=computed):
                    if (first := int(columns.numbers[0])) <= seq:
                        raise DamagedRecording(f"{each.path}: found entry number {first}, expected one above {seq}")
                    seq = int(columns.numbers[-1])
                    yield columns

    def times(self) -> Iterator[tuple[Mapping[int, Stream], Numbers, Numbers]]:
        """As SessionFile.times."""
        for each in self.parts:
            with SessionFile.open(each.path) as part:
                yield from part.times()

    def span(self, channel: ChannelSummary) -> tuple[int, int]:
        """As SessionFile.span; the parts between the first and the last one with the stream are not opened."""
        first, last = self._span(channel, self.parts), self._span(channel, self.parts[::-1])
        return first[0], last[1]

    @staticmethod
    def _span(channel: ChannelSummary, parts: Sequence[PartSummary]) -> tuple[int, int]:
        """The times in the first of these parts that has the stream."""
        for each in parts:
            with SessionFile.open(each.path) as part:
                span = next(
                    (
                        part.span(own)
                        for own in part.channels
                        if own.count and replace(own, count=0, qos=None) == replace(channel, count=0, qos=None)
                    ),
                    (0, 0),
                )
            if span[0]:
                return span
        return 0, 0

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Schema | None, Channel, Row]]:
        """As SessionFile.messages."""
        for each in self.parts:
            with SessionFile.open(each.path) as part:
                yield from part.messages(wanted)

    def all_columns(self) -> Iterator[tuple[Definitions, bytes, Columns]]:
        """As SessionFile.all_columns."""
        for each in self.parts:
            with SessionFile.open(each.path) as part:
                yield from part.all_columns()

    def figures(self) -> dict[str, str] | None:
        """Those of the last part."""
        with SessionFile.open(self.parts[-1].path) as part:
            return part.figures()

    @property
    def has_digests(self) -> bool:
        """As SessionFile.has_digests, of any part."""
        return self._has_digests

    def keep_missing(self) -> set[int]:
        """Nothing: a part is open only while it is read."""
        return set()

    def forget_chunks(self) -> None:
        """As SessionFile.forget_chunks, of the parts that are open."""
        for each in self._kept:
            each.forget_chunks()

    @property
    def is_indexed(self) -> bool:
        """As SessionFile.is_indexed, of all parts."""
        return self._is_indexed

    @property
    def is_sealed(self) -> bool:
        """As SessionFile.is_sealed, of any part."""
        return self._is_sealed

    @property
    def most_bytes(self) -> int:
        """As SessionFile.most_bytes."""
        return self._most_bytes

    def damaged_indexes(self) -> int:
        """As SessionFile.damaged_indexes, of all parts."""
        count = 0
        for each in self.parts:
            with SessionFile.open(each.path) as part:
                count += part.damaged_indexes()
        return count

    def attachments(self) -> Iterator[Attachment]:
        """Those of the first part, with which the session begins."""
        with SessionFile.open(self.parts[0].path) as part:
            yield from part.attachments()

    def beside(self) -> Iterator[Attachment | Metadata]:
        """Those of the first part, with which the session begins."""
        with SessionFile.open(self.parts[0].path) as part:
            yield from part.beside()

    def _of_parts(self, entries: Callable[[SessionFile], Iterator[Entry]], start_ns: int = 0) -> Iterator[Entry]:
        seq = 0
        for each in self.parts:
            if each.end_ns < start_ns:
                continue
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
        """That of the first part; nothing if the recording has all parts: it begins with the session."""
        with SessionFile.open(self.parts[0].path) as first:
            return first.prologue()

    def prologue_file(self) -> SessionFile | None:
        """As SessionFile.prologue_file, of the first part."""
        with SessionFile.open(self.parts[0].path) as first:
            return first.prologue_file()

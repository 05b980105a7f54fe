"""The readable rest of a damaged recording: cut off anywhere, bits flipped anywhere, no index.

``damaged`` finds the records, most messages are in chunks under a checksum.  Nothing is taken from a chunk whose
checksum is wrong, so what is returned is right, and everything else is reported, with its place in the file and in
time.  One flipped bit costs one chunk at most.

Files of other programs are read in the same way; of their messages without a checksum it is only known that they are
where they should be.

Memory is bounded by the largest chunk and the largest attachment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, TypeVar

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema, Statistics

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.base.untrusted.shape import digits
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import facts, layout, migrations, records
from igtl_gateway.record.sessionfile.channels import SEQUENCES, Decode, decoder, is_marked, kind_of
from igtl_gateway.record.sessionfile.chunk_columns import Array, Columns, count_of, take
from igtl_gateway.record.sessionfile.chunks import PackedChunk
from igtl_gateway.record.sessionfile.columns import WireHeads, mask_of
from igtl_gateway.record.sessionfile.compression import NAMES, Compression
from igtl_gateway.record.sessionfile.contents import message_bound
from igtl_gateway.record.sessionfile.damaged import DamagedFile, RecordSpan
from igtl_gateway.record.sessionfile.index import not_mcap, read_summary
from igtl_gateway.record.sessionfile.large_outputs import digest_decoder
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.records import MAGIC, MESSAGE_HEAD, MESSAGE_RECORD, Malformed
from igtl_gateway.record.sessionfile.salvage_report import (
    ATTACHMENT,
    BYTES,
    CHANNEL,
    CHUNK,
    CUT_OFF,
    LEDGER,
    MAX_LOSSES,
    METADATA,
    NUMBER,
    Loss,
    SalvageReport,
)

_Value = TypeVar("_Value")
#: Key of what a ledger states of a recovery: the file had session metadata.
HAS_SESSION = "has_session"
#: Metadata records that are of the file that they are in.
_OF_THE_FILE = frozenset({layout.SEAL_METADATA, layout.FIGURES_METADATA})
#: Characters of the text of a loss that quotes the file.
_MAX_TEXT = 300


@dataclass(frozen=True, slots=True)
class Salvaged:
    """A message, with all that is needed to write it again; ``entry`` is None where it is not one of the session."""

    schema: Schema | None
    channel: Channel
    message: Message
    entry: Entry | None


@dataclass(frozen=True, slots=True)
class SalvagedChunk:
    """A chunk of which every message is right, in order of time unless the file is of another program.

    Attributes:
        chunk, data: as it lies in the file, with the right fields, and its records.
        definitions: of its messages.
        first_ns, last_ns: times of its first and its last message.
    """

    chunk: PackedChunk
    data: bytes
    definitions: tuple[tuple[Schema | None, Channel], ...]
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class _Definition:
    channel: Channel
    schema: Schema | None
    kind: Kind | None
    decode: Decode | None


class Salvage:
    """A file of which as much as possible is read; a context manager.  Use :meth:`open`.

    Attributes:
        path: the file.
        has_header: whether the file's header can be read.
        profile, library: of the header; without it, the profile is that of a session, or ``""`` in another file.
        session, format_version, ledger, foreign: as of SessionFile.
        recorded_session: the session metadata as the file has it, of whatever version.
        growing: another process is writing it.
        compression: of its chunks; ``"none"`` where they have none or there are none.
        report: what was read and lost so far.
        position: offset that has been read up to, for the display of progress.
    """

    def __init__(self, path: Path, stream: IO[bytes]) -> None:
        self.path = path
        self._stream = stream
        self._file = DamagedFile(path, stream)
        if not self._file.size:
            raise UnsupportedRecording(f"{path}: the file is empty")
        self.report = SalvageReport(self._file.size)
        self.position = 0
        self.has_header = False
        self.profile = self.library = ""
        self.compression: Compression = "none"
        self.growing = files.is_being_written(stream)
        self._metadata: list[RecordSpan] = []
        self._attachments: list[RecordSpan] = []
        self._schemas: dict[int, tuple[Schema, bool]] = {}  # and whether under a checksum
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self._definitions: dict[int, _Definition] = {}  # of channels that are complete
        self._searched = False
        self._statistics: Statistics | None = None
        self._read_summary()
        #: Item of the session metadata that cannot be used → why.
        self.unusable: dict[str, str] = {}
        session, self.ledger, found = self._survey()
        self.foreign = (
            session is None
            and not any(is_marked(channel) for channel, _ in self._channels.values())
            and not self.library.startswith("igtl-gateway")
        )
        if not (self.has_header or self.foreign):
            self.profile = layout.MCAP_PROFILE
        self.recorded_session = session or {}
        self.format_version, self.session = migrations.read_session(path, session)
        start = self._file.read(0, len(MAGIC))
        if not found and not MAGIC.startswith(start):
            raise not_mcap(path, start)

    @classmethod
    def open(cls, path: Path | str) -> Salvage:
        """Open a file and survey its records; the messages are read by :meth:`read`.

        Raises UnsupportedRecording (no such file, nothing of MCAP in it, a newer version), DamagedRecording where
        the disk refuses.
        """
        path = Path(path)
        stream = files.open_file(path)
        try:
            return cls(path, stream)
        except OSError as error:
            stream.close()
            raise DamagedRecording(f"{path}: cannot be read: {error.strerror}") from None
        except BaseException:
            stream.close()
            raise

    def close(self) -> None:
        """Close the file.  Payloads that were read stay valid."""
        self._stream.close()

    def __enter__(self) -> Salvage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def entries(self) -> Iterator[Entry]:
        """All entries that can be read, in their order.  Raises DamagedRecording where the disk refuses."""
        found = (each.entry for each in self.read() if each.entry is not None)
        return migrations.entries(self.format_version, found)

    def attachments(self) -> Iterator[Attachment]:
        """The attachments whose checksum is right."""
        for span in self._attachments:
            if attachment := self._file.attachment(span):
                yield attachment

    def metadata(self) -> Iterator[Metadata]:
        """The metadata records that are not of the session, without seals and figures."""
        for span in self._metadata:
            if metadata := _parsed(records.parse_metadata, self._file.content(span)):
                yield metadata

    def read(self) -> Iterator[Salvaged]:
        """All messages that can be read, as they lie in the file; once.  Raises DamagedRecording as above."""
        for each in self._read(whole_chunks=False):
            if isinstance(each, Salvaged):
                yield each

    def read_chunks(self) -> Iterator[Salvaged | SalvagedChunk]:
        """As :meth:`read`, but where a chunk is right as a whole, the chunk."""
        return self._read(whole_chunks=True)

    def _read(self, *, whole_chunks: bool) -> Iterator[Salvaged | SalvagedChunk]:
        try:
            attachments = len(self._attachments)
            yield from _SalvagePass(self, self._file, self._statistics, attachments, whole_chunks=whole_chunks).run()
        except OSError as error:
            raise DamagedRecording(f"{self.path}: cannot be read: {error.strerror}") from None

    def define(self, opcode: int, content: bytes, *, is_checked: bool) -> None:
        """Add a schema or a channel; one under a checksum overrides one that is not."""
        if opcode == records.SCHEMA:
            schema = _parsed(records.parse_schema, content)
            if schema and (is_checked or schema.id not in self._schemas):
                self._schemas[schema.id] = schema, is_checked
        elif opcode == records.CHANNEL:
            channel = _parsed(records.parse_channel, content)
            if channel and (is_checked or channel.id not in self._channels):
                self._channels[channel.id] = channel, is_checked

    def knows(self, opcode: int, content: bytes) -> bool:
        """Whether a record in a chunk defines what is known, under a checksum, as it is known.

        Bytes behind its fields would be copied, too, and other readers may stumble over them.
        """
        try:
            if opcode == records.SCHEMA:
                schema = records.parse_schema(content)
                known = self._schemas.get(schema.id) == (schema, True)
                return known and content == records.pack(schema)[records.HEAD.size :]
            channel = records.parse_channel(content)
        except Malformed:
            return False
        known = opcode == records.CHANNEL and self._channels.get(channel.id) == (channel, True)
        return known and content == records.pack(channel)[records.HEAD.size :]

    def definition(self, channel_id: int) -> _Definition | None:
        """Channel, schema and decoder of messages; None if no copy of the channel is left."""
        known = self._definitions.get(channel_id)
        if known:
            return known
        if not self._is_defined(channel_id) and not self._searched:
            self._searched = True
            self._define_from_chunks()
        if not self._is_defined(channel_id):
            return None
        channel, _ = self._channels[channel_id]
        schema, _ = self._schemas.get(channel.schema_id, (None, False))
        kind, _ = kind_of(channel, schema, self.foreign)
        decode = None
        if kind and schema:
            digested = layout.DIGEST_KEY in channel.metadata
            decode = digest_decoder(channel, kind) if digested else decoder(kind, channel.topic, schema.name)
        self._definitions[channel_id] = _Definition(channel, schema, kind, decode)
        return self._definitions[channel_id]

    # -- the survey -------------------------------------------------------------------------------------------

    def _read_summary(self) -> None:
        """Take the definitions and counts of the summary, if its checksum is right."""
        try:
            summary = read_summary(self._stream, self._file.size, str(self.path))
        except (Malformed, LimitExceeded):
            return
        if not (summary.start and summary.has_checksum):
            return
        self.report.indexed = self.report.closed = True
        self._file.data_end = summary.start
        try:
            for opcode, at, end in records.records(summary.data, "summary"):
                self.define(opcode, summary.data[at:end], is_checked=True)
                if opcode == records.STATISTICS:
                    self._statistics = _parsed(records.parse_statistics, summary.data[at:end])
        except Malformed:
            return

    def _survey(self) -> tuple[dict[str, str] | None, dict[str, Any] | None, bool]:
        """Everything except the messages: session metadata, ledger, and whether there is anything of MCAP at all."""
        sessions: list[dict[str, str]] = []
        ledger: dict[str, Any] | None = None
        found = False
        for span in self._file.walk():
            found = found or span.opcode in (records.CHUNK, records.METADATA, records.HEADER)
            if span.opcode == records.DATA_END:
                self.report.closed = True
            elif span.opcode == records.CHUNK and self.compression == "none":
                name = self._file.chunk_compression(span)
                self.compression = next(each for each in NAMES if NAMES[each] == name)
            elif span.opcode == records.ATTACHMENT:
                self._attachments.append(span)
                limits.check_limit("count", len(self._attachments), f"{self.path}: attachments")
            elif span.opcode == records.HEADER:
                if header := _parsed(records.parse_header, self._file.small_content(span)):
                    self.has_header, self.profile, self.library = True, header.profile, header.library
            elif span.opcode in records.DEFINITIONS:
                self.define(span.opcode, self._file.small_content(span), is_checked=False)
            elif span.opcode == records.METADATA and (
                metadata := _parsed(records.parse_metadata, self._file.small_content(span))
            ):
                if metadata.name in layout.SESSION_RECORDS:
                    sessions += [items] if (items := _right(_session_items, metadata)) else []
                elif metadata.name == layout.LEDGER_METADATA:
                    ledger = ledger or _right(_check_ledger, metadata)
                elif metadata.name not in _OF_THE_FILE:
                    self._metadata.append(span)
                    limits.check_limit("count", len(self._metadata), f"{self.path}: metadata records")
        return self._best_session(sessions), ledger, found

    def _best_session(self, found: list[dict[str, str]]) -> dict[str, str] | None:
        """The items that can be used, of the first record that has all of them, else of the first one."""
        if not found:
            return None
        usable = [facts.usable_session(items) for items in found]
        items, self.unusable = min(usable, key=lambda each: len(each[1]))
        if layout.CONFIGURATION_KEY in self.unusable:
            for attachment in self.attachments():
                text = attachment.data.decode("utf-8", "replace")
                if attachment.name == layout.CONFIGURATION_ATTACHMENT and not facts.configuration_fault(text):
                    del self.unusable[layout.CONFIGURATION_KEY]
                    return {**items, layout.CONFIGURATION_KEY: text}
        return items

    def _is_defined(self, channel_id: int) -> bool:
        if channel_id not in self._channels:
            return False
        channel, _ = self._channels[channel_id]
        return not channel.schema_id or channel.schema_id in self._schemas

    def _define_from_chunks(self) -> None:
        """Add the definitions in all chunks."""
        for span in self._file.walk():
            if span.opcode != records.CHUNK:
                continue
            try:
                _, data = self._file.chunk(span)
                for opcode, at, end in records.records(data, "chunk"):
                    self.define(opcode, data[at:end], is_checked=True)
            except (Malformed, LimitExceeded):
                continue


class _SalvagePass:
    """One pass over the messages."""

    def __init__(
        self,
        salvage: Salvage,
        file: DamagedFile,
        statistics: Statistics | None,
        attachments: int,
        *,
        whole_chunks: bool,
    ) -> None:
        self._whole_chunks = whole_chunks
        self._heads = WireHeads()
        self._salvage, self._file, self._statistics = salvage, file, statistics
        self._attachments = attachments  # found in the file
        self._report = salvage.report
        self._open: list[Loss] = []  # since the last message: how far they reach shows with the next one
        self._unknown: dict[int, Loss] = {}
        self._unknown_counts: dict[int, int] = {}
        self._seq = self._entries = self._seen = 0

    def run(self) -> Iterator[Salvaged | SalvagedChunk]:
        file, report = self._file, self._report
        torn: RecordSpan | None = None
        for span in file.walk():
            self._salvage.position = span.end
            if span.opcode == records.CHUNK:
                yield from self._read_chunk(span)
            elif span.opcode == records.MESSAGE and self._salvage.foreign:
                yield from self._message(file.content(span), span)
            elif span.opcode == 0 and span.end == report.size and not report.closed:
                torn = span
            elif span.opcode in (0, records.MESSAGE) or span.opcode >= records.PRIVATE:
                # a message of the gateway outside of a chunk has lost the chunk around it, and with it the checksum
                self._lose(BYTES, span, "not readable")
            elif span.opcode == records.ATTACHMENT and file.attachment(span) is None:
                self._lose(ATTACHMENT, span, "its checksum is wrong")
            elif span.opcode == records.METADATA and (damage := self._damage_of_metadata(span)):
                self._lose(METADATA, span, damage)
        self._end(torn)

    def _read_chunk(self, span: RecordSpan) -> Iterator[Salvaged | SalvagedChunk]:
        try:
            chunk, data = self._file.chunk(span)
        except (Malformed, LimitExceeded) as error:
            self._lose(CHUNK, span, str(error))
            return
        if self._whole_chunks and (whole := self._whole(chunk, data)):
            yield whole
            return
        try:
            for opcode, at, end in records.records(data, "chunk"):
                if opcode in records.DEFINITIONS:
                    self._salvage.define(opcode, data[at:end], is_checked=True)
                elif opcode == records.MESSAGE:
                    yield from self._message(data[at:end], span)
        except Malformed as error:
            self._lose(CHUNK, span, str(error))

    def _whole(self, chunk: PackedChunk, data: bytes) -> SalvagedChunk | None:
        """A chunk of which every message is right; None, and nothing is counted, where one may not be."""
        salvage, report = self._salvage, self._report
        count, in_order, end, _ = count_of(data)
        if end < len(data) or not count or not (in_order or salvage.foreign):
            return None
        found = Columns.empty(count)
        take(data, 0, *found)
        if not self._has_known_definitions(data, found):
            return None
        numbered, firsts = np.unique(found.channels, return_index=True)
        # in the order of their first messages
        definitions = {number: salvage.definition(number) for number in numbered[np.argsort(firsts)].tolist()}
        known = {number: each for number, each in definitions.items() if each}
        entries = found.where(mask_of(found.channels, {number for number, each in known.items() if each.decode}))
        numbers = self._numbers(entries)
        if len(known) < len(definitions) or numbers is None or not self._decode(data, entries, known):
            return None
        self._seen += count
        limits.check_limit("count", self._seen, f"{salvage.path}: messages", message_bound(report.size))
        if len(numbers):
            self._close_losses(int(entries.times[0]), int(numbers[0]) - self._seq - 1)
            self._seq = int(numbers[-1])
            self._entries += len(numbers)
        first, last = int(found.times.min()), int(found.times.max())
        report.start_ns = min(report.start_ns, first) if report.messages else first
        report.end_ns = max(report.end_ns, last)
        report.messages += count
        pairs = tuple((each.schema, each.channel) for each in known.values())
        return SalvagedChunk(chunk, data, pairs, int(found.times[0]), int(found.times[-1]))

    def _has_known_definitions(self, data: bytes, found: Columns) -> bool:
        """Whether the records between the messages are definitions that are known."""
        begins = np.append(found.begins - MESSAGE_RECORD.size, len(data))
        ends = np.concatenate((np.zeros(1, np.int64), found.ends))
        gaps = np.flatnonzero(begins > ends)
        return all(
            self._salvage.knows(opcode, between[at:end])
            for gap in gaps.tolist()
            for between in [data[ends[gap] : begins[gap]]]
            for opcode, at, end in records.records(between, "chunk")
        )

    def _numbers(self, entries: Columns) -> Array | None:
        """Numbers of entries; None if one is not right."""
        if self._salvage.foreign:
            return self._entries + 1 + np.arange(len(entries.times))
        after = entries.sequences.astype(np.int64)
        before = np.concatenate((np.array([self._seq % SEQUENCES]), after[:-1])) if len(after) else after
        steps = (after - before) % SEQUENCES
        checked = steps if self._seq else steps[1:]
        if (steps == 0).any() or (checked >= SEQUENCES // 2).any():
            return None
        return self._seq + np.cumsum(steps)

    def _decode(self, data: bytes, entries: Columns, known: Mapping[int, _Definition]) -> bool:
        """Whether all entries can be decoded; those of ROS always can."""
        kinds = {number: each.kind for number, each in known.items()}
        wire = entries.where(mask_of(entries.channels, {n for n, kind in kinds.items() if kind in layout.WIRE_TOPICS}))
        if self._heads.unwrap(data, wire.channels, wire.begins, wire.ends)[3]:
            return False
        notes = entries.where(mask_of(entries.channels, {n for n, kind in kinds.items() if kind in layout.NOTE_KINDS}))
        try:
            for number, *rest in zip(*(column.tolist() for column in notes), strict=True):
                if decode := known[number].decode:
                    decode((number, *rest, data), 0)
        except LayoutError:
            return False
        return True

    def _message(self, content: bytes, span: RecordSpan) -> Iterator[Salvaged]:
        if len(content) < MESSAGE_HEAD.size:
            self._lose(BYTES, span, "a message shorter than its head")
            return
        self._seen += 1
        limits.check_limit("count", self._seen, f"{self._salvage.path}: messages", message_bound(self._report.size))
        number, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
        definition = self._salvage.definition(number)
        if definition is None:
            if number not in self._unknown:
                self._unknown[number] = self._lose(CHANNEL, span, "")
            self._unknown_counts[number] = self._unknown_counts.get(number, 0) + 1
            return
        message = Message(number, log_time, content[MESSAGE_HEAD.size :], publish_time, sequence)
        entry = None
        if definition.decode:
            foreign = self._salvage.foreign
            step = (sequence - self._seq) % SEQUENCES
            if not foreign and (step == 0 or (self._seq and step >= SEQUENCES // 2)):
                self._lose(NUMBER, span, f"found entry number {sequence}, expected one above {self._seq}")
                return
            seq = self._entries + 1 if foreign else self._seq + step
            try:
                row = (number, sequence, log_time, publish_time, MESSAGE_HEAD.size, len(content), content)
                entry = definition.decode(row, seq)
            except LayoutError as error:
                self._lose(NUMBER, span, f"entry {seq}: {error}")
                return
            self._close_losses(log_time, seq - self._seq - 1)
            self._seq = seq
            self._entries += 1
        report = self._report
        report.messages += 1
        report.start_ns = min(report.start_ns, log_time) if report.messages > 1 else log_time
        report.end_ns = max(report.end_ns, log_time)
        yield Salvaged(definition.schema, definition.channel, message, entry)

    def _lose(self, what: str, span: RecordSpan, text: str) -> Loss:
        if what == BYTES and self._open and self._open[-1].what == BYTES:
            last = self._open[-1]
            if last.at + last.size == span.at:
                last.size += span.size
                return last
        start, end = self._report.end_ns, 0
        if what == CHUNK:
            times = self._file.chunk_times(span)
            if start <= times[0] <= times[1]:
                start, end = times
        loss = Loss(what, span.at, span.size, start, end, text)
        self._report.add(loss)
        if len(self._open) < MAX_LOSSES:
            self._open.append(loss)
        return loss

    def _close_losses(self, log_time: int, missing: int) -> None:
        """An entry follows the losses that are open: they end here, or turn out not to be losses."""
        if not self._open:
            return
        foreign = self._salvage.foreign
        for loss in self._open:
            # bytes between entries with successive numbers were the index of a chunk
            if loss.what == BYTES and not missing and not foreign:
                if loss in self._report.lost:
                    self._report.lost.remove(loss)
            elif loss.end_ns == 0:
                loss.end_ns = max(loss.start_ns, log_time)
        self._report.missing_numbers += 0 if foreign else missing
        self._open.clear()

    def _damage_of_metadata(self, span: RecordSpan) -> str:
        """The damage of a metadata record; ``""`` where it has none."""
        metadata = _parsed(records.parse_metadata, self._file.small_content(span))
        if metadata is None:
            return "not readable"
        try:
            if metadata.name == layout.LEDGER_METADATA:
                _check_ledger(metadata)
            elif metadata.name in layout.SESSION_RECORDS and not self._salvage.session:
                _session_items(metadata)
        except (LayoutError, DamagedRecording) as error:
            return str(error)
        return ""

    def _end(self, torn: RecordSpan | None) -> None:
        report, statistics = self._report, self._statistics
        nowhere = RecordSpan(0, 0, 0)
        for number, loss in self._unknown.items():
            loss.text = (
                f"{count_text(self._unknown_counts[number], 'message')} of a channel of which no description is left"
            )
        if statistics is not None:
            report.missing = max(0, statistics.message_count - report.messages)
            if report.missing and not any(loss.what in (BYTES, CHUNK, CHANNEL, NUMBER) for loss in report.lost):
                self._lose(BYTES, nowhere, "messages of the index were not found")
            if not report.missing:
                # no message is missing, so the bytes were only indexes
                report.lost = [loss for loss in report.lost if loss.what not in (BYTES, CHUNK)]
            if statistics.attachment_count > self._attachments:
                self._lose(ATTACHMENT, nowhere, "not found")
        end = RecordSpan(0, report.size, report.size)
        if not report.closed:
            rest = f" and {count_text(torn.size, 'byte')} of a record" if torn else ""
            why = "is not there yet: it is being recorded" if self._salvage.growing else "was not yet on the disk"
            self._lose(CUT_OFF, torn or end, f"the file ends here{rest}: what came after it {why}")
        ours = not self._salvage.foreign
        # a recovery that found none has named it
        was_lost = (self._salvage.ledger or {}).get("recovered", {}).get(HAS_SESSION) is False
        if ours and not self._salvage.session and not was_lost:
            self._lose(METADATA, nowhere, "the session metadata, such as the configuration")
        for key, why in self._salvage.unusable.items():
            self._lose(METADATA, nowhere, f"the item {key!r} of the session metadata: {why}"[:_MAX_TEXT])
        if ours and self._salvage.ledger is None and report.closed:
            self._lose(LEDGER, end, "the fate of every message")


def _parsed(parse: Callable[[bytes], _Value], content: bytes) -> _Value | None:
    """A record; None if the bytes are not one."""
    try:
        return parse(content)
    except Malformed:
        return None


def _right(check: Callable[[Metadata], _Value], metadata: Metadata) -> _Value | None:
    """The result of a check; None if it fails."""
    try:
        return check(metadata)
    except (LayoutError, DamagedRecording):
        return None


def _session_items(metadata: Metadata) -> dict[str, str]:
    """The session metadata of a record, with items that may be unusable.  Raises LayoutError, DamagedRecording."""
    items = layout.unseal(metadata.metadata)
    digits(items.get(layout.FORMAT_VERSION_KEY), layout.FORMAT_VERSION_KEY)
    return items


def _check_ledger(metadata: Metadata) -> dict[str, Any]:
    """The ledger of a record.  Raises LayoutError, DamagedRecording."""
    return facts.ledger(layout.unseal(metadata.metadata).get(layout.LEDGER_KEY, ""), metadata.name)

"""What is left of a damaged recording: cut off anywhere, bits flipped anywhere, no index.

An MCAP file is a row of records, each with its length in front, and most messages are in chunks under a checksum.
The row is walked from record to record.  Where a record does not fit, its own fields may tell its end after all
(almost all of them have their lengths twice); otherwise the next place is sought at which a record fits.  Nothing is
taken from a chunk whose checksum is wrong, so what is given is right, and whatever is not given is told, with its
place in the file and in time.  One flipped bit costs one chunk at most.

Files of other programs are read the same way; of their messages without a checksum no more can be said than that
they are where they should be.

Memory is bounded by the largest chunk and the largest attachment.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, TypeVar

from mcap.records import Attachment, Channel, Message, Metadata, Schema, Statistics

from igtl_gateway.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.session.entry import Entry
from igtl_gateway.sessionfile import facts, layout, migrations, records
from igtl_gateway.sessionfile.index import check_chunk, check_work, message_bound
from igtl_gateway.sessionfile.layout import LayoutError
from igtl_gateway.sessionfile.reader import SEQUENCES, Decode, decoder, format_version, kind_of
from igtl_gateway.sessionfile.records import CHUNK_HEAD, FOOTER_RECORD, HEAD, MAGIC, MESSAGE_HEAD, Malformed
from igtl_gateway.sessionfile.unpack import COMPRESSIONS, declared_size, unpacked
from igtl_gateway.untrusted import files, limits
from igtl_gateway.untrusted.shape import digits

Compression = Literal["lz4", "zstd", "none"]
_Record = TypeVar("_Record")

#: Losses that are told one by one; the rest are counted.
MAX_LOSSES = 1_000

#: Kinds of losses.
CUT_OFF, CHUNK, BYTES, CHANNEL, NUMBER, METADATA, LEDGER, ATTACHMENT = (
    "cut_off", "chunk", "bytes", "channel", "number", "metadata", "ledger", "attachment",
)  # fmt: skip

_SESSION = (layout.SESSION_METADATA, layout.SESSION_COPY_METADATA)

_U32, _U64 = records.U32, records.U64
#: The fields of each record of a data section: bytes of fixed size, or a length (of 4 or 8 bytes) and so many bytes.
_FIELDS: dict[int, tuple[int | struct.Struct, ...]] = {
    records.HEADER: (_U32, _U32),
    records.SCHEMA: (2, _U32, _U32, _U32),
    records.CHANNEL: (4, _U32, _U32, _U32),
    records.CHUNK: (CHUNK_HEAD.size, _U32, _U64),
    records.MESSAGE_INDEX: (2, _U32),
    records.ATTACHMENT: (16, _U32, _U32, _U64, 4),
    records.METADATA: (_U32, _U32),
    records.DATA_END: (4,),
}
#: What describes messages.
_DEFINITIONS = (records.SCHEMA, records.CHANNEL)
#: Where a record may begin, for the search: one of those that are never inside a chunk, or, in files that have
#: messages outside, a message.  None is larger than a terabyte.
_CANDIDATE = re.compile(rb"[\x06\x07\x09\x0c\x0f](?=.{5}\0\0\0)", re.DOTALL)
_CANDIDATE_MESSAGE = re.compile(rb"[\x05\x06\x07\x09\x0c\x0f](?=.{5}\0\0\0)", re.DOTALL)
_WINDOW = 1 << 20
#: So many records in a row have to fit for the first one to be taken as a message.
_CHAIN = 4


@dataclass(slots=True)
class Loss:
    """Something that is not there.

    Attributes:
        what: kind of the loss.
        at: offset in the file.
        size: bytes of the file that could not be used.
        start_ns, end_ns: UTC nanoseconds between which it happened, as far as known; 0 = not known.
        text: the reason, for people.
    """

    what: str
    at: int
    size: int
    start_ns: int
    end_ns: int
    text: str


@dataclass(slots=True)
class SalvageReport:
    """What was read and what was not; complete after the last message.

    Attributes:
        size: bytes of the file.
        closed: the recording ended properly: nothing was still to come.
        indexed: the index is right.
        messages: messages that were read.
        start_ns, end_ns: UTC nanoseconds of the first and the last of them; 0 where there is none.
        missing: messages that were there and are lost, by the index; None where the index is lost, too.
        missing_numbers: entry numbers that the places of loss leave out: so many entries, at most, are lost there.
        lost: the losses, in order; the first MAX_LOSSES of them.
        more_lost: how many more there are.
    """

    size: int
    closed: bool = False
    indexed: bool = False
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    missing: int | None = None
    missing_numbers: int = 0
    lost: list[Loss] = field(default_factory=list)
    more_lost: int = 0

    @property
    def whole(self) -> bool:
        """Whether everything that was recorded has been read."""
        return self.closed and not self.lost


@dataclass(frozen=True, slots=True)
class Salvaged:
    """A message, with all that is needed to write it again; ``entry`` is None where it is not one of the session."""

    schema: Schema | None
    channel: Channel
    message: Message
    entry: Entry | None


@dataclass(frozen=True, slots=True)
class _Definition:
    channel: Channel
    schema: Schema | None
    decode: Decode | None


@dataclass(frozen=True, slots=True)
class _RecordSpan:
    """A record, or (opcode 0) bytes that are none."""

    opcode: int
    at: int
    end: int


class Salvage:
    """A file of which as much as possible is read; a context manager.  Use :meth:`open`.

    Attributes:
        path: the file.
        profile, library: of the file's header; ``""`` where that is lost.
        session, format_version, ledger, foreign: as of SessionFile.
        recorded_session: the session metadata as the file has it, of whatever version.
        growing: another process is writing it.
        compression: of its chunks; ``"none"`` where they have none or there are none.
        report: what was read and lost so far.
        position: offset that has been read up to, for whoever shows progress.
    """

    def __init__(self, path: Path, stream: IO[bytes]) -> None:
        self.path = path
        self._stream = stream
        self._window = (0, b"")
        size = stream.seek(0, 2)
        if not size:
            raise UnsupportedRecording(f"{path}: the file is empty")
        self.report = SalvageReport(size)
        self.position = 0
        self.profile = self.library = ""
        self.compression: Compression = "none"
        self.growing = files.is_being_written(stream)
        self._metadata: list[_RecordSpan] = []
        self._deadline = limits.Deadline(files.stored_bytes(path, size))
        self._work = 0  # bytes unpacked
        self._loose = False  # messages lie outside of chunks
        self._schemas: dict[int, tuple[Schema, bool]] = {}  # and whether under a checksum
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self._definitions: dict[int, _Definition] = {}  # settled ones
        self._sought = False
        self._attachments: list[_RecordSpan] = []
        self._statistics: Statistics | None = None
        self._data_end = size
        self._read_summary()
        found = self._survey()
        if not found and not MAGIC.startswith(self._bytes(0, len(MAGIC))):
            start = self._bytes(0, len(MAGIC))
            raise UnsupportedRecording(f"{path}: not an MCAP file: found {start.hex(' ')}, expected {MAGIC.hex(' ')}")

    @classmethod
    def open(cls, path: Path | str) -> Salvage:
        """Open a file and look over it; the messages are read by :meth:`read`.

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
        for frame in self._attachments:
            attachment = self._attachment(frame)
            if attachment:
                yield attachment

    def metadata(self) -> Iterator[Metadata]:
        """The metadata records that are not of the session."""
        for frame in self._metadata:
            metadata = _parsed(records.parse_metadata, self._content(frame))
            if metadata:
                yield metadata

    def read(self) -> Iterator[Salvaged]:
        """All messages that can be read, as they lie in the file; once.  Raises DamagedRecording as above."""
        try:
            yield from _SalvagePass(self).run()
        except OSError as error:
            raise DamagedRecording(f"{self.path}: cannot be read: {error.strerror}") from None

    # -- looking over it --------------------------------------------------------------------------------------

    def _read_summary(self) -> None:
        """Take from the summary what it has, if its checksum is right."""
        size = self.report.size
        if size < len(MAGIC) + FOOTER_RECORD.size:
            return
        footer = self._bytes(size - FOOTER_RECORD.size, FOOTER_RECORD.size)
        opcode, _, start, _, crc, magic = FOOTER_RECORD.unpack(footer)
        if magic != MAGIC or opcode != records.FOOTER or not crc:
            return
        if not len(MAGIC) <= start <= size - FOOTER_RECORD.size:
            return
        if size - start > limits.current_limits().memory:
            return
        summary = self._bytes(start, size - FOOTER_RECORD.size - start)
        if zlib.crc32(footer[: -len(MAGIC) - _U32.size], zlib.crc32(summary)) != crc:
            return
        self.report.indexed = self.report.closed = True
        self._data_end = start
        for opcode, content in _records(summary):
            self._define(opcode, content, checked=True)
            if opcode == records.STATISTICS:
                self._statistics = _parsed(records.parse_statistics, content)

    def _survey(self) -> bool:
        """Everything but the messages.  Gives whether there is anything of MCAP at all."""
        session: dict[str, str] | None = None
        ledger: dict[str, Any] | None = None
        found = False
        for frame in self._walk():
            self._deadline.check(str(self.path))
            found = found or frame.opcode in (records.CHUNK, records.METADATA, records.HEADER)
            if frame.opcode == records.DATA_END:
                self.report.closed = True
            elif frame.opcode == records.CHUNK and self.compression == "none":
                told = self._bytes(frame.at + HEAD.size + CHUNK_HEAD.size + _U32.size, 4)
                self.compression = "lz4" if told[:3] == b"lz4" else "zstd" if told == b"zstd" else "none"
            elif frame.opcode == records.ATTACHMENT:
                self._attachments.append(frame)
                limits.check_limit("count", len(self._attachments), f"{self.path}: attachments")
            elif frame.opcode in (records.HEADER, records.SCHEMA, records.CHANNEL):
                content = self._small_content(frame)
                self._define(frame.opcode, content, checked=False)
                if frame.opcode == records.HEADER and (header := _parsed(records.parse_header, content)):
                    self.profile, self.library = header.profile, header.library
            elif frame.opcode == records.METADATA and (
                metadata := _parsed(records.parse_metadata, self._small_content(frame))
            ):
                if metadata.name in _SESSION:
                    session = session or _unsealed(metadata)
                elif metadata.name == layout.LEDGER_METADATA:
                    ledger = ledger or _ledger(metadata)
                else:
                    self._metadata.append(frame)
                    limits.check_limit("count", len(self._metadata), f"{self.path}: metadata records")
        marked = any(layout.KIND_KEY in channel.metadata for channel, _ in self._channels.values())
        self.foreign = session is None and not marked and not self.library.startswith("igtl-gateway")
        self.format_version = format_version(self.path, session)
        self.recorded_session = session or {}
        try:
            self.session = migrations.session(self.format_version, self.recorded_session)
        except UnsupportedRecording as error:
            raise UnsupportedRecording(f"{self.path}: {error}") from None
        self.ledger = ledger
        return found

    def _define(self, opcode: int, content: bytes, *, checked: bool) -> None:
        """Learn a schema or a channel; what is under a checksum overrides what is not."""
        if opcode == records.SCHEMA:
            schema = _parsed(records.parse_schema, content)
            if schema and (checked or schema.id not in self._schemas):
                self._schemas[schema.id] = schema, checked
        elif opcode == records.CHANNEL:
            channel = _parsed(records.parse_channel, content)
            if channel and (checked or channel.id not in self._channels):
                self._channels[channel.id] = channel, checked

    def _definition(self, channel_id: int) -> _Definition | None:
        """What a channel is; None if no copy of it is left."""
        known = self._definitions.get(channel_id)
        if known:
            return known
        if not self._is_defined(channel_id) and not self._sought:
            self._sought = True
            for frame in self._walk():
                for opcode, content in self._definitions_in(frame):
                    self._define(opcode, content, checked=True)
        if not self._is_defined(channel_id):
            return None
        channel, _ = self._channels[channel_id]
        schema, _ = self._schemas.get(channel.schema_id, (None, False))
        kind, _ = kind_of(channel, schema, self.foreign)
        decode = decoder(kind, channel.topic, schema.name) if kind and schema else None
        self._definitions[channel_id] = _Definition(channel, schema, decode)
        return self._definitions[channel_id]

    def _is_defined(self, channel_id: int) -> bool:
        if channel_id not in self._channels:
            return False
        channel, _ = self._channels[channel_id]
        return not channel.schema_id or channel.schema_id in self._schemas

    def _definitions_in(self, frame: _RecordSpan) -> Iterator[tuple[int, bytes]]:
        if frame.opcode == records.CHUNK:
            try:
                yield from _records(self._chunk(frame), _DEFINITIONS)
            except (Malformed, LimitExceeded):
                return

    def _attachment(self, frame: _RecordSpan) -> Attachment | None:
        """An attachment; None if its checksum is wrong (0: it has none)."""
        content = self._content(frame)
        try:
            attachment, covered = records.parse_attachment(content)
        except Malformed:
            return None
        crc = int.from_bytes(content[covered : covered + _U32.size], "little")
        return attachment if not crc or crc == zlib.crc32(content[:covered]) else None

    def _chunk(self, frame: _RecordSpan) -> bytes:
        """The records in a chunk, of which some field may be damaged.

        Raises Malformed if its checksum fits nothing, LimitExceeded if it asks for too much.
        """
        content = self._content(frame)
        if len(content) < CHUNK_HEAD.size + _U32.size + _U64.size:
            raise Malformed("it is cut off")
        _, _, size, crc = CHUNK_HEAD.unpack_from(content)
        found = re.match(b"|".join(_packed(each) for each in COMPRESSIONS), content[CHUNK_HEAD.size :][:8])
        first = found[0][_U32.size :].decode() if found else ""
        too_large: LimitExceeded | None = None
        for compression in sorted(COMPRESSIONS, key=lambda name: name != first):
            if not crc and compression != first:
                continue  # nothing would tell right from wrong
            at = CHUNK_HEAD.size + _U32.size + len(compression) + _U64.size
            length = int.from_bytes(content[at - _U64.size : at], "little")
            packed = content[at : at + length] if length <= len(content) - at else content[at:]
            for told in dict.fromkeys((size, declared_size(compression, packed))) if crc else (size,):
                self._deadline.check(str(self.path))
                try:
                    check_chunk(len(packed), told, "chunk")
                    self._work += told
                    check_work(self.report.size, self._work, str(self.path))
                    return unpacked(compression, packed, told, crc)
                except LimitExceeded as error:
                    too_large = too_large or error
                except Malformed:
                    continue
        raise too_large or Malformed("its checksum is wrong")

    def _times(self, frame: _RecordSpan) -> tuple[int, int]:
        """First and last time of the messages in a chunk, as it says itself, without a checksum."""
        content = self._bytes(frame.at + HEAD.size, CHUNK_HEAD.size)
        if len(content) < CHUNK_HEAD.size:
            return 0, 0
        start, end, _, _ = CHUNK_HEAD.unpack(content)
        return start, end

    # -- from record to record --------------------------------------------------------------------------------

    def _walk(self) -> Iterator[_RecordSpan]:
        """All records up to the end of the data, and what lies between them."""
        at, limit = len(MAGIC), self._data_end
        ended = False
        while at < limit:
            frame = self._frame(at, limit, ended)
            if frame.opcode == 0 and frame.end == at:
                frame = _RecordSpan(0, at, self._seek_record(at + 1, limit))
            if frame.opcode == records.MESSAGE:
                self._loose = True
            if not ended or frame.opcode:
                yield frame
            # behind the data there is only the index, of which nothing can be lost
            ended = ended or frame.opcode == records.DATA_END
            at = frame.end

    def _frame(self, at: int, limit: int, ended: bool) -> _RecordSpan:
        """The record at ``at``, as far as it fits; of no length if nothing tells where it ends.

        Behind the data (``ended``) there are other records than those in the table.
        """
        head = self._bytes(at, HEAD.size)
        if len(head) < HEAD.size:
            return _RecordSpan(0, at, at)
        opcode, length = HEAD.unpack(head)
        outer = at + HEAD.size + length
        inner = self._inner_end(opcode, at, limit)
        if inner == outer or (ended and outer <= limit and opcode not in _FIELDS and self._fits(outer, limit)):
            return _RecordSpan(opcode, at, outer)
        outer_fits = outer <= limit and self._fits(outer, limit)
        if inner and outer_fits and inner < outer and opcode in _FIELDS and not self._fits(inner, limit):
            # more bytes than its fields need, as MCAP allows; of a chunk only the opcode may be damaged
            return _RecordSpan(
                records.CHUNK if self._inner_end(records.CHUNK, at, limit) == outer else opcode, at, outer
            )
        # where both may be, the nearer end swallows nothing
        if inner and self._fits(inner, limit) and not (outer_fits and outer < inner):
            return _RecordSpan(opcode, at, inner)  # its length is damaged
        if outer_fits:
            if opcode in (records.MESSAGE, records.CHUNK, records.ATTACHMENT, records.METADATA):
                return _RecordSpan(opcode, at, outer)  # a field of it is damaged, if it has any: its checksum tells
            # of a chunk only the opcode may be damaged
            return _RecordSpan(records.CHUNK if self._inner_end(records.CHUNK, at, limit) == outer else 0, at, outer)
        return _RecordSpan(0, at, at)

    def _fits(self, at: int, limit: int, chain: int = 1) -> bool:
        """Whether at ``at`` the file ends, or ``chain`` records may follow."""
        for _ in range(chain):
            head = self._bytes(at, HEAD.size)
            if at == limit or head.startswith(MAGIC):
                return True
            if len(head) < HEAD.size:
                return False
            opcode, length = HEAD.unpack(head)
            at += HEAD.size + length
            if not (0 < opcode <= records.DATA_END or opcode >= records.PRIVATE) or at > limit:
                return False
        return True

    def _inner_end(self, opcode: int, at: int, limit: int) -> int:
        """Where a record ends by its own fields; 0 if they do not fit into the file."""
        fields = _FIELDS.get(opcode)
        if not fields:
            return 0
        end = at + HEAD.size
        for each in fields:
            if isinstance(each, int):
                end += each
            else:
                size = self._bytes(end, each.size)
                if len(size) < each.size:
                    return 0
                end += each.size + each.unpack(size)[0]
            if end > limit:
                return 0
        return end

    def _seek_record(self, at: int, limit: int) -> int:
        """Offset of the next record that fits, or of the end."""
        pattern = _CANDIDATE_MESSAGE if self._loose else _CANDIDATE
        while at < limit:
            self._deadline.check(f"{self.path}: offset {at:,}")
            at = min(files.next_data(self._stream, at), limit)
            window = self._bytes(at, min(_WINDOW, limit - at))
            self._window = (at, window)
            for found in pattern.finditer(window):
                if self._is_record(at + found.start(), limit):
                    self._window = (0, b"")
                    return at + found.start()
            # a head may lie across the end of the window
            at += max(1, len(window) - HEAD.size + 1) if at + len(window) < limit else len(window)
        self._window = (0, b"")
        return limit

    def _is_record(self, at: int, limit: int) -> bool:
        """Whether there is a record beyond doubt."""
        opcode, length = HEAD.unpack(self._bytes(at, HEAD.size))
        end = at + HEAD.size + length
        if opcode == records.MESSAGE:
            return bool(length >= MESSAGE_HEAD.size and self._fits(at, limit, _CHAIN))
        if self._inner_end(opcode, at, limit) != end:
            return False
        if opcode == records.DATA_END:
            return self._fits(end, limit)
        # what zeros and small numbers look like: the first text or array must not be empty
        first = _FIELDS[opcode][0]
        skipped = first if isinstance(first, int) else 0
        return opcode == records.CHUNK or self._bytes(at + HEAD.size + skipped, _U32.size) != bytes(_U32.size)

    def _small_content(self, frame: _RecordSpan) -> bytes:
        """Content of a record that is kept; nothing of one that is larger than any that makes sense."""
        return self._content(frame) if 8 * (frame.end - frame.at) <= limits.current_limits().free else b""

    def _content(self, frame: _RecordSpan) -> bytes:
        """Content of a record.  Raises LimitExceeded."""
        limits.check_limit("memory", frame.end - frame.at, f"{self.path}: record at offset {frame.at:,}")
        return self._bytes(frame.at + HEAD.size, frame.end - frame.at - HEAD.size)

    def _bytes(self, at: int, size: int) -> bytes:
        start, window = self._window
        if start <= at and at + size <= start + len(window):
            return window[at - start : at - start + size]
        self._stream.seek(at)
        return self._stream.read(size)


class _SalvagePass:
    """One pass over the messages."""

    def __init__(self, file: Salvage) -> None:
        self._file = file
        self._report = file.report
        self._open: list[Loss] = []  # since the last message: how far they reach shows with the next one
        self._unknown: dict[int, Loss] = {}
        self._unknown_counts: dict[int, int] = {}
        self._seq = self._entries = self._seen = 0

    def run(self) -> Iterator[Salvaged]:
        file, report = self._file, self._report
        torn: _RecordSpan | None = None
        for frame in file._walk():
            file.position = frame.end
            file._deadline.check(str(file.path))
            if frame.opcode == records.CHUNK:
                yield from self._read_chunk(frame)
            elif frame.opcode == records.MESSAGE and file.foreign:
                yield from self._message(file._content(frame), frame)
            elif frame.opcode == 0 and frame.end == report.size and not report.closed:
                torn = frame
            elif frame.opcode in (0, records.MESSAGE) or frame.opcode >= records.PRIVATE:
                # a message of ours outside of a chunk has lost the chunk around it, and with it the checksum
                self._lose(BYTES, frame, "not readable")
            elif frame.opcode == records.ATTACHMENT and file._attachment(frame) is None:
                self._lose(ATTACHMENT, frame, "its checksum is wrong")
            elif frame.opcode == records.METADATA and (damage := self._damage_of_metadata(frame)):
                self._lose(METADATA, frame, damage)
        self._end(torn)

    def _read_chunk(self, frame: _RecordSpan) -> Iterator[Salvaged]:
        try:
            data = self._file._chunk(frame)
        except (Malformed, LimitExceeded) as error:
            self._lose(CHUNK, frame, str(error))
            return
        at = 0
        for opcode, content in _records(data):
            at += HEAD.size + len(content)
            if opcode in _DEFINITIONS:
                self._file._define(opcode, content, checked=True)
            elif opcode == records.MESSAGE:
                yield from self._message(content, frame)
        if at != len(data):
            self._lose(CHUNK, frame, f"found bytes that are no record after {at} of {len(data)} bytes")

    def _message(self, content: bytes, frame: _RecordSpan) -> Iterator[Salvaged]:
        if len(content) < MESSAGE_HEAD.size:
            self._lose(BYTES, frame, "a message shorter than its head")
            return
        self._seen += 1
        limits.check_limit("count", self._seen, f"{self._file.path}: messages", message_bound(self._report.size))
        number, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
        definition = self._file._definition(number)
        if definition is None:
            if number not in self._unknown:
                self._unknown[number] = self._lose(CHANNEL, frame, "")
            self._unknown_counts[number] = self._unknown_counts.get(number, 0) + 1
            return
        message = Message(number, log_time, content[MESSAGE_HEAD.size :], publish_time, sequence)
        entry = None
        if definition.decode:
            step = (sequence - self._seq) % SEQUENCES
            if not self._file.foreign and (step == 0 or (self._seq and step >= SEQUENCES // 2)):
                self._lose(NUMBER, frame, f"found entry number {sequence}, expected one above {self._seq}")
                return
            seq = self._entries + 1 if self._file.foreign else self._seq + step
            try:
                row = (number, sequence, log_time, publish_time, MESSAGE_HEAD.size, len(content), content)
                entry = definition.decode(row, seq)
            except LayoutError as error:
                self._lose(NUMBER, frame, f"entry {seq}: {error}")
                return
            self._close_losses(log_time, seq - self._seq - 1)
            self._seq = seq
            self._entries += 1
        report = self._report
        report.messages += 1
        report.start_ns = min(report.start_ns, log_time) if report.messages > 1 else log_time
        report.end_ns = max(report.end_ns, log_time)
        yield Salvaged(definition.schema, definition.channel, message, entry)

    def _lose(self, what: str, frame: _RecordSpan, text: str) -> Loss:
        if what == BYTES and self._open and self._open[-1].what == BYTES:
            last = self._open[-1]
            if last.at + last.size == frame.at:
                last.size += frame.end - frame.at
                return last
        start, end = self._report.end_ns, 0
        if what == CHUNK:
            told = self._file._times(frame)
            if start <= told[0] <= told[1]:
                start, end = told
        loss = Loss(what, frame.at, frame.end - frame.at, start, end, text)
        if len(self._report.lost) < MAX_LOSSES:
            self._report.lost.append(loss)
        else:
            self._report.more_lost += 1
        if len(self._open) < MAX_LOSSES:
            self._open.append(loss)
        return loss

    def _close_losses(self, log_time: int, missing: int) -> None:
        """An entry follows the losses that are open: they end here, or turn out to be none."""
        if not self._open:
            return
        for loss in self._open:
            # bytes between entries with successive numbers were the index of a chunk
            if loss.what == BYTES and not missing and not self._file.foreign:
                self._dismiss(loss)
            elif loss.end_ns == 0:
                loss.end_ns = max(loss.start_ns, log_time)
        self._report.missing_numbers += 0 if self._file.foreign else missing
        self._open.clear()

    def _dismiss(self, loss: Loss) -> None:
        if loss in self._report.lost:
            self._report.lost.remove(loss)

    def _damage_of_metadata(self, frame: _RecordSpan) -> str:
        """What is wrong with a metadata record, ``""`` where nothing is."""
        metadata = _parsed(records.parse_metadata, self._file._small_content(frame))
        if metadata is None:
            return "not readable"
        try:
            if metadata.name == layout.LEDGER_METADATA:
                _check_ledger(metadata)
            elif metadata.name in _SESSION and not self._file.session:
                _check_session(metadata)
        except (LayoutError, DamagedRecording) as error:
            return str(error)
        return ""

    def _end(self, torn: _RecordSpan | None) -> None:
        file, report = self._file, self._report
        for number, loss in self._unknown.items():
            loss.text = f"{self._unknown_counts[number]:,} messages of a channel of which no description is left"
        if file._statistics is not None:
            report.missing = max(0, file._statistics.message_count - report.messages)
            if report.missing and not any(loss.what in (BYTES, CHUNK, CHANNEL, NUMBER) for loss in report.lost):
                self._lose(BYTES, _RecordSpan(0, 0, 0), "messages of the index were not found")
            if not report.missing:
                # not a message is missing, so the bytes were nothing but indexes
                report.lost = [loss for loss in report.lost if loss.what not in (BYTES, CHUNK)]
            if file._statistics.attachment_count > len(file._attachments):
                self._lose(ATTACHMENT, _RecordSpan(0, 0, 0), "not found")
        end = _RecordSpan(0, report.size, report.size)
        if not report.closed:
            rest = f" and {torn.end - torn.at:,} bytes of a record" if torn else ""
            why = "is not there yet: it is being recorded" if file.growing else "was not yet on the disk"
            self._lose(CUT_OFF, torn or end, f"the file ends here{rest}: what came after it {why}")
        ours = not file.foreign
        if ours and not file.session:
            self._lose(METADATA, _RecordSpan(0, 0, 0), "what the recording says of itself, such as the configuration")
        if ours and file.ledger is None and report.closed:
            self._lose(LEDGER, end, "what became of every message")


def _records(data: bytes, opcodes: tuple[int, ...] = ()) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of records in a row (of these opcodes, or all), up to the first that does not fit."""
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > len(data) - at:
            return
        if not opcodes or opcode in opcodes:
            yield opcode, data[at : at + length]
        at += length


def _parsed(read: Callable[[bytes], _Record], content: bytes) -> _Record | None:
    """A record; None if the bytes are none."""
    try:
        return read(content)
    except Malformed:
        return None


def _packed(text: str) -> bytes:
    return re.escape(_U32.pack(len(text)) + text.encode())


def _check_session(metadata: Metadata) -> dict[str, str]:
    """The session metadata of a record.  Raises LayoutError, DamagedRecording."""
    items = layout.unseal(metadata.metadata)
    digits(items.get(layout.FORMAT_VERSION_KEY), layout.FORMAT_VERSION_KEY)
    facts.check_session(items, metadata.name)
    return items


def _check_ledger(metadata: Metadata) -> dict[str, Any]:
    """The ledger of a record.  Raises LayoutError, DamagedRecording."""
    return facts.ledger(layout.unseal(metadata.metadata).get(layout.LEDGER_KEY, ""), metadata.name)


def _unsealed(metadata: Metadata) -> dict[str, str] | None:
    try:
        return _check_session(metadata)
    except (LayoutError, DamagedRecording):
        return None


def _ledger(metadata: Metadata) -> dict[str, Any] | None:
    try:
        return _check_ledger(metadata)
    except (LayoutError, DamagedRecording):
        return None

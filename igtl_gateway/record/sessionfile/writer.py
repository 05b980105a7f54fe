"""Writing a session file: entries in, MCAP out, as ``docs/reference/session-log.md`` specifies.

Synchronous and single-threaded; the recorder runs it in its own process, tools use it directly.  It adds no times and
nothing random: equal entries give equal records, and equal files with the same compressor.

What a whole file depends on is there twice: the session metadata; and schemas and channels, which are in the first
chunk that needs them and also between the chunks.  So a single damaged place costs only the chunk that it is in.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from io import BufferedWriter, BytesIO, FileIO
from pathlib import Path
from typing import Any, Literal

from mcap.records import Attachment, Metadata

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import FileTaken, RecordingError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.systems.files import sync_folder
from igtl_gateway.base.version import __version__
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import figures, layout
from igtl_gateway.record.sessionfile.chunk_rows import MessageRows, RowStream
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.figures import Figures
from igtl_gateway.record.sessionfile.large_outputs import DIGEST_NAME, LARGE_BYTES, Causes, LargeOutputs, pack_digest
from igtl_gateway.record.sessionfile.layout import CHUNK_BYTES, LayoutError
from igtl_gateway.record.sessionfile.messages import RawPacker, device_name, pack_message
from igtl_gateway.record.sessionfile.new_file import cannot_begin, create_file, os_error_text, unbuffered
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.sealing import Sealer
from igtl_gateway.record.sessionfile.side_file import TopicCount, topic_counts
from igtl_gateway.record.sessionfile.stream import McapStream
from igtl_gateway.record.sessionfile.whole_files import replaced

#: When written data are forced to the disk, so that a power failure does not lose them.
Fsync = Literal["never", "flush", "close"]
QosOf = Callable[[str, str], Qos | None]
DefinitionOf = Callable[[str], Definition | None]

#: Channels of ROS topics.  MCAP has 65,535 channels, and the other kinds need some.
_MAX_ROS_CHANNELS = 60_000
#: Bound of the known streams and links: more than a session has, unless a peer invents names.
_MAX_KNOWN = 10_000
#: More than the head of a message has: links, type and device name of its stream.
_HEAD_BYTES = 64 << 10
_U64 = 1 << 64
_DATASYNC = getattr(os, "fdatasync", os.fsync)  # not every system has fdatasync


class _TakenAway(OSError):
    """The file is not what was written."""


class SessionWriter:
    """Writes one session file.

    Args:
        path: the file to create.
        session: the session metadata (configuration, versions, host …).
        qos_of: QoS of a ROS topic (name, type), None where it is not known.
        definition_of: definition of a ROS type, None where it is not known; it has precedence over other sources.
        compression: of the chunks.
        together: see ``McapStream``.
        chunk_bytes: size at which a chunk is closed.
        fsync: when written data are forced to the disk.
        overwrite: replace an existing file instead of refusing it.
        prologue: inputs before the first entry that the gateway's state follows from.
        types: definitions of ROS types; a caller that writes several files shares one.
        memory: write into this instead of a file.
        sealer: seals the file at each flush and at its end.
        counted: write the figures of the entries at the end of the file.
        outputs: how large outputs are written; None: in full.

    Raises RecordingError when the file cannot be created, DiskRefused where the disk is the reason.  From the
    constructor on the file can be read by scanning, and after :meth:`close` by its index.
    """

    def __init__(
        self,
        path: Path,
        session: dict[str, str],
        *,
        qos_of: QosOf = lambda _topic, _type: None,
        definition_of: DefinitionOf = lambda _type: None,
        compression: Compression = "lz4",
        together: bool = False,
        chunk_bytes: int = CHUNK_BYTES,
        fsync: Fsync = "never",
        overwrite: bool = False,
        prologue: Iterable[Entry] = (),
        types: RosTypes | None = None,
        memory: BytesIO | None = None,
        sealer: Sealer | None = None,
        counted: bool = False,
        outputs: LargeOutputs | None = None,
    ) -> None:
        self.path = path
        #: Entries written so far, and those that a failure leaves: as of the last flush, none of a file taken away.
        self.entries = self.flushed_entries = 0
        #: Whether another program has removed, replaced or changed the file.
        self.was_taken = False
        #: Stamps of the first and the last one, 0 before there is one.
        self.start_ns = self.end_ns = 0
        #: ROS types without a definition: their messages are recorded, but other tools cannot decode them.
        self.undefined: list[str] = []
        self._qos_of = qos_of
        self._definition_of = definition_of
        self._types = types  # None: not needed so far; those of rosbags take 0.1 s
        self._topics = layout.WireTopics()
        self._channels: dict[tuple[Kind, str, str], int] = {}  # by kind, channel and type of the entries
        self._digests: dict[tuple[Kind, str, str], int] = {}  # likewise, of those whose digest is written
        # channel and packer by kind, channel, type and links of the entries
        self._known: dict[tuple[Kind, str, str, tuple[int, ...]], tuple[int, RawPacker | None]] = {}
        self._schemas: dict[str, int] = {}
        self._figures: dict[str, Figures] = {}
        self._closed = False
        self._refused: FileIO | None = None  # the file, once the disk has refused something of it
        self._flushed: tuple[int, dict[int, int]] = 0, {}  # end, and messages by channel, at the last flush
        self._failure = ""
        self._fsync = fsync
        before = packed_session(prologue, qos_of, definition_of, self._types)
        self._outputs = outputs if outputs and outputs.mode != "full" else None
        self._causes = Causes(self._outputs, midway=bool(before)) if self._outputs else None
        self._left_out = 0  # large outputs that are not to be here
        with replaced(path) if overwrite and os.path.lexists(path) else nullcontext(path) as place:
            self._file = memory or create_file(place)
            self._mcap = McapStream(
                self._file, chunk_bytes=chunk_bytes, compression=compression, together=together, sealer=sealer
            )
            try:
                self._start(session, before)
                if counted:
                    self.count(figures.FILE, Figures())
                if fsync != "never":
                    sync_folder(place.parent)
            except OSError as error:
                self._abandon()
                with suppress(OSError):  # the disk has become read-only
                    place.unlink(missing_ok=True)
                raise cannot_begin(path, error) from error

    def _start(self, session: dict[str, str], prologue: bytes) -> None:
        version = layout.DIGEST_VERSION if self.has_digests else layout.FORMAT_VERSION
        facts = {**session, layout.FORMAT_VERSION_KEY: str(version)}
        self._mcap.start(layout.MCAP_PROFILE, f"igtl-gateway {__version__}")
        for name in layout.SESSION_RECORDS:
            self._mcap.add_metadata(name, layout.seal(facts))
        configuration = facts.get(layout.CONFIGURATION_KEY, "{}").encode()
        self._mcap.add_attachment(layout.CONFIGURATION_ATTACHMENT, "application/json", configuration)
        if prologue:
            self._mcap.add_attachment(layout.PROLOGUE_ATTACHMENT, "application/octet-stream", prologue)
        self._mcap.flush()

    def add_beside(self, found: Attachment | Metadata) -> None:
        """Add an attachment or a metadata record of another program, as it is.  Raises RecordingError."""
        with self._disk_errors():
            if isinstance(found, Metadata):
                self._mcap.add_metadata(found.name, found.metadata)
            else:
                times = found.log_time, found.create_time
                self._mcap.add_attachment(found.name, found.media_type, found.data, *times)

    def count(self, item: str, counts: Figures) -> None:
        """Count the entries of the file, and state it in an item of its figures.  To be called before the first one."""
        counts.begin_file()
        self._figures[item] = counts
        self._mcap.watchers.append(counts.add_chunk)

    @property
    def is_counted(self) -> bool:
        """Whether the file gets figures."""
        return bool(self._figures)

    def write(self, entry: Entry) -> None:
        """Add an entry; the next :meth:`flush` hands it to the operating system.

        Raises LayoutError for an entry that the format cannot hold (the file is not touched), RecordingError when
        the disk refuses (then nothing more can be written).
        """
        seq, stamp_ns, source_ns = entry.seq, entry.stamp_ns, entry.source_ns
        if not (0 <= stamp_ns < _U64 and 0 <= source_ns < _U64 and seq >= 0):
            found = f"number {seq}, stamp {stamp_ns} ns, source stamp {source_ns} ns"
            raise LayoutError(f"entry of {entry.channel or entry.kind.value}: found {found}, expected unsigned 64 bits")
        kind = entry.kind
        if self._causes is not None and not self._is_full(self._causes, entry):
            return
        known = self._known.get((kind, entry.channel, entry.type, entry.links))
        packer = known[1] if known else RawPacker(entry) if kind in layout.WIRE_TOPICS else None
        head, data = b"", _data(entry)
        if packer:
            head = packer.head(entry, data)
        elif not known or kind in layout.NOTE_KINDS:  # of the other known streams, the payload is the message
            data = pack_message(entry)
        channel = known[0] if known else self._learn_channel(entry, packer)
        self._add(entry, channel, head, data)

    def _add(self, entry: Entry, channel: int, head: bytes, data: Buffer) -> None:
        """Add the message of an entry, in two pieces.  Raises RecordingError."""
        stamp_ns = entry.stamp_ns
        if self._failure or self._closed:
            self._check_open()
        try:
            self._mcap.add_message(channel, stamp_ns, head, data, entry.source_ns or stamp_ns, entry.seq & 0xFFFFFFFF)
        except OSError as error:
            raise self._failed(error) from error
        self.start_ns = self.start_ns or stamp_ns
        self.end_ns = stamp_ns
        self.entries += 1

    def _is_full(self, causes: Causes, entry: Entry) -> bool:
        """Whether an entry is to be written in full; else this has written its digest or counted it, or raises."""
        assert self._outputs
        place = self.entries + self._left_out
        if entry.kind.is_input:
            causes.input(entry, place)
            return True
        if entry.size < LARGE_BYTES or entry.kind in layout.NOTE_KINDS or not causes.follows(entry, place):
            return True
        if self._outputs.mode == "none":
            self._outputs.left_out[entry.channel] += 1
            self._left_out += 1
            return False
        data = _data(entry)
        message = pack_digest(entry, data)
        self._add(entry, self._digest_channel(entry), b"", message)
        for counts in self._figures.values():
            counts.add_bytes(entry.kind, entry.channel, entry.type, len(data), message)
        return False

    @property
    def has_digests(self) -> bool:
        """Whether the digest may stand for a large output."""
        return self._outputs is not None and self._outputs.mode == "digest"

    def takes_rows(self, largest: int) -> bool:
        """Whether :meth:`add_rows` takes entries whose payload is below this size."""
        return self._mcap.takes_rows(largest + _HEAD_BYTES)

    def row_stream(self, entry: Entry) -> RowStream | None:
        """How :meth:`add_rows` writes the entries of a stream, of which this one was written; None if it does not."""
        known = self._known.get((entry.kind, entry.channel, entry.type, entry.links))
        if known is None or entry.kind in layout.NOTE_KINDS:
            return None
        if self._outputs and not entry.kind.is_input and entry.size >= LARGE_BYTES:
            return None  # its digest may be enough
        channel, packer = known
        return (channel, *packer.common) if packer else (channel, -1, b"")

    def add_rows(self, room: memoryview, begin: int, end: int, streams: list[RowStream | None]) -> tuple[int, int, int]:
        """Add entries straight from the recorder's queue, as :meth:`write` would.

        Arguments as of ``chunk_rows.add_rows``.  Returns the end of the last row that was taken, the number of rows,
        and the bytes of their payloads.  What it left goes to :meth:`write`.  Raises RecordingError as that.
        """
        self._check_open()
        place, rows, size, first_ns, last_ns = self._mcap.add_rows(room, begin, end, streams)
        if rows:
            self.start_ns = self.start_ns or first_ns
            self.end_ns = last_ns
            self.entries += rows
        return place, rows, size

    def add_columns(self, rows: MessageRows, row: int, streams: list[RowStream | None]) -> int:
        """Add entries from a row on, as :meth:`write` would, up to one that only it takes; return the row of that.

        ``streams``: by ident, as of :meth:`row_stream`; only :meth:`write` takes those of None.  Raises RecordingError.
        """
        with self._disk_errors():
            end = self._mcap.add_columns(rows, row, streams)
        if end > row:
            self.start_ns = self.start_ns or int(rows.times[row])
            self.end_ns = int(rows.times[end - 1])
            self.entries += end - row
        return end

    def end_full_chunk(self) -> None:
        """Write what :meth:`add_rows` took as soon as it fills a chunk.  Raises RecordingError."""
        with self._disk_errors():
            self._mcap.end_full_chunk()

    def flush(self) -> None:
        """Hand all entries to the operating system: SIGKILL does not lose them.  Raises RecordingError.

        Here and at the end a file is detected that was removed, replaced or changed by another program (FileTaken): no
        other call fails for that.
        """
        with self._disk_errors():
            self._mcap.flush()
            self._check_file("flush")
        self.flushed_entries, self._flushed = self.entries, (self.end_ns, self._mcap.counts)

    @property
    def has_failed(self) -> bool:
        """Whether nothing more can be written: the disk has refused, or the file was taken away."""
        return bool(self._failure)

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return 0 if self._file.closed else self._mcap.size

    def close(self, ledger: dict[str, Any], *, last_part: bool = True) -> None:
        """Write the ledger and the index.  Idempotent.  Raises RecordingError; what was flushed stays readable.

        Args:
            ledger: the ledger.
            last_part: for the seal: the recording has no further part.
        """
        if self._closed:
            return
        self._closed = True
        if self._failure:
            return
        with self._disk_errors():
            self._mcap.flush()
            if stated := figures.record_of(self._figures):
                self._mcap.add_metadata(layout.FIGURES_METADATA, stated)
            self._mcap.add_metadata(layout.LEDGER_METADATA, layout.seal_ledger(ledger))
            self._mcap.finish(last_part=last_part)
            self._file.flush()
            self._check_file("flush", "close")
            if isinstance(self._file, BufferedWriter):
                self._file.close()

    def finish_after_failure(self, ledger: dict[str, Any], *, last_part: bool = True) -> bool:
        """Give a file of which the disk has refused something its end, behind what was flushed; whether it has one.

        To be called again when there is room.  Arguments as of `close`.
        """
        raw = self._refused
        if raw is None:
            return False
        end, size = BytesIO(), self._mcap.flushed_size
        self.entries, (self.end_ns, counts) = self.flushed_entries, self._flushed
        self._mcap.go_back(end, counts)
        self._mcap.add_metadata(layout.LEDGER_METADATA, layout.seal_ledger(ledger))
        self._mcap.finish(last_part=last_part)
        try:
            raw.truncate(size)
            raw.seek(size)
            left = end.getbuffer()
            while left:
                left = left[raw.write(left) or 0 :]
        except OSError:
            with suppress(OSError):
                raw.truncate(size)
            return False
        self.give_up()
        return True

    def give_up(self) -> None:
        """Leave a file without its end."""
        raw, self._refused = self._refused, None
        if raw:
            with suppress(OSError):
                raw.close()

    @property
    def files(self) -> list[Path]:
        """The files that were written."""
        return [self.path]

    def topics(self) -> list[TopicCount]:
        """Messages of a closed file by topic and type; the kinds of entries of one topic together."""
        return topic_counts(self._mcap)

    def _learn_channel(self, entry: Entry, packer: RawPacker | None) -> int:
        """The channel of an entry of a new kind, stream, type or links; it is kept for the next such entries."""
        channel = self._channels.get((entry.kind, entry.channel, entry.type)) or self._open_channel(entry)
        if len(self._known) >= _MAX_KNOWN:
            self._known.clear()
        self._known[entry.kind, entry.channel, entry.type, entry.links] = channel, packer
        return channel

    def _open_channel(self, entry: Entry) -> int:
        """The channel of the first entry of a stream."""
        stream = (entry.kind, entry.channel, entry.type)
        if entry.kind in layout.ROS_KINDS:
            if len(self._channels) >= _MAX_ROS_CHANNELS:
                raise LayoutError(
                    f"topic {entry.channel}: found {counted(len(self._channels), 'channel')}, expected fewer"
                )
            qos = self._qos_of(entry.channel, entry.type) or Qos()
            channel = self._register(entry.channel, entry.type, entry.kind, {layout.QOS_KEY: layout.qos_yaml(qos)})
        elif entry.kind in layout.NOTE_KINDS:
            channel = self._register(layout.NOTES_TOPIC, layout.NOTE_TYPE, entry.kind, {})
        else:
            topic = self._topics.topic(entry.kind, entry.type, device_name(entry))
            facts = {layout.STREAM_KEY: layout.escape(entry.channel)}
            if topic in layout.SHARED_TOPICS:
                # not kept under the name of the stream: there may be any number of them
                stream, facts = (entry.kind, topic, ""), {}
                if stream in self._channels:
                    return self._channels[stream]
            channel = self._register(topic, layout.RAW_MESSAGE_TYPE, entry.kind, facts)
        self._channels[stream] = channel
        self._count_channel(channel, stream)
        return channel

    def _count_channel(self, channel: int, stream: tuple[Kind, str, str]) -> None:
        for counts in self._figures.values():
            if stream[1] in layout.SHARED_TOPICS:
                counts.give_up()
            else:
                counts.add_channel(channel, *stream)

    def _digest_channel(self, entry: Entry) -> int:
        """The channel of the digests of a stream, beside that of its other messages: no other program reads these."""
        stream = (entry.kind, entry.channel, entry.type)
        if stream in self._digests:
            return self._digests[stream]
        facts = {layout.DIGEST_KEY: DIGEST_NAME}
        if entry.kind in layout.ROS_KINDS:
            topic, ros_type = entry.channel, entry.type
            qos = self._qos_of(entry.channel, entry.type) or Qos()
        else:
            topic, ros_type = self._topics.topic(entry.kind, entry.type, device_name(entry)), layout.RAW_MESSAGE_TYPE
            qos = Qos()
            if topic in layout.SHARED_TOPICS:
                stream = (entry.kind, topic, "")
                if stream in self._digests:
                    return self._digests[stream]
            else:
                facts[layout.STREAM_KEY] = layout.escape(entry.channel)
        # its definition has to be in the file: who reads it gets messages of this type
        definition = self._register_schema(ros_type)
        if definition and definition.type_hash:
            facts[layout.DIGEST_HASH_KEY] = definition.type_hash
        facts |= {layout.DIGEST_TOPIC_KEY: topic, layout.DIGEST_TYPE_KEY: ros_type}
        facts[layout.QOS_KEY] = layout.qos_yaml(qos)
        place = f"{layout.DIGEST_TOPIC}{topic}"
        self._digests[stream] = channel = self._register(place, layout.RAW_MESSAGE_TYPE, entry.kind, facts)
        self._count_channel(channel, stream)
        return channel

    def _register(self, topic: str, ros_type: str, kind: Kind, facts: dict[str, str]) -> int:
        metadata = {layout.QOS_KEY: layout.qos_yaml(Qos()), layout.KIND_KEY: kind.value, **facts}
        definition = self._register_schema(ros_type)
        if definition and (type_hash := definition.file_hash(ros_type)):
            metadata[layout.TYPE_HASH_KEY] = type_hash
        with self._disk_errors():
            return self._mcap.register_channel(topic, layout.MESSAGE_ENCODING, self._schemas[ros_type], metadata)

    def _register_schema(self, ros_type: str) -> Definition | None:
        definition = self._definition_of(ros_type)
        if not definition:
            self._types = self._types or RosTypes()
            definition = self._types.find(ros_type)
        if ros_type not in self._schemas:
            if not definition:
                self.undefined.append(ros_type)
            # without a definition the encoding must be empty, too, as in files of rosbag2
            encoding, data = (definition.encoding, definition.data) if definition else ("", b"")
            with self._disk_errors():
                self._schemas[ros_type] = self._mcap.register_schema(ros_type, encoding, data)
        return definition

    def _check_file(self, *moments: Fsync) -> None:
        """Force the data to the disk where that is due.  Raises OSError if the file there is not what was written."""
        if not isinstance(self._file, BufferedWriter):
            return
        if self._fsync in moments:
            _DATASYNC(self._file.fileno())
        here = os.fstat(self._file.fileno())
        try:
            there = self.path.stat()
        except FileNotFoundError:
            raise _TakenAway(errno.ENOENT, "the file was removed") from None
        if (there.st_dev, there.st_ino) != (here.st_dev, here.st_ino):
            raise _TakenAway(errno.ESTALE, "another file took its place")
        if here.st_size != self._mcap.size:
            change = "the file was truncated" if here.st_size < self._mcap.size else "another program wrote to the file"
            raise _TakenAway(errno.ESTALE, change)

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Around code that may write: an error of the disk ends the recording, with one line."""
        self._check_open()
        try:
            yield
        except OSError as error:
            raise self._failed(error) from error

    def _check_open(self) -> None:
        if self._failure or self._file.closed:
            raise RecordingError(self._failure or f"recording to {self.path}: already closed")

    def _failed(self, error: OSError) -> RecordingError:
        """After an error the contents of file and buffers are unknown, so nothing more is written."""
        self._failure = f"recording to {self.path} failed: {os_error_text(error)}"
        if not isinstance(error, _TakenAway) and isinstance(self._file, BufferedWriter):
            with suppress(OSError):  # its end is written when there is room; until then it has what was flushed
                self._refused = unbuffered(self._file)  # what is in the buffer must not follow
                self._refused.truncate(self._mcap.flushed_size)
        self._abandon()
        if isinstance(error, _TakenAway):
            self.was_taken, self.flushed_entries = True, 0
            return FileTaken(self._failure)
        return RecordingError(self._failure)

    def _abandon(self) -> None:
        """Close the file without another attempt to write."""
        if isinstance(self._file, BufferedWriter):
            self._file.raw.close()


def _data(entry: Entry) -> bytes | memoryview:
    """The payload in one piece; one that is in one piece already is not copied."""
    payload = entry.payload
    if len(payload) == 1:
        part = payload[0]
        if type(part) is bytes or (
            type(part) is memoryview and part.format == "B" and part.ndim == 1 and part.c_contiguous
        ):
            return part
    return entry.data()


def packed_session(
    entries: Iterable[Entry], qos_of: QosOf, definition_of: DefinitionOf, types: RosTypes | None = None
) -> bytes:
    """Return entries as the bytes of an MCAP file of the same layout; no bytes without entries."""
    entries = list(entries)
    if not entries:
        return b""
    stream = BytesIO()
    writer = SessionWriter(
        Path(layout.PROLOGUE_ATTACHMENT), {}, qos_of=qos_of, definition_of=definition_of, types=types, memory=stream
    )
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return stream.getvalue()

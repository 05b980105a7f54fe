"""Writing MCAP: chunks of messages, then the summary.

The library's own writer makes objects of each message and copies a payload seven times.  Here a message is packed once,
behind those before it.  A large message that is stored as it is, or with lz4, is not even copied once: it ends its
chunk, and goes from where it lies into the compressor or into the file.

How a large message is stored is decided by stream, while it is recorded, from sizes and gateway times alone:

- Where several large chunks of a stream in a row hardly shrink, the next ones are stored uncompressed, and from time to
  time one is tried again.
- In the files of a recorder, ``auto`` and ``zstd`` have chunks that continue behind a large message, because an input
  and its outputs have much in common: of three copies, one remains.  For real ultrasound that is a quarter of what lz4
  leaves, and less work.
- ``auto`` has lz4 for small messages, and for large ones while more of them come in a second than the recorder has time
  for with zstd.  One chunk in 32 of a stream is compressed at two levels: the slower one is for what it makes a quarter
  smaller, such as ultrasound, and the fast one finds copies at the speed of raw bytes, such as those of speckle.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import IO, Any

from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.chunk_rows import (
    ChunkIndex,
    MessageRows,
    RowStream,
    add_columns,
    add_rows,
    index_messages,
)
from igtl_gateway.record.sessionfile.compression import Compression, compress, picture_compressor
from igtl_gateway.record.sessionfile.file_end import pack_summary
from igtl_gateway.record.sessionfile.layout import CHUNK_BYTES, SEAL_METADATA
from igtl_gateway.record.sessionfile.records import MAGIC, MESSAGE, MESSAGE_HEAD, MESSAGE_RECORD, crc32, pack
from igtl_gateway.record.sessionfile.sealing import KINDS, SEAL, Sealer, entry_numbers

#: A message of this part of a chunk's size is large.
_LARGE = 4

#: Outputs have the gateway time of their input and a few nanoseconds: what comes later than this is another input.
_OF_ONE_NS = 100
#: A chunk with large messages may be larger by this, until the next input: an input and its outputs are in one.
_WITH_LARGE = 8
#: Compressed size, relative to the uncompressed one, from which on compression is not worth its time: small for
#: ``auto``, which compares two levels by it, too; large for zstd, for which size comes first.
_POOR = {"lz4": 0.9, "auto": 0.75, "zstd": 0.98}
#: Levels of zstd for large messages, the fast one first.  Level 3 leaves 1 to 5 % less of ultrasound than level 2, and
#: takes 1.5 times as long.
_LEVELS: dict[str, tuple[int, ...]] = {"auto": (-5, 2), "zstd": (3,)}
#: The largest message that goes into a chunk with others: a reader accepts a chunk of 64 MiB at any ratio.
_MOST_HELD = 32 << 20
#: Large bytes in a second of gateway time up to which ``auto`` has zstd (1 to 4 ns each, so a quarter of a CPU).
_MOST_PER_S = 64_000_000
#: After this number of such chunks in a row ...
_TRIES = 4
#: ... this number is stored uncompressed before the next one is tried.
_UNCOMPRESSED = 31


class McapStream:
    """Writes one file.  Every method may raise OSError; after that no other may be called.

    Args:
        file: takes the bytes; it is not closed here.
        chunk_bytes: size at which a chunk ends.
        compression: of the chunks.
        together: with ``auto`` and ``zstd``, an input and its large outputs are in one chunk.
        sealer: seals what is written, at each flush and at the end.
    """

    def __init__(
        self,
        file: IO[bytes],
        *,
        chunk_bytes: int = CHUNK_BYTES,
        compression: Compression,
        together: bool = False,
        sealer: Sealer | None = None,
    ) -> None:
        #: Called with each chunk that is not copied, and the end of its last message.
        self.watchers: list[Callable[[bytearray, Buffer], None]] = []
        #: Bytes written so far.
        self.size = 0
        self._file = file
        self._sealer = sealer
        self._chunk_bytes = chunk_bytes
        self._large = sys.maxsize if compression == "zstd" and not together else chunk_bytes // _LARGE
        self._compression = compression
        self._zstd = [picture_compressor(level) for level in _LEVELS.get(compression, ())] if together else []
        self._judged: dict[int, int] = {}  # chunks until the levels are compared again, by channel
        self._slower: dict[int, bool] = {}  # whether a channel is worth the slower level
        self._large_ns = 0  # log time of the last large message
        self._held: list[int] = []  # channels of the large messages inside the chunk
        self._second_ns = self._second_bytes = 0  # since when large messages are counted, and their bytes
        self._is_fast = False  # more came in the last second than zstd has time for
        self._poor: dict[int, int] = {}  # large chunks in a row that hardly shrank, by channel of the large message
        self._chunk = bytearray()
        #: Definitions so far; number 1 comes first.
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self._chunks = bytearray()  # chunk indexes
        self._chunk_count = self._first = self._last = 0
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._flushed = self._state()
        self._seal_mark = sealer.mark() if sealer else None

    def start(self, profile: str, library: str) -> None:
        """To be called first."""
        self._put(MAGIC)
        self._put_record(records.HEADER, pack(Header(profile, library)))

    def add_metadata(self, name: str, items: dict[str, str]) -> None:
        """A metadata record, before the messages that wait for their chunk's end."""
        data = pack(Metadata(name=name, metadata=items))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(data), name=name))
        self._put_record(records.METADATA, data)

    def add_attachment(self, name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0) -> None:
        """An attachment, as add_metadata."""
        record = pack(
            Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)
        )
        self._attachments.append(
            AttachmentIndex(
                offset=self.size, length=len(record), create_time=create_time, log_time=log_time,
                data_size=len(data), name=name, media_type=media_type,
            )
        )  # fmt: skip
        self._put_record(records.ATTACHMENT, record)

    def register_schema(self, name: str, encoding: str, text: bytes, number: int | None = None) -> int:
        """A schema, in the chunk and between the chunks; returns its number, which is the next one unless given."""
        schema = Schema(id=number or len(self.schemas) + 1, data=text, encoding=encoding, name=name)
        self.schemas.append(schema)
        self._define(records.SCHEMA, schema)
        return schema.id

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: dict[str, str], number: int | None = None
    ) -> int:
        """A channel, as register_schema.  ``schema`` 0: it has none."""
        number = len(self.channels) + 1 if number is None else number
        channel = Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=metadata)
        self.channels.append(channel)
        self._define(records.CHANNEL, channel)
        return number

    def _define(self, opcode: int, record: McapRecord) -> None:
        data = pack(record)
        self._chunk += data
        self.end_full_chunk()
        self._put_record(opcode, data)

    def add_message(
        self, channel: int, log_time: int, head: bytes, data: Buffer, publish_time: int, sequence: int
    ) -> None:
        """A message, in two pieces; ``data`` may change as soon as this returns.  Times and numbers have to fit."""
        size = len(head) + len(data)
        is_large = size >= self._large
        is_held = is_large and self._holds(channel, size, log_time)
        if is_large and self._held:
            is_input = log_time - self._large_ns > _OF_ONE_NS
            if not is_held or (is_input and len(self._chunk) > self._chunk_bytes):
                self._end_chunk()
        if is_large:
            self._large_ns = log_time
        chunk = self._chunk
        begin = MESSAGE_RECORD.pack(MESSAGE, MESSAGE_HEAD.size + size, channel, sequence, log_time, publish_time)
        chunk += begin
        chunk += head
        if is_large and not is_held:
            self._end_chunk(channel, data)
            return
        chunk += data
        if is_held:
            self._held.append(channel)
        self.end_full_chunk()

    def _holds(self, channel: int, size: int, log_time: int) -> bool:
        """Whether a large message goes into the chunk, which zstd compresses; else it ends its own."""
        if not self._zstd or size > _MOST_HELD:
            return False
        if self._compression == "auto":
            self._second_bytes += size
            if log_time - self._second_ns >= NS_PER_S:
                self._is_fast = self._second_bytes * NS_PER_S > _MOST_PER_S * (log_time - self._second_ns)
                self._second_ns, self._second_bytes = log_time, 0
        return not (self._is_fast or self._is_poor(channel))

    def _is_poor(self, channel: int) -> bool:
        """Whether the large messages of a channel are stored as they are now."""
        return _TRIES <= self._poor.get(channel, 0) < _TRIES + _UNCOMPRESSED

    @property
    def _most(self) -> int:
        """The size at which the chunk ends."""
        return self._chunk_bytes * _WITH_LARGE if self._held else self._chunk_bytes

    def takes_rows(self, largest: int) -> bool:
        """Whether there is :meth:`add_rows`, and messages of up to this size do not end their chunk."""
        return add_rows is not None and largest < self._large

    def add_rows(
        self, room: memoryview, begin: int, end: int, streams: list[RowStream | None]
    ) -> tuple[int, int, int, int, int]:
        """Messages from the recorder's queue, as ``chunk_rows.add_rows``; :meth:`end_full_chunk` has to follow."""
        if add_rows is None:
            raise TypeError("installed without the C part")
        return add_rows(self._chunk, room, begin, end, streams, self._most)

    def add_columns(self, rows: MessageRows, row: int, streams: list[RowStream | None]) -> int:
        """Messages from a row on, as add_message each of them, up to one that only add_message takes; return its row.

        ``streams``: by ident; only add_message takes those of None.
        """
        if add_columns is None:
            return row
        before = -1
        while row != before:
            before = row
            row = add_columns(self._chunk, *rows, row, streams, self._most, self._large)
            self.end_full_chunk()
        return row

    def end_full_chunk(self) -> None:
        """Write the chunk if it has its size."""
        if len(self._chunk) > self._most:
            self._end_chunk()

    def flush(self) -> None:
        """End the chunk, seal what is not sealed yet, and hand all to the operating system."""
        self._end_chunk()
        if self._sealer and self._sealer.is_due:
            self._put_seal(self._sealer)
        self._file.flush()
        self._flushed = self._state()
        self._seal_mark = self._sealer.mark() if self._sealer else None

    def _state(self) -> tuple[int, ...]:
        """What is in the file, as far as only more can come."""
        return self.size, len(self._chunks), self._chunk_count, self._first, self._last, *map(len, self._lists())

    def _lists(self) -> tuple[list[Any], ...]:
        return self._attachments, self._metadata, self.schemas, self.channels

    @property
    def flushed_size(self) -> int:
        """Bytes of the file at the last flush."""
        return self._flushed[0]

    def go_back(self, file: IO[bytes], counts: dict[int, int]) -> None:
        """Forget what came after the last flush; what follows goes to another file, whose bytes belong there.

        Args:
            counts: messages by channel at the last flush.
        """
        self._file, self._counts = file, counts
        self._chunk.clear()
        self._held.clear()
        self.size, length, self._chunk_count, self._first, self._last, *lengths = self._flushed
        del self._chunks[length:]
        for each, number in zip(self._lists(), lengths, strict=True):
            del each[number:]
        if self._sealer and self._seal_mark:
            self._sealer.go_back(self._seal_mark)

    @property
    def counts(self) -> dict[int, int]:
        """Messages by channel, of complete chunks."""
        return dict(self._counts)

    def finish(self, *, last_part: bool = True) -> None:
        """Write the end of the file; nothing can be added after that.

        Args:
            last_part: for the seal: the recording has no further part.
        """
        self._end_chunk()
        if self._sealer is None:
            self._put(self._end_of_file(0))
            return
        self._metadata.append(MetadataIndex(offset=self.size, length=0, name=SEAL_METADATA))
        seal, end = self._sealer.last_seal(self._end_of_file, last_part=last_part)
        self._file.write(seal)
        self._file.write(end)
        self.size += len(seal) + len(end)

    def _put_seal(self, sealer: Sealer) -> None:
        seal = sealer.seal()
        self._metadata.append(MetadataIndex(offset=self.size, length=len(seal), name=SEAL_METADATA))
        self._put(seal)
        sealer.end_unit(SEAL)

    def _end_of_file(self, seal: int) -> bytes:
        """The end of the data section, the summary and the footer, behind a last seal of a length (0: without one)."""
        if seal:
            self._metadata[-1] = replace(self._metadata[-1], length=seal)
        data = bytearray(pack(DataEnd(0)))
        return bytes(data + self._summary(self.size + seal + len(data)))

    def _summary(self, start: int) -> bytes:
        """The summary, the footer and the last magic, at an offset."""
        groups: tuple[tuple[int, Buffer], ...] = (
            (records.SCHEMA, pack(*self.schemas)),
            (records.CHANNEL, pack(*self.channels)),
            (records.STATISTICS, pack(self.statistics())),
            (records.CHUNK_INDEX, self._chunks),
            (records.ATTACHMENT_INDEX, pack(*self._attachments)),
            (records.METADATA_INDEX, pack(*self._metadata)),
        )
        return pack_summary(start, groups)

    def statistics(self) -> Statistics:
        """Of the file up to its last complete chunk."""
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self._first,
            message_end_time=self._last,
            schema_count=len(self.schemas),
        )

    def _end_chunk(self, channel: int = 0, rest: Buffer = b"") -> None:
        """Write the chunk, if there is a message in it; ``rest``: the end of its last one, a large one of a channel."""
        first, last, index, rows = index_messages(self._chunk)
        if not rows:
            return
        for watcher in self.watchers:
            watcher(self._chunk, rest)
        size = len(self._chunk) + len(rest)
        numbers = entry_numbers(self._chunk, index, rows) if self._sealer else (-1, -1)
        crc = crc32(self._chunk)
        if rest:
            crc = crc32(rest, crc)
        name, parts = self._compressed(channel, rest, size)
        self._put_chunk((first, last, index, rows), size, crc, name, parts, numbers)
        self._chunk.clear()
        self._held.clear()

    def copy_chunk(self, data: bytes, crc: int, name: str, packed: bytes) -> None:
        """A chunk of another file as it is, behind those before it.

        Its schemas and channels have to be registered under their numbers.

        Args:
            data, crc: its records, and their checksum or 0.
            name, packed: of the compression, and what it makes of them.
        """
        self._end_chunk()
        found = index_messages(data)
        if found[3]:
            self._put_chunk(found, len(data), crc or crc32(data), name, [packed])

    def _put_chunk(
        self,
        found: ChunkIndex,
        size: int,
        crc: int,
        name: str,
        parts: Sequence[Buffer],
        numbers: tuple[int, int] = (-1, -1),
    ) -> None:
        """Write a chunk, whose compressed data are the parts, and its indexes."""
        first, last, index, rows = found
        packed = sum(map(len, parts))
        begin = self.size
        self._put(records.pack_chunk_head(first, last, size, crc, name, packed))
        for part in parts:
            self._put(part)
        end = self.size
        offsets: list[int] = []  # by channel: its number, the place of its index
        counts = self._counts
        for number, place, count in rows:
            offsets += (number, end + place)
            counts[number] = counts.get(number, 0) + count
        self._put_record(records.CHUNK, index, *numbers)
        self._chunks += records.pack_chunk_index(
            first, last, begin, end - begin, offsets, len(index), name, packed, size
        )
        self._first = min(self._first, first) if self._chunk_count else first
        self._last = max(self._last, last)
        self._chunk_count += 1

    def _compressed(self, channel: int, rest: Buffer, size: int) -> tuple[str, Sequence[Buffer]]:
        """The name of the compression of the chunk, and the parts that are to be written."""
        plain = (self._chunk, rest) if rest else (self._chunk,)
        if self._compression == "none":
            return "", plain
        channels = set(self._held) or {channel}
        if size >= self._large and not self._held and self._is_poor(channel):
            self._poor[channel] += 1
            return "", plain
        packed: Sequence[Buffer]
        if self._zstd and (self._held or self._compression == "zstd"):
            name, packed = "zstd", (self._with_zstd(plain),)
        else:
            name = "zstd" if self._compression == "zstd" else "lz4"
            packed = compress(name, plain, size)
        if size < self._large or not (self._held or rest or name == "lz4"):
            return name, packed
        is_small = sum(map(len, packed)) <= size * _POOR[self._compression]
        for one in channels:
            self._poor[one] = 0 if is_small else min(self._poor.get(one, 0) + 1, _TRIES)
        return (name, packed) if is_small else ("", plain)

    def _with_zstd(self, plain: Sequence[Buffer]) -> bytes:
        """A chunk as zstd compresses it, at the level of its streams."""
        data = b"".join(plain) if len(plain) > 1 else plain[0]
        fast, slow = self._zstd[0], self._zstd[-1]
        if fast is slow:
            return slow.compress(data)
        channels = set(self._held)
        for one in channels:
            self._judged[one] = self._judged.get(one, 0) - 1
        if all(self._judged[one] >= 0 for one in channels):
            return (slow if any(self._slower[one] for one in channels) else fast).compress(data)
        quick, small = fast.compress(data), slow.compress(data)
        is_worth_it = len(small) <= len(quick) * _POOR[self._compression]
        for one in channels:
            self._judged[one], self._slower[one] = _UNCOMPRESSED, is_worth_it
        return small if is_worth_it else quick

    def _put_record(self, opcode: int, data: Buffer, first: int = -1, last: int = -1) -> None:
        """Write the end of a record or of a chunk with its indexes: a unit of the seal, with its entry numbers."""
        self._put(data)
        if self._sealer:
            self._sealer.end_unit(KINDS[opcode], first, last)
            if self._sealer.is_full:
                self._put_seal(self._sealer)

    def _put(self, data: Buffer) -> None:
        self._file.write(data)
        self.size += len(data)
        if self._sealer:
            self._sealer.update(data)

"""What is in an MCAP file and where: what the index of a file holds, however it was made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from mcap.records import Channel, Schema

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile import records

#: What a slow machine unpacks and checks in a second.  It makes the limit of time a limit of bytes, which does not
#: depend on the speed of the caller.
_BYTES_PER_SECOND = 100_000_000


@dataclass(frozen=True, slots=True)
class ChunkEntry:
    """A chunk, or a run of messages outside of chunks.

    Attributes:
        start_ns, end_ns: log_time of its first and last message.
        at, length: its record in the file; of a run all its records.
        size: bytes unpacked.
        places: channel and offset of each of its message indexes, 10 bytes each.
        index_length: bytes of the message indexes behind it.
        loose: it is a run of records without a chunk around them.
    """

    start_ns: int
    end_ns: int
    at: int
    length: int
    size: int
    places: bytes = b""
    index_length: int = 0
    loose: bool = False

    @property
    def channels(self) -> list[int]:
        """Channels of its messages; none where no index names them."""
        return [channel for channel, _ in records.INDEX_OFFSET.iter_unpack(self.places)]

    @property
    def message_indexes(self) -> dict[int, int]:
        """Channel → offset of its message index."""
        return dict(records.INDEX_OFFSET.iter_unpack(self.places))


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """Name and place of an attachment or a metadata record."""

    name: str
    at: int
    length: int


@dataclass(slots=True)
class Index:
    """What is in a file.

    Attributes:
        size: bytes of the file.
        schemas, channels: by number.
        counts: messages by channel.
        start_ns, end_ns: log_time of the first and the last message; 0 without any.
        chunks: in the order of the file.
        attachments, metadata: in the order of the summary, or of the file.
        scanned: made by a pass over the file.
    """

    size: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    chunks: list[ChunkEntry] = field(default_factory=list)
    attachments: list[RecordPlace] = field(default_factory=list)
    metadata: list[RecordPlace] = field(default_factory=list)
    scanned: bool = False

    def define(self, opcode: int, content: bytes) -> None:
        """Add a schema or a channel.

        Of a definition that is longer than any that is parsed, the beginning is kept; it is refused like the whole.
        """
        if opcode == records.SCHEMA:
            schema = records.parse_schema(content)
            most = 4 * limits.current_limits().definition + 1  # a character of UTF-8 has at most 4 bytes
            self.schemas[schema.id] = schema if len(schema.data) <= most else replace(schema, data=schema.data[:most])
        elif opcode == records.CHANNEL:
            channel = records.parse_channel(content)
            self.channels[channel.id] = channel


def message_bound(size: int) -> int:
    """Messages that a file of ``size`` bytes may have: one for each byte, as they differ at least in their times."""
    return max(limits.current_limits().count // 10, size)


def check_work(file_size: int, work: int, place: str) -> None:
    """Raise LimitExceeded if unpacking ``work`` bytes of a file takes too long."""
    current = limits.current_limits()
    most = (current.seconds + current.seconds_per_mb * file_size // 1_000_000) * _BYTES_PER_SECOND
    if work > most:
        raise limits.exceeded("seconds", f"{counted(work, 'byte')} unpacked", place, counted(most, "byte"))


def work_of(chunks: Iterable[ChunkEntry]) -> int:
    """Bytes of all these chunks, unpacked."""
    return sum(chunk.size for chunk in chunks)

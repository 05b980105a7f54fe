"""Reads the records of a ROS 1 bag, format 2.0 (``#ROSBAG V2.0``, wiki.ros.org/Bags/Format/2.0), within the limits.

The index at the end of the file lists the connections and the chunks.  Each chunk is decompressed once and read
completely, so an index that repeats chunks or messages does not multiply the work.  Chunks that overlap in time are
merged.

Memory: the chunks that overlap at one time; if these are several, at most the limit ``free``.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits, unpack

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
#: Largest header of a record in bytes: a few fields of a few bytes each, and the name of a topic.
_MAX_HEADER = 1 << 16

_U32, _U64, _TIME, _PAIR = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II"), struct.Struct("<II")
_PACKINGS: dict[bytes, unpack.Packing] = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}


@dataclass(frozen=True, slots=True)
class BagConnection:
    """A publisher's connection: topic and type as in ROS 1, with the definition of the type."""

    number: int
    topic: str
    ros1_type: str
    definition: str
    latching: bool


@dataclass(frozen=True, slots=True)
class ChunkInfo:
    """A chunk in the index.

    Attributes:
        at: offset of the chunk in the file.
        start_ns: time of its first message.
        counts: connection → number of messages.
    """

    at: int
    start_ns: int
    counts: dict[int, int]


class BagMessage(NamedTuple):
    """A message; sorts by time, and by the order in the file if times are equal."""

    time_ns: int
    order: int
    connection: int
    data: bytes


class BagFile:
    """An open bag.  Raises UnsupportedRecording, DamagedRecording."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = files.size_of(path)
        self._deadline = files.deadline_of(path)
        self._stream = files.open_file(path)
        self.connections: list[BagConnection] = []
        self.chunks: list[ChunkInfo] = []
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def messages(self) -> Iterator[BagMessage]:
        """Yield all messages in the order of time.  Raises DamagedRecording."""
        chunks = sorted(self.chunks, key=lambda chunk: (chunk.start_ns, chunk.at))
        waiting: list[tuple[int, int, int, Iterator[BagMessage], BagMessage]] = []
        held = 0
        for index, chunk in enumerate(chunks):
            found, size = self._chunk(chunk, index)
            held += size
            if waiting:
                limits.check_limit("free", held, f"{self._path}: chunks that overlap in time")
            rest = iter(found)
            if first := next(rest, None):
                heapq.heappush(waiting, (first.time_ns, index, size, rest, first))
            else:
                held -= size
            end_ns = chunks[index + 1].start_ns if index + 1 < len(chunks) else None
            while waiting and (end_ns is None or waiting[0][0] < end_ns):
                _, one, size, rest, message = waiting[0]
                yield message
                if following := next(rest, None):
                    heapq.heapreplace(waiting, (following.time_ns, one, size, rest, following))
                else:
                    heapq.heappop(waiting)
                    held -= size

    # -- the index -----------------------------------------------------------------------------------------------

    def _open(self) -> None:
        magic = self._stream.read(len(_MAGIC))
        if magic != _MAGIC:
            raise UnsupportedRecording(f"{self._path}: found {magic!r}, expected {_MAGIC!r}")
        head = self._header(_BAG)
        if head.get(b"encryptor"):
            raise UnsupportedRecording(f"{self._path}: found an encrypted bag, expected a plain one")
        index, connections, chunks = (
            self._u64(head, b"index_pos"),
            *(self._u32(head, name) for name in (b"conn_count", b"chunk_count")),
        )
        if not index:
            raise DamagedRecording(f"{self._path}: found no index, expected one; run: rosbag reindex {self._path}")
        if index > self._size:
            raise DamagedRecording(
                f"{self._path}: cut off: found {counted(self._size, 'byte')}, expected an index at {index}"
            )
        limits.check_limit("topics", connections, f"{self._path}: connections")
        limits.check_limit("count", chunks, f"{self._path}: chunks")
        self._stream.seek(index)
        self.connections = [self._connection() for _ in range(connections)]
        self.chunks = [self._chunk_info() for _ in range(chunks)]
        if len({chunk.at for chunk in self.chunks}) < chunks:
            raise DamagedRecording(f"{self._path}: index: found a chunk twice, expected each chunk once")
        if len({one.number for one in self.connections}) < connections:
            raise DamagedRecording(f"{self._path}: index: found a connection twice, expected each connection once")

    def _connection(self) -> BagConnection:
        head = self._header(_CONNECTION)
        facts = self._fields(self._read(self._length("a connection"), "a connection"))
        for name in (b"type", b"message_definition"):
            if name not in facts:
                raise DamagedRecording(f"{self._place()}: found a connection without {name.decode()}")
        return BagConnection(
            self._u32(head, b"conn"),
            _text(head.get(b"topic", b"")),
            _text(facts[b"type"]),
            _text(facts[b"message_definition"]),
            facts.get(b"latching") == b"1",
        )

    def _chunk_info(self) -> ChunkInfo:
        head = self._header(_CHUNK_INFO)
        version, count = self._u32(head, b"ver"), self._u32(head, b"count")
        data = self._read(self._length("the index entry of a chunk"), "the index entry of a chunk")
        if version != 1 or len(data) != count * _PAIR.size:
            raise DamagedRecording(
                f"{self._place()}: found an index entry of a chunk in another layout, expected version 1"
            )
        start_ns = self._time(head, b"start_time") if count else 0
        return ChunkInfo(self._u64(head, b"chunk_pos"), start_ns, dict(_PAIR.iter_unpack(data)))

    # -- chunks --------------------------------------------------------------------------------------------------

    def _chunk(self, chunk: ChunkInfo, index: int) -> tuple[list[BagMessage], int]:
        """Return the messages of a chunk in the order of time, and its decompressed size in bytes."""
        self._deadline.check(str(self._path))
        self._stream.seek(min(chunk.at, self._size))
        head = self._header(_CHUNK)
        place = f"{self._path}: chunk {index + 1} of {len(self.chunks)} at byte {chunk.at}"
        how, size = head.get(b"compression", b""), self._u32(head, b"size")
        if how not in _PACKINGS:
            raise UnsupportedRecording(f"{place}: found compression {how[:20]!r}, expected none, bz2 or lz4")
        packed = self._read(self._length("a chunk"), "a chunk")
        data = unpack.unpack_within_limits(_PACKINGS[how], packed, size, place) if _PACKINGS[how] else packed
        return sorted(self._messages(data, index << 32, place)), len(data)

    def _messages(self, data: bytes, order: int, place: str) -> Iterator[BagMessage]:
        at, count, most = 0, 0, limits.current_limits().count
        while at < len(data):
            try:
                (length,) = _U32.unpack_from(data, at)
                head = self._fields(data[at + 4 : at + 4 + length])
                at += 4 + length
                (length,) = _U32.unpack_from(data, at)
            except struct.error:
                raise DamagedRecording(f"{place}: ends inside a record") from None
            at += 4
            if length > len(data) - at:
                raise DamagedRecording(
                    f"{place}: found a record of {counted(length, 'byte')}, {counted(len(data) - at, 'byte')} remain"
                )
            count += 1
            if count > most:
                limits.check_limit("count", count, f"{place}: records")
            if head.get(b"op") == bytes([_MESSAGE]):
                yield BagMessage(
                    self._time(head, b"time"), order + at, self._u32(head, b"conn"), data[at : at + length]
                )
            at += length

    # -- records -------------------------------------------------------------------------------------------------

    def _header(self, expected: int) -> dict[bytes, bytes]:
        length = self._length("a record")
        if length > _MAX_HEADER:
            raise DamagedRecording(
                f"{self._place()}: found a header of {counted(length, 'byte')}, expected at most {_MAX_HEADER}"
            )
        head = self._fields(self._read(length, "a record"))
        if head.get(b"op") != bytes([expected]):
            raise DamagedRecording(
                f"{self._place()}: found a record of kind {head.get(b'op', b'')[:8].hex() or 'none'}, "
                f"expected {expected:02x}"
            )
        return head

    def _fields(self, data: bytes) -> dict[bytes, bytes]:
        found, at = {}, 0
        while at < len(data):
            size = int.from_bytes(data[at : at + 4], "little")
            name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
            at += 4 + size
            if not equals or at > len(data):
                raise DamagedRecording(f"{self._place()}: found a header field that exceeds its header")
            found[name] = value
        return found

    def _length(self, what: str) -> int:
        return int(_U32.unpack(self._read(4, what))[0])

    def _read(self, size: int, what: str) -> bytes:
        left = self._size - self._stream.tell()
        if size > left:
            raise DamagedRecording(
                f"{self._place()}: cut off: {what} has {counted(size, 'byte')}, {counted(left, 'byte')} remain"
            )
        limits.check_limit("memory", size, f"{self._place()}: {what}")
        data = self._stream.read(size)
        if len(data) < size:
            raise DamagedRecording(f"{self._place()}: cut off inside {what}")
        return data

    def _place(self) -> str:
        return f"{self._path}: byte {self._stream.tell()}"

    def _u32(self, head: dict[bytes, bytes], name: bytes) -> int:
        return int(self._number(_U32, head, name)[0])

    def _u64(self, head: dict[bytes, bytes], name: bytes) -> int:
        return int(self._number(_U64, head, name)[0])

    def _time(self, head: dict[bytes, bytes], name: bytes) -> int:
        seconds, rest = self._number(_TIME, head, name)
        return int(seconds * 1_000_000_000 + rest)

    def _number(self, form: struct.Struct, head: dict[bytes, bytes], name: bytes) -> tuple[int, ...]:
        value = head.get(name, b"")
        if len(value) != form.size:
            raise DamagedRecording(
                f"{self._place()}: found {counted(len(value), 'byte')} of {name.decode()}, expected {form.size}"
            )
        return form.unpack(value)


def _text(data: bytes) -> str:
    return data.decode("utf-8", "backslashreplace")

"""The index of a file by one pass over its data, for files whose summary does not have what reading needs.

MCAP lets a writer leave out nearly everything of the summary: a file without an index, or with half of one, is valid.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.chunks import packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, RecordPlace, check_work, message_bound
from igtl_gateway.record.sessionfile.records import HEAD, MAGIC, MESSAGE_HEAD, Malformed

#: Messages outside of chunks are read in pieces of about this size.
_PIECE = 1 << 20


def scan(path: Path, stream: IO[bytes], size: int, data_end: int) -> Index:
    """The index of the records between the magic and ``data_end``.  Raises Malformed, LimitExceeded."""
    return _Scan(path, stream, size, data_end).run()


class _Scan:
    """One pass over the data section of a file."""

    def __init__(self, path: Path, stream: IO[bytes], size: int, data_end: int) -> None:
        self._place, self._stream, self._end = str(path), stream, data_end
        self._index = Index(size, scanned=True)
        self._messages = self._work = 0
        # messages outside of chunks: where they begin, first and last time, count
        self._run: tuple[int, int, int, int] | None = None
        self._deadline = limits.Deadline(files.stored_bytes(path, size))

    def run(self) -> Index:
        index, at = self._index, len(MAGIC)
        while at < self._end:
            opcode, end = self._head(at)
            if self._run and (opcode != records.MESSAGE or at - self._run[0] >= _PIECE):
                self._end_run(at)
            if opcode == records.MESSAGE:
                self._loose(at, end)
            elif opcode in records.DEFINITIONS:
                index.define(opcode, self._content(at, end))
            elif opcode == records.CHUNK:
                self._chunk(at, end)
            elif opcode in (records.ATTACHMENT, records.METADATA):
                self._named(opcode, at, end)
            at = end
            if opcode == records.DATA_END:
                break
            self._deadline.check(self._place)
        if self._run:
            self._end_run(at)
        return index

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode of the record at ``at``, and where it ends."""
        self._stream.seek(at)
        head = self._stream.read(HEAD.size)
        if len(head) < HEAD.size or at + HEAD.size > self._end:
            raise Malformed(f"found {counted(self._end - at, 'byte')} at {at}, expected a record")
        opcode, length = HEAD.unpack(head)
        end = at + HEAD.size + length
        if end > self._end:
            raise Malformed(f"found a record of {counted(length, 'byte')} at {at}, expected it before {self._end}")
        return opcode, end

    def _content(self, at: int, end: int, most: int | None = None) -> bytes:
        size = end - at - HEAD.size
        limits.check_limit("memory", size, f"{self._place}: record at offset {at}")
        self._stream.seek(at + HEAD.size)
        return self._stream.read(size if most is None else min(size, most))

    def _named(self, opcode: int, at: int, end: int) -> None:
        """An attachment or a metadata record."""
        self._stream.seek(at + HEAD.size + (2 * records.U64.size if opcode == records.ATTACHMENT else 0))
        size = int.from_bytes(self._stream.read(records.U32.size), "little")
        limits.check_limit("free", size, f"{self._place}: name at offset {at}")
        places = self._index.attachments if opcode == records.ATTACHMENT else self._index.metadata
        name = self._stream.read(min(size, end - at))
        places.append(RecordPlace(name.decode("utf-8", "replace"), at, end - at))
        limits.check_limit("count", len(places), self._place)

    def _count(self, channel: int) -> None:
        counts = self._index.counts
        counts[channel] = counts.get(channel, 0) + 1
        self._messages += 1
        if not self._messages & 0xFFFF:
            limits.check_limit("count", self._messages, self._place, message_bound(self._index.size))
            self._deadline.check(self._place)

    def _add(self, chunk: ChunkEntry, messages: int) -> None:
        index = self._index
        if messages:
            first = self._messages == messages
            index.start_ns = chunk.start_ns if first else min(index.start_ns, chunk.start_ns)
            index.end_ns = max(index.end_ns, chunk.end_ns)
        index.chunks.append(chunk)
        limits.check_limit("count", len(index.chunks), self._place)

    def _loose(self, at: int, end: int) -> None:
        head = self._content(at, end, MESSAGE_HEAD.size)
        if len(head) < MESSAGE_HEAD.size:
            raise Malformed(
                f"found a message of {counted(len(head), 'byte')} at {at}, expected {MESSAGE_HEAD.size} and more"
            )
        channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack(head)
        self._count(channel)
        begin, first, last, number = self._run or (at, stamp_ns, stamp_ns, 0)
        self._run = begin, min(first, stamp_ns), max(last, stamp_ns), number + 1

    def _end_run(self, end: int) -> None:
        assert self._run
        begin, first, last, number = self._run
        self._add(ChunkEntry(first, last, begin, end - begin, end - begin, loose=True), number)
        self._run = None

    def _chunk(self, at: int, end: int) -> None:
        data = packed_chunk(self._stream, ChunkEntry(0, 0, at, end - at, 0), self._place).unpack()
        self._work += len(data)
        check_work(self._index.size, self._work, self._place)
        before, first, last = self._messages, 1 << 64, 0
        for opcode, start, stop in records.records(data, f"chunk at offset {at}"):
            if opcode == records.MESSAGE:
                if stop - start < MESSAGE_HEAD.size:
                    raise Malformed(f"found a message of {counted(stop - start, 'byte')} in the chunk at {at}")
                channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
                first, last = min(first, stamp_ns), max(last, stamp_ns)
                self._count(channel)
            elif opcode in records.DEFINITIONS:
                self._index.define(opcode, data[start:stop])
        number = self._messages - before
        self._add(ChunkEntry(first if number else 0, last, at, end - at, len(data)), number)

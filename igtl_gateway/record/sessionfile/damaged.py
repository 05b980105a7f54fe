"""A damaged file as a sequence of records: found one after the other, whatever bytes are wrong.

Each record of an MCAP file has its length in front, and almost all of them have it in their fields once more.  Where
the length in front does not fit, the fields may show the end of the record after all; otherwise the next offset is
searched at which a record fits.

What looks like a record may be of another file: a prologue is an MCAP file in an attachment, and the payload of a
message may hold one.  So where both lengths of a record agree and the file ends before them, the rest is that record;
and a search does not stop between the two magics of a file in the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.records import Attachment

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.chunks import PackedChunk, check_chunk
from igtl_gateway.record.sessionfile.compression import NAMES, declared_size, decompress
from igtl_gateway.record.sessionfile.contents import check_work
from igtl_gateway.record.sessionfile.records import (
    CHUNK_HEAD,
    FIELDS,
    FOOTER_RECORD,
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    U32,
    U64,
    Malformed,
)

#: Where a record may begin, for the search: a record that is never inside a chunk, or, in files that have messages
#: outside of chunks, a message.  None is as large as ``_TOO_LARGE``.
_CANDIDATE = re.compile(rb"[\x06\x07\x09\x0c\x0f](?=.{5}\0\0\0)", re.DOTALL)
_CANDIDATE_MESSAGE = re.compile(rb"[\x05\x06\x07\x09\x0c\x0f](?=.{5}\0\0\0)", re.DOTALL)
_TOO_LARGE = 1 << 40
_WINDOW = 1 << 20
#: Number of consecutive records that have to fit for the first one to be taken as a message.
_CHAIN = 4
#: The name of a compression with its length in front.
_NAME = re.compile(b"|".join(re.escape(U32.pack(len(name)) + name.encode()) for name in NAMES.values()))


@dataclass(frozen=True, slots=True)
class RecordSpan:
    """A record, or (opcode 0) bytes that are not a record."""

    opcode: int
    at: int
    end: int

    @property
    def size(self) -> int:
        """Bytes, with the head."""
        return self.end - self.at


class DamagedFile:
    """The records of a file; every method may raise OSError, and LimitExceeded where reading takes too long.

    Attributes:
        size: bytes of the file.
        data_end: where the data section ends, as far as known.
    """

    def __init__(self, path: Path, stream: IO[bytes]) -> None:
        self._path = path
        self._stream = stream
        self.size = self.data_end = stream.seek(0, 2)
        self._window = (0, b"")
        self._deadline = limits.Deadline(files.stored_bytes(path, self.size))
        self._work = 0  # bytes unpacked
        self._loose = False  # messages lie outside of chunks
        self._magic = (0, -1)  # from here on, the first magic is there; -1: unknown

    def walk(self) -> Iterator[RecordSpan]:
        """All records up to the end of the data, and the bytes between them."""
        at, limit = len(MAGIC), self.data_end
        ended = False
        while at < limit:
            self._deadline.check(str(self._path))
            span = self._span(at, limit, ended)
            if span.opcode == 0 and span.end == at:
                span = RecordSpan(0, at, self._seek_record(at + 1, limit) if ended else self._next_record(at, limit))
            if span.opcode == records.MESSAGE:
                self._loose = True
            if not ended or span.opcode:
                yield span
            # behind the data there is only the index, of which nothing can be lost
            ended = ended or span.opcode == records.DATA_END
            at = span.end

    def read(self, at: int, size: int) -> bytes:
        """The bytes at an offset; fewer at the end of the file."""
        start, window = self._window
        if start <= at and at + size <= start + len(window):
            return window[at - start : at - start + size]
        self._stream.seek(at)
        return self._stream.read(size)

    def content(self, span: RecordSpan) -> bytes:
        """Content of a record.  Raises LimitExceeded."""
        limits.check_limit("memory", span.size, f"{self._path}: record at offset {span.at:,}")
        return self.read(span.at + HEAD.size, span.size - HEAD.size)

    def small_content(self, span: RecordSpan) -> bytes:
        """Content of a record that is kept; no bytes of one that is larger than any plausible one."""
        return self.content(span) if 8 * span.size <= limits.current_limits().free else b""

    def attachment(self, span: RecordSpan) -> Attachment | None:
        """An attachment; None if its checksum is wrong."""
        try:
            return records.parse_attachment(self.content(span))
        except Malformed:
            return None

    def chunk(self, span: RecordSpan) -> tuple[PackedChunk, bytes]:
        """A chunk, one field of which may be damaged: with the right fields, and its records.

        Raises Malformed if its checksum fits nothing, LimitExceeded if it needs too much.
        """
        content = self.content(span)
        if len(content) < CHUNK_HEAD.size + U32.size + U64.size:
            raise Malformed("it is cut off")
        _, _, size, crc = CHUNK_HEAD.unpack_from(content)
        recorded = self._compression(content[CHUNK_HEAD.size :])
        too_large: LimitExceeded | None = None
        for compression in sorted(NAMES.values(), key=lambda name: name != recorded):
            if not crc and compression != recorded:
                continue  # nothing would distinguish right from wrong
            at = CHUNK_HEAD.size + U32.size + len(compression) + U64.size
            length = int.from_bytes(content[at - U64.size : at], "little")
            packed = content[at : at + length] if length <= len(content) - at else content[at:]
            for unpacked in dict.fromkeys((size, declared_size(compression, packed))) if crc else (size,):
                self._deadline.check(str(self._path))
                try:
                    check_chunk(len(packed), unpacked, "chunk")
                    self._work += unpacked
                    check_work(self.size, self._work, str(self._path))
                    data = decompress(compression, packed, unpacked, crc)
                except LimitExceeded as error:
                    too_large = too_large or error
                    continue
                except Malformed:
                    continue
                return PackedChunk(f"chunk at offset {span.at:,}", compression, packed, unpacked, crc), data
        raise too_large or Malformed("its checksum is wrong")

    def chunk_times(self, span: RecordSpan) -> tuple[int, int]:
        """First and last time of the messages in a chunk by its own fields, which have no checksum."""
        content = self.read(span.at + HEAD.size, CHUNK_HEAD.size)
        return CHUNK_HEAD.unpack(content)[:2] if len(content) == CHUNK_HEAD.size else (0, 0)

    def chunk_compression(self, span: RecordSpan) -> str:
        """The name of the compression of a chunk."""
        return self._compression(self.read(span.at + HEAD.size + CHUNK_HEAD.size, 8))

    @staticmethod
    def _compression(data: bytes) -> str:
        found = _NAME.match(data[:8])
        return found[0][U32.size :].decode() if found else ""

    # -- from record to record --------------------------------------------------------------------------------

    def _span(self, at: int, limit: int, ended: bool) -> RecordSpan:
        """The record at ``at``, as far as it fits; of no length if nothing shows where it ends.

        Behind the data (``ended``) there are other records than those in the table of fields.
        """
        head = self.read(at, HEAD.size)
        if len(head) < HEAD.size:
            return RecordSpan(0, at, at)
        opcode, length = HEAD.unpack(head)
        outer = at + HEAD.size + length
        inner = self._inner_end(opcode, at, limit)
        if inner == outer or (ended and outer <= limit and opcode not in FIELDS and self._fits(outer, limit)):
            return RecordSpan(opcode, at, outer)
        if outer > limit == self.size and self._is_torn(opcode, at, outer):
            return RecordSpan(0, at, limit)
        outer_fits = outer <= limit and self._fits(outer, limit)
        if inner and outer_fits and inner < outer and opcode in FIELDS and not self._fits(inner, limit):
            # more bytes than its fields need, as MCAP allows; of a chunk only the opcode may be damaged
            return RecordSpan(
                records.CHUNK if self._inner_end(records.CHUNK, at, limit) == outer else opcode, at, outer
            )
        # where both are possible, the nearer end swallows nothing
        if inner and self._fits(inner, limit) and not (outer_fits and outer < inner):
            return RecordSpan(opcode, at, inner)  # its length is damaged
        if outer_fits:
            if opcode in (records.MESSAGE, records.CHUNK, records.ATTACHMENT, records.METADATA):
                return RecordSpan(opcode, at, outer)  # a field is damaged, if it has any: its checksum shows it
            # of a chunk only the opcode may be damaged
            return RecordSpan(records.CHUNK if self._inner_end(records.CHUNK, at, limit) == outer else 0, at, outer)
        return RecordSpan(0, at, at)

    def _is_torn(self, opcode: int, at: int, outer: int) -> bool:
        """Whether the file ends inside a record: its fields state the same end as its length, as far as they go.

        A length of nonsense is beyond every end that its fields may state, and not one of a record.
        """
        fields = FIELDS.get(opcode)
        if not fields or outer - at - HEAD.size >= _TOO_LARGE:
            return False
        end = at + HEAD.size
        for each in fields:
            if isinstance(each, int):
                end += each
                continue
            size = self.read(end, each.size)
            if len(size) < each.size:
                return end <= outer
            end += each.size + each.unpack(size)[0]
        return end == outer

    def _next_record(self, at: int, limit: int) -> int:
        """Offset of the next record behind damage at ``at`` that is not in a file in the file, or of the end."""
        magic = self._next_magic(at, limit)
        if magic == limit:
            return self._seek_record(at + 1, limit)
        if not self._ends_file(magic):  # a file in the file begins there, unless a record has it
            found = self._seek_record(at + 1, limit, magic)
            if found < magic:
                return found
            while not self._ends_file(magic):
                magic = self._next_magic(magic + 1, limit)
                if magic == limit:
                    return limit
        return magic + len(MAGIC)

    def _next_magic(self, at: int, limit: int) -> int:
        """Offset of the next magic that is not the last one of the file; ``limit``: there is none."""
        known_from, known = self._magic
        if known >= 0 and known_from <= at <= known:
            return known
        known_from = at
        while at < limit:
            self._deadline.check(f"{self._path}: offset {at:,}")
            at = min(files.next_data(self._stream, at), limit)
            window = self.read(at, min(_WINDOW, limit - at))
            place = window.find(MAGIC)
            if 0 <= place and at + place < self.size - len(MAGIC):
                limit = at + place
                break
            at += max(1, len(window) - len(MAGIC) + 1) if at + len(window) < limit else len(window)
        self._magic = (known_from, limit)
        return limit

    def _ends_file(self, magic: int) -> bool:
        """Whether a magic is the last one of a file: a footer is before it."""
        head = self.read(magic - FOOTER_RECORD.size + len(MAGIC), HEAD.size)
        return head == HEAD.pack(records.FOOTER, records.FOOTER_LENGTH)

    def _fits(self, at: int, limit: int, chain: int = 1) -> bool:
        """Whether at ``at`` the file ends, or ``chain`` records may follow."""
        for _ in range(chain):
            head = self.read(at, HEAD.size)
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
        fields = FIELDS.get(opcode)
        if not fields:
            return 0
        end = at + HEAD.size
        for each in fields:
            if isinstance(each, int):
                end += each
            else:
                size = self.read(end, each.size)
                if len(size) < each.size:
                    return 0
                end += each.size + each.unpack(size)[0]
            if end > limit:
                return 0
        return end

    def _seek_record(self, at: int, limit: int, until: int | None = None) -> int:
        """Offset of the next record that fits and begins before ``until``, or that, or of the end."""
        pattern = _CANDIDATE_MESSAGE if self._loose else _CANDIDATE
        until = limit if until is None else until
        while at < until:
            self._deadline.check(f"{self._path}: offset {at:,}")
            at = min(files.next_data(self._stream, at), until)
            window = self.read(at, min(_WINDOW, limit - at))
            self._window = (at, window)
            for found in pattern.finditer(window):
                if at + found.start() >= until:
                    break
                if self._is_record(at + found.start(), limit):
                    self._window = (0, b"")
                    return at + found.start()
            # a head may lie across the end of the window
            at += max(1, len(window) - HEAD.size + 1) if at + len(window) < limit else len(window)
        self._window = (0, b"")
        return until

    def _is_record(self, at: int, limit: int) -> bool:
        """Whether there is a record beyond doubt."""
        opcode, length = HEAD.unpack(self.read(at, HEAD.size))
        end = at + HEAD.size + length
        if opcode == records.MESSAGE:
            return bool(length >= MESSAGE_HEAD.size and self._fits(at, limit, _CHAIN))
        if self._inner_end(opcode, at, limit) != end:
            return False
        if opcode == records.DATA_END:
            return self._fits(end, limit)
        # zeros and small numbers look like records: the first text or array must not be empty
        first = FIELDS[opcode][0]
        skipped = first if isinstance(first, int) else 0
        return opcode == records.CHUNK or self.read(at + HEAD.size + skipped, U32.size) != bytes(U32.size)

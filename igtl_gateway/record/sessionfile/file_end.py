"""The end of a file: what follows the data section, taken apart and put together again at another offset."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from mcap.records import AttachmentIndex, Footer, SummaryOffset

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.records import FOOTER_RECORD, HEAD, MAGIC, U64, Malformed, crc32, pack

_OFFSET = HEAD.size + 1 + 2 * U64.size  # bytes of a summary offset


def pack_summary(start: int, groups: Iterable[tuple[int, Buffer]]) -> bytes:
    """Return a summary at an offset, with the footer and the last magic.

    Args:
        start: of the summary.
        groups: opcode and records of each group; a group without records has an offset, too.
    """
    data, offsets = bytearray(), bytearray()
    for opcode, group in groups:
        offsets += pack(SummaryOffset(group_opcode=opcode, group_start=start + len(data), group_length=len(group)))
        data += group
    footer = Footer(summary_start=start, summary_offset_start=start + len(data), summary_crc=0)
    data += offsets
    crc = crc32(pack(footer)[: records.FOOTER_COVERED], crc32(data))
    return bytes(data) + pack(replace(footer, summary_crc=crc)) + MAGIC


@dataclass(frozen=True, slots=True)
class FileEnd:
    """The end of the data section, and the groups of the summary; None: there is no summary."""

    data_end: bytes
    groups: tuple[tuple[int, bytes], ...] | None

    @classmethod
    def parse(cls, data: bytes, at: int) -> FileEnd:
        """Return the end of a file, which begins at an offset.  Raises Malformed for one in another spelling."""
        if len(data) < FOOTER_RECORD.size:
            raise Malformed("end: found no footer")
        _, _, start, offsets, _, _ = FOOTER_RECORD.unpack(data[-FOOTER_RECORD.size :])
        if not start:
            found = cls(data[: -FOOTER_RECORD.size], None)
        elif not at <= start <= offsets <= at + len(data) - FOOTER_RECORD.size:
            raise Malformed("end: found a footer with other offsets")
        else:
            groups, begin = [], start - at
            rows = data[offsets - at : -FOOTER_RECORD.size]
            for place in range(0, len(rows) - _OFFSET + 1, _OFFSET):
                opcode, size = rows[place + HEAD.size], U64.unpack_from(rows, place + _OFFSET - U64.size)[0]
                groups.append((opcode, data[begin : begin + size]))
                begin += size
            found = cls(data[: start - at], tuple(groups))
        if found.pack(at) != data:
            raise Malformed("end: found a summary in another spelling than that of igtl-gateway")
        return found

    def pack(self, at: int) -> bytes:
        """Return the bytes of the end of a file at an offset."""
        if self.groups is None:
            return self.data_end + pack(Footer(0, 0, 0)) + MAGIC
        return self.data_end + pack_summary(at + len(self.data_end), self.groups)

    def with_attachment(self, index: AttachmentIndex) -> FileEnd:
        """Return the end with the index of one more attachment, the last one.  Raises Malformed."""
        if self.groups is None:
            return self
        groups = [
            (opcode, counted(group, attachments=1) if opcode == records.STATISTICS else group)
            for opcode, group in self.groups
        ]
        place = next((at for at, (opcode, _) in enumerate(groups) if opcode == records.ATTACHMENT_INDEX), len(groups))
        before = groups[place][1] if place < len(groups) else b""
        groups[place : place + 1] = [(records.ATTACHMENT_INDEX, before + pack(index))]
        return replace(self, groups=tuple(groups))

    def without_attachment(self, index: AttachmentIndex) -> Iterator[FileEnd]:
        """Yield the ends that get this one :meth:`with_attachment`: at most two, one of them without such a group."""
        if self.groups is None:
            yield self
            return
        last = pack(index)
        groups = tuple(
            (opcode, counted(group, attachments=-1) if opcode == records.STATISTICS else
             group.removesuffix(last) if opcode == records.ATTACHMENT_INDEX else group)
            for opcode, group in self.groups
        )  # fmt: skip
        for found in (groups, tuple(row for row in groups if row != (records.ATTACHMENT_INDEX, b""))):
            if (before := replace(self, groups=found)).with_attachment(index) == self:
                yield before


def counted(group: bytes, *, attachments: int = 0, metadata: int = 0) -> bytes:
    """Return statistics with more (or less) attachments and metadata records.  Raises Malformed."""
    found = records.parse_statistics(group[HEAD.size :])
    counts = found.attachment_count + attachments, found.metadata_count + metadata
    if not all(0 <= count < 1 << 32 for count in counts):
        raise Malformed("end: found another number of attachments or metadata records")
    return pack(replace(found, attachment_count=counts[0], metadata_count=counts[1]))

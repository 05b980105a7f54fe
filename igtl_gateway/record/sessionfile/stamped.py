"""The time stamp of a sealed file: an attachment behind its last seal, under the rule that no seal covers.

The last seal covers the end of the file as it was before.  The attachment changes that end in one way only: its index
and one more attachment in the statistics.  So the sealed end follows from the present one, and every byte counts.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.records import Attachment, AttachmentIndex

from igtl_gateway.base.errors import RecordingError, UnsupportedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.seal.digest import new_digest
from igtl_gateway.record.seal.statement import EndOfFile
from igtl_gateway.record.seal.time_stamps import MAX_BYTES, read_reply
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.file_end import FileEnd
from igtl_gateway.record.sessionfile.layout import TIME_STAMP_ATTACHMENT
from igtl_gateway.record.sessionfile.new_file import create_file, os_error_text
from igtl_gateway.record.sessionfile.records import HEAD, Malformed, pack

#: Media type of a reply (RFC 3161).
_MEDIA_TYPE = "application/timestamp-reply"
#: Bytes by which the end of a file may grow.
_GROWTH = 200
_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Stamp:
    """A time stamp in a file: its record, the reply in it, and what is wrong with the record ("": nothing)."""

    at: int
    size: int
    reply: bytes = b""
    problem: str = ""

    @property
    def end(self) -> int:
        return self.at + self.size


def stamp_record(reply: bytes) -> bytes:
    """Return the attachment with the reply of an authority."""
    return pack(Attachment(create_time=0, log_time=0, name=TIME_STAMP_ATTACHMENT, media_type=_MEDIA_TYPE, data=reply))


def stamp_at(stream: IO[bytes], at: int, size: int) -> Stamp | None:
    """Return the time stamp at an offset; None if there is no complete attachment."""
    stream.seek(at)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode != records.ATTACHMENT or length > size - at - HEAD.size:
        return None
    whole = HEAD.size + length
    if length > MAX_BYTES + 1024:
        return Stamp(at, whole, problem=f"it has {count_text(length, 'byte')}")
    content = stream.read(length)
    try:
        reply = records.parse_attachment(content).data
    except Malformed:
        return Stamp(at, whole, problem="its checksum is wrong")
    if stamp_record(reply) != head + content:
        return Stamp(at, whole, problem="it has another spelling than that of igtl-gateway")
    return Stamp(at, whole, reply)


def has_sealed_end(stream: IO[bytes], size: int, stamp: Stamp, sealed: EndOfFile) -> bool:
    """Return whether the end of a file behind a time stamp follows from the sealed one.  Raises LimitExceeded."""
    left = size - stamp.end
    if not sealed.size <= left <= sealed.size + _GROWTH:
        return False
    limits.check_limit("memory", left, "end of the file")
    stream.seek(stamp.end)
    try:
        found = FileEnd.parse(stream.read(), stamp.end)
        for before in found.without_attachment(_index(stamp)):
            data = before.pack(stamp.at)
            if len(data) == sealed.size and new_digest().update(data).digest() == sealed.digest:
                return True
    except Malformed:
        return False
    return False


def stamped_copy(source: Path, at: int, reply_file: Path, digest: bytes, output: Path) -> int:
    """Write a copy of a sealed file with a time stamp, and return its size.

    Args:
        source: a file whose seal was checked.
        at: offset behind its last seal.
        reply_file: reply of the authority.
        digest: SHA-256 of the last seal.
        output: the file to write.

    Raises ConfigError for another reply, UnsupportedRecording for a file with another end, RecordingError when the disk
    refuses, LimitExceeded, Unavailable.
    """
    reply = read_reply(reply_file, digest)
    with files.open_file(source) as stream:
        size = stream.seek(0, os.SEEK_END)
        limits.check_limit("memory", size - at, f"{source}: end of the file")
        stream.seek(at)
        record = stamp_record(reply)
        try:
            end = FileEnd.parse(stream.read(), at)
            tail = end.with_attachment(_index(Stamp(at, len(record), reply))).pack(at + len(record))
        except Malformed as error:
            raise UnsupportedRecording(f"{source}: {error}") from None
        file = create_file(output)
        try:
            stream.seek(0)
            left = at
            while left and (piece := stream.read(min(left, _PIECE))):
                file.write(piece)
                left -= len(piece)
            file.write(record + tail)
            file.close()
        except OSError as error:
            raise RecordingError(f"cannot write {output}: {os_error_text(error)}") from error
        finally:
            with suppress(OSError):
                file.raw.close()  # closed already, or without what a full disk did not take
    return at + len(record) + len(tail)


def _index(stamp: Stamp) -> AttachmentIndex:
    return AttachmentIndex(
        offset=stamp.at,
        length=stamp.size,
        log_time=0,
        create_time=0,
        data_size=len(stamp.reply),
        name=TIME_STAMP_ATTACHMENT,
        media_type=_MEDIA_TYPE,
    )

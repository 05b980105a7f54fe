"""Where a message lies in an MCAP file: its chunk, and its record in it, so that any program finds the same bytes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import files
from igtl_gateway.record.sessionfile.chunks import column_batches, packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index, check_work, work_of
from igtl_gateway.record.sessionfile.index import read_index, recover_hint
from igtl_gateway.record.sessionfile.records import CHUNK_HEAD, HEAD, MESSAGE_RECORD, U32, U64, Malformed


@dataclass(frozen=True, slots=True)
class MessagePlace:
    """A message record of a file.

    Attributes:
        path: the file.
        topic: of its channel.
        sequence: lower 32 bits of the entry number; in files of other programs any number.
        time_ns: log_time, UTC ns.
        chunk_at: offset of its chunk record in the file; None if it is in no chunk.
        compression: of the chunk, ``zstd`` or ``lz4``; "": its records lie in the file as they are.
        data_at, data_length: bytes of the records of the chunk in the file, as they are stored.
        offset: of the record in these bytes, unpacked.
        length: bytes of the record, its opcode and length included.
    """

    path: Path
    topic: str
    sequence: int
    time_ns: int
    chunk_at: int | None
    compression: str
    data_at: int
    data_length: int
    offset: int
    length: int

    @property
    def file_at(self) -> int | None:
        """Offset of the record in the file; None if it is compressed."""
        return None if self.compression else self.data_at + self.offset


def messages_at(path: Path, times: Collection[int]) -> Iterator[MessagePlace]:
    """Yield the messages of a file with one of these log_times (UTC ns), in the order of the file.

    Only chunks that may have one are read.  Raises UnsupportedRecording, DamagedRecording, LimitExceeded.
    """
    wanted = np.array(sorted(times), np.uint64)
    with files.open_file(path) as stream:
        index = read_index(path, stream)
        chunks = [each for each in index.chunks if _may_have(each, wanted)]
        check_work(index.size, work_of(chunks), str(path))
        try:
            for chunk in chunks:
                yield from _of_chunk(path, stream, index, chunk, wanted)
        except Malformed as error:
            raise DamagedRecording(f"{path}: {error}{recover_hint(path)}") from None


def _may_have(chunk: ChunkEntry, wanted: npt.NDArray[np.uint64]) -> bool:
    first, last = (
        np.searchsorted(wanted, np.uint64(chunk.start_ns)),
        np.searchsorted(wanted, np.uint64(chunk.end_ns), "right"),
    )
    return bool(first < last)


def _of_chunk(
    path: Path, stream: IO[bytes], index: Index, chunk: ChunkEntry, wanted: npt.NDArray[np.uint64]
) -> Iterator[MessagePlace]:
    packed = packed_chunk(stream, chunk, str(path))
    data_at = chunk.at
    if not chunk.loose:
        data_at += HEAD.size + CHUNK_HEAD.size + U32.size + len(packed.compression) + U64.size
    for columns in column_batches(packed.unpack()):
        for row in np.flatnonzero(np.isin(columns.times, wanted)).tolist():
            begin, end = int(columns.begins[row]) - MESSAGE_RECORD.size, int(columns.ends[row])
            channel = index.channels.get(int(columns.channels[row]))
            if channel is None:
                raise Malformed(f"found a message of channel {columns.channels[row]}, of which there is no record")
            yield MessagePlace(
                path, channel.topic, int(columns.sequences[row]), int(columns.times[row]),
                None if chunk.loose else chunk.at, packed.compression, data_at, len(packed.data), begin, end - begin,
            )  # fmt: skip

"""Sealing a recording that exists already: a copy of its records with seals behind them.

The data section is copied byte for byte, so all offsets of the index stay right.  The summary is that of the file, with
the seals in its statistics and its metadata index.
"""

from __future__ import annotations

import os
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from typing import IO

import numpy as np
from mcap.records import DataEnd, Footer, MetadataIndex

from igtl_gateway.base.errors import RecordingError, UnsupportedRecording
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.record.seal.statement import UnitRow
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.chunks import column_batches, packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.file_end import counted, pack_summary
from igtl_gateway.record.sessionfile.index import recover_hint
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.new_file import create_file, os_error_text
from igtl_gateway.record.sessionfile.records import FOOTER_RECORD, HEAD, MAGIC, Malformed, pack
from igtl_gateway.record.sessionfile.sealing import SEAL, Sealer
from igtl_gateway.record.sessionfile.seals import has_name_of_seal
from igtl_gateway.record.sessionfile.units import FoundUnit, data_end, kind_of, units

#: One seal has all records of the file.
_MOST_UNITS = 300_000
#: Seals of a copy: of its records, and of the end of the file.
_SEALS = 2
_PIECE = 1 << 20


def seal_copy(source: Path, output: Path, sealer: Sealer) -> int:
    """Write a sealed copy of a closed MCAP file, and return its size.

    Raises UnsupportedRecording for a file that is not closed or has seals, RecordingError when the disk refuses,
    LimitExceeded.
    """
    with files.open_file(source) as stream:
        size = stream.seek(0, os.SEEK_END)
        end, groups = _end_of_file(source, stream, size)
        for unit in units(stream, 0, end):
            if unit.opcode == records.METADATA and has_name_of_seal(stream, unit.at):
                raise UnsupportedRecording(f"{source}: found a seal at byte {unit.at:,}, expected a file without seals")
            sealer.add(_row(source, stream, unit))
            if len(sealer) > _MOST_UNITS:
                raise UnsupportedRecording(f"{source}: found more than {_MOST_UNITS:,} records, expected fewer")
        file = create_file(output)
        try:
            return _write(stream, end, groups, sealer, file)
        except OSError as error:
            raise RecordingError(f"cannot write {output}: {os_error_text(error)}") from error
        finally:
            with suppress(OSError):
                file.raw.close()  # closed already, or without what a full disk did not take


def _end_of_file(path: Path, stream: IO[bytes], size: int) -> tuple[int, dict[int, bytes]]:
    """Return the end of the data section, and the records of the summary by opcode, as the copy has them.

    The index of the metadata lacks the two seals: their places are not known yet.  Raises UnsupportedRecording.
    """
    stream.seek(max(0, size - FOOTER_RECORD.size))
    footer = stream.read()
    end = data_end(stream, len(MAGIC), size)
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        raise UnsupportedRecording(f"{path}: found another kind of file, expected MCAP")
    if end is None or footer[-len(MAGIC) :] != MAGIC or footer[0] != records.FOOTER:
        raise UnsupportedRecording(f"{path}: found a file that was not closed{recover_hint(path)}")
    _, _, start, _, _, _ = FOOTER_RECORD.unpack(footer)
    stop = size - FOOTER_RECORD.size
    if not start:
        return end, {}
    if not end < start <= stop:
        raise UnsupportedRecording(f"{path}: found a summary at byte {start:,}, expected it behind byte {end:,}")
    limits.check_limit("memory", stop - start, f"{path}: summary")
    stream.seek(start)
    data = stream.read(stop - start)
    groups: dict[int, bytearray] = {}
    try:
        for opcode, begin, after in records.records(data, "summary"):
            groups.setdefault(opcode, bytearray()).extend(data[begin - HEAD.size : after])
        groups.pop(records.SUMMARY_OFFSET, None)
        found = {opcode: bytes(group) for opcode, group in groups.items()}
        if statistics := found.get(records.STATISTICS):
            found[records.STATISTICS] = counted(statistics, metadata=_SEALS)
    except Malformed as error:
        raise UnsupportedRecording(f"{path}: {error}{recover_hint(path)}") from None
    return end, found


def _row(path: Path, stream: IO[bytes], unit: FoundUnit) -> UnitRow:
    first = last = -1
    if unit.opcode == records.CHUNK:
        stream.seek(unit.at)
        length = HEAD.size + HEAD.unpack(stream.read(HEAD.size))[1]
        try:
            data = packed_chunk(stream, ChunkEntry(0, 0, unit.at, length, 0), str(path)).unpack()
            numbers = np.concatenate([columns.sequences for columns in column_batches(data)])
        except Malformed as error:
            raise UnsupportedRecording(f"{path}: {error}{recover_hint(path)}") from None
        first, last = (int(numbers.min()), int(numbers.max())) if len(numbers) else (-1, -1)
    return UnitRow(kind_of(unit.opcode), unit.size, unit.digest, first, last)


def _write(stream: IO[bytes], end: int, groups: dict[int, bytes], sealer: Sealer, file: BufferedWriter) -> int:
    stream.seek(0)
    left = end
    while left and (piece := stream.read(min(left, _PIECE))):
        file.write(piece)
        left -= len(piece)
    seal = sealer.seal()
    sealer.update(seal)
    sealer.end_unit(SEAL)
    file.write(seal)
    at = end + len(seal)
    first = MetadataIndex(offset=end, length=len(seal), name=SEAL_METADATA)

    def rest(length: int) -> bytes:
        data = pack(DataEnd(0))
        indexes = pack(first, MetadataIndex(offset=at, length=length, name=SEAL_METADATA))
        return data + _summary(at + length + len(data), groups, indexes)

    last, tail = sealer.last_seal(rest, last_part=True)
    file.write(last)
    file.write(tail)
    file.close()
    return at + len(last) + len(tail)


def _summary(start: int, groups: dict[int, bytes], indexes: bytes) -> bytes:
    """Return the summary with the indexes of two more metadata records, the footer and the last magic."""
    if not groups:
        return pack(Footer(0, 0, 0)) + MAGIC
    rows = []
    for opcode in (*groups, *(() if records.METADATA_INDEX in groups else (records.METADATA_INDEX,))):
        group = groups.get(opcode, b"")
        if opcode == records.METADATA_INDEX:
            group += indexes
        rows.append((opcode, group))
    return pack_summary(start, rows)

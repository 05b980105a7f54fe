"""The number of samples that an mp4 file states, before it is opened.

FFmpeg makes a row of 24 bytes of each stated sample, and decodes it: a file of 2 kB that states 80 million samples
takes all memory.  A sample has at least one byte of its own, so there cannot be more than the file has bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import limits

_HEAD = struct.Struct(">I4s")
_LARGE = struct.Struct(">Q")
_FOLDERS = frozenset({b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"moof", b"traf", b"mvex"})
#: Box → offset of its number of rows (samples, or runs of samples), behind its head.
_COUNTS = {b"stsz": 8, b"stz2": 8, b"stts": 4, b"ctts": 4, b"stsc": 4, b"stss": 4, b"stco": 4, b"co64": 4, b"elst": 4}
_TIMES = struct.Struct(">II")
_TRUN_COUNT = 4
#: Flag of a run of samples that have a time to be shown at.
_TRUN_SHOWN = 0x800
#: Samples of a video: 240 MB of rows.  Bytes that are holes of a sparse file count as bytes.
_MOST = 10_000_000
#: Of the longest head of a box with a number: what is read.
_READ = 16


def check_samples(stream: IO[bytes], size: int, place: str) -> None:
    """Raise DamagedRecording if a file of ``size`` bytes states more samples than it can have; LimitExceeded."""
    boxes = 0
    for kind, at, length in _boxes(stream, 0, size, 0, place):
        boxes += 1
        limits.check_limit("count", boxes, f"{place}: boxes")
        offset = _TRUN_COUNT if kind == b"trun" else _COUNTS.get(kind)
        if offset is None:
            continue
        stream.seek(at)
        head = stream.read(min(_READ, length))
        if len(head) < offset + 4:
            raise DamagedRecording(f"{place}: {kind.decode()}: found {counted(length, 'byte')}, expected a whole box")
        found = int.from_bytes(head[offset : offset + 4], "big")
        if kind == b"stts":
            found = _samples_of_runs(stream, at + offset + 4, min(found, length // _TIMES.size))
        if found > size:
            raise DamagedRecording(
                f"{place}: {kind.decode()}: found {count_text(found, 'sample')}, expected at most one for each of "
                f"{count_text(size, 'byte')}"
            )
        if found > _MOST:
            raise DamagedRecording(
                f"{place}: {kind.decode()}: found {count_text(found, 'sample')}, expected at most {_MOST:,}"
            )
    stream.seek(0)


def is_reordered(stream: IO[bytes], size: int, place: str) -> bool:
    """Return whether samples have times to be shown at beside those to be decoded at: some need later ones.

    Of a file of ``size`` bytes that ``check_samples`` has taken.
    """
    for kind, at, _ in _boxes(stream, 0, size, 0, place):
        stream.seek(at)
        head = stream.read(_TIMES.size)
        if kind == b"ctts" and any(head[4:]):
            return True
        if kind == b"trun" and int.from_bytes(head[:4], "big") & _TRUN_SHOWN:
            return True
    return False


def _samples_of_runs(stream: IO[bytes], at: int, runs: int) -> int:
    """Return the number of samples of the runs of equal durations."""
    stream.seek(at)
    data = stream.read(runs * _TIMES.size)
    return sum(count for count, _ in _TIMES.iter_unpack(data[: len(data) // _TIMES.size * _TIMES.size]))


def _boxes(stream: IO[bytes], at: int, end: int, depth: int, place: str) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each box, and where its content begins and how long it is.

    It ends without an error where another box is expected and is not there: FFmpeg reports them when it reads the file.
    """
    limits.check_limit("depth", depth, place)
    while at + _HEAD.size <= end:
        stream.seek(at)
        head = stream.read(_HEAD.size + _LARGE.size)
        if len(head) < _HEAD.size:
            return
        length, kind = _HEAD.unpack_from(head)
        begin = at + _HEAD.size
        if length == 1 and len(head) == _HEAD.size + _LARGE.size:
            (length,) = _LARGE.unpack_from(head, _HEAD.size)
            begin += _LARGE.size
        elif length == 0:
            length = end - at
        stop = min(at + length, end)
        if stop < begin:
            return
        yield kind, begin, stop - begin
        if kind in _FOLDERS:
            yield from _boxes(stream, begin, stop, depth + 1, place)
        at = stop

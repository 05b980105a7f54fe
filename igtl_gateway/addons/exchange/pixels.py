"""Reads the pixels of a file, frame by frame, in the order of IMAGE: components fastest, then columns, rows, slices.

Consecutive frames in the file are read one at a time.  If the frame axis is not the slowest, all frames are read,
within the limit ``memory``.  Values are not changed.  64-bit integers become float64, which IMAGE supports, if float64
represents every value of a frame exactly.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits
from igtl_gateway.addons.exchange.raster import BZIP2, COMPONENT, FRAME, RAW, WIDER, Raster, check_room
from igtl_gateway.addons.exchange.source import library_errors_as_damage

_READ = 1 << 20
#: Fewer bytes than these behind the last pixel may be white space without a note.
_WHITE = 16
#: Up to this value float64 represents every integer.
_EXACT = 1 << 53
#: What a file with a header of its own begins with: name, offset and bytes.
_GZIP = "a gzip file"
_HEADERS = (
    ("an NRRD file", 0, b"NRRD0"),
    ("a MetaImage file", 0, b"ObjectType"),
    ("a MetaImage file", 0, b"NDims"),
    ("a NIfTI file", 344, b"n+1\0"),
    ("a NIfTI file", 4, b"n+2\0"),
    ("a PNG file", 0, b"\x89PNG\r\n"),
    ("a JPEG file", 0, b"\xff\xd8\xff"),
    ("a TIFF file", 0, b"II*\0"),
    ("a TIFF file", 0, b"MM\0*"),
    ("a DICOM file", 128, b"DICM"),
    (_GZIP, 0, b"\x1f\x8b\x08"),
)
_START = 512


def read_frames(raster: Raster, notes: list[str]) -> Iterator[bytearray | bytes]:
    """Yield the frames in order, each in memory of its own; add a note to ``notes`` for bytes after the last one.

    Raises DamagedRecording if pixels are missing, LimitExceeded.
    """
    packed = files.size_of(raster.data)
    check_room(raster, packed)
    _check_bare(raster, packed)
    deadline = files.deadline_of(raster.data)
    with files.open_file(raster.data) as stream:
        pixels = _PixelStream(raster, stream, packed)
        pixels.skip(raster.skip)
        if all(axis.role != FRAME or axis.size == 1 for axis in raster.axes[:-1]):
            for index in range(raster.frames):
                deadline.check(raster.where)
                yield _ordered(raster, pixels.read(raster.frame_bytes, f"frame {index}"), index, framed=False)
            pixels.note_rest(notes)
            return
        total = raster.frame_bytes * raster.frames
        limits.check_limit("memory", total, f"{raster.where}: bytes of all frames, which are not consecutive")
        data = pixels.read(total, "all frames")
        pixels.note_rest(notes)
        for index in range(raster.frames):
            deadline.check(raster.where)
            yield _ordered(raster, data, index, framed=True)


def _check_bare(raster: Raster, size: int) -> None:
    """Raise UnsupportedRecording for a pixel file that is an image file itself: its header is not pixels."""
    if not raster.is_beside or size == max(raster.offset, 0) + raster.frame_bytes * raster.frames:
        return
    with files.open_file(raster.data) as stream:
        start = stream.read(_START)
    kind = next((name for name, at, magic in _HEADERS if start[at:].startswith(magic)), "")
    if kind and (raster.packing == RAW or kind != _GZIP):
        raise UnsupportedRecording(
            f"{raster.where}: found {kind} as its pixel file {raster.data.name}, expected pixels without a header: "
            f"import {raster.data.name} itself"
        )


def _ordered(raster: Raster, data: bytearray, index: int, *, framed: bool) -> bytearray | bytes:
    """Return frame ``index`` with its components fastest; ``framed``: ``data`` has all frames, not only this one."""
    axes = [axis for axis in raster.axes if framed or axis.role != FRAME]
    order = [number for number, axis in enumerate(axes) if axis.role == COMPONENT]
    if not framed and order in ([], [0]) and raster.dtype not in WIDER:
        return data
    dtype = np.dtype((">" if raster.big_endian else "<") + raster.dtype)
    values = np.frombuffer(data, dtype).reshape([axis.size for axis in reversed(axes)])
    if framed:
        frame = next(number for number, axis in enumerate(axes) if axis.role == FRAME)
        values = np.take(values, index, axis=len(axes) - 1 - frame)
        order = [number - (number > frame) for number in order]
    last = [values.ndim - 1 - number for number in order]
    values = np.moveaxis(values, last, range(values.ndim - len(last), values.ndim))
    if raster.dtype in WIDER:
        values = _widened(values, raster, index)
    return np.ascontiguousarray(values).tobytes()


def _widened(values: npt.NDArray[Any], raster: Raster, index: int) -> npt.NDArray[Any]:
    """Return 64-bit integers as float64 of the same byte order.  Raises DamagedRecording if one is not exact."""
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    if not -_EXACT <= low <= high <= _EXACT:
        raise DamagedRecording(
            f"{raster.where}: frame {index}: found 64-bit integers from {low} to {high}, expected values within "
            "±2^53, which float64 represents exactly; IMAGE has no 64-bit integers"
        )
    return values.astype((">" if raster.big_endian else "<") + WIDER[raster.dtype])


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


class _PixelStream:
    """The decompressed bytes of a pixel file, from the first pixel."""

    def __init__(self, raster: Raster, stream: BinaryIO, size: int) -> None:
        self._raster, self._stream = raster, stream
        offset = raster.offset
        if offset < 0:
            offset = max(size - raster.frame_bytes * raster.frames, 0)
        stream.seek(offset)
        self._decompressor: _Decompressor | None = None if raster.packing == RAW else self._new_decompressor()
        self._waiting = b""

    def _new_decompressor(self) -> _Decompressor:
        return bz2.BZ2Decompressor() if self._raster.packing == BZIP2 else zlib.decompressobj(zlib.MAX_WBITS | 32)

    def read(self, size: int, what: str) -> bytearray:
        """Return exactly ``size`` bytes.  Raises DamagedRecording; ``what`` names them in the error."""
        data = bytearray()
        with library_errors_as_damage(self._raster.data):
            while len(data) < size:
                part = self._read_some(size - len(data))
                if not part:
                    raise DamagedRecording(
                        f"{self._raster.where}: {what}: found {counted(len(data), 'byte')} of pixels, expected {size}"
                    )
                data += part
        return data

    def skip(self, size: int) -> None:
        """Skip ``size`` bytes."""
        while size > 0:
            part = min(size, _READ)
            self.read(part, "bytes before the pixels")
            size -= part

    def note_rest(self, notes: list[str]) -> None:
        """Add a note if there are bytes after the last pixel."""
        rest = b""
        try:
            while len(rest) < _WHITE and (more := self._read_some(_WHITE - len(rest))):
                rest += more
        except (OSError, ValueError, EOFError, zlib.error):
            rest = b"?"
        # some programs end a file with a line end
        if rest.strip() or len(rest) == _WHITE:
            notes.append("bytes after the last pixel that the header declares are ignored")

    def _read_some(self, missing: int) -> bytes:
        """Return between 1 and ``missing`` bytes; none at the end."""
        if self._decompressor is None:
            return self._stream.read(min(missing, _READ))
        while True:
            if self._decompressor.eof:  # gzip files can have several members
                self._waiting = self._decompressor.unused_data + self._waiting or self._stream.read(_READ)
                if not self._waiting.strip(b"\0"):
                    return b""
                self._decompressor = self._new_decompressor()
            if not self._waiting and getattr(self._decompressor, "needs_input", True):
                self._waiting = self._stream.read(_READ)
                if not self._waiting:
                    return b""
            part = self._decompressor.decompress(self._waiting, min(missing, _READ))
            self._waiting = getattr(self._decompressor, "unconsumed_tail", b"")
            if part:
                return part

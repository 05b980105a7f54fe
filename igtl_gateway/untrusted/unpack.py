"""Unpacking that cannot fill the memory: what comes out is bounded before it is made, whatever a header promises.

A piece may unpack to what :mod:`igtl_gateway.untrusted.limits` allows for its packed size.  Where a format also
stores the unpacked size, that size is the bound, and any other size of the result is an error.
"""

from __future__ import annotations

import bz2 as _bz2
from collections.abc import Callable
from typing import BinaryIO

import zstandard
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.untrusted import limits

_COPY_BYTES = 1 << 20


def bz2(data: bytes, size: int, place: str) -> bytes:
    """``data`` of bzip2, ``size`` bytes unpacked.  Raises DamagedRecording, LimitExceeded."""
    return _whole(data, size, place, lambda: _bz2.BZ2Decompressor().decompress(data, size + 1))


def lz4(data: bytes, size: int, place: str) -> bytes:
    """``data`` of an lz4 frame, ``size`` bytes unpacked.  Raises DamagedRecording, LimitExceeded."""
    return _whole(data, size, place, lambda: LZ4FrameDecompressor().decompress(data, max_length=size + 1))


def zstd(data: bytes, size: int, place: str) -> bytes:
    """``data`` of a zstd frame, ``size`` bytes unpacked.  Raises DamagedRecording, LimitExceeded."""
    return _whole(data, size, place, lambda: _zstd(data, size + 1))


def zstd_of_any_size(data: bytes, place: str) -> bytes:
    """A zstd frame where no other place tells its size.  Raises DamagedRecording, LimitExceeded."""
    try:
        told = int(zstandard.frame_content_size(data))
        if told >= 0:
            return zstd(data, told, place)
        allowed = limits.current_limits().unpacked(len(data))
        found = _zstd(data, allowed + 1)
    except zstandard.ZstdError as error:
        raise DamagedRecording(f"{place}: found no zstd data: {error}") from None
    limits.check_unpacked(len(data), len(found), place)
    return found


def zstd_file(packed: BinaryIO, out: BinaryIO, size: int, allowed: int, place: str) -> None:
    """Unpack a file of ``size`` bytes into ``out``, at most ``allowed`` ones.

    Raises DamagedRecording, LimitExceeded; OSError of ``out``.
    """
    written = 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True, closefd=False) as stream:
            while data := stream.read(_COPY_BYTES):
                written += len(data)
                limits.check_limit("ratio", written, f"{place}: {size} packed bytes", allowed)
                out.write(data)
    except zstandard.ZstdError as error:
        raise DamagedRecording(f"{place}: cannot be unpacked: {error}") from None


def _zstd(data: bytes, most: int) -> bytes:
    """At most so many bytes.  Raises ZstdError."""
    return bytes(zstandard.ZstdDecompressor().stream_reader(data).read(most))


def _whole(data: bytes, size: int, place: str, unpack: Callable[[], bytes]) -> bytes:
    limits.check_unpacked(len(data), size, place)
    try:
        found = unpack()
    except (OSError, ValueError, EOFError, RuntimeError, zstandard.ZstdError) as error:  # what the libraries raise
        raise DamagedRecording(f"{place}: cannot be unpacked: {error}") from None
    if len(found) != size:
        more = "more than " if len(found) > size else ""
        raise DamagedRecording(f"{place}: found {more}{min(len(found), size)} unpacked bytes, expected {size}")
    return found

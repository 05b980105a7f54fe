"""Unpacks data within the limits: the size of the result is limited before memory is allocated.

:mod:`.limits` sets the maximum for a packed size.  If a format also stores the unpacked size, the result must have
exactly that size.
"""

from __future__ import annotations

import bz2
from io import BytesIO
from typing import BinaryIO, Literal

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted import limits

#: Packing of a piece; ``""``: none.
Packing = Literal["bz2", "lz4", "zstd", ""]

_COPY_BYTES = 1 << 20
#: What zstd reports if this machine has too little memory.
_NO_MEMORY = "Allocation error : not enough memory"


class PackedDataError(ValueError):
    """Packed data that are damaged, or whose unpacked size is wrong."""


def unpack(packing: Packing, packed: bytes, size: int) -> bytes:
    """Unpack exactly ``size`` bytes, and allocate no more.  It checks no limits, so any thread can call it.

    Raises PackedDataError; MemoryError if this machine, or the bound of the process, has less: the data may be good.
    """
    try:
        declared = declared_size(packing, packed)
        found = b"" if declared > size else _at_most(packing, packed, size + 1, is_declared=0 < declared == size)
    except (OSError, ValueError, EOFError, RuntimeError, zstandard.ZstdError) as error:
        if _NO_MEMORY in str(error):
            raise MemoryError from None
        raise PackedDataError(f"found {packing} data that cannot be unpacked: {error}") from None
    if declared > size or len(found) > size:
        raise PackedDataError(f"found more than {counted(size, 'unpacked byte')}, expected {size}")
    if len(found) < size:
        raise PackedDataError(f"found {counted(len(found), 'unpacked byte')}, expected {size}")
    return found


def unpack_within_limits(packing: Packing, packed: bytes, size: int, place: str) -> bytes:
    """As :func:`unpack`, if the limits allow the size.  Raises DamagedRecording, LimitExceeded."""
    limits.check_unpacked(len(packed), size, place)
    try:
        return unpack(packing, packed, size)
    except PackedDataError as error:
        raise DamagedRecording(f"{place}: {error}") from None


def unpack_zstd_of_any_size(packed: bytes, place: str) -> bytes:
    """Unpack a zstd frame whose size is stored nowhere else.  Raises DamagedRecording, LimitExceeded."""
    try:
        declared = int(zstandard.frame_content_size(packed))
        if declared >= 0:
            return unpack_within_limits("zstd", packed, declared, place)
        found = _at_most("zstd", packed, limits.current_limits().unpacked(len(packed)) + 1, is_declared=False)
    except zstandard.ZstdError as error:
        raise DamagedRecording(f"{place}: found invalid zstd data: {error}") from None
    limits.check_unpacked(len(packed), len(found), place)
    return found


def unpack_zstd_file(packed: BinaryIO, out: BinaryIO, size: int, allowed: int, place: str) -> None:
    """Unpack a file of ``size`` bytes into ``out``, at most ``allowed`` bytes.

    Raises DamagedRecording, LimitExceeded; OSError of ``out``.
    """
    written = 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True, closefd=False) as stream:
            while data := stream.read(_COPY_BYTES):
                written += len(data)
                limits.check_limit("ratio", written, f"{place}: {counted(size, 'packed byte')}", allowed)
                out.write(data)
    except zstandard.ZstdError as error:
        raise DamagedRecording(f"{place}: cannot be unpacked: {error}") from None


def declared_size(packing: Packing, packed: bytes) -> int:
    """Return the unpacked size that packed data declare; 0 for none.  Raises the errors of the libraries."""
    match packing:
        case "lz4":
            return int(lz4.frame.get_frame_info(packed)["content_size"])
        case "zstd":
            size = zstandard.get_frame_parameters(packed).content_size
            return 0 if size == zstandard.CONTENTSIZE_UNKNOWN else size
        case "":
            return len(packed)
        case _:
            return 0


def _at_most(packing: Packing, packed: bytes, size: int, *, is_declared: bool) -> bytes:
    """Unpack at most ``size`` bytes; in one step if the data declare their size, which is then within the limit."""
    match packing:
        case "bz2":
            return bz2.BZ2Decompressor().decompress(packed, size)
        case "lz4" if is_declared:
            return bytes(lz4.frame.decompress(packed))
        case "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
        case "zstd" if is_declared:
            return zstandard.ZstdDecompressor().decompress(packed)
        case "zstd":  # several frames, or one that does not declare its size
            with zstandard.ZstdDecompressor().stream_reader(BytesIO(packed), read_across_frames=True) as reader:
                return reader.read(size)
        case _:
            return packed

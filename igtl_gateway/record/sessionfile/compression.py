"""Compression of chunks: both directions, with the names that MCAP gives them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.untrusted import unpack
from igtl_gateway.record.sessionfile.records import Malformed, crc32

Compression = Literal["auto", "lz4", "zstd", "none"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)

#: Compression → its name in a chunk record; ``auto`` has lz4 or zstd by chunk.
NAMES: dict[Compression, Literal["lz4", "zstd", ""]] = {"lz4": "lz4", "zstd": "zstd", "none": ""}
_PACKINGS: dict[str, unpack.Packing] = {"lz4": "lz4", "zstd": "zstd", "": ""}
#: How far back zstd looks for what repeats, as a power of two: over a picture of Full HD and its outputs.
_WINDOW_LOG = 24


def picture_compressor(level: int) -> zstandard.ZstdCompressor:
    """Zstd of this level, which finds a copy of a picture behind it; of one thread alone."""
    params = zstandard.ZstdCompressionParameters.from_level(level, window_log=_WINDOW_LOG)
    return zstandard.ZstdCompressor(compression_params=params)


def compress(compression: str, parts: Sequence[Buffer], size: int) -> Sequence[Buffer]:
    """The parts of a chunk, ``size`` bytes together, as one compressed frame in pieces."""
    match compression:
        case "lz4":  # takes the parts one after the other: they are not joined for it
            context = lz4.frame.create_compression_context()
            begin = lz4.frame.compress_begin(context, source_size=size)
            middle = [lz4.frame.compress_chunk(context, part) for part in parts]
            return begin, *middle, lz4.frame.compress_flush(context)
        case "zstd":
            return (zstandard.compress(b"".join(parts)),)
        case _:
            return parts


def decompress(name: str, packed: bytes, size: int, crc: int) -> bytes:
    """The records of a chunk; at most ``size`` bytes are allocated.

    Args:
        name: of the compression, as in the chunk.
        packed: the compressed bytes.
        size: bytes unpacked, as the chunk declares; the caller has checked it against the limits.
        crc: their checksum, as the chunk declares; 0: it has none.

    Raises Malformed.
    """
    if name not in _PACKINGS:
        raise Malformed(f"found compression {name!r}, expected lz4, zstd or none")
    try:
        data = unpack.unpack(_PACKINGS[name], packed, size)
    except unpack.PackedDataError as error:
        raise Malformed(str(error)) from None
    if crc and (found := crc32(data)) != crc:
        raise Malformed(f"found checksum {found:08x}, expected {crc:08x}")
    return data


def declared_size(name: str, packed: bytes) -> int:
    """The unpacked size that compressed data declare themselves; 0 where they do not."""
    try:
        return unpack.declared_size(_PACKINGS[name], packed)
    except (KeyError, RuntimeError, zstandard.ZstdError):
        return 0

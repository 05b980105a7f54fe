"""The bytes of a chunk, unpacked within bounds: a chunk cannot make more bytes than it says, nor say what it likes.

Sizes are checked before anything is allocated: what the chunk says against the limits, what the compressed frame says
against the chunk.  Where the frame says nothing, no more than the chunk's size is unpacked, and one byte to notice it.
"""

from __future__ import annotations

from io import BytesIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from fastcrc.crc32 import iso_hdlc

from igtl_gateway.sessionfile.records import Malformed

#: What MCAP calls them.
COMPRESSIONS = ("lz4", "zstd", "")


def unpacked(compression: str, packed: bytes, size: int, crc: int) -> bytes:
    """The records of a chunk.

    Args:
        compression: its name in the chunk.
        packed: the compressed bytes.
        size: bytes unpacked, as the chunk says; within the limits, by whoever asks.
        crc: their checksum, as the chunk says; 0: it has none.

    Raises Malformed.
    """
    unpack = {"lz4": _lz4, "zstd": _zstd, "": _plain}.get(compression)
    if unpack is None:
        raise Malformed(f"found compression {compression!r}, expected lz4, zstd or none")
    try:
        data = unpack(packed, size)
    except Malformed:
        raise
    except (RuntimeError, zstandard.ZstdError, MemoryError, EOFError, ValueError) as error:
        raise Malformed(f"found {compression} data that cannot be unpacked: {error}") from None
    if len(data) != size:
        found = f"more than {size}" if len(data) > size else len(data)
        raise Malformed(f"found {found} bytes unpacked, expected {size}")
    if crc and (found_crc := iso_hdlc(data)) != crc:
        raise Malformed(f"found checksum {found_crc:08x}, expected {crc:08x}")
    return data


def declared_size(compression: str, packed: bytes) -> int:
    """Bytes unpacked, as the compressed data say themselves; 0 where they do not."""
    try:
        match compression:
            case "lz4":
                return int(lz4.frame.get_frame_info(packed)["content_size"])
            case "zstd":
                size = zstandard.get_frame_parameters(packed).content_size
                return 0 if size == zstandard.CONTENTSIZE_UNKNOWN else size
            case _:
                return len(packed)
    except (RuntimeError, zstandard.ZstdError):
        return 0


def _plain(packed: bytes, _size: int) -> bytes:
    return packed


def _lz4(packed: bytes, size: int) -> bytes:
    told = lz4.frame.get_frame_info(packed)["content_size"]
    if told == size:
        return bytes(lz4.frame.decompress(packed))
    if told:
        raise Malformed(f"found an lz4 frame of {told} bytes unpacked, expected {size}")
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))


def _zstd(packed: bytes, size: int) -> bytes:
    told = zstandard.get_frame_parameters(packed).content_size
    if told == size:
        return zstandard.ZstdDecompressor().decompress(packed)
    # one that does not say its size, or several
    with zstandard.ZstdDecompressor().stream_reader(BytesIO(packed), read_across_frames=True) as reader:
        return reader.read(size + 1)

"""Small pictures for the page: an IMAGE of OpenIGTLink as PNG."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from igtl_gateway.addon import WireError
from igtl_gateway.addon.igtl import READING, Image, decode

#: Longest side of a small picture, pixels.
SMALL = 320
_GREY, _COLOUR = 0, 2


def small_png(message: bytes) -> bytes:
    """Return the middle slice of an IMAGE as PNG with at most ``SMALL`` pixels a side; empty without pixels.

    Values other than bytes are shown from their least (black) to their largest (white).

    Raises WireError: the message is no IMAGE.
    """
    image = decode(message, check_crc=False, reading=READING).content
    if not isinstance(image, Image):
        raise WireError("picture", type(image).__name__, "an IMAGE")
    columns, rows, slices = image.sub_size
    if not columns * rows * slices:
        return b""
    kind = image.dtype
    parts = image.num_components
    size = columns * rows * parts
    pixels = np.frombuffer(image.pixels, kind, size, slices // 2 * size * kind.itemsize)
    pixels = pixels.reshape(rows, columns, parts)
    step = -(-max(columns, rows) // SMALL)
    return _png(_as_bytes(pixels[::step, ::step, : 3 if parts >= 3 else 1]))


def _as_bytes(pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels, np.uint8)
    values = np.nan_to_num(pixels.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    least, most = values.min(), values.max()
    scaled: NDArray[np.uint8] = ((values - least) * (255.0 / (most - least or 1.0))).astype(np.uint8)
    return scaled


def _png(pixels: NDArray[np.uint8]) -> bytes:
    rows, columns, parts = pixels.shape
    lines = np.zeros((rows, 1 + columns * parts), np.uint8)  # each after the number of its filter, 0
    lines[:, 1:] = pixels.reshape(rows, -1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, _COLOUR if parts == 3 else _GREY, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 3)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )

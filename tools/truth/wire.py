"""OpenIGTLink messages of the peers of a world, packed by hand: the truth does not pass through the product's codec."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import fastcrc
import numpy as np

from tools.truth.world import MIDDLE, SPACING, Array

_HEADER = struct.Struct(">H12s20sQQQ")


def message(kind: str, device: str, body: bytes, stamp_ns: int, version: int = 1, *, crc: bool = True) -> bytes:
    """A whole message; versions from 2 on have an extended header and one item of metadata.  Stamp 0: unset."""
    if version > 1:
        key, value = b"Source", b"truth"
        head = struct.pack(">HHHI", 1, len(key), 3, len(value))
        body = struct.pack(">HHII", 12, len(head), len(key + value), 7) + body + head + key + value
    seconds, rest = divmod(stamp_ns, 10**9)
    ticks = seconds << 32 | round(rest * 2**32 / 10**9)
    check = fastcrc.crc64.ecma_182(body) if crc else 0
    return _HEADER.pack(version, kind.encode(), device.encode(), ticks, len(body), check) + body


def transform(matrix: Array) -> bytes:
    """TRANSFORM: the matrix column by column."""
    return np.asarray(matrix)[:3, :4].T.astype(">f4").tobytes()


def tracking(tools: Mapping[str, Array]) -> bytes:
    """TDATA: 70 bytes for each tool."""
    return b"".join(struct.pack(">20sBB", name.encode(), 1, 0) + transform(matrix) for name, matrix in tools.items())


def image(pixels: Array) -> bytes:
    """IMAGE of one slice: big-endian, RAS, with the placement of the world."""
    rows, columns = pixels.shape
    matrix = np.zeros((4, 3))
    matrix[0, 1], matrix[1, 2], matrix[2, 0] = SPACING[0], -SPACING[1], -SPACING[2]
    matrix[3] = MIDDLE
    kind = {1: 3, 2: 5}[pixels.dtype.itemsize]
    head = struct.pack(">HBBBB3H", 1, 1, kind, 1, 1, columns, rows, 1)
    return head + matrix.astype(">f4").tobytes() + struct.pack(">6H", 0, 0, 0, columns, rows, 1) + pixels.tobytes()


def text(value: str) -> bytes:
    """STRING in ASCII."""
    return struct.pack(">HH", 3, len(value)) + value.encode()


def points(places: Mapping[str, Sequence[float]]) -> bytes:
    """POINT: 136 bytes for each."""
    return b"".join(
        struct.pack(">64s32s4B4f20s", name.encode(), b"Plan", 255, 0, 0, 255, *place, 1.0, b"")
        for name, place in places.items()
    )


def surface(vertices: Array) -> bytes:
    """POLYDATA with triangles over its points and the number of each as attribute."""
    count = len(vertices)
    cells = [(number, number + 1, number + 2) for number in range(count - 2)]
    polys = b"".join(struct.pack(">4I", 3, *cell) for cell in cells)
    head = struct.pack(">10I", count, 0, 0, 0, 0, len(cells), len(polys), 0, 0, 1)
    name = b"number\0"
    attribute = struct.pack(">BBI", 0, 1, count) + name + b"\0" * (len(name) % 2)
    values = np.arange(count, dtype=">f4").tobytes()
    return head + np.asarray(vertices).astype(">f4").tobytes() + polys + attribute + values

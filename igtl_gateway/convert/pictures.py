"""Pictures of ROS that are more than rows of numbers: what a CompressedImage holds, depth, and Bayer mosaics.

``CompressedImage.format`` is text that each publisher words in its own way.  JPEG and PNG show themselves by their
first bytes, so these decide; the words decide about the rest.  The depth of compressed_depth_image_transport is a PNG
behind twelve bytes of its own, with metres as inverse numbers of 16 bits for ``32FC1``.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted

Array = npt.NDArray[Any]

JPEG, PNG = "jpeg", "png"
_MAGIC = {b"\xff\xd8\xff": JPEG, b"\x89PNG\r\n\x1a\n": PNG}
_WORDS = re.compile("[a-z0-9]+")
_NAMES = {"jpg": JPEG, "avc": "h264", "hevc": "h265", "vp90": "vp9", "av10": "av1"}
_CODECS = (JPEG, PNG, "h264", "h265", "vp9", "av1")
#: format, and two parameters of the quantisation.
_DEPTH_HEAD = struct.Struct("<iff")
_DEPTHS = ("16UC1", "32FC1")
_PNG_BIT_DEPTH = 24  # offset of the byte


@dataclass(frozen=True, slots=True)
class Coding:
    """What a CompressedImage holds.

    Attributes:
        codec: ``jpeg``, ``png``, or one of video; ``""``: another one.
        depth: encoding of depth, ``16UC1`` or ``32FC1``; ``""`` for other pictures.
        start: bytes before those of the codec.
        scale, shift: a number n of ``32FC1`` is scale / (n - shift) metres, and 0 is no measurement.
    """

    codec: str
    depth: str = ""
    start: int = 0
    scale: float = 0.0
    shift: float = 0.0


def coding_of(form: str, data: Buffer) -> Coding:
    """Return what a CompressedImage of this ``format`` holds.  Raises ConversionError for depth in another form."""
    words = _WORDS.findall(form.lower().replace("h.26", "h26"))
    if "compresseddepth" in words:
        return _depth(form, data)
    start = bytes(memoryview(data)[:8])
    codec = next((name for magic, name in _MAGIC.items() if start.startswith(magic)), "")
    named = (_NAMES.get(word, word) for word in words)
    return Coding(codec or next((name for name in named if name in _CODECS), ""))


def _depth(form: str, data: Buffer) -> Coding:
    given, size = memoryview(data), _DEPTH_HEAD.size
    encoding = form.partition(";")[0].strip().upper()
    if encoding not in _DEPTHS or bytes(given[size : size + 8]) not in _MAGIC:
        begins = bytes(given[size : size + 4]).hex() or "no data"
        raise ConversionError(
            f"sensor_msgs/CompressedImage: found format {form!r} with {begins} "
            f"behind its {counted(size, 'byte')} of parameters, expected {' or '.join(_DEPTHS)} as PNG"
        )
    _, scale, shift = _DEPTH_HEAD.unpack_from(given)
    if encoding == _DEPTHS[1] and not (np.isfinite(scale) and np.isfinite(shift) and scale > 0):
        raise ConversionError(
            f"sensor_msgs/CompressedImage: found the quantisation {scale:g}, {shift:g} of {form!r}, "
            "expected finite numbers, the first above 0"
        )
    return Coding(PNG, encoding, size, scale, shift)


def depths(pixels: Array, coding: Coding) -> Array:
    """Return depth as it was before compressed_depth_image_transport: uint16 of ``16UC1``, float32 metres of ``32FC1``.

    Raises ConversionError for other pixels than (rows, columns) of 16 bits.
    """
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ConversionError(
            f"sensor_msgs/CompressedImage: found a PNG of {pixels.dtype} with "
            f"{counted(pixels.ndim, 'axis', 'axes')} as depth, "
            "expected one number of 16 bits for each pixel"
        )
    if coding.depth == _DEPTHS[0]:
        return pixels
    with np.errstate(divide="ignore"):
        metres = np.float32(coding.scale) / (pixels.astype(np.float32) - np.float32(coding.shift))
    return np.where(pixels == 0, np.float32(np.nan), metres)


def is_deep_png(data: Buffer) -> bool:
    """Return whether a PNG has 16 bits for each number."""
    return bytes(memoryview(data)[_PNG_BIT_DEPTH : _PNG_BIT_DEPTH + 1]) == b"\x10"


_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")


def bayer_pattern(encoding: str) -> str:
    """Return the colours of a cell of a Bayer mosaic, by rows, such as ``rggb``; ``""`` for other encodings."""
    found = _BAYER.fullmatch(encoding.lower())
    return found[1] if found else ""


def demosaiced(mosaic: Array, pattern: str) -> Array:
    """Convert a Bayer mosaic (rows, columns) to RGB: all pixels of a cell of 2 × 2 get the colours of the cell.

    A cell that the edge cuts takes its missing pixels from the cell before it.
    """
    rows, columns = mosaic.shape
    whole = np.pad(mosaic, ((0, rows % 2), (0, columns % 2)), "reflect" if min(rows, columns) > 1 else "edge")
    cell = {(row, column): whole[row::2, column::2] for row in (0, 1) for column in (0, 1)}
    at = {colour: [(i // 2, i % 2) for i, name in enumerate(pattern) if name == colour] for colour in "rgb"}
    (red,), (blue,), greens = at["r"], at["b"], at["g"]
    green = (cell[greens[0]].astype(np.uint32) + cell[greens[1]]) >> 1
    small = np.stack([cell[red], green.astype(mosaic.dtype), cell[blue]], axis=-1)
    return small.repeat(2, axis=0).repeat(2, axis=1)[:rows, :columns]

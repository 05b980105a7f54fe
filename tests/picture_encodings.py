"""Every form of a picture in ROS, with the pixels that it stands for: one table for all ways out of a recording."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header, Image

Array = npt.NDArray[Any]
SIZES = {"even": (10, 14), "odd": (9, 13)}
#: Parameters of compressed_depth_image_transport for 0.2 … 4 m: metres = SCALE / (number - SHIFT).
SCALE, SHIFT = 10_000.0, 200.0


@dataclass(frozen=True)
class Form:
    """A picture.

    Attributes:
        content: Image or CompressedImage, with the stamp that is given.
        pixels: what it stands for: (rows, columns) or (rows, columns, 3) RGB, in the numbers of the sensor.
        close: how far apart pixels may be.
        refused: no way out reads it: each gives a reason.
    """

    content: Image | CompressedImage
    pixels: Array
    close: float = 0.0
    refused: bool = False

    def at(self, stamp_ns: int) -> Image | CompressedImage:
        """Return the message with a stamp."""
        header, given = Header(stamp_ns, "camera"), self.content
        if isinstance(given, CompressedImage):
            return CompressedImage(header, given.format, given.data)
        return Image(header, given.height, given.width, given.encoding, given.is_bigendian, given.step, given.data)

    @property
    def is_deep(self) -> bool:
        """Whether its numbers have more than 8 bits."""
        return bool(self.pixels.dtype != np.uint8)


def plain(encoding: str, pixels: Array, *, big: bool = False, pad: int = 0) -> Image:
    rows, columns = pixels.shape[:2]
    given = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    lines = [given[row].tobytes() + bytes(pad) for row in range(rows)]
    return Image(Header(), rows, columns, encoding, int(big), len(lines[0]), b"".join(lines))


def coded(codec: str, pixels: Array) -> bytes:
    """One picture by FFmpeg."""
    of = {(1, 2): "gray", (1, 3): "rgb24", (2, 2): "gray16be", (2, 3): "rgb48be"}[pixels.dtype.itemsize, pixels.ndim]
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.time_base = pixels.shape[1], pixels.shape[0], Fraction(1)
    encoder.pix_fmt = "yuvj444p" if codec == "mjpeg" else of
    encoder.options = {"q": "1", "qmin": "1", "qmax": "1"} if codec == "mjpeg" else {}
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=of)
    if codec == "mjpeg":
        frame = frame.reformat(format="yuvj444p", dst_color_range="JPEG")
    return b"".join(bytes(packet) for packet in (*encoder.encode(frame), *encoder.encode(None)))


def depth(form: str, pixels: Array, scale: float = 0.0, shift: float = 0.0) -> CompressedImage:
    return CompressedImage(Header(), form, struct.pack("<iff", 0, scale, shift) + coded("png", pixels))


def mosaic(rgb: Array, pattern: str) -> Array:
    """What a sensor with this pattern of colours sees of a picture."""
    at = {(row, column): "rgb".index(pattern[2 * row + column]) for row in (0, 1) for column in (0, 1)}
    seen = np.zeros(rgb.shape[:2], rgb.dtype)
    for (row, column), colour in at.items():
        seen[row::2, column::2] = rgb[row::2, column::2, colour]
    return seen


def forms(size: str) -> Iterator[tuple[str, Form]]:
    rows, columns = SIZES[size]
    row, column = np.mgrid[:rows, :columns]
    grey = (3 * row + 11 * column).astype(np.uint8)
    rgb = np.stack([grey, 255 - grey, (40 + 5 * row).astype(np.uint8)], axis=-1)
    wide = (500 + 37 * column + row).astype(np.uint16)
    wide_rgb = np.stack([wide, 4000 - wide, wide // 2], axis=-1)
    metres = (0.25 * column + 0.01 * row).astype(np.float32)
    # one colour for each cell of a mosaic, which no way of demosaicing changes
    cells = np.repeat(np.repeat(rgb[::2, ::2], 2, 0), 2, 1)[:rows, :columns]
    if rows % 2:  # a cell that the edge cuts has lost colours
        cells[-1] = cells[-2]
        cells[:, -1] = cells[:, -2]
    alpha = np.full((rows, columns, 1), 77, np.uint8)
    numbers = np.where((row + column) % 7 == 0, 0, 2600 + 300 * column + row).astype(np.uint16)
    inverse = np.where(numbers == 0, np.nan, np.float32(SCALE) / (numbers - np.float32(SHIFT))).astype(np.float32)
    yield "rgb8", Form(plain("rgb8", rgb), rgb)
    yield "rgb8 with padded rows", Form(plain("rgb8", rgb, pad=5), rgb)
    yield "bgr8", Form(plain("bgr8", rgb[..., ::-1]), rgb)
    yield "rgba8", Form(plain("rgba8", np.concatenate([rgb, alpha], 2)), rgb)
    yield "bgra8", Form(plain("bgra8", np.concatenate([rgb[..., ::-1], alpha], 2)), rgb)
    yield "mono8", Form(plain("mono8", grey), grey)
    yield "8UC1", Form(plain("8UC1", grey), grey)
    for big in (False, True):
        end = " big-endian" * big
        yield f"mono16{end}", Form(plain("mono16", wide, big=big), wide)
        yield f"16UC1{end}", Form(plain("16UC1", wide, big=big), wide)
        yield f"32FC1{end}", Form(plain("32FC1", metres, big=big), metres)
        yield f"rgb16{end}", Form(plain("rgb16", wide_rgb, big=big), wide_rgb)
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        yield f"bayer_{pattern}8", Form(plain(f"bayer_{pattern}8", mosaic(cells, pattern)), cells)
    deep_cells = cells.astype(np.uint16) * 16
    yield "bayer_rggb16", Form(plain("bayer_rggb16", mosaic(deep_cells, "rggb"), big=True), deep_cells)
    yield "an unknown encoding", Form(plain("yuv420p10", rgb), rgb, refused=True)
    yield "jpeg", Form(CompressedImage(Header(), "rgb8; jpeg compressed bgr8", coded("mjpeg", cells)), cells, close=12)
    yield "png", Form(CompressedImage(Header(), "bgr8; png compressed bgr8", coded("png", rgb)), rgb)
    yield "png of grey", Form(CompressedImage(Header(), "png", coded("png", grey)), grey)
    yield "png under another name", Form(CompressedImage(Header(), "jpeg", coded("png", rgb)), rgb)
    yield "png of 16 bits", Form(CompressedImage(Header(), "mono16; png compressed mono16", coded("png", wide)), wide)
    yield "png of 16UC1", Form(CompressedImage(Header(), "16UC1; png compressed 16UC1", coded("png", wide)), wide)
    yield (
        "png of rgb16",
        Form(CompressedImage(Header(), "bgr16; png compressed bgr16", coded("png", wide_rgb)), wide_rgb),
    )
    yield "depth", Form(depth("16UC1; compressedDepth png", wide), wide)
    yield "depth of Noetic", Form(depth("16UC1; compressedDepth", wide), wide)
    yield "depth in metres", Form(depth("32FC1; compressedDepth png", numbers, SCALE, SHIFT), inverse, close=1e-6)
    rvl = CompressedImage(Header(), "16UC1; compressedDepth rvl", struct.pack("<iff", 0, 0, 0) + bytes(40))
    yield "depth as RVL", Form(rvl, wide, refused=True)
    yield "depth without a name", Form(depth("compressedDepth png", wide), wide, refused=True)
    yield "depth without a scale", Form(depth("32FC1; compressedDepth png", numbers), inverse, refused=True)
    yield "depth of 8 bits", Form(depth("16UC1; compressedDepth png", grey), grey, refused=True)
    yield "tiff", Form(CompressedImage(Header(), "rgb8; tiff compressed rgb8", b"II*\0" + bytes(40)), rgb, refused=True)


FORMS = {f"{name}, {size}": form for size in SIZES for name, form in forms(size)}

"""Encoded pictures with a mask: decoded, masked and encoded again, by PyAV (FFmpeg).

Each frame gives one frame at once, and a key frame stays a key frame.  A frame that cannot be decoded is removed, and
all frames after it up to the next key frame.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon.messages import MAX_PIXELS, import_av
from igtl_gateway.addon.settings import ENCODERS
from igtl_gateway.addons.deidentify.masks import Mask, masked

_DECODERS = {"h264": "h264", "vp9": "vp9"}
_PICTURES = {"jpeg": "mjpeg", "png": "png"}
#: Quality of JPEG: FFmpeg's scale, 2 is the best.
_QUALITY = "2"
#: Bits of a pixel of video: far more than real encoders spend.
_BITS = 4
_RATE = 30


class MaskedVideo:
    """One stream of frames; H.264 and VP9.  Raises Unavailable without PyAV."""

    def __init__(self, mask: Mask) -> None:
        self._av = import_av()
        self._mask = mask
        self._decoder: Any = None
        self._encoder: Any = None
        self._count = 0

    def frame(self, codec: str, data: bytes, *, is_key: bool) -> bytes | None:
        """Return the frame with the mask; None if it has no picture, or for another codec."""
        if codec not in _DECODERS or not data or (self._decoder is None and not is_key):
            return None
        try:
            pixels = self._decode(codec, data)
            return None if pixels is None else self._encode(codec, self._hide(pixels), is_key=is_key)
        except (self._av.FFmpegError, ValueError):
            self._decoder = None
            return None

    def _decode(self, codec: str, data: bytes) -> npt.NDArray[np.uint8] | None:
        if self._decoder is None:
            self._decoder = _opened(self._av, _DECODERS[codec])
            self._decoder.flags |= self._av.codec.context.Flags.low_delay
        self._count += 1
        packet = self._av.Packet(data)
        packet.pts = self._count
        found = [each for each in self._decoder.decode(packet) if each.pts == self._count and not each.is_corrupt]
        return found[0].to_ndarray(format="rgb24") if found else None

    def _hide(self, pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        return np.ascontiguousarray(masked(self._mask, pixels, (pixels.shape[0], pixels.shape[1])))

    def _encode(self, codec: str, pixels: npt.NDArray[np.uint8], *, is_key: bool) -> bytes | None:
        rows, columns = pixels.shape[:2]
        if self._encoder is None or (self._encoder.height, self._encoder.width) != (rows, columns):
            self._encoder = self._new_encoder(codec, rows, columns)
        picture = self._av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p")
        picture.pts = self._count
        picture.pict_type = self._av.video.frame.PictureType.I if is_key else self._av.video.frame.PictureType.NONE
        return b"".join(bytes(packet) for packet in self._encoder.encode(picture)) or None

    def _new_encoder(self, codec: str, rows: int, columns: int) -> Any:
        name, settings = ENCODERS[codec]
        encoder = self._av.CodecContext.create(name, "w")
        encoder.width, encoder.height, encoder.pix_fmt = columns, rows, "yuv420p"
        encoder.framerate, encoder.time_base = Fraction(_RATE), Fraction(1, _RATE)
        encoder.bit_rate, encoder.gop_size, encoder.max_b_frames = _BITS * rows * columns * _RATE, 10_000, 0
        encoder.thread_count = 1
        encoder.options = settings
        encoder.open()
        return encoder


def masked_picture(kind: str, data: bytes, mask: Mask) -> bytes | None:
    """Return a ``jpeg`` or ``png`` with the mask; None if it cannot be decoded.  Raises Unavailable."""
    av = import_av()
    try:
        decoder = _opened(av, _PICTURES[kind])
        found = [*decoder.decode(av.Packet(data)), *decoder.decode(None)]
        form = "gray" if found[0].format.name.startswith("gray") else "rgb24"
        pixels = found[0].to_ndarray(format=form)
        rows, columns = pixels.shape[:2]
        hidden = masked(mask, pixels.reshape(rows, columns, -1), (rows, columns)).reshape(pixels.shape)
        return _encoded(av, kind, np.ascontiguousarray(hidden), form)
    except (av.FFmpegError, ValueError, IndexError):
        return None


def _encoded(av: Any, kind: str, pixels: npt.NDArray[np.uint8], form: str) -> bytes:
    encoder = av.CodecContext.create(_PICTURES[kind], "w")
    encoder.height, encoder.width = pixels.shape[:2]
    encoder.pix_fmt = form if kind == "png" else "yuvj444p"
    encoder.time_base = Fraction(1, _RATE)
    if kind == "jpeg":
        encoder.options = {"qmin": _QUALITY, "qmax": _QUALITY}
    picture = av.VideoFrame.from_ndarray(pixels, format=form).reformat(format=encoder.pix_fmt)
    picture.pts = 0
    return b"".join(bytes(packet) for packet in (*encoder.encode(picture), *encoder.encode(None)))


def _opened(av: Any, name: str) -> Any:
    codec = av.CodecContext.create(name, "r")
    codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
    codec.thread_count = 1
    return codec

"""Masks and metadata of pictures: plain ones, JPEG and PNG, and video, which is encoded again.

Without a mask the pixels stay.  JPEG, PNG, H.264, H.265 and AV1 lose their text without being decoded.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import Unavailable
from igtl_gateway.addon.messages import is_key_frame
from igtl_gateway.addons.deidentify.masks import Mask, hidden, masked
from igtl_gateway.addons.deidentify.profile import Profile
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.transcoding import MaskedVideo, masked_picture

#: Codecs of VIDEO → names of CompressedImage.
FOUR_LETTERS = {"H264": "h264", "X265": "h265", "O265": "h265", "VP90": "vp9", "AV10": "av1"}
_VIDEO = frozenset(FOUR_LETTERS.values())
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_START = b"\x00\x00\x01"
#: Segments of JPEG that are needed to decode it: JFIF (APP0) and Adobe's colour transform (APP14), tables, frames.
_KEPT_SEGMENTS = frozenset({0xE0, 0xEE, 0xC4, 0xDB, 0xDD, *range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC)})
_KEPT_CHUNKS = frozenset({b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"gAMA", b"sBIT", b"pHYs", b"sRGB", b"cHRM"})

#: Kinds of units that a decoder needs: of H.264 slices, parameter sets, delimiters and ends; of H.265 the same; of AV1
#: sequence headers, delimiters, frames and tiles.  The others are text, filling, reserved, or for private use.
_H264_UNITS = frozenset({1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 13, 14, 15, 19, 20})
_H265_UNITS = frozenset({*range(10), *range(16, 22), *range(32, 38)})
_AV1_UNITS = frozenset({1, 2, 3, 4, 6, 7})


class PixelCleaner:
    """Changes the pictures of a session by the masks of a profile; adds the names of their streams to ``streams``."""

    def __init__(self, profile: Profile, report: Report, streams: set[str] | None = None) -> None:
        self._profile, self._report = profile, report
        self._streams = set() if streams is None else streams
        self._videos: dict[str, MaskedVideo] = {}

    def plain(
        self, pixels: npt.NDArray[Any], stream: str, size: tuple[int, int], at: tuple[int, int] = (0, 0)
    ) -> memoryview | None:
        """Return the bytes of masked pixels (…, rows, columns, components), None without a mask; see ``masked``."""
        mask = self._mask(stream)
        if mask is None or not pixels.size:
            return None
        if not hidden(mask, *size).any():
            self._report.left["mask"] = "no mask reaches some pictures: it is outside of them, and text burnt in stays"
        self._report.add("pixels")
        return np.ascontiguousarray(masked(mask, pixels, size, at)).reshape(-1).view(np.uint8).data

    def video(self, codec: str, data: bytes, stream: str, *, is_key: bool) -> bytes | None:
        """Return an encoded frame with the mask, or without its messages; None: it has to be removed."""
        name, mask = FOUR_LETTERS.get(codec, codec), self._mask(stream)
        if mask is None:
            return self._stripped(name, data)
        try:
            if stream not in self._videos:
                self._videos[stream] = MaskedVideo(mask)
            new = self._videos[stream].frame(name, data, is_key=is_key or is_key_frame(name, data))
        except Unavailable:
            self._report.left["video with a mask"] = "removed: PyAV is not installed"
            return None
        self._report.add("pixels", new is not None)
        return new

    def compressed(self, form: str, data: bytes, stream: str) -> bytes | None:
        """Return the data of a CompressedImage; None: it has to be removed."""
        if form in _VIDEO:
            return self.video(form, data, stream, is_key=is_key_frame(form, data))
        kind = "jpeg" if data.startswith(_JPEG) else "png" if data.startswith(_PNG) else ""
        if not kind or "compresseddepth" in form.lower():
            return None
        mask = self._mask(stream)
        if mask is None:
            return self._stripped(kind, data)
        try:
            new = masked_picture(kind, data, mask)
        except Unavailable:
            self._report.left["pictures with a mask"] = "removed: PyAV is not installed"
            return None
        self._report.add("pixels", new is not None)
        return new

    def _mask(self, stream: str) -> Mask | None:
        self._streams.add(stream)
        mask = self._profile.mask(stream)
        if mask is None:
            self._report.left["pixels"] = "no mask for some streams of pictures: text that is burnt in stays"
        return mask

    def _stripped(self, kind: str, data: bytes) -> bytes | None:
        """Return a picture or frame without text; None if it is damaged."""
        try:
            new = _STRIPPERS[kind](data) if kind in _STRIPPERS else data
        except (ValueError, IndexError, struct.error):
            return None
        self._report.add("picture data", new != data)
        return new


def without_jpeg_texts(data: bytes) -> bytes:
    """Return a JPEG without comments, EXIF and what follows its end.  Raises ValueError."""
    parts, at = [_JPEG], 2
    while True:
        if data[at] != 0xFF:
            raise ValueError("no marker")
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == 0xD9:
            return b"".join((*parts, b"\xff\xd9"))
        (size,) = struct.unpack_from(">H", data, at + 2)
        end = at + 2 + size
        if marker == 0xDA:  # the coded picture: up to the next marker that is not a restart
            while (end := data.find(b"\xff", end)) >= 0 and (data[end + 1] == 0 or 0xD0 <= data[end + 1] <= 0xD7):
                end += 2
            if end < 0:
                raise ValueError("no end")
            parts.append(data[at:end])
        elif marker == 0xE0:
            parts.append(_jfif(data[at:end]))
        elif marker == 0xEE:
            parts.append(_adobe(data[at:end]))
        elif marker in _KEPT_SEGMENTS:
            parts.append(data[at:end])
        at = end


def _jfif(segment: bytes) -> bytes:
    """Return APP0 of JFIF without its thumbnail; nothing for other APP0."""
    if segment[4:9] != b"JFIF\0" or len(segment) < 18:
        return b""
    return b"\xff\xe0" + struct.pack(">H", 16) + segment[4:16] + b"\0\0"


def _adobe(segment: bytes) -> bytes:
    """Return APP14 of Adobe without what follows its colour transform; nothing for other APP14."""
    is_adobe = segment[4:9] == b"Adobe" and len(segment) >= 16
    return b"\xff\xee" + struct.pack(">H", 14) + segment[4:16] if is_adobe else b""


def without_png_texts(data: bytes) -> bytes:
    """Return a PNG with the chunks of its picture only.  Raises struct.error and ValueError."""
    parts, at = [_PNG], len(_PNG)
    while True:
        size, kind = struct.unpack_from(">I4s", data, at)
        chunk = data[at + 8 : at + 8 + size]
        if len(chunk) < size:
            raise ValueError("no end")
        if kind in _KEPT_CHUNKS:
            parts.append(struct.pack(">I", size) + kind + chunk + struct.pack(">I", zlib.crc32(kind + chunk)))
        if kind == b"IEND":
            return b"".join(parts)
        at += 12 + size


def without_h264_messages(data: bytes) -> bytes:
    """Return a frame of H.264 (Annex B) without units of text (SEI) and those that no decoder reads."""
    return _without(data, lambda head: head & 0x1F in _H264_UNITS)


def without_h265_messages(data: bytes) -> bytes:
    """Return a frame of H.265 (Annex B) without units of text (SEI) and those that no decoder reads."""
    return _without(data, lambda head: head >> 1 & 0x3F in _H265_UNITS)


def without_av1_metadata(data: bytes) -> bytes:
    """Return a frame of AV1 (Section 5 of its specification) without metadata, padding and units of unknown kinds.

    Raises ValueError and IndexError.
    """
    parts, at = [], 0
    while at < len(data):
        head = data[at]
        if not head & 0x02:
            raise ValueError("no size")
        begin = at + 1 + (head >> 2 & 1)
        size, begin = _leb128(data, begin)
        if begin + size > len(data):
            raise ValueError("no end")
        if head >> 3 & 0x0F in _AV1_UNITS:
            parts.append(data[at : begin + size])
        at = begin + size
    return b"".join(parts)


def _leb128(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of AV1, and the offset behind it.  Raises IndexError and ValueError."""
    value = 0
    for place in range(8):
        value |= (data[at + place] & 0x7F) << 7 * place
        if data[at + place] < 0x80:
            return value, at + place + 1
    raise ValueError("no number")


def _without(data: bytes, is_needed: Callable[[int], bool]) -> bytes:
    """Return the same bytes if all units are needed, and nothing is before them.  Raises ValueError and IndexError."""
    units = list(_units(data))
    kept = [unit for unit, head in units if is_needed(head)]
    is_clean = len(kept) == len(units) and not data[: data.find(_START)].strip(b"\0")
    return data if is_clean else b"".join(kept)


def _units(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield the units of Annex B with their start codes, and their first bytes."""
    at = data.find(_START)
    if at < 0:
        raise ValueError("no start code")
    while at >= 0:
        head = data[at + 3]
        next_at = data.find(_START, at + 3)
        yield b"\x00" + data[at : next_at if next_at >= 0 else len(data)].rstrip(b"\x00"), head
        at = next_at


_STRIPPERS = {
    "jpeg": without_jpeg_texts,
    "png": without_png_texts,
    "h264": without_h264_messages,
    "h265": without_h265_messages,
    "av1": without_av1_metadata,
}

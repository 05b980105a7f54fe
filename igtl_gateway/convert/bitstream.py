"""Detection of key frames: whether one encoded video frame can be decoded without the frames before it.

Formats have their names in foxglove_msgs/CompressedVideo: ``h264`` and ``h265`` (Annex B), ``vp9``, ``av1``
(low-overhead OBUs).  Only the first bytes are read.  No input raises an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from igtl_gateway.base.buffers import Buffer

_START_CODE = b"\x00\x00\x01"
#: The headers of a frame precede its first slice, which is searched for in this number of bytes.
_MAX_HEADERS = 1 << 16

_H264_SLICES, _H264_IDR = range(1, 6), 5
_H265_SLICES, _H265_IRAP = range(32), range(16, 22)
_AV1_SEQUENCE_HEADER, _AV1_FRAMES = 1, (3, 6)


def is_key_frame(codec: str, data: Buffer) -> bool:
    """Return whether decoding can begin with this frame; False for unknown formats."""
    detect = _DETECTORS.get(codec)
    return detect is not None and detect(bytes(memoryview(data)[:_MAX_HEADERS]))


def _h264(data: bytes) -> bool:
    return next((kind == _H264_IDR for byte in _units(data) if (kind := byte & 0x1F) in _H264_SLICES), False)


def _h265(data: bytes) -> bool:
    return next((kind in _H265_IRAP for byte in _units(data) if (kind := byte >> 1 & 0x3F) in _H265_SLICES), False)


def _units(data: bytes) -> Iterator[int]:
    """Yield the first byte of each unit of an Annex B stream."""
    at = data.find(_START_CODE)
    while 0 <= at < len(data) - len(_START_CODE):
        yield data[at + len(_START_CODE)]
        at = data.find(_START_CODE, at + len(_START_CODE))


def _vp9(data: bytes) -> bool:
    """Parse, from the top bit: 10, two bits of the profile (a 0 if it is 3), show existing frame, not a key frame."""
    if not data or data[0] >> 6 != 0b10:
        return False
    return data[0] >> (1 if data[0] >> 4 & 0b11 == 0b11 else 2) & 0b11 == 0


def _av1(data: bytes) -> bool:
    """Search for the sequence header: encoders write it before each key frame, and before no other frame."""
    at = 0
    while at < len(data):
        kind, extended, sized = data[at] >> 3 & 0x0F, data[at] >> 2 & 1, data[at] >> 1 & 1
        if kind == _AV1_SEQUENCE_HEADER:
            return True
        if kind in _AV1_FRAMES or not sized:
            return False
        at += 1 + extended
        size = shift = 0
        while at < len(data):
            byte = data[at]
            size |= (byte & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if byte < 0x80 or shift == 56:
                break
        at += size
    return False


_DETECTORS: dict[str, Callable[[bytes], bool]] = {"h264": _h264, "h265": _h265, "vp9": _vp9, "av1": _av1}

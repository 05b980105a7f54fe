"""The image size of an encoded video, read from the headers before its key frames.

The formats are those of ``bitstream``.  No input raises an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from igtl_gateway.base.buffers import Buffer

_START_CODE = b"\x00\x00\x01"
#: The headers precede the first slice; they are searched for in this number of bytes.
_MAX_HEADERS = 1 << 16
#: Maximum size of one header in bytes.
_MAX_HEADER = 1 << 12
_MAX_SIZE = 65_535

_H264_SPS, _H264_SLICES = 7, range(1, 6)
_H265_SPS, _H265_SLICES = 33, range(32)
_AV1_SEQUENCE_HEADER = 1

#: H.264 profiles whose header contains the chroma sampling; it is 4:2:0 in the other profiles.
_H264_HIGH = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
_YUV420, _YUV422, _YUV444 = 1, 2, 3

#: Maximum number of leading zeros of an Exp-Golomb code of 32 bits.
_MAX_ZEROS = 31

Size = tuple[int, int]


def frame_size(codec: str, data: Buffer) -> Size | None:
    """Return (width, height) in pixels after cropping; None if the frame does not contain it.

    ``codec`` is ``h264``, ``h265`` (Annex B), ``vp9`` or ``av1``.
    """
    parse = _PARSERS.get(codec)
    if parse is None:
        return None
    try:
        size = parse(bytes(memoryview(data)[:_MAX_HEADERS]))
    except _EndOfBits:
        return None
    return size if size and all(0 < length <= _MAX_SIZE for length in size) else None


class _EndOfBits(Exception):
    """The bytes end inside a header, or a code is invalid."""


class _Bits:
    """Reads the bits of a header, the highest bit of each byte first."""

    __slots__ = ("_left", "_value")

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def take(self, count: int) -> int:
        """Read a number of ``count`` bits."""
        self._left -= count
        if self._left < 0:
            raise _EndOfBits
        return self._value >> self._left & ((1 << count) - 1)

    def flag(self) -> bool:
        return self.take(1) == 1

    def golomb(self) -> int:
        """Read an unsigned Exp-Golomb code: n zeros, a one, and n bits."""
        zeros = 0
        while not self.flag():
            zeros += 1
            if zeros > _MAX_ZEROS:
                raise _EndOfBits
        return (1 << zeros) - 1 + self.take(zeros)

    def signed_golomb(self) -> int:
        code = self.golomb()
        return (code + 1) // 2 if code & 1 else -(code // 2)


def _units(data: bytes) -> Iterator[bytes]:
    """Return the units of an Annex B stream."""
    return (unit for unit in data.split(_START_CODE)[1:] if unit)


def _without_emulation_prevention(unit: bytes) -> _Bits:
    """Return the bits of a unit without its emulation prevention bytes."""
    return _Bits(unit[:_MAX_HEADER].replace(b"\x00\x00\x03", b"\x00\x00"))


def _cropped(bits: _Bits, width: int, height: int, x_unit: int, y_unit: int) -> Size:
    """Return the size inside the cropping window (left, right, top, bottom), if one follows."""
    if bits.flag():
        left, right, top, bottom = (bits.golomb() for _ in range(4))
        width -= x_unit * (left + right)
        height -= y_unit * (top + bottom)
    return width, height


def _h264(data: bytes) -> Size | None:
    for unit in _units(data):
        kind = unit[0] & 0x1F
        if kind == _H264_SPS:
            return _h264_sps(_without_emulation_prevention(unit[1:]))
        if kind in _H264_SLICES:
            break
    return None


def _h264_sps(bits: _Bits) -> Size:
    """Return the size in a sequence parameter set: H.264, 7.3.2.1.1."""
    profile = bits.take(8)
    bits.take(16)  # constraints, level
    bits.golomb()
    chroma, separate = _YUV420, False
    if profile in _H264_HIGH:
        chroma = bits.golomb()
        separate = chroma == _YUV444 and bits.flag()
        bits.golomb()  # bits of luma and chroma samples
        bits.golomb()
        bits.flag()
        if bits.flag():
            for index in range(12 if chroma == _YUV444 else 8):
                if bits.flag():
                    _skip_scaling_list(bits, 16 if index < 6 else 64)
    bits.golomb()
    order = bits.golomb()
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.flag()
        bits.golomb()
        bits.golomb()
        for _ in range(min(bits.golomb(), 255)):
            bits.golomb()
    bits.golomb()  # reference frames
    bits.flag()
    width, height = 16 * (bits.golomb() + 1), 16 * (bits.golomb() + 1)
    frames_only = bits.flag()
    if not frames_only:
        bits.flag()
    bits.flag()
    fields = 1 if frames_only else 2
    x_unit = 2 if chroma in (_YUV420, _YUV422) and not separate else 1
    y_unit = 2 if chroma == _YUV420 else 1
    return _cropped(bits, width, height * fields, x_unit, y_unit * fields)


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.signed_golomb()) % 256
        last = following or last


def _h265(data: bytes) -> Size | None:
    for unit in _units(data):
        kind = unit[0] >> 1 & 0x3F
        if kind == _H265_SPS:
            return _h265_sps(_without_emulation_prevention(unit[2:]))
        if kind in _H265_SLICES:
            break
    return None


def _h265_sps(bits: _Bits) -> Size:
    """Return the size in a sequence parameter set: H.265, 7.3.2.2.1 and 7.3.3."""
    bits.take(4)
    layers = bits.take(3)
    bits.take(1 + 88 + 8)  # general profile and level
    present = [(bits.flag(), bits.flag()) for _ in range(layers)]
    if layers:
        bits.take(2 * (8 - layers))
    for profile, level in present:
        bits.take(88 * profile + 8 * level)
    bits.golomb()
    chroma = bits.golomb()
    if chroma == _YUV444:
        bits.flag()
    width, height = bits.golomb(), bits.golomb()
    return _cropped(bits, width, height, 2 if chroma in (_YUV420, _YUV422) else 1, 2 if chroma == _YUV420 else 1)


def _vp9(data: bytes) -> Size | None:
    """Return the size in a key frame (VP9, 6.2 and 7.2); only key frames have the sync code at this place."""
    bits = _Bits(data[:16])
    if bits.take(2) != 0b10:
        return None
    profile = bits.take(1) + 2 * bits.take(1)
    if profile == 3:
        bits.flag()
    shows_other, not_key = bits.flag(), bits.flag()
    bits.take(2)
    if shows_other or not_key or bits.take(24) != 0x498342:
        return None
    if profile >= 2:
        bits.flag()
    has_sampling = profile in (1, 3)
    if bits.take(3) == 7:  # sRGB
        bits.take(1 if has_sampling else 0)
    else:
        bits.take(4 if has_sampling else 1)
    return bits.take(16) + 1, bits.take(16) + 1


def _av1(data: bytes) -> Size | None:
    at = 0
    while at < len(data):
        kind, extended, sized = data[at] >> 3 & 0x0F, data[at] >> 2 & 1, data[at] >> 1 & 1
        at += 1 + extended
        size = len(data) - at
        if sized:
            size = shift = 0
            while at < len(data) and shift < 56:
                byte = data[at]
                size |= (byte & 0x7F) << shift
                at, shift = at + 1, shift + 7
                if byte < 0x80:
                    break
        if kind == _AV1_SEQUENCE_HEADER:
            return _av1_sequence(_Bits(data[at : at + min(size, _MAX_HEADER)]))
        at += size
    return None


def _av1_sequence(bits: _Bits) -> Size:
    """Return the size in a sequence header: AV1, 5.5.1."""
    bits.take(4)  # profile, still picture
    if bits.flag():  # reduced header
        bits.take(5)
    else:
        delays = _av1_timing(bits)
        shows_delay = bits.flag()
        for _ in range(bits.take(5) + 1):
            bits.take(12)
            if bits.take(5) > 7:
                bits.flag()
            if delays and bits.flag():
                bits.take(2 * delays + 1)
            if shows_delay and bits.flag():
                bits.take(4)
    wide, high = bits.take(4) + 1, bits.take(4) + 1
    return bits.take(wide) + 1, bits.take(high) + 1


def _av1_timing(bits: _Bits) -> int:
    """Return the number of bits of the delays of the decoder model; 0 without a model."""
    if not bits.flag():
        return 0
    bits.take(64)
    if bits.flag():
        bits.golomb()
    if not bits.flag():
        return 0
    delays = bits.take(5) + 1
    bits.take(32 + 5 + 5)
    return delays


_PARSERS: dict[str, Callable[[bytes], Size | None]] = {"h264": _h264, "h265": _h265, "vp9": _vp9, "av1": _av1}

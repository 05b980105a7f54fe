"""Masks of plain and encoded pictures, and what JPEG, PNG and H.264 carry besides the picture."""

from __future__ import annotations

import struct
import zlib
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.masks import Fan, Mask, Rectangle, hidden
from igtl_gateway.addons.deidentify.messages import MessageCleaner
from igtl_gateway.addons.deidentify.pixels import (
    PixelCleaner,
    without_av1_metadata,
    without_h264_messages,
    without_jpeg_texts,
    without_png_texts,
)
from igtl_gateway.addons.deidentify.profile import Profile
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.image import BIG_ENDIAN, SCALARS, Image
from igtl_gateway.wire.video import Video
from tests.tables import table

CORNER = Mask("**", (Rectangle(0, 0, 24, 16),), value=7)
TEXT = b"PlantedName"
SIZE = (64, 96)  # rows, columns: even, as video needs it


def cleaned(content: Any, *masks: Mask) -> Any:
    context = Context.of(Profile(masks=masks), bytes(32), 0)
    kind = "IMAGE" if isinstance(content, Image) else "VIDEO"
    data = b"".join(encode(Message(kind, "Scan", content)))
    return decode(MessageCleaner(context).clean(data, f"{kind}/Scan")).content


def gradient() -> Any:
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    return np.stack([rows + 100, columns + 100, np.full(SIZE, 200)], axis=-1).astype(np.uint8)


def coded(name: str, form: str, options: dict[str, str], pictures: list[Any]) -> list[bytes]:
    av = pytest.importorskip("av")
    encoder = av.CodecContext.create(name, "w")
    encoder.height, encoder.width, encoder.pix_fmt = *SIZE, form
    encoder.time_base, encoder.framerate = Fraction(1, 30), Fraction(30)
    encoder.options, encoder.max_b_frames = options, 0
    frames = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=form)
        frame.pts = number
        frames.append(b"".join(bytes(packet) for packet in encoder.encode(frame)))
    return [*frames, b"".join(bytes(packet) for packet in encoder.encode(None))]


def shown(name: str, frames: list[bytes]) -> list[Any]:
    av = pytest.importorskip("av")
    decoder = av.CodecContext.create(name, "r")
    found = [picture for frame in frames for picture in decoder.decode(av.Packet(frame))] + decoder.decode(None)
    return [picture.to_ndarray(format="rgb24").astype(int) for picture in found]


@table("scalar", sorted(SCALARS))
def test_every_scalar_type_is_masked(scalar: int) -> None:
    dtype = np.dtype(SCALARS[scalar]).newbyteorder(">")
    pixels = np.arange(1, 2 * 64 * 96 * 2 + 1).reshape(2, 64, 96, 2).astype(dtype)
    image = Image((96, 64, 2), scalar, pixels.tobytes(), 2, endian=BIG_ENDIAN)
    new = cleaned(image, CORNER).array
    assert (new[:, :16, :24] == 7).all()
    pixels[:, :16, :24] = 7
    assert new.tobytes() == pixels.tobytes()
    assert bytes(cleaned(image).pixels) == image.pixels


def test_a_part_of_an_image_is_masked_at_its_place() -> None:
    part = Image((96, 64, 1), 3, bytes([9]) * 200, subvol_offset=(20, 10, 0), subvol_size=(20, 10, 1))
    new = cleaned(part, CORNER).array[0, :, :, 0]
    assert (new[:6, :4] == 7).all()
    assert (new == 7).sum() == 24


def test_all_outside_of_a_fan_is_hidden() -> None:
    away = hidden(Mask("**", fan=Fan(48, 0, 10, 50, 45, 135)), *SIZE)
    assert not away[30, 48]
    assert away[5, 48] and away[60, 48] and away[10, 5] and away[30, 90]


def test_video_is_encoded_again_with_the_mask() -> None:
    settings = {"preset": "ultrafast", "tune": "zerolatency"}
    frames = [frame for frame in coded("libx264", "yuv420p", settings, [gradient()] * 4) if frame]
    context = Context.of(Profile(masks=(Mask("**", (Rectangle(0, 0, 24, 16),)),)), bytes(32), 0)
    cleaner = MessageCleaner(context)
    new = []
    for number, data in enumerate(frames):
        video = Video("H264", (96, 64, 1), data, frame_type=1 if number == 0 else 2)
        message = b"".join(encode(Message("VIDEO", "Scan", video)))
        content = decode(cleaner.clean(message, "VIDEO/Scan")).content
        assert isinstance(content, Video)
        new.append(bytes(content.data))
    pictures = shown("h264", new)
    assert len(pictures) == len(frames)
    for picture in pictures:
        assert picture[:12, :20].max() < 30
        assert abs(picture[32:, 40:] - gradient()[32:, 40:]).mean() < 8
    with pytest.raises(Removed):
        cleaned(Video("H264", (96, 64, 1), frames[1], frame_type=2), CORNER)


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_pictures_are_masked_and_lose_their_text(kind: str) -> None:
    name, form = {"jpeg": ("mjpeg", "yuvj444p"), "png": ("png", "rgb24")}[kind]
    data = b"".join(coded(name, form, {"qmin": "2", "qmax": "2"} if kind == "jpeg" else {}, [gradient()]))
    if kind == "jpeg":
        exif = b"\xff\xe1" + struct.pack(">H", 2 + len(TEXT)) + TEXT
        comment = b"\xff\xfe" + struct.pack(">H", 2 + len(TEXT)) + TEXT
        planted, stripped = data[:2] + exif + comment + data[2:] + TEXT, without_jpeg_texts
    else:
        chunk = struct.pack(">I4s", len(TEXT), b"tEXt") + TEXT + struct.pack(">I", zlib.crc32(b"tEXt" + TEXT))
        planted, stripped = data[:33] + chunk + data[33:] + TEXT, without_png_texts
    clean = stripped(planted)
    assert TEXT in planted and TEXT not in clean
    assert (shown(name, [clean])[0] == shown(name, [data])[0]).all()
    for cut in range(0, len(planted) - 12, 97):
        with pytest.raises((ValueError, IndexError, struct.error)):
            stripped(planted[:cut][: data.find(b"\xff\xd9") if kind == "jpeg" else -1])
    pixels = Context.of(Profile(masks=(CORNER,)), bytes(32), 0).pixels
    new = pixels.compressed(kind, planted, "/camera")
    assert new is not None and TEXT not in new
    picture = shown(name, [new])[0]
    assert abs(picture[:12, :20] - 7).max() < 12
    assert abs(picture[32:, 40:] - gradient()[32:, 40:]).mean() < 4


#: Form → kinds of units that a decoder needs, of all kinds that the head of a unit can have.
UNITS = {
    "h264": (32, {1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 13, 14, 15, 19, 20}),
    "h265": (64, {*range(10), *range(16, 22), *range(32, 38)}),
    "av1": (16, {1, 2, 3, 4, 6, 7}),
}


@pytest.mark.parametrize("form", UNITS)
def test_which_units_of_video_stay(form: str) -> None:
    count, needed = UNITS[form]
    for kind in range(count):
        if form == "av1":
            unit, other = bytes([kind << 3 | 2, 2, 9, 9]), bytes([1 << 3 | 2, 0])
        else:
            head = kind << (form == "h265")
            unit, other = b"\0\0\0\1" + bytes([head, 9, 9]), b"\0\0\0\1" + bytes([1 << (form == "h265"), 7])
        found = PixelCleaner(Profile(), Report()).compressed(form, other + unit + other, "/camera")
        assert found == (other + unit + other if kind in needed else other + other), kind


@pytest.mark.parametrize("size", [0, 1, 126, 127, 128, 129, 255, 256, 16_383, 16_384, 16_385])
def test_units_of_av1_have_any_size(size: int) -> None:
    number, rest = bytearray(), size
    while rest > 127:
        number.append(rest & 127 | 128)
        rest >>= 7
    unit = bytes([1 << 3 | 2, *number, rest]) + bytes(size)
    text = bytes([5 << 3 | 2, 3]) + b"abc"
    assert without_av1_metadata(unit + text + unit) == unit + unit
    for bad in (unit + text[:-1], unit + bytes([1 << 3, 0]), unit + bytes([1 << 3 | 2, *[128] * 8, 0])):
        with pytest.raises((ValueError, IndexError)):
            without_av1_metadata(bad)


#: A segment of JPEG: marker, content → what stays of it (marker and size before it), None: nothing.
SEGMENTS = {
    "tables": (0xDB, bytes(range(9)), bytes(range(9))),
    "Huffman": (0xC4, b"x" * 5, b"x" * 5),
    "restarts": (0xDD, b"xy", b"xy"),
    **{
        f"frame {marker:X}": (marker, b"frame", b"frame") for marker in (0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC7, 0xC9, 0xCB)
    },
    "comment": (0xFE, TEXT, None),
    "EXIF": (0xE1, b"Exif\0\0" + TEXT, None),
    **{f"APP{number}": (0xE0 + number, TEXT, None) for number in (2, 3, 12, 13, 15)},
    "JFIF": (0xE0, b"JFIF\0\1\2\1\0\3\0\4\5\6" + TEXT, b"JFIF\0\1\2\1\0\3\0\4\0\0"),
    "JFIF alone": (0xE0, b"JFIF\0\1\2\1\0\3\0\4\0\0", b"JFIF\0\1\2\1\0\3\0\4\0\0"),
    "JFIF that is cut off": (0xE0, b"JFIF\0\1\2\1\0\3\0\4\0", None),
    "JFXX": (0xE0, b"JFXX\0" + TEXT * 2, None),
    "Adobe": (0xEE, b"Adobe\0\x64\1\2\3\4\2" + TEXT, b"Adobe\0\x64\1\2\3\4\2"),
    "Adobe alone": (0xEE, b"Adobe\0\x64\1\2\3\4\2", b"Adobe\0\x64\1\2\3\4\2"),
    "Adobe that is cut off": (0xEE, b"Adobe\0\x64\1\2\3\4", None),
    "another APP14": (0xEE, b"Ducky\0" + TEXT, None),
}


@pytest.mark.parametrize("name", SEGMENTS)
def test_which_segments_of_a_jpeg_stay(name: str) -> None:
    def segment(marker: int, content: bytes) -> bytes:
        return bytes([0xFF, marker]) + struct.pack(">H", 2 + len(content)) + content

    marker, content, stays = SEGMENTS[name]
    scan = segment(0xDA, b"\1\1\0\0\x3f\0") + b"\x12\xff\x00\x34\xff\xd3\x56"
    expected = b"\xff\xd8" + (b"" if stays is None else segment(marker, stays)) + scan + b"\xff\xd9"
    assert without_jpeg_texts(b"\xff\xd8" + segment(marker, content) + scan + b"\xff\xd9" + TEXT) == expected
    assert without_jpeg_texts(b"\xff\xd8\xff" + segment(marker, content) + scan + b"\xff\xd9") == expected, "filled"
    with pytest.raises((ValueError, IndexError, struct.error)):
        without_jpeg_texts(b"\xff\xd8\0" + segment(marker, content) + scan + b"\xff\xd9")


def test_a_chunk_of_a_png_that_is_cut_off_is_damage() -> None:
    whole = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", 0, b"IEND") + struct.pack(">I", zlib.crc32(b"IEND"))
    assert without_png_texts(whole + TEXT) == whole
    with pytest.raises(ValueError, match="no end"):
        without_png_texts(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", 5, b"IEND") + b"ab")


def test_messages_in_h264_are_removed() -> None:
    start = b"\x00\x00\x00\x01"
    units = (b"\x67\x42\x1e", b"\x06\x05" + TEXT + b"\x80", b"\x65\x88\x84")
    frame = b"".join(start + unit for unit in units)
    assert without_h264_messages(frame) == start + units[0] + start + units[2]
    assert without_h264_messages(start + units[2]) == start + units[2]

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
from igtl_gateway.addons.deidentify.pixels import without_h264_messages, without_jpeg_texts, without_png_texts
from igtl_gateway.addons.deidentify.profile import Profile
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


def test_messages_in_h264_are_removed() -> None:
    start = b"\x00\x00\x00\x01"
    units = (b"\x67\x42\x1e", b"\x06\x05" + TEXT + b"\x80", b"\x65\x88\x84")
    frame = b"".join(start + unit for unit in units)
    assert without_h264_messages(frame) == start + units[0] + start + units[2]
    assert without_h264_messages(start + units[2]) == start + units[2]

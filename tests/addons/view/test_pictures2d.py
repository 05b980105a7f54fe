"""Images of every encoding: upright, in their colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.igtl_msgs import ColorTable, VideoFrame
from igtl_gateway.convert.rosmsg import Header, Image
from tests.picture_encodings import FORMS

from .conftest import Draw, Drawn

Array = npt.NDArray[Any]
HEADER = Header(0, "camera")
WIDTH, HEIGHT = 4, 2
#: Red, green / blue, white … row by row: shows every turn and every swap.
RGB = np.array(
    [[(255, 0, 0), (0, 255, 0), (10, 20, 30), (0, 0, 0)], [(0, 0, 255), (255, 255, 255), (1, 2, 3), (9, 8, 7)]],
    np.uint8,
)
_MODELS = {1: 1, 2: 3, 3: 4, 4: 3, 5: 4}  # rerun's colour model → channels
_DTYPES = {6: "u1", 7: "i1", 8: "u2", 9: "i2", 10: "u4", 11: "i4", 34: "f4", 35: "f8"}


def image(encoding: str, pixels: Array, *, big: bool = False, pad: int = 0) -> Image:
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).tobytes()
    step = len(rows) // height
    data = b"".join(rows[row * step : (row + 1) * step] + bytes(pad) for row in range(height))
    return Image(HEADER, height, width, encoding, int(big), step + pad, data)


def seen_as(drawn: Drawn, path: str = "topic") -> Array:
    """The picture as (rows, columns, RGB), or (rows, columns) of one channel."""
    row = drawn.one(path)
    (form,) = row["Image:format"]
    channels = _MODELS[form["color_model"]]
    (buffer,) = row["Image:buffer"]
    pixels = np.array(buffer, np.uint8).view(_DTYPES[form["channel_datatype"]])
    shaped: Array = pixels.reshape(form["height"], form["width"], channels)
    if channels == 1:
        return shaped[..., 0]
    return shaped[..., [2, 1, 0]] if form["color_model"] in (4, 5) else shaped[..., :3]


ALPHA = np.full((*RGB.shape[:2], 1), 200, np.uint8)
COLOURED = {
    "rgb8": RGB,
    "bgr8": RGB[..., ::-1],
    "rgba8": np.concatenate([RGB, ALPHA], axis=2),
    "bgra8": np.concatenate([RGB[..., ::-1], ALPHA], axis=2),
    "rgb16": RGB.astype(np.uint16) * 257,
    "bgr16": RGB[..., ::-1].astype(np.uint16) * 257,
    "rgba16": np.concatenate([RGB, ALPHA], axis=2).astype(np.uint16) * 257,
    "8UC3": RGB,
    "16UC3": RGB.astype(np.uint16) * 257,
    "32FC3": RGB.astype(np.float32) / 255,
    "64FC4": np.concatenate([RGB, ALPHA], axis=2).astype(np.float64) / 255,
}


@pytest.mark.parametrize("big", [False, True], ids=["little", "big"])
@pytest.mark.parametrize("encoding", COLOURED)
def test_colours_are_right_and_the_picture_is_upright(encoding: str, big: bool, draw: Draw) -> None:
    drawn = draw(image(encoding, COLOURED[encoding], big=big, pad=6))
    np.testing.assert_allclose(seen_as(drawn).astype(int), RGB, atol=1)
    shown = drawn.view.seen.shown["/topic"]
    assert (shown.what, shown.width, shown.height, shown.frame) == (EntityKind.IMAGE, WIDTH, HEIGHT, "camera")


GREY = np.array([[0, 7, 200, 90], [255, 1, 2, 3]])


@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "mono16", "16UC1", "32FC1", "64FC1"])
def test_one_channel_keeps_its_numbers(encoding: str, draw: Draw) -> None:
    kind = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4", "64FC1": "f8"}[encoding]
    np.testing.assert_array_equal(seen_as(draw(image(encoding, GREY.astype(kind), big=True))), GREY)


@pytest.mark.parametrize(("encoding", "kind"), [("8SC1", "i1"), ("16SC1", "i2"), ("32SC1", "i4")])
def test_signed_numbers_are_shown_in_their_order(encoding: str, kind: str, draw: Draw) -> None:
    ramp = np.linspace(-100, 100, 8).astype(kind).reshape(2, 4)
    shown = seen_as(draw(image(encoding, ramp))).reshape(-1)
    assert shown.dtype == np.uint8
    assert (np.diff(shown.astype(int)) > 0).all()


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_becomes_colour(pattern: str, draw: Draw) -> None:
    values = {"r": 200, "g": 100, "b": 50}
    cell = np.array([values[name] for name in pattern], np.uint8).reshape(2, 2)
    shown = seen_as(draw(image(f"bayer_{pattern}8", np.tile(cell, (2, 3)))))
    assert shown.shape == (4, 6, 3)
    assert (shown == (200, 100, 50)).all()


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12"])
def test_pictures_in_luma_and_chroma(encoding: str, draw: Draw) -> None:
    luma, u, v = 90, 30, 220
    octets = {
        "nv12": [luma] * 8 + [u, v] * 2,
        "yuyv": [luma, u, luma, v] * 4,
        "yuv422_yuy2": [luma, u, luma, v] * 4,
    }.get(encoding, [u, luma, v, luma] * 4)
    drawn = draw(Image(HEADER, HEIGHT, WIDTH, encoding, 0, 0, bytes(octets)))
    row = drawn.one("topic")
    expected = octets if encoding == "nv12" else [luma, u, luma, v] * 4
    assert list(row["Image:buffer"][0]) == expected
    assert row["Image:format"][0]["pixel_format"] == (26 if encoding == "nv12" else 27)


def test_of_two_channels_the_first_is_shown_and_said(draw: Draw) -> None:
    drawn = draw(image("8UC2", np.stack([GREY, GREY[::-1]], axis=-1).astype(np.uint8)))
    np.testing.assert_array_equal(seen_as(drawn), GREY)
    assert any("8UC2 is drawn by its first component" in line for line in drawn.log())


@pytest.mark.parametrize(
    "message", [Image(HEADER, 2, 2, "mono8", 0, 2, b"abc"), Image(HEADER, 1, 1, "hsv9", 0, 1, b"a")]
)
def test_what_is_no_picture_is_refused(message: Image, draw: Draw) -> None:
    assert draw(message).view.counts.refused == {"/topic": 1}


def test_jpeg_and_png_go_in_as_they_are(draw: Draw) -> None:
    jpeg, png = CompressedImage(HEADER, "rgb8; jpeg compressed bgr8", b"jj"), CompressedImage(HEADER, "png", b"pp")
    first, second = draw(jpeg, png).rows("topic")
    assert first["EncodedImage:media_type"] == ["image/jpeg"]
    assert (second["EncodedImage:media_type"], bytes(second["EncodedImage:blob"][0])) == (["image/png"], b"pp")


H264_KEY = b"\0\0\0\1\x67\x42\0\x0a\xe9\x08\x83\xc8\0\0\0\1\x68\xce\x38\x80\0\0\0\1\x65\x88\x84"
H264_DELTA = b"\0\0\0\1\x41\x9a\x02"


def test_video_starts_with_a_key_frame(draw: Draw) -> None:
    frames = [CompressedImage(HEADER, "h264", data) for data in (H264_DELTA, H264_KEY, H264_DELTA)]
    drawn = draw(*frames)
    rows = drawn.rows("topic")
    assert drawn.view.counts.refused == {"/topic": 1}
    assert [bytes(row["VideoStream:sample"][0]) for row in rows[1:]] == [H264_KEY, H264_DELTA]
    assert [row["VideoStream:is_keyframe"] for row in rows[1:]] == [[True], [False]]


def test_a_raw_frame_of_video_is_a_picture(draw: Draw) -> None:
    place = ((1.0, 0, 0, 0, 1, 0, 0, 0, 1), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    size = (4, 2, 1)
    frame = VideoFrame(HEADER, "I420", 1, False, size, (0, 0, 0), size, 1, *place, bytes(range(12)))
    row = draw(frame).one("topic")
    assert (row["Image:format"][0]["pixel_format"], list(row["Image:buffer"][0])) == (20, list(range(12)))


def test_a_colour_table_is_a_strip_of_its_colours(draw: Draw) -> None:
    colours = np.arange(256 * 3, dtype=np.uint32).astype(np.uint8)
    strip = seen_as(draw(ColorTable(HEADER, 3, 19, False, colours.tobytes())))
    np.testing.assert_array_equal(strip[0], colours.reshape(256, 3))


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_a_picture_is_right_or_not_drawn(name: str, draw: Draw) -> None:
    """Encoded pictures of 8 bits are those of the publisher; the others have the numbers of the sensor."""
    form = FORMS[name]
    drawn = draw(form.at(0))
    if form.refused:
        assert not any("Image" in column for row in drawn.rows("topic") for column in row)
        assert any("found" in line and "expected" in line for line in drawn.log())
        return
    row = drawn.one("topic")
    if "EncodedImage:blob" in row:
        (blob,) = row["EncodedImage:blob"]
        data = bytes(bytearray(blob))
        assert not form.is_deep and data == bytes(form.content.data)
        (media,) = row["EncodedImage:media_type"]
        assert media == ("image/png" if data.startswith(b"\x89PNG") else "image/jpeg")
        return
    pixels = seen_as(drawn)
    expected = form.pixels
    if expected.ndim == 3 and form.is_deep:
        assert any("the upper 8 of its 16 bits" in line for line in drawn.log())
        expected = (expected >> 8).astype(np.uint8)
    assert pixels.shape == expected.shape
    np.testing.assert_allclose(pixels.astype(float), expected.astype(float), atol=form.close)


@pytest.mark.parametrize("encoding", ["yuv422_yuy2", "uyvy", "nv12"])
def test_padded_rows_of_yuv_are_left_out_and_odd_sizes_refused(encoding: str, draw: Draw) -> None:
    rows, row = (3, 4) if encoding == "nv12" else (2, 8)
    lines = [bytes(range(10 * number, 10 * number + row)) for number in range(rows)]
    plain = draw(Image(HEADER, 2, 4, encoding, 0, row, b"".join(lines))).one("topic")
    padded = draw(Image(HEADER, 2, 4, encoding, 0, row + 3, b"".join(line + b"xyz" for line in lines))).one("topic")
    assert padded["Image:buffer"] == plain["Image:buffer"]
    for width, step, data in ((3, 6, bytes(60)), (4, row, b"".join(lines)[:-1])):
        drawn = draw(Image(HEADER, 2, width, encoding, 0, step, data))
        assert not any("Image:buffer" in each for each in drawn.rows("topic"))
        assert any("found" in line and "expected" in line for line in drawn.log())

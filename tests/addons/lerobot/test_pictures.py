"""Pictures of every form that a recording has, as RGB of 8 bits."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot.drafting import _window as drafted_window
from igtl_gateway.addons.lerobot.pictures import PictureReader, Pictures
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.video import Video
from tests.addons.lerobot.sessions import Sent, bars, number_of, write_session
from tests.picture_encodings import FORMS
from tests.tables import table


def encoded(codec: str, numbers: range, **options: str) -> list[bytes]:
    """Pictures of :func:`bars`, encoded one after the other."""
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.time_base = 64, 48, Fraction(1, 30)
    encoder.pix_fmt = {"png": "rgb24", "mjpeg": "yuvj420p"}.get(codec, "yuv420p")
    encoder.options, encoder.gop_size = options, 5
    frames = []
    for number in numbers:
        frame = av.VideoFrame.from_ndarray(np.repeat(bars(number)[:, :, np.newaxis], 3, axis=2), format="rgb24")
        frame = frame.reformat(format=encoder.pix_fmt)
        frame.pts = number
        frames += [bytes(packet) for packet in encoder.encode(frame)]
    return frames + [bytes(packet) for packet in encoder.encode(None)]


def compressed(form: str, data: bytes) -> Any:
    return lambda stamp_ns: CompressedImage(Header(stamp_ns, "camera"), form, data)


def h264() -> list[bytes]:
    return encoded("libx264", range(20), tune="zerolatency", preset="ultrafast", **{"x264-params": "repeat-headers=1"})


@pytest.mark.parametrize(
    ("stream", "contents", "first"),
    [
        ("/camera", [compressed("rgb8; jpeg compressed bgr8", each) for each in encoded("mjpeg", range(8))], 0),
        ("/camera", [compressed("png", each) for each in encoded("png", range(8))], 0),
        ("/camera", [compressed("h264", each) for each in h264()], 0),
        ("VIDEO/Camera", [Video("H264", (64, 48, 1), each) for each in h264()[2:]], 3),
        ("/camera", [compressed("png", b"") if n == 3 else compressed("png", each)
                     for n, each in enumerate(encoded("png", range(8)))], 0),
    ],
    ids=["jpeg", "png", "h264", "VIDEO from the middle", "an empty one"],
)  # fmt: skip
def test_encoded_pictures(stream: str, contents: list[Any], first: int, tmp_path: Path) -> None:
    messages: list[Sent] = [(0.03 * number, stream, each) for number, each in enumerate(contents)]
    path = write_session(tmp_path / "s.mcap", messages)
    with igtl_gateway.open(path) as recording:
        pictures = Pictures(recording[stream])
        assert pictures.size == (48, 64)
        # before the first key frame there is no picture
        start = 2 if stream.startswith("VIDEO") else 0
        usable = pictures.usable.tolist()
        assert usable[0] == first and len(usable) >= len(contents) - max(first, 1)
        for index in (usable[-1], usable[0], usable[len(usable) // 2]):  # also backwards
            assert number_of(pictures.rgb(index)) == index + start


@table("is_indexed", [True, False])
def test_pictures_of_a_video_in_any_order_are_those_in_order(
    is_indexed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SessionFile, "is_indexed", is_indexed)
    data = h264()
    messages: list[Sent] = [(0.03 * n, "VIDEO/Camera", Video("H264", (64, 48, 1), each)) for n, each in enumerate(data)]
    with igtl_gateway.open(write_session(tmp_path / "s.mcap", messages)) as recording:
        pictures, again = Pictures(recording["VIDEO/Camera"]), PictureReader(recording["VIDEO/Camera"])
        in_order = {index: pictures.rgb(index) for index in pictures.usable.tolist()}
        for index in np.random.default_rng(1).permutation(pictures.usable).tolist() * 2:
            begin_ns, time_ns, before = pictures.places[index].tolist()
            assert np.array_equal(again.rgb((begin_ns, time_ns, before)), in_order[index]), index
        begins = pictures.places[:, 0]
        assert len(set(begins.tolist())) == len(data) // 5  # a key frame at every fifth one
        # from another frame than a key frame, decoding begins again at the first message
        place = (int(pictures.places[7, 1]), *pictures.places[8, 1:].tolist())
        assert begins[8] < place[0] and np.array_equal(again.rgb(place), in_order[8])
        with pytest.raises(GatewayError, match="found no picture in the message at 5 ns"):
            again.rgb((5, 5, 0))


@pytest.mark.parametrize("pixels", [np.arange(48).reshape(4, 4, 3), np.arange(64).reshape(4, 4, 4)])
def test_colours_stay_and_alpha_goes(pixels: Any, tmp_path: Path) -> None:
    image = Image((4, 4, 1), 3, pixels.astype(np.uint8).tobytes(), num_components=pixels.shape[2])
    with igtl_gateway.open(write_session(tmp_path / "s.mcap", [(0.0, "IMAGE/A", image)])) as recording:
        assert np.array_equal(Pictures(recording["IMAGE/A"]).rgb(0), pixels[:, :, :3])


def test_other_streams_have_none(tmp_path: Path) -> None:
    with igtl_gateway.open("fixtures/star.mcap") as recording, pytest.raises(ConfigError, match="expected pictures"):
        Pictures(recording["/star/tool"])


def scaled(pixels: Any, low: float, high: float) -> Any:
    """The pixels of a video, by a window: (rows, columns, 3) of 8 bits."""
    with np.errstate(invalid="ignore"):
        part = np.clip((np.asarray(pixels, np.float64) - low) / (high - low), 0, 1)
    eight = np.round(np.nan_to_num(part) * 255).astype(np.uint8)
    return np.repeat(eight[:, :, np.newaxis], 3, 2) if eight.ndim == 2 else eight


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_a_picture_is_right_or_refused(name: str, tmp_path: Path) -> None:
    form = FORMS[name]
    rows, columns = form.pixels.shape[:2]
    low, high = (600.0, 2000.0) if form.pixels.dtype == np.uint16 else (0.5, 3.0) if form.is_deep else (16.0, 235.0)
    path = write_session(tmp_path / "s.mcap", [(0.0, "/camera", form.at), (0.1, "/camera", form.at)])
    with igtl_gateway.open(path) as recording:
        stream = recording["/camera"]
        if form.refused:
            with pytest.raises(ConfigError, match=r"/camera.*: found .*, expected"):
                Pictures(stream, (low, high))
            return
        made = Pictures(stream, (low, high))
        assert (made.usable.tolist(), made.size) == ([0, 1], (rows, columns))
        expected = scaled(form.pixels, low, high)
        close = form.close * 255 / (high - low)
        assert np.abs(made.rgb(1)[:rows, :columns].astype(int) - expected).max() <= close + (close > 0)
        if form.is_deep:
            with pytest.raises(ConfigError, match=r"window = \[low, high\]"):
                Pictures(stream)
        else:
            whole = form.pixels if form.pixels.ndim == 3 else np.repeat(form.pixels[:, :, np.newaxis], 3, 2)
            assert np.abs(Pictures(stream).rgb(0)[:rows, :columns].astype(int) - whole).max() <= form.close


def test_a_draft_has_the_window_of_encoded_depth(tmp_path: Path) -> None:
    form = FORMS["depth, even"]
    path = write_session(tmp_path / "s.mcap", [(0.1 * number, "/camera", form.at) for number in range(3)])
    with igtl_gateway.open(path) as recording:
        assert drafted_window(recording["/camera"]) == (form.pixels.min(), form.pixels.max())


def test_a_black_first_picture_is_not_the_window_of_a_draft(tmp_path: Path) -> None:
    pixels = [np.full((8, 8), 90 * number, np.uint16) for number in range(30)]
    messages: list[Sent] = [
        (0.1 * number, "IMAGE/Deep", Image((8, 8, 1), 5, each.tobytes())) for number, each in enumerate(pixels)
    ]
    with igtl_gateway.open(write_session(tmp_path / "s.mcap", messages)) as recording:
        low, high = drafted_window(recording["IMAGE/Deep"])
        assert low == 0 and high >= 0.9 * pixels[-1].max()

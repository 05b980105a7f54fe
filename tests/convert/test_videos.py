"""VIDEO ⇄ our own frames, compressed images and compressed video; real streams keep their own parameters."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.common_msgs import CompressedImage, CompressedVideo
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.geometry import IDENTITY
from igtl_gateway.convert.igtl_msgs import MetadataItem, VideoFrame
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.videos import (
    DELTA_FRAME,
    FORMATS,
    compressed_image_to_igtl,
    compressed_video_to_igtl,
    is_compressed,
    video_to_compressed_image,
    video_to_compressed_video,
    video_to_igtl,
    video_to_ros,
)
from igtl_gateway.wire.image import BIG_ENDIAN, LPS, Image
from igtl_gateway.wire.video import KEY_FRAME, Video
from tests.strategies import any32, finite32, videos
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)
#: 0.5 × 0.5 × 2 mm, centred at 10, 20, 30 mm.
MATRIX = (0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 2.0, 10.0, 20.0, 30.0)
#: A key frame of H.264 without its parameters, and a frame between.
IDR, SLICE = b"\x00\x00\x00\x01\x65\x88\x80", b"\x00\x00\x00\x01\x41\x9a\x00"


def to_ros() -> ToRosContext:
    return ToRosContext("Scope", 5, "frame", "", metadata=ITEMS)


def content_of(out: ConvertedMessage) -> Video:
    assert isinstance(out.content, Video)
    out.content.pack()
    return out.content


def there_and_back(content: Video) -> Video:
    message = video_to_ros(content, to_ros())
    assert (message.header, message.metadata) == (Header(5, "frame"), ITEMS)
    out = video_to_igtl(VideoFrame.unpack(message.pack()), ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.metadata) == (5, "frame", ITEMS)
    return content_of(out)


def frame(**changes: Any) -> VideoFrame:
    fields: dict[str, Any] = {
        "header": Header(7, "f"),
        "codec": "H264",
        "frame_type": 1,
        "is_bigendian": False,
        "size": (640, 480, 1),
        "offset": (0, 0, 0),
        "part_size": (640, 480, 1),
        "coordinate_system": 1,
        "direction": IDENTITY,
        "spacing": (0.001, 0.001, 0.001),
        "center": (0.0, 0.0, 0.0),
        "data": IDR,
    }
    return VideoFrame(**(fields | changes))


def test_a_frame_by_hand() -> None:
    content = Video("VP90", (640, 480, 1), b"frame", 0x0300, BIG_ENDIAN, LPS, MATRIX, (1, 2, 0), (3, 4, 1))
    message = video_to_ros(content, to_ros())
    assert message == VideoFrame(
        *(Header(5, "frame"), "VP90", 0x0300, True, (640, 480, 1), (1, 2, 0), (3, 4, 1), LPS),
        direction=(-1.0, -0.0, 0.0, -0.0, -1.0, 0.0, -0.0, -0.0, 1.0),
        spacing=(0.0005, 0.0005, 0.002),
        center=(-0.01, -0.02, 0.03),
        data=b"frame",
        metadata=ITEMS,
    )
    assert there_and_back(content) == content


@given(videos(finite32.filter(bool)), st.sampled_from([1, 2]), st.integers(1, 255), st.text("AB64", max_size=4))
def test_any_frame_comes_back(content: Video, endian: int, coordinate: int, codec: str) -> None:
    content = replace(content, endian=endian, coordinate=coordinate, codec=codec, video_version=1)
    assert join(there_and_back(content).pack()) == join(content.pack())


@given(videos(any32))
def test_no_frame_is_refused_on_its_way_to_ros(content: Video) -> None:
    video_to_ros(content, to_ros()).pack()
    content = replace(content, codec="H264")
    message = video_to_ros(content, to_ros())
    again = VideoFrame.unpack(message.pack())
    assert bytes(again.data) == bytes(content.data)
    if all(map(math.isfinite, content.wire_matrix)):
        assert content_of(video_to_igtl(again, ToIgtlContext())).size == content.size
    else:
        with pytest.raises(ConversionError, match="expected finite numbers"):
            video_to_igtl(again, ToIgtlContext())


def test_data_is_not_copied() -> None:
    data = np.zeros(24, np.uint8)
    content = Video("H264", (4, 6, 1), data.data)
    for message in (
        video_to_ros(content, to_ros()),
        video_to_compressed_image(content, to_ros()),
        video_to_compressed_video(content, to_ros()),
    ):
        assert np.shares_memory(np.frombuffer(message.data, np.uint8), data)
    sent = content_of(compressed_image_to_igtl(CompressedImage(Header(), "h264", data.data), ToIgtlContext()))
    assert np.shares_memory(np.frombuffer(sent.data, np.uint8), data)


@pytest.mark.parametrize("codec", ["H264X", "ÄÖÜ"])
def test_codecs_of_too_many_letters(codec: str) -> None:
    with pytest.raises(ConversionError, match="expected 4 letters"):
        video_to_igtl(frame(codec=codec), ToIgtlContext())


@pytest.mark.parametrize("changes", [{"center": (0.0, math.nan, 0.0)}, {"spacing": (1e36, 1.0, 1.0)}])
def test_places_beyond_the_wire(changes: dict[str, Any]) -> None:
    video_to_igtl(frame(), ToIgtlContext())
    with pytest.raises(ConversionError, match="igtl_msgs/msg/VideoFrame"):
        video_to_igtl(frame(**changes), ToIgtlContext())


def test_a_coordinate_system_not_filled_in_is_ras() -> None:
    assert video_to_igtl(frame(coordinate_system=0), ToIgtlContext()) == video_to_igtl(frame(), ToIgtlContext())


@pytest.mark.parametrize(("codec", "format_name"), FORMATS.items())
def test_formats_have_their_names_in_ros(codec: str, format_name: str) -> None:
    content = Video(codec, (4, 4, 1), b"frame")
    assert is_compressed(content)
    assert video_to_compressed_image(content, to_ros()) == CompressedImage(Header(5, "frame"), format_name, b"frame")
    assert video_to_compressed_video(content, to_ros()) == CompressedVideo(5, "frame", b"frame", format_name)


@pytest.mark.parametrize("codec", ["I420", "", "h264", "XXXX", "\udc80"])
def test_raw_and_unknown_pictures_have_none(codec: str) -> None:
    assert not is_compressed(Video(codec, (4, 4, 1), b"frame"))


@table(
    ("named", "codec"),
    [
        *(("h264", "H264"), ("H264", "H264"), ("H.264", "H264"), ("avc", "H264"), ("h264_nvenc", "H264")),
        *(("rgb8; h264", "H264"), ("bgr8; h264 compressed bgr8", "H264"), ("h264; yuv420p", "H264")),
        *(("h265", "X265"), ("h.265", "X265"), ("hevc", "X265"), ("HEVC", "X265"), ("rgb8;hevc", "X265")),
        *(("vp9", "VP90"), ("VP9", "VP90"), ("av1", "AV10"), ("mono8; av1", "AV10")),
    ],
)
def test_ways_to_write_a_format(named: str, codec: str) -> None:
    for out in (
        compressed_image_to_igtl(CompressedImage(Header(7, "camera"), named, IDR), ToIgtlContext()),
        compressed_video_to_igtl(CompressedVideo(7, "camera", IDR, named), ToIgtlContext()),
    ):
        assert (out.stamp_ns, out.frame_id) == (7, "camera")
        content = content_of(out)
        assert (content.codec, bytes(content.data), content.wire_matrix) == (codec, IDR, Image.IDENTITY)


@table("named", ["jpeg", "png", "rgb8; jpeg compressed bgr8", "16UC1; compressedDepth png", "", "vp8", "h26", "xh264"])
def test_pictures_are_no_video(named: str) -> None:
    with pytest.raises(ConversionError, match=r"sensor_msgs/msg/CompressedImage: .*expected one of .*h264.* not VIDEO"):
        compressed_image_to_igtl(CompressedImage(Header(), named, b"\xff\xd8"), ToIgtlContext())
    with pytest.raises(ConversionError, match=r"foxglove_msgs/msg/CompressedVideo: "):
        compressed_video_to_igtl(CompressedVideo(0, "", b"\xff\xd8", named), ToIgtlContext())


def test_a_frame_without_data_is_refused() -> None:
    with pytest.raises(ConversionError, match="found a frame without data"):
        compressed_image_to_igtl(CompressedImage(Header(), "h264", b""), ToIgtlContext())


@pytest.mark.parametrize(("data", "kind"), [(IDR, KEY_FRAME), (SLICE, DELTA_FRAME), (b"nonsense", DELTA_FRAME)])
def test_the_bit_stream_tells_key_frames(data: bytes, kind: int) -> None:
    content = content_of(compressed_image_to_igtl(CompressedImage(Header(), "h264", data), ToIgtlContext()))
    assert (content.frame_type, content.size) == (kind, (0, 0, 1))
    assert content.is_key_frame is (kind == KEY_FRAME)


@pytest.mark.parametrize("codec", ["h264", "h265", "vp9", "av1"])
def test_real_streams(codec: str) -> None:
    """A stream of ROS goes out with its key frames and sizes, and comes back as it was."""
    pytest.importorskip("av")
    from tests.convert.real_video import frames

    stream = frames(codec, 130, 98)
    assert {is_key for _, is_key in stream} == {True, False}
    for data, is_key in stream:
        message = CompressedImage(Header(7, "camera"), codec, data)
        out = compressed_image_to_igtl(CompressedImage.unpack(message.pack()), ToIgtlContext())
        content = content_of(out)
        assert content.is_key_frame is is_key
        assert content.size == content.sub_size == ((130, 98, 1) if is_key else (0, 0, 1))
        received = Video.unpack(memoryview(join(content.pack())))
        back = video_to_compressed_image(received, ToRosContext("Scope", 7, "camera", ""))
        assert back.pack() == message.pack()

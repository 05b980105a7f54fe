"""VIDEO: layout, key frames, odd flags.  Whole messages are in the corpus."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.video import Video
from tests.tables import table
from tests.wire.handmade import MATRIX, video

CONTENT, MEANING = video(b"H264", 1, b"frame")


def test_golden_bytes() -> None:
    frame = Video("H264", (64, 48, 1), b"frame", wire_matrix=tuple(MATRIX))
    assert join(frame.pack()) == CONTENT
    again = Video.unpack(memoryview(CONTENT))
    assert again.describe() == frame.describe() == MEANING
    assert again.sub_size == frame.sub_size == (64, 48, 1)


@table(
    ("frame_type", "is_key", "is_grey"),
    [(0, False, False), (1, True, False), (2, False, False), (0xFF, False, False), (0x100, True, True),
     (0x101, True, True), (0x200, False, True), (0x2FF, False, True)],
)  # fmt: skip
def test_frame_types(frame_type: int, is_key: bool, is_grey: bool) -> None:
    frame = Video("H264", (1, 1, 1), b"", frame_type)
    assert (frame.is_key_frame, frame.is_grey) == (is_key, is_grey)


def test_every_flag_is_carried() -> None:
    """The library never looks at some of them, and a frame is no worse for them."""
    data = b"\xff" * 3 + b"a\0b\xff" + b"\xff" * 69
    frame = Video.unpack(memoryview(data))
    assert join(frame.pack()) == data
    assert frame.describe()["codec"] == "a"


def test_truncation() -> None:
    for size in range(76):
        with pytest.raises(TruncatedMessage):
            Video.unpack(memoryview(CONTENT[:size]))
    assert Video.unpack(memoryview(CONTENT[:76])).data == b""


@pytest.mark.parametrize(
    "frame",
    [
        Video("H.264", (1, 1, 1), b""),
        Video("H264", (65_536, 1, 1), b""),
        Video("H264", (1, 1, 1), b"", frame_type=65_536),
        Video("H264", (1, 1, 1), b"", coordinate=256),
        Video("H264", (1, 1, 1), b"", wire_matrix=(1e300,) * 12),
    ],
)
def test_what_does_not_fit(frame: Video) -> None:
    with pytest.raises(MalformedBody):
        encode(Message("VIDEO", "", frame))


def test_the_frame_is_not_copied() -> None:
    data = join(encode(Message("VIDEO", "", Video("VP90", (1, 1, 1), bytes(1000)))))
    frame = decode(data).content
    assert isinstance(frame, Video)
    assert np.shares_memory(np.frombuffer(frame.pack()[1], np.uint8), np.frombuffer(data, np.uint8))

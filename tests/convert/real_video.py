"""Real video, made by the encoders of PyAV: importing this needs ``av``."""

from __future__ import annotations

import functools
from fractions import Fraction

import av
import numpy as np

ENCODERS = {"h264": "libx264", "h265": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}
_OPTIONS = {
    "h264": {"preset": "ultrafast", "tune": "zerolatency"},
    "h265": {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=none:repeat-headers=1"},
    "vp9": {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"},
    "av1": {"preset": "12", "svtav1-params": "pred-struct=1:lookahead=0"},
}


@functools.cache
def frames(
    codec: str, width: int, height: int, pixels: str = "yuv420p", count: int = 5, interval: int = 3
) -> tuple[tuple[bytes, bool], ...]:
    """(bit stream, whether it is a key frame) of each picture of a moving pattern."""
    context = av.CodecContext.create(ENCODERS[codec], "w")
    context.width, context.height, context.pix_fmt = width, height, pixels
    context.time_base, context.gop_size, context.max_b_frames = Fraction(1, 30), interval, 0
    context.options = _OPTIONS[codec]
    packets = []
    for number in range(count):
        pattern = np.add.outer(np.arange(height), np.arange(width)) * 3 + 20 * number
        picture = av.VideoFrame.from_ndarray(np.repeat(pattern.astype(np.uint8)[..., None], 3, 2), "rgb24")
        picture = picture.reformat(format=pixels)
        picture.pts = number
        packets += context.encode(picture)
    packets += context.encode(None)
    return tuple((bytes(packet), bool(packet.is_keyframe)) for packet in packets)

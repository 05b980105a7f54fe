"""Frames of mp4 files for messages: as they are encoded where each can be a message of its own, otherwise decoded.

A frame can be a message of its own if its codec is one of CompressedVideo and no frame needs a later one.  H.264 and
H.265 get the form of Annex B there, with the parameter sets before each key frame; no frame is encoded again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, DamagedRecording
from igtl_gateway.addon.messages import import_av, is_key_frame
from igtl_gateway.addon.untrusted import check_limit, open_file
from igtl_gateway.addons.lerobot.episodes import TOLERANCE_S
from igtl_gateway.addons.lerobot.mp4_samples import is_reordered
from igtl_gateway.addons.lerobot.video import Pixels, opened_video, pixels_of

#: Name of a codec in mp4 → its name in CompressedVideo, and the filter that makes its form of Annex B.
_CODECS = {
    "avc1": ("h264", "h264_mp4toannexb"), "avc3": ("h264", "h264_mp4toannexb"),
    "hvc1": ("h265", "hevc_mp4toannexb"), "hev1": ("h265", "hevc_mp4toannexb"),
    "vp09": ("vp9", ""), "av01": ("av1", ""),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """A frame at ``time_ns`` of its file: its bytes, and whether decoding can begin with it."""

    time_ns: int
    data: bytes
    is_key: bool


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """A frame at ``time_ns`` of its file: (rows, columns, 3), RGB."""

    time_ns: int
    pixels: Pixels


def format_of_frames(path: Path) -> str:
    """Return the format of CompressedVideo that the frames of a file have; "" if they must be decoded.

    Raises as ``read_video``.
    """
    with opened_video(path) as (file, _):
        name, _ = _CODECS.get(str(file.streams.video[0].codec_context.codec_tag), ("", ""))
    if not name:
        return ""
    with open_file(path) as stream:
        if is_reordered(stream, os.fstat(stream.fileno()).st_size, str(path)):
            return ""
    first = next(encoded_frames(path), None)
    return name if first is not None and first.is_key else ""


def encoded_frames(path: Path, from_s: float = 0.0) -> Iterator[EncodedFrame]:
    """Yield the frames of a file, from the last key frame at or before ``from_s`` on.  Raises as ``read_video``."""
    with opened_video(path) as (file, deadline):
        stream = file.streams.video[0]
        name, filter_name = _CODECS[str(stream.codec_context.codec_tag)]
        convert = _converter(filter_name, stream)
        _seek(file, stream, from_s)
        for packet in file.demux(video=0):
            deadline.check(str(path))
            if packet.pts is None:  # the end
                continue
            check_limit("memory", packet.size, f"{path}: bytes of a frame")
            if packet.dts is not None and packet.dts != packet.pts:
                raise DamagedRecording(f"{path}: found a frame that is decoded before others, expected none")
            time_ns, is_key = _ns(packet.pts, stream), packet.is_keyframe
            data = convert(packet)  # which takes what is in the packet
            frame = EncodedFrame(time_ns, data, is_key and is_key_frame(name, data))
            with deadline.paused():
                yield frame


def decoded_frames(path: Path, from_s: float = 0.0) -> Iterator[DecodedFrame]:
    """Yield the pictures of a file, from the last key frame at or before ``from_s`` on.  Raises as ``read_video``."""
    with opened_video(path) as (file, deadline):
        stream = file.streams.video[0]
        _seek(file, stream, from_s)
        for packet in file.demux(video=0):
            frames = packet.decode()
            deadline.check(str(path))
            for frame in frames:
                if frame.pts is None:
                    raise DamagedRecording(f"{path}: found a frame without a time, expected one")
                found = DecodedFrame(_ns(frame.pts, stream), pixels_of(path, frame))
                with deadline.paused():
                    yield found


def _seek(file: Any, stream: Any, from_s: float) -> None:
    if from_s > 0:
        file.seek(int((from_s + TOLERANCE_S) / stream.time_base), stream=stream, backward=True)


def _ns(pts: int, stream: Any) -> int:
    """A time in the units of a stream as ns."""
    base = stream.time_base
    return (2 * pts * int(base.numerator) * NS_PER_S + int(base.denominator)) // (2 * int(base.denominator))


def _converter(name: str, stream: Any) -> Callable[[Any], bytes]:
    if not name:
        return bytes
    chain = import_av().bitstream.BitStreamFilterContext(name, stream)
    return lambda packet: b"".join(bytes(each) for each in chain.filter(packet))

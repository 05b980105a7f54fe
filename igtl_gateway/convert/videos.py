"""VIDEO ⇄ igtl_msgs/VideoFrame, sensor_msgs/CompressedImage and foxglove_msgs/CompressedVideo.

Encoded frames pass through as they are; nothing is encoded or decoded here.  What a frame of ROS does not say
(key frame or not, size) is read from its bit stream.  The size stands before key frames only; the gateway remembers
it for the frames between them.
"""

from __future__ import annotations

import re

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage, CompressedVideo
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.framesize import frame_size
from igtl_gateway.convert.geometry import Placement
from igtl_gateway.convert.igtl_msgs import VideoFrame
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, RAS
from igtl_gateway.wire.video import KEY_FRAME, Video

#: What the reference library says of a frame that needs others (P of OpenH264; 2 would be "skipped").
DELTA_FRAME = 3

#: Codec of the wire → format; the first codec of a format is what we send.
FORMATS = {"H264": "h264", "VP90": "vp9", "X265": "h265", "O265": "h265", "AV10": "av1"}
_CODECS = {name: codec for codec, name in reversed(FORMATS.items())}
_ALIASES = {"avc": "h264", "hevc": "h265"} | {name: name for name in _CODECS}
_WORD = re.compile("[a-z0-9]+")
_CODEC_BYTES = 4


def is_compressed(content: Video) -> bool:
    """Whether ROS has a name for the format; it has none for raw images (I420)."""
    return content.codec in FORMATS


def video_to_ros(content: Video, to: ToRosContext) -> VideoFrame:
    """A matrix that is not finite gives numbers that are none: later frames depend on this one all the same."""
    placement = Placement.of_wire(content.wire_matrix, content.coordinate, to.lengths)
    return VideoFrame(
        Header(to.stamp_ns, to.frame_id),
        visible(content.codec),
        content.frame_type,
        content.endian == BIG_ENDIAN,
        content.size,
        content.subvol_offset,
        content.sub_size,
        content.coordinate,
        placement.direction,
        placement.spacing,
        placement.center,
        content.data,
        to.metadata,
    )


def video_to_igtl(message: VideoFrame, to: ToIgtlContext) -> ConvertedMessage:
    """The inverse; a coordinate system that is not filled in (0) is RAS.

    Raises ConversionError for a codec of more than four letters, and for numbers that float32 cannot hold.
    """
    codec = visible(message.codec)
    if len(codec.encode()) > _CODEC_BYTES:
        raise ConversionError(f"{message.TYPE}: found codec {message.codec!r}, expected {_CODEC_BYTES} letters")
    coordinate = message.coordinate_system or RAS
    placement = Placement(message.direction, message.spacing, message.center)
    content = Video(
        codec,
        message.size,
        message.data,
        message.frame_type,
        BIG_ENDIAN if message.is_bigendian else LITTLE_ENDIAN,
        coordinate,
        placement.to_wire(coordinate, to.lengths, message.TYPE),
        message.offset,
        message.part_size,
    )
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def video_to_compressed_image(content: Video, to: ToRosContext) -> CompressedImage:
    """The bit stream with its format; for codecs that ``is_compressed`` knows."""
    return CompressedImage(Header(to.stamp_ns, to.frame_id), FORMATS[content.codec], content.data)


def video_to_compressed_video(content: Video, to: ToRosContext) -> CompressedVideo:
    """The bit stream with its format; for codecs that ``is_compressed`` knows."""
    return CompressedVideo(to.stamp_ns, to.frame_id, content.data, FORMATS[content.codec])


def compressed_image_to_igtl(message: CompressedImage, _: ToIgtlContext) -> ConvertedMessage:
    """Raises ConversionError for formats that are no video, and for empty frames."""
    content = _video(message.format, message.data, message.TYPE)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id)


def compressed_video_to_igtl(message: CompressedVideo, _: ToIgtlContext) -> ConvertedMessage:
    """Raises ConversionError for formats that are no video, and for empty frames."""
    return ConvertedMessage(_video(message.format, message.data, message.TYPE), message.timestamp_ns, message.frame_id)


def _video(named: str, data: Buffer, ros_type: str) -> Video:
    """An encoded frame; of size 0 × 0 where it does not tell."""
    format_name = _format(named, ros_type)
    if not memoryview(data).nbytes:
        raise ConversionError(f"{ros_type}: found a frame without data, expected one encoded frame")
    width, height = frame_size(format_name, data) or (0, 0)
    frame_type = KEY_FRAME if is_key_frame(format_name, data) else DELTA_FRAME
    return Video(_CODECS[format_name], (width, height, 1), data, frame_type)


def _format(named: str, ros_type: str) -> str:
    """The format that a message names: ``"h264"``, ``"HEVC"``, ``"rgb8; h264 compressed bgr8"``, ``"h264_nvenc"`` …"""
    for word in _WORD.findall(named.lower().replace("h.26", "h26")):
        if word in _ALIASES:
            return _ALIASES[word]
    raise ConversionError(
        f"{ros_type}: found format {named!r}, expected one of {', '.join(sorted(_ALIASES))}: "
        "single images (jpeg, png) are not VIDEO; publish them as sensor_msgs/Image"
    )

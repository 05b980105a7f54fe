"""VIDEO ⇄ igtl_msgs/VideoFrame, sensor_msgs/CompressedImage and foxglove_msgs/CompressedVideo.

Encoded frames pass through unchanged; this module neither encodes nor decodes.  A ROS message declares neither the size
of a frame nor whether it is a key frame: both are read from the bit stream.  Only key frames contain the size; the
gateway stores it for the frames between them.
"""

from __future__ import annotations

import re

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage, CompressedVideo
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.framesize import frame_size
from igtl_gateway.convert.geometry import Placement
from igtl_gateway.convert.igtl_msgs import VideoFrame
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, RAS
from igtl_gateway.wire.video import KEY_FRAME, Video

#: Frame type of the reference library for frames that depend on others (P of OpenH264; 2 is "skipped").
DELTA_FRAME = 3

#: Codec of the wire → format; the gateway sends the first codec of a format.
FORMATS = {"H264": "h264", "VP90": "vp9", "X265": "h265", "O265": "h265", "AV10": "av1"}
_CODECS = {name: codec for codec, name in reversed(FORMATS.items())}
_ALIASES = {"avc": "h264", "hevc": "h265"} | {name: name for name in _CODECS}
_WORD = re.compile("[a-z0-9]+")
_CODEC_BYTES = 4


def is_compressed(content: Video) -> bool:
    """Return whether ROS has a name for the format; it has none for raw images (I420)."""
    return content.codec in FORMATS


def video_to_ros(content: Video, to: ToRosContext) -> VideoFrame:
    """Convert to VideoFrame.  A matrix with NaN or infinity is not rejected: later frames depend on this one."""
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
    """Convert to VIDEO; an unset coordinate system (0) is RAS.

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
    """Convert to CompressedImage, if ``is_compressed``: the bit stream and its format."""
    return CompressedImage(Header(to.stamp_ns, to.frame_id), FORMATS[content.codec], content.data)


def video_to_compressed_video(content: Video, to: ToRosContext) -> CompressedVideo:
    """Convert to CompressedVideo, if ``is_compressed``: the bit stream and its format."""
    return CompressedVideo(to.stamp_ns, to.frame_id, content.data, FORMATS[content.codec])


def compressed_image_to_igtl(message: CompressedImage, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to VIDEO.  Raises ConversionError for formats other than video, and for empty frames."""
    content = _video(message.format, message.data, message.TYPE)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id)


def compressed_video_to_igtl(message: CompressedVideo, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to VIDEO.  Raises ConversionError for formats other than video, and for empty frames."""
    return ConvertedMessage(_video(message.format, message.data, message.TYPE), message.timestamp_ns, message.frame_id)


def _video(named: str, data: Buffer, ros_type: str) -> Video:
    """Return an encoded frame; its size is 0 × 0 if it does not contain the size."""
    format_name = _format(named, ros_type)
    if not memoryview(data).nbytes:
        raise ConversionError(f"{ros_type}: found a frame without data, expected one encoded frame")
    width, height = frame_size(format_name, data) or (0, 0)
    frame_type = KEY_FRAME if is_key_frame(format_name, data) else DELTA_FRAME
    return Video(_CODECS[format_name], (width, height, 1), data, frame_type)


def _format(named: str, ros_type: str) -> str:
    """Return the format in a string such as ``"HEVC"``, ``"rgb8; h264 compressed bgr8"``, ``"h264_nvenc"``."""
    for word in _WORD.findall(named.lower().replace("h.26", "h26")):
        if word in _ALIASES:
            return _ALIASES[word]
    raise ConversionError(
        f"{ros_type}: found format {named!r}, expected one of {', '.join(sorted(_ALIASES))}: "
        "single images (jpeg, png) are not VIDEO; publish them as sensor_msgs/Image"
    )

"""Images and video: every encoding of ROS, upright and in the right colours."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError, Unavailable
from igtl_gateway.addon.messages import (
    JPEG,
    PNG,
    VIDEO_FORMATS,
    Coding,
    bayer_pattern,
    coding_of,
    decoded_still,
    demosaiced,
    depths,
    frame_size,
    is_deep_png,
    is_key_frame,
)
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.ros import CameraInfo, ColorTable, CompressedImage, CompressedVideo, Image, VideoFrame
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.view.arrays import ColumnOf, image_of_pixels
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.colours import span
from igtl_gateway.addons.view.contents import PLACES

Array = npt.NDArray[Any]

_COLOURS = {"rgb": rr.ColorModel.RGB, "rgba": rr.ColorModel.RGBA, "bgr": rr.ColorModel.BGR, "bgra": rr.ColorModel.BGRA}
_CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4}
_NAMED = re.compile(r"(mono|rgba?|bgra?)(8|16)")
_OPENCV = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)(?:C([1-9][0-9]{0,4}))?")
_DTYPES = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_MODELS = {3: rr.ColorModel.RGB, 4: rr.ColorModel.RGBA}
_PIXEL_FORMATS = {
    "nv12": rr.PixelFormat.NV12,
    "yuv422_yuy2": rr.PixelFormat.YUY2,
    "yuyv": rr.PixelFormat.YUY2,
    "uyvy": rr.PixelFormat.YUY2,
    "yuv422": rr.PixelFormat.YUY2,
}
_UYVY = ("uyvy", "yuv422")
_MEDIA = {JPEG: "image/jpeg", PNG: "image/png"}
_CODECS = {
    "h264": rr.VideoCodec.H264,
    "h265": rr.VideoCodec.H265,
    "vp9": rr.VideoCodec.VP9,
    "av1": rr.VideoCodec.AV1,
}
_WORDS = re.compile("[a-z0-9]+")
_ALIASES = {"avc": "h264", "hevc": "h265", "vp90": "vp9", "av10": "av1"}
_COLOUR_PLANES = (3, 4)
_MAP_UINT16, _MAP_RGB = 5, 19
_STRIP = 32  #: height of the image of a colour table, in pixels


def draw_image(message: Image, canvas: Canvas) -> None:
    """sensor_msgs/Image."""
    canvas.shown.width, canvas.shown.height = message.width, message.height
    frame = canvas.frame(message.header.frame_id)
    canvas.log(image_components(message, canvas), frame=f"{frame}/image" if frame in canvas.pen.cameras else "")


def image_components(message: Image, canvas: Canvas) -> rr.AsComponents | list[ColumnOf]:
    """Return the components of an image.  Raises ConversionError for an unknown encoding."""
    encoding = message.encoding.lower()
    if encoding in _PIXEL_FORMATS:
        return _subsampled(message, encoding)
    if pattern := bayer_pattern(encoding):
        is_wide = encoding.endswith("16")
        pixels = demosaiced(_rows(message, "u2" if is_wide else "u1", 1)[..., 0], pattern)
        return image_of_pixels(_eight_bits(pixels, canvas, message.encoding), rr.ColorModel.RGB)
    if named := _NAMED.fullmatch(encoding):
        pixels = _rows(message, f"u{int(named[2]) // 8}", _CHANNELS[named[1]])
        if named[1] == "mono":
            return grey(pixels[..., 0])
        return image_of_pixels(_eight_bits(pixels, canvas, message.encoding), _COLOURS[named[1]])
    if opencv := _OPENCV.fullmatch(message.encoding):
        channels = int(opencv[2] or 1)
        pixels = _rows(message, _DTYPES[opencv[1]], channels)
        if channels in _COLOUR_PLANES:
            # OpenCV's names do not state the order; the gateway uses RGB for them, as OpenIGTLink does
            return image_of_pixels(_eight_bits(pixels, canvas, message.encoding), _MODELS[channels])
        if channels > 1:
            canvas.text_once(f"{message.encoding} is drawn by its first component")
        return grey(pixels[..., 0])
    raise ConversionError(f"{message.TYPE}: found encoding {message.encoding!r}, expected one that can be drawn")


def grey(pixels: Array) -> list[ColumnOf]:
    """Draw one component; the viewer chooses the range of pixels with more than 8 bits."""
    return image_of_pixels(windowed(pixels) if pixels.dtype.kind == "i" else pixels, rr.ColorModel.L)


def windowed(pixels: Array) -> Array:
    """Scale numbers to 8 bits, from the 1st to the 99th percentile (a radiological window)."""
    low, high = span(pixels.reshape(-1)[:: max(pixels.size // 100_000, 1)])
    spread = high - low or 1.0
    scaled = np.clip((pixels.astype(np.float32) - np.float32(low)) * np.float32(255.0 / spread), 0, 255)
    octets: Array = np.nan_to_num(scaled).astype(np.uint8)
    return octets


def draw_compressed_image(message: CompressedImage, canvas: Canvas) -> None:
    """sensor_msgs/CompressedImage: JPEG, PNG, depth, or a frame of video."""
    canvas.frame(message.header.frame_id)
    coding = coding_of(message.format, message.data)
    if coding.codec not in _MEDIA:
        _draw_video(canvas, [coding.codec or message.format], message.data)
    elif coding.depth or (coding.codec == PNG and is_deep_png(message.data)):
        canvas.log(_deep(message, coding, canvas))
    else:
        canvas.log(rr.EncodedImage(contents=bytes(message.data), media_type=_MEDIA[coding.codec]))


def _deep(message: CompressedImage, coding: Coding, canvas: Canvas) -> list[ColumnOf]:
    """Draw a picture of 16 bits: the viewer's own decoder knows neither its range nor its metres."""
    try:
        pixels = decoded_still(coding.codec, bytes(message.data[coding.start :]))
    except Unavailable as error:
        raise ConversionError(f"{message.TYPE}: found {message.format!r} of 16 bits: {error}") from None
    if coding.depth:
        pixels = depths(pixels, coding)
    return (
        grey(pixels)
        if pixels.ndim == 2
        else image_of_pixels(_eight_bits(pixels, canvas, message.format), rr.ColorModel.RGB)
    )


def draw_compressed_video(message: CompressedVideo, canvas: Canvas) -> None:
    """foxglove_msgs/CompressedVideo."""
    canvas.frame(message.frame_id)
    _draw_video(canvas, [message.format.lower()], message.data)


def draw_video_frame(message: VideoFrame, canvas: Canvas) -> None:
    """igtl_msgs/VideoFrame; raw frames (I420) are drawn as images."""
    canvas.frame(message.header.frame_id)
    width, height, _ = message.size
    if message.codec == "I420":
        octets = width * height * 3 // 2
        data = bytes(message.data[:octets])
        if len(data) < octets:
            raise ConversionError(f"{message.TYPE}: found {counted(len(data), 'byte')} of I420, expected {octets}")
        canvas.shown.width, canvas.shown.height = width, height
        pixel_format = rr.PixelFormat.Y_U_V12_LimitedRange
        canvas.log(rr.Image(bytes=data, width=width, height=height, pixel_format=pixel_format))
        return
    _draw_video(canvas, [VIDEO_FORMATS.get(message.codec, message.codec.lower())], message.data)


def draw_camera(message: CameraInfo, canvas: Canvas) -> None:
    """sensor_msgs/CameraInfo: a pinhole in its frame; later images with this frame are drawn in it."""
    frame = canvas.frame(message.header.frame_id)
    canvas.shown.width, canvas.shown.height = message.width, message.height
    matrix = np.array(message.k).reshape(3, 3)
    if not matrix[0, 0] > 0 or not matrix[1, 1] > 0 or not message.width or not message.height:
        raise ConversionError(
            f"{message.TYPE}: found focal lengths {message.k[0]:g} and {message.k[4]:g}, expected others"
        )
    if canvas.pen.owners.setdefault(f"{frame}/image", canvas.shown.path) != canvas.shown.path:
        canvas.text_once(f"frame {frame} already has a camera")
        return
    pinhole = rr.Pinhole(
        image_from_camera=matrix,
        resolution=(message.width, message.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.02,
        parent_frame=frame,
        child_frame=f"{frame}/image",
    )
    if frame not in canvas.pen.cameras:
        canvas.pen.cameras.add(frame)
        canvas.pen.static(f"{PLACES}/{canvas.shown.path}", pinhole)  # a view without a camera reports an error
    canvas.log(pinhole)


def draw_color_table(message: ColorTable, canvas: Canvas) -> None:
    """igtl_msgs/ColorTable: the colours, with index 0 at the left."""
    if message.map_type == _MAP_RGB:
        row = np.frombuffer(message.table, np.uint8)
        row = row[: row.size // 3 * 3].reshape(1, -1, 3)
    else:
        wide = message.map_type == _MAP_UINT16
        row = np.frombuffer(message.table, (">" if message.is_bigendian else "<") + ("u2" if wide else "u1"))
        row = (row >> 8 if wide else row).astype(np.uint8).reshape(1, -1, 1).repeat(3, axis=2)
    if not row.size:
        raise ConversionError(f"{message.TYPE}: found an empty table, expected 256 or 65536 rows")
    canvas.shown.width, canvas.shown.height = row.shape[1], _STRIP
    canvas.log(image_of_pixels(row.repeat(_STRIP, axis=0), rr.ColorModel.RGB))


def _draw_video(canvas: Canvas, words: list[str], data: Buffer) -> None:
    named = [_ALIASES.get(word, word) for word in words]
    name = next((word for word in named if word in _CODECS), None)
    if name is None:
        raise ConversionError(f"{canvas.shown.ros_type}: found format {' '.join(words)!r}, expected one to draw")
    if size := frame_size(name, data):
        canvas.shown.width, canvas.shown.height = size
    key = is_key_frame(name, data)
    if key:
        canvas.memory["started"] = name
    if canvas.memory.get("started") != name:
        raise ConversionError("found a frame before the first key frame, expected a key frame")
    canvas.log(rr.VideoStream(_CODECS[name], sample=bytes(data), is_keyframe=key))


def _rows(message: Image, kind: str, channels: int) -> Array:
    """Return pixels (height, width, channels) in native byte order, without row padding."""
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    height, width = message.height, message.width
    row = width * channels * dtype.itemsize
    step = message.step or row
    size = memoryview(message.data).nbytes
    if step < row or size < step * (height - 1) + row * (height > 0) or not height or not width:
        raise ConversionError(
            f"{message.TYPE}: found {counted(size, 'byte')} with step {message.step}, expected "
            f"{counted(height, 'row')} of {counted(row, 'byte')}"
        )
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    pixels: Array = np.ndarray((height, width, channels), dtype, message.data, 0, strides)
    native: Array = pixels.astype(dtype.newbyteorder("="), copy=False)
    return native


def _subsampled(message: Image, encoding: str) -> rr.Image:
    """Draw YUV, whose colours are those of two columns, or of two rows, too.  Raises ConversionError for odd sizes."""
    pixel_format = _PIXEL_FORMATS[encoding]
    width, height = message.width, message.height
    is_planar = pixel_format == rr.PixelFormat.NV12
    row = width if is_planar else 2 * width
    rows = height * 3 // 2 if is_planar else height
    step = message.step or row
    size = memoryview(message.data).nbytes
    if width % 2 or (is_planar and height % 2) or not width or not height:
        raise ConversionError(f"{message.TYPE}: found {width} x {height} of {message.encoding}, expected even numbers")
    if step < row or size < step * (rows - 1) + row:
        raise ConversionError(
            f"{message.TYPE}: found {counted(size, 'byte')} with step {step}, expected {counted(rows, 'row')} of "
            f"{counted(row, 'byte')}"
        )
    data: Array = np.ascontiguousarray(np.ndarray((rows, row), np.uint8, message.data, 0, (step, 1)))
    if encoding in _UYVY:
        data = data.reshape(-1, 2)[:, ::-1]
    return rr.Image(bytes=data.tobytes(), width=width, height=height, pixel_format=pixel_format)


def _eight_bits(pixels: Array, canvas: Canvas, encoding: str) -> Array:
    """Convert colours to 8 bits: the upper 8 of 16 bits; floats from 0 … 1; signed numbers by their window."""
    kind = pixels.dtype
    if kind == np.uint8:
        return np.ascontiguousarray(pixels)
    if kind == np.uint16:
        canvas.text_once(f"{encoding} is drawn by the upper 8 of its 16 bits")
        return (pixels >> 8).astype(np.uint8)
    if kind.kind == "f" and float(np.nanmax(pixels, initial=0.0)) <= 1.0:
        return np.nan_to_num(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
    canvas.text_once(f"{encoding} is drawn from its 1st to its 99th percentile")
    return windowed(pixels)

"""IMAGE ⇄ sensor_msgs/Image: two-dimensional images of every scalar type, grey or in colour.

Pixels change only from BGR order and padded rows, and from uint32, which ROS has no encoding for.  The byte order is
declared, not swapped.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, SCALARS, Image

#: ROS encodings of (scalar type, components); all others have the OpenCV names below.
_NAMES = {
    (3, 1): "mono8",
    (3, 3): "rgb8",
    (3, 4): "rgba8",
    (5, 1): "mono16",
    (5, 3): "rgb16",
    (5, 4): "rgba16",
}
_OPENCV = {2: "8SC", 3: "8UC", 4: "16SC", 5: "16UC", 6: "32SC", 10: "32FC", 11: "64FC"}
_UINT32, _FLOAT64 = 7, 11

#: Encoding → (scalar type, components, whether blue is the first component).
_ENCODINGS = {name: (*key, False) for key, name in _NAMES.items()} | {
    "bgr8": (3, 3, True),
    "bgra8": (3, 4, True),
    "bgr16": (5, 3, True),
    "bgra16": (5, 4, True),
    # a Bayer mosaic is sent as a grey image
    **{f"bayer_{order}{bits}": (kind, 1, False) for order in ("rggb", "bggr", "gbrg", "grbg") for bits, kind in
       ((8, 3), (16, 5))},
}  # fmt: skip
_SCALAR_OF_OPENCV = {name: scalar for scalar, name in _OPENCV.items()}
_OPENCV_NAME = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)C([1-9][0-9]{0,4})")
_MAX_COMPONENTS = 254  # the reference library's limit
_MAX_SIZE = 65_535


def image_to_ros(content: Image, to: ToRosContext) -> RosImage:
    """Convert to Image.  Raises ConversionError for volumes and partial updates, which ROS images cannot hold."""
    width, height, slices = content.dimensions
    if slices != 1:
        raise ConversionError(
            f"IMAGE {to.device_name!r}: found a volume of {counted(slices, 'slice')}, expected 1 for sensor_msgs/Image"
        )
    if content.sub_size != content.dimensions:
        raise ConversionError(
            f"IMAGE {to.device_name!r}: found the part {content.sub_size} at {content.subvol_offset} "
            f"of {content.dimensions}, expected the whole image"
        )
    scalar, components = content.number_type, content.num_components
    pixels, big = content.pixels, content.endian == BIG_ENDIAN
    if scalar == _UINT32:  # ROS has no encoding for uint32; float64 holds every value
        pixels = content.array.astype("<f8").reshape(-1).view(np.uint8).data
        scalar, big = _FLOAT64, False
        to.warnings.append(("uint32_as_float64", "uint32 pixels have no ROS encoding and are published as 64FC"))
    encoding = _NAMES.get((scalar, components)) or f"{_OPENCV[scalar]}{components}"
    item = np.dtype(SCALARS[scalar]).itemsize
    step = width * components * item
    return RosImage(Header(to.stamp_ns, to.frame_id), height, width, encoding, int(big and item > 1), step, pixels)


def image_to_igtl(message: RosImage, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to a 2-D IMAGE of 1 mm spacing, centred at the origin.  Raises ConversionError for unknown encodings."""
    scalar, components, blue_first = pixel_layout(message.encoding)
    dtype = np.dtype((">" if message.is_bigendian else "<") + SCALARS[scalar])
    width, height = message.width, message.height
    row = width * components * dtype.itemsize
    size = memoryview(message.data).nbytes
    if message.step < row or size < message.step * (height - 1) + row * (height > 0):
        raise ConversionError(
            f"sensor_msgs/Image: found {counted(size, 'byte')} with step {message.step}, "
            f"expected at least {counted(height, 'row')} of {counted(row, 'byte')} ({width} {message.encoding} pixels)"
        )
    if width > _MAX_SIZE or height > _MAX_SIZE:
        raise ConversionError(f"sensor_msgs/Image: found {width} x {height}, expected at most {_MAX_SIZE} each")
    pixels = memoryview(message.data)[: message.step * height]
    if message.step != row and height:
        pixels = _unpadded(pixels, height, row, message.step)
    if blue_first:
        pixels = _red_first(np.frombuffer(pixels, dtype).reshape(-1, components))
    endian = BIG_ENDIAN if message.is_bigendian and dtype.itemsize > 1 else LITTLE_ENDIAN
    image = Image((width, height, 1), scalar, pixels, components, endian)
    return ConvertedMessage(image, message.header.stamp_ns, message.header.frame_id)


def pixel_layout(encoding: str) -> tuple[int, int, bool]:
    """Return scalar type, components and whether blue is the first one.  Raises ConversionError."""
    if known := _ENCODINGS.get(encoding):
        return known
    if match := _OPENCV_NAME.fullmatch(encoding):
        components = int(match[2])
        if components <= _MAX_COMPONENTS:
            return _SCALAR_OF_OPENCV[f"{match[1]}C"], components, False
    raise ConversionError(
        f"sensor_msgs/Image: found encoding {encoding!r}, "
        f"expected one of {', '.join(_ENCODINGS)} or an OpenCV name such as 16UC1"
    )


def _unpadded(pixels: memoryview, height: int, row: int, step: int) -> memoryview:
    """Return the rows without padding; the last row may lack it."""
    rows: npt.NDArray[np.uint8] = np.ndarray((height, row), np.uint8, pixels, 0, (step, 1))
    return np.ascontiguousarray(rows).reshape(-1).data


def _red_first(pixels: npt.NDArray[Any]) -> memoryview:
    """Return BGR(A) pixels (n, 3 or 4) as RGB(A) bytes."""
    swapped = pixels.copy()
    swapped[:, 0] = pixels[:, 2]
    swapped[:, 2] = pixels[:, 0]
    return swapped.reshape(-1).view(np.uint8).data

"""IMAGE ⇄ igtl_msgs/Volume: slices and volumes with position and orientation; slices → sensor_msgs/Image.

Pixels are neither copied nor swapped: the message declares their byte order.
"""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.base.errors import ConversionError, MalformedBody
from igtl_gateway.convert import images
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.geometry import Placement, split_axes
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, OLD_LPS, RAS, Image

_UINT32 = 7

_ZERO_IS_LPS = (
    "coordinate system 0 is read as LPS, which it is in C++ libraries before 2013 and in openigtlink4java; "
    "if the matrix is in RAS, let the sender write 1: 3D Slicer ignores this byte"
)

#: Tolerance for the length of a direction vector; float32 rotations are within it.
_UNIT_TOLERANCE = 1e-3


def is_flat(content: Image) -> bool:
    """Return whether the image has exactly one slice."""
    return content.dimensions[2] == 1


def has_slices(content: Image) -> bool:
    return not is_flat(content)


def exceeds_picture(content: Image) -> bool:
    """Return whether slices, placement or scalar type exceed what sensor_msgs/Image can represent."""
    return (
        not is_flat(content)
        or content.wire_matrix != Image.IDENTITY
        or content.is_lps
        or content.scalar_type == _UINT32
    )


def image_to_volume(content: Image, to: ToRosContext) -> Volume:
    """Convert to Volume.  A matrix with NaN or infinity is not rejected: the pixels are still of use.

    Raises ConversionError for a part of an image; ``assembly`` joins parts before.
    """
    _check_whole(content, to)
    coordinate = LPS if content.is_lps else RAS
    if content.coordinate == OLD_LPS:
        to.warnings.append(("coordinate_zero", _ZERO_IS_LPS))
    placement = Placement.of_wire(content.wire_matrix, coordinate, to.lengths)
    return Volume(
        Header(to.stamp_ns, to.frame_id),
        content.dimensions,
        content.number_type,
        content.num_components,
        content.endian == BIG_ENDIAN,
        coordinate,
        placement.direction,
        placement.spacing,
        placement.origin(content.dimensions),
        content.pixels,
        to.metadata,
    )


def volume_to_image(message: Volume, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to IMAGE; an unset coordinate system (0) is RAS.

    Raises ConversionError if the fields contradict each other, and for numbers that float32 cannot hold.
    """
    _, lengths = split_axes(message.direction)
    if any(abs(length - 1) > _UNIT_TOLERANCE for length in lengths):
        text = (
            f"columns of the direction have the lengths {lengths}, expected 1: the voxel size differs from the spacing"
        )
        to.warnings.append(("direction_not_unit", text))
    coordinate = message.coordinate_system or RAS
    placement = Placement.from_origin(message.direction, message.spacing, message.origin, message.size)
    content = Image(
        message.size,
        message.scalar_type,
        message.data,
        message.components,
        BIG_ENDIAN if message.is_bigendian else LITTLE_ENDIAN,
        coordinate,
        placement.to_wire(coordinate, to.lengths, message.TYPE),
    )
    try:
        content.check()
    except MalformedBody as error:
        raise ConversionError(f"{message.TYPE}: {error}") from None
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def image_to_slices(content: Image, to: ToRosContext) -> list[RosMessage]:
    """Convert to one Image for each slice, beginning with k = 0, all with stamp and frame of the volume.

    Raises ConversionError for a part of an image.
    """
    _check_whole(content, to)
    width, height, count = content.dimensions
    pixels = memoryview(content.pixels)
    size = pixels.nbytes // max(count, 1)
    flat = (width, height, 1)
    later = replace(to, warnings=[])  # the warnings of all slices are equal: only those of the first are reported
    return [
        images.image_to_ros(
            replace(content, dimensions=flat, subvol_size=flat, pixels=pixels[k * size : (k + 1) * size]),
            later if k else to,
        )
        for k in range(count)
    ]


def _check_whole(content: Image, to: ToRosContext) -> None:
    if content.sub_size != content.dimensions:
        raise ConversionError(
            f"IMAGE {to.device_name!r}: found the part {content.sub_size} at {content.subvol_offset} "
            f"of {content.dimensions}, expected the whole image"
        )

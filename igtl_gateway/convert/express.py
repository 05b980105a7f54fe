"""From bytes to bytes, for messages that are as the last one of their stream but for what they carry and their stamp.

A tracker says the same thing a thousand times a second: only twelve numbers and the stamp differ.  What the layers
above make of the first message (names, frames, metadata, rows of the table) is kept as *sample* and *templates*;
here the next message is held against the sample, and the templates get its numbers.  Whatever is not plainly so
(another size or frame, a wrong CRC, numbers that are not finite, a matrix that is no rotation) gives None: the
message then takes the full path, which knows what to say of it.

Of the functions of poses there are two each with the same results, bit for bit: the ones here, and the compiled ones of
``_express.c`` where the package was built with a C compiler.  ``COMPILED`` says which are in use.

Those of *bulk*, for texts, points and clouds, whose sizes may change from message to message, and for pictures, are
compiled only: without them such messages take the full path, which is slower by 0.2 to 0.5 ms where they are rare.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from igtl_gateway.convert.poses import (
    BEYOND_FLOAT32,
    ROUNDING,
    canonical_quaternion,
    determinant,
    distance_from_rotation,
    rotation_matrix,
    rotation_quaternion,
    unit_quaternion,
)
from igtl_gateway.errors import ConversionError
from igtl_gateway.stamp import ns_to_ros, ns_to_ticks, ros_to_ns, ticks_to_ns
from igtl_gateway.wire.header import BODY_SIZE_AT, CRC_AT, HEADER_SIZE, TICKS_AT, U64, crc64
from igtl_gateway.wire.message import MESSAGE_ID_AT

#: Bytes of the numbers of TRANSFORM (a matrix) and of POSITION (position and quaternion), by which they are told apart.
MATRIX, QUATERNION = 48, 28

_ID_AT = HEADER_SIZE + MESSAGE_ID_AT
_NUMBERS = {size: struct.Struct(f">{size // 4}f") for size in (MATRIX, QUATERNION)}
_STAMP = struct.Struct("<iI")
_NAMES_AT = 12  # in CDR: behind encapsulation and stamp
_POSE = struct.Struct("<7d")
_DIGITS = 19  # of a stamp in metadata: from 2001 to 2262
_FIRST = 10 ** (_DIGITS - 1)


def pose_to_ros(
    data: object,
    sample: bytes,
    at: int,
    size: int,
    check_crc: bool,
    own: bool,
    received_ns: int,
    ratio: tuple[float, float],
    forms: tuple[tuple[bytes, int], ...],
) -> tuple[Any, ...] | None:
    """A TRANSFORM or POSITION as ROS messages that end with a pose.

    Args:
        data: one whole message; None comes back for anything but ``bytes``.
        sample: a message of the stream; ``data`` has to be the same but for time stamp, CRC, message id and numbers.
        at, size: where the numbers are, and their bytes: ``MATRIX`` or ``QUATERNION``.
        check_crc: whether a wrong CRC is to be seen.
        own: whether the message's own stamp is told (``received_ns`` where it has none), else ``received_ns``, UTC ns.
        ratio: lengths are multiplied by the first and divided by the second number.
        forms: CDR templates, each with the offset of its stamp.

    Returns:
        The message's own stamp (UTC ns), the stamp told, and the CDR bytes of each form; None if the message is not
        plainly as the sample.
    """
    if not isinstance(data, bytes) or len(data) != len(sample):
        return None
    end = at + size
    if data[:TICKS_AT] != sample[:TICKS_AT] or data[BODY_SIZE_AT:CRC_AT] != sample[BODY_SIZE_AT:CRC_AT]:
        return None
    if at > HEADER_SIZE and data[HEADER_SIZE:_ID_AT] != sample[HEADER_SIZE:_ID_AT]:  # the id is not compared
        return None
    if data[end:] != sample[end:]:
        return None
    if check_crc and crc64(data[HEADER_SIZE:]) != U64.unpack_from(data, CRC_AT)[0]:
        return None
    m = _NUMBERS[size].unpack_from(data, at)
    if not all(map(math.isfinite, m)):
        return None
    if size == MATRIX:
        rows = [[m[0], m[3], m[6]], [m[1], m[4], m[7]], [m[2], m[5], m[8]]]
        if distance_from_rotation(rows) > ROUNDING or determinant(rows) < 0.0:
            return None
        position, rotation = m[9:], rotation_quaternion(rows)
    else:
        try:
            position, rotation = m[:3], canonical_quaternion(unit_quaternion(m[3:]))
        except ConversionError:
            return None
    times, by = ratio
    pose = _POSE.pack(*[length * times / by for length in position], *rotation)
    source_ns = ticks_to_ns(U64.unpack_from(data, TICKS_AT)[0])
    stamp_ns = source_ns if own and source_ns > 0 else received_ns
    stamp = _STAMP.pack(*ns_to_ros(stamp_ns))
    made = [
        template[:stamp_at] + stamp + template[stamp_at + _STAMP.size : -_POSE.size] + pose
        for template, stamp_at in forms
    ]
    return source_ns, stamp_ns, *made


def pose_to_igtl(
    cdr: object,
    sample: bytes,
    names: tuple[int, int, int],
    size: int,
    own: bool,
    source_ns: int,
    received_ns: int,
    ratio: tuple[float, float],
    forms: tuple[tuple[bytes, int, int], ...],
) -> tuple[Any, ...] | None:
    """A ROS message of header, names and pose as TRANSFORM or POSITION.

    Args:
        cdr: the message, little-endian; None comes back for anything but ``bytes``.
        sample: a message of the stream; ``cdr`` has to be the same but for stamp, padding and pose.
        names: offsets behind its first name, before and behind its second one; what is between them is padding, which
            senders leave as it was in their memory.
        size: ``MATRIX`` or ``QUATERNION``.
        own: whether the message's own stamp is told (``source_ns`` where it has none), else ``received_ns``; UTC ns.
        ratio: lengths are multiplied by the first and divided by the second number.
        forms: whole messages as templates, each with the offset of its numbers, and of the 19 digits of the ROS stamp
            in its metadata (0: no metadata; −1: metadata without a stamp).

    Returns:
        The stamp told (UTC ns) and the bytes of each form; None if the message is not plainly as the sample.
    """
    if not isinstance(cdr, bytes) or len(cdr) != len(sample):
        return None
    first_end, second, end = names
    if cdr[:4] != sample[:4] or cdr[_NAMES_AT:first_end] != sample[_NAMES_AT:first_end]:
        return None
    if cdr[second:end] != sample[second:end]:
        return None
    header_ns = ros_to_ns(*_STAMP.unpack_from(cdr, 4))
    said_ns = header_ns or source_ns
    stamp_ns = said_ns if own and said_ns > 0 else received_ns
    pose = _POSE.unpack_from(cdr, len(cdr) - _POSE.size)
    if not all(map(math.isfinite, pose)):
        return None
    times, by = ratio
    position = [length * times / by for length in pose[:3]]
    if not max(map(abs, position)) < BEYOND_FLOAT32:
        return None
    try:
        rotation = unit_quaternion(pose[3:])
    except ConversionError:
        return None
    if size == MATRIX:
        (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(rotation)
        numbers = _NUMBERS[size].pack(a, d, g, b, e, h, c, f, i, *position)
    else:
        numbers = _NUMBERS[size].pack(*position, *rotation)
    made = []
    for template, at, digits_at in forms:
        if header_ns < _FIRST if digits_at > 0 else digits_at and header_ns:
            return None  # metadata of another size than in the template
        out = bytearray(template)
        U64.pack_into(out, TICKS_AT, ns_to_ticks(stamp_ns))
        out[at : at + size] = numbers
        if digits_at > 0:
            out[digits_at : digits_at + _DIGITS] = b"%d" % header_ns
        U64.pack_into(out, CRC_AT, crc64(out[HEADER_SIZE:]))
        made.append(bytes(out))
    return stamp_ns, *made


#: The functions above, for those who want them whatever is in use.
PLAIN = (pose_to_ros, pose_to_igtl)
COMPILED = False

#: What bulk is made of and what of it: STRING ⇄ String of ASCII, POINT of one point → PointStamped, POINT of points
#: without labels ⇄ PointCloud2, POLYDATA that is nothing but points ⇄ PointCloud2.  Clouds to OpenIGTLink have x, y and
#: z as float32 and nothing else; all numbers are finite.  IMAGE ⇄ Image, of the size and with all else as in the
#: sample, and Image of BGR → IMAGE of RGB.
TEXT, POINT, POINTS, CLOUD, PICTURE, BLUE_FIRST = range(6)

Fill = Callable[..., tuple[Any, ...] | None]

#: As ``pose_to_ros``, but for ``sample``: what stands before and behind the content; ``at``, ``size``: how long these
#: two are; ``forms``: for each what it is made as, a template (of clouds and pictures: up to the data; of a point:
#: whole), and the offsets of its stamp (0: none) and of its width.  Of a form that has no place for the content None
#: comes back.
bulk_to_ros: Fill | None = None

#: As ``pose_to_igtl``, but for ``sample``: what stands before the content; ``names``: of a cloud the offsets of its
#: height and of its data, how long a point is and where x, y and z are in it (of a picture: how long it is, and
#: zeros), and then begin and end of each part of the sample that has to be the same; ``size``: what is made; ``forms``:
#: for each what stands before and behind the content, and where in the latter the digits are.
bulk_to_igtl: Fill | None = None

if not TYPE_CHECKING:
    try:
        from igtl_gateway.convert._express import bulk_to_igtl, bulk_to_ros, pose_to_igtl, pose_to_ros  # noqa: F401

        COMPILED = True
    except ImportError:  # pragma: no cover - installed without the C part
        pass

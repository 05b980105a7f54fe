"""Conversions of bytes to bytes, for messages that differ from the last one of their stream in values and stamp.

A tracker sends a thousand messages per second that differ only in twelve numbers and the stamp.  The fast path stores
the results of the full path for the first message (names, frames, metadata, rows of the table) as *sample* and
*templates*.  The functions of this module compare the next message with the sample and fill its numbers into the
templates.  In every other case (another size or frame, a wrong CRC, NaN or infinity, a matrix that is not a rotation)
they return None, and the message takes the full path, which reports the reason.

Each function for poses exists twice, with results that are equal bit for bit: here, and compiled in ``_express.c`` if
the package was built with a C compiler.  ``COMPILED`` is true if the compiled functions are in use.

The functions for *bulk* (strings, points and clouds, whose sizes can change from message to message, and images) exist
only compiled.  Without them these messages take the full path, which takes 0.2 to 0.5 ms longer for rare messages.
A large one is converted in blocks that fit the cache, together with its CRC, while other threads of Python run.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import ns_to_ros, ns_to_ticks, ros_to_ns, ticks_to_ns
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
from igtl_gateway.wire.header import BODY_SIZE_AT, CRC_AT, HEADER_SIZE, TICKS_AT, U64, crc64
from igtl_gateway.wire.message import MESSAGE_ID_AT

#: Size in bytes of the numbers of TRANSFORM (a matrix) and of POSITION (position, quaternion); it selects the form.
MATRIX, QUATERNION = 48, 28

_ID_AT = HEADER_SIZE + MESSAGE_ID_AT
_NUMBERS = {size: struct.Struct(f">{size // 4}f") for size in (MATRIX, QUATERNION)}
_STAMP = struct.Struct("<iI")
_NAMES_AT = 12  # in CDR: after encapsulation and stamp
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
    forms: tuple[tuple[bytes, int] | tuple[bytes, int, int], ...],
) -> tuple[Any, ...] | None:
    """Convert a TRANSFORM or POSITION to ROS messages that end with a pose, and to one of its metadata.

    Args:
        data: one whole message; the result is None for types other than ``bytes``.
        sample: a message of the stream; ``data`` must be equal except in stamp, CRC, message id and numbers.
        at, size: offset and size in bytes of the numbers; the size is ``MATRIX`` or ``QUATERNION``.
        check_crc: whether the CRC is checked.
        own: whether the ROS stamp is the message's own stamp (``received_ns`` if unset) or ``received_ns``; UTC ns.
        ratio: lengths are multiplied by the first and divided by the second number.
        forms: CDR templates, each with the offset of its stamp; of the metadata, also with that of the message id.

    Returns:
        The message's own stamp (UTC ns), the ROS stamp (UTC ns), and the CDR bytes of each form; None if the message
        differs from the sample in anything else.
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
    made = []
    for template, stamp_at, *id_at in forms:
        out = bytearray(template)
        out[stamp_at : stamp_at + _STAMP.size] = stamp
        if id_at:
            out[id_at[0] : id_at[0] + 4] = data[_ID_AT : _ID_AT + 4][::-1]  # big-endian there, little-endian here
        else:
            out[-_POSE.size :] = pose
        made.append(bytes(out))
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
    """Convert a ROS message of header, names and pose to TRANSFORM or POSITION.

    Args:
        cdr: the message, little-endian; the result is None for types other than ``bytes``.
        sample: a message of the stream; ``cdr`` must be equal except in stamp, padding and pose.
        names: offsets of the end of the first name, and of begin and end of the second one.  The bytes between the
            names and after the second one are padding, which senders leave uninitialised.
        size: ``MATRIX`` or ``QUATERNION``. own: whether the OpenIGTLink stamp is the message's own stamp
        (``source_ns`` if unset) or ``received_ns``; UTC ns. ratio: lengths are multiplied by the first and divided by
        the second number. forms: whole messages as templates, each with the offset of its numbers, and of the 19
        digits of the ROS stamp
            in its metadata (0: no metadata; −1: metadata without a stamp; below: minus the offset of the digits of the
            OpenIGTLink stamp, if ROS has none).

    Returns:
        The OpenIGTLink stamp (UTC ns) and the bytes of each form; None if the message differs from the sample in
        anything else.
    """
    if not isinstance(cdr, bytes) or len(cdr) != len(sample):
        return None
    first_end, second, end = names
    if cdr[:4] != sample[:4] or cdr[_NAMES_AT:first_end] != sample[_NAMES_AT:first_end]:
        return None
    if cdr[second:end] != sample[second:end]:
        return None
    header_ns = ros_to_ns(*_STAMP.unpack_from(cdr, 4))
    own_ns = header_ns or source_ns
    stamp_ns = own_ns if own and own_ns > 0 else received_ns
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
        if digits_at > 0:
            fits = header_ns >= _FIRST
        else:
            fits = not digits_at or (not header_ns and (digits_at == -1 or stamp_ns >= _FIRST))
        if not fits:
            return None  # the metadata would have another size than in the template
        out = bytearray(template)
        U64.pack_into(out, TICKS_AT, ns_to_ticks(stamp_ns))
        out[at : at + size] = numbers
        if digits_at not in (0, -1):
            out[abs(digits_at) : abs(digits_at) + _DIGITS] = b"%d" % (header_ns or stamp_ns)
        U64.pack_into(out, CRC_AT, crc64(out[HEADER_SIZE:]))
        made.append(bytes(out))
    return stamp_ns, *made


#: The functions above; available if the compiled ones are in use, too.
PLAIN = (pose_to_ros, pose_to_igtl)
COMPILED = False

#: Conversions of bulk messages: STRING ⇄ String of ASCII, POINT of one point → PointStamped, POINT of unlabelled
#: points ⇄ PointCloud2, POLYDATA with points only ⇄ PointCloud2, IMAGE ⇄ Image with everything but the pixels as in
#: the sample, Image of BGR → IMAGE of RGB, POLYDATA of points and triangles ⇄ Mesh, and the same ⇄ Marker of triangles
#: (to OpenIGTLink only without colours and rotation), TDATA and QTDATA ⇄ messages of poses with the sample's tools,
#: the metadata of any of them → Metadata, IMAGE → Volume with everything but the pixels as in the sample,
#: POINT with the sample's labels → PointList, JointState → SENSOR and NDARRAY.
#: Clouds to OpenIGTLink have only the fields x, y and z as float32; all numbers are finite.
TEXT, POINT, POINTS, CLOUD, PICTURE, BLUE_FIRST, MESH, TRIANGLES, TOOLS, METADATA, VOLUME, LANDMARKS, NUMBERS = range(
    13
)

FillTemplate = Callable[..., tuple[Any, ...] | None]

#: Like ``pose_to_ros``, with other meanings of some arguments.  ``sample``: the bytes before and after the content; and
#: for points with labels the content itself.
#: ``at``, ``size``: the sizes of these two.  ``forms``: for each form the conversion, a template (for clouds and images
#: up to the data; for a point the whole message; for a marker all but its points; for tools the whole message and its
#: rows), the offsets of its stamp (0: none) and of its width (of a marker: of the number of its points; of tools: the
#: bytes of one; of metadata: of the message id), and the number of bytes after the points of a marker or the pixels of
#: a volume; for tools and landmarks (the whole message and its rows, the offset of each place) that of the rows.
#: The result has None for a form that does not apply to the content.
bulk_to_ros: FillTemplate | None = None

#: Like ``pose_to_igtl``, with other meanings of some arguments.  ``sample``: the bytes before the content.  ``names``:
#: for a cloud the offsets of its height and of its data, the size of a point, and the offsets of x, y and z in it; for
#: an image the offsets, the size of its data, and zeros; for a marker the offsets of its pose and of its points, their
#: size, the bytes from their number to them, and zeros; then begin and end of each part of the sample that must be
#: equal; for tools their number, the size of the message, the bytes of one, and zeros: in the sample, content and rows
#: (``gateway/fastpath/tools.py``) follow the message; for numbers the same with that of their rows and the size of
#: the content (``gateway/fastpath/joints.py``).  ``size``: the conversion.  ``forms``: for each form the bytes
#: before and after the content, and the offset of the digits in the latter.  The result has a tuple of buffers for a
#: large image: its pixels are a view on ``cdr``.
bulk_to_igtl: FillTemplate | None = None

if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._express import bulk_to_igtl, bulk_to_ros, pose_to_igtl, pose_to_ros  # noqa: F401

        COMPILED = True
    except ImportError:  # pragma: no cover - installed without the C part
        pass

"""TRANSFORM and POSITION ⇄ geometry_msgs/TransformStamped; geometry_msgs/PoseStamped → both.

All arithmetic is plain +, −, ×, ÷ and √ on Python floats: IEEE 754 defines every bit, on every machine.  There is no
SVD, because the bits of LAPACK depend on the library that numpy was built with, and verification compares bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from igtl_gateway.base.errors import ConversionError, NotFinite
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.units import Number
from igtl_gateway.wire.transform import Position, Transform

Quaternion = tuple[float, float, float, float]
Rows = list[list[float]]

#: Tolerance for an orthonormal rotation matrix (float32 rounding is about 1e-6); above it the matrix is projected.
ROUNDING = 1e-5
#: Above this tolerance a warning reports the loss of scale or shear.
_NOTICEABLE = 1e-3
_MAX_ITERATIONS = 100
#: Numbers from this one on round to the infinity of float32.
BEYOND_FLOAT32 = 2.0**128 - 2.0**103


def transform_to_ros(content: Transform, to: ToRosContext) -> TransformStamped:
    """Convert to TransformStamped.  Raises ConversionError for reflections, singular matrices, NaN and infinity."""
    return _stamped(pose_of_matrix(content.wire_matrix, to, f"TRANSFORM {to.device_name!r}"), to)


def position_to_ros(content: Position, to: ToRosContext) -> TransformStamped:
    """Convert to TransformStamped.  Raises ConversionError for a quaternion of zero length, NaN and infinity."""
    return _stamped(pose_of_position(content.position, content.quaternion, to, f"POSITION {to.device_name!r}"), to)


def _stamped(pose: Pose, to: ToRosContext) -> TransformStamped:
    return TransformStamped(Header(to.stamp_ns, to.frame_id), to.child_frame_id, pose[:3], pose[3:])


def pose_of_matrix(wire_matrix: Sequence[float], to: ToRosContext, place: str) -> Pose:
    """Return the pose, in ROS units, of the twelve numbers of TRANSFORM; ``place`` is for warnings and errors.

    Raises ConversionError for reflections, singular matrices, NaN and infinity.
    """
    m = wire_matrix
    if not all(map(math.isfinite, m)):
        raise NotFinite(f"{place}: found {list(m)}, expected finite numbers")
    matrix = [[m[row], m[row + 3], m[row + 6]] for row in range(3)]
    rotation = nearest_quaternion(matrix, place)
    if (off := distance_from_rotation(matrix)) > _NOTICEABLE:
        lost = f"{place}: rotation matrix is not orthonormal: scale or shear ({off:.3g}) is lost"
        to.warnings.append(("not_a_rotation", lost))
    to_ros = to.lengths.to_ros
    return (to_ros(m[9]), to_ros(m[10]), to_ros(m[11]), *rotation)


def pose_of_position(position: Sequence[float], quaternion: Sequence[float], to: ToRosContext, place: str) -> Pose:
    """Return the pose, in ROS units, of the numbers of POSITION; ``place`` is for errors.

    Raises ConversionError for a quaternion of zero length, NaN and infinity.
    """
    if not all(map(math.isfinite, (*position, *quaternion))):
        raise NotFinite(f"{place}: found {(*position, *quaternion)}, expected finite numbers")
    x, y, z = position
    to_ros = to.lengths.to_ros
    return (to_ros(x), to_ros(y), to_ros(z), *canonical_quaternion(unit_quaternion(quaternion, place)))


def transform_to_igtl(message: TransformStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to TRANSFORM.  Raises ConversionError for a quaternion of zero length, NaN and infinity."""
    pose = (*message.translation, *message.rotation)
    return _outgoing(_matrix(pose, to, "TransformStamped"), message.header, message.child_frame_id)


def position_to_igtl(message: TransformStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POSITION with position and quaternion.  Raises ConversionError as ``transform_to_igtl``."""
    pose = (*message.translation, *message.rotation)
    return _outgoing(_position(pose, to, "TransformStamped"), message.header, message.child_frame_id)


def pose_to_transform(message: PoseStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to TRANSFORM.  Raises ConversionError as ``transform_to_igtl``."""
    return _outgoing(_matrix(message.pose, to, "PoseStamped"), message.header)


def pose_to_position(message: PoseStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POSITION with position and quaternion.  Raises ConversionError as ``transform_to_igtl``."""
    return _outgoing(_position(message.pose, to, "PoseStamped"), message.header)


def _outgoing(content: Transform | Position, header: Header, child_frame_id: str = "") -> ConvertedMessage:
    return ConvertedMessage(content, header.stamp_ns, header.frame_id, child_frame_id)


def _matrix(pose: Pose, to: ToIgtlContext, place: str) -> Transform:
    translation, rotation = _finite(pose, to, place)
    (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(rotation)
    return Transform((a, d, g, b, e, h, c, f, i, *translation))


def _position(pose: Pose, to: ToIgtlContext, place: str) -> Position:
    return Position(*_finite(pose, to, place))


def _finite(pose: Pose, to: ToIgtlContext, place: str) -> tuple[tuple[float, ...], Quaternion]:
    """Return translation in OpenIGTLink units and unit quaternion.  Raises ConversionError."""
    x, y, z = pose[:3]
    to_igtl = to.lengths.to_igtl
    translation = to_igtl(x), to_igtl(y), to_igtl(z)
    if not all(map(math.isfinite, (*translation, *pose[3:]))):
        raise NotFinite(f"{place}: found {pose}, expected finite numbers")
    if max(map(abs, translation)) >= BEYOND_FLOAT32:
        raise ConversionError(f"{place}: found {pose}, expected lengths within float32")
    return translation, unit_quaternion(pose[3:], place)


def unit_quaternion(quaternion: Sequence[float], place: str = "quaternion") -> Quaternion:
    """Return the quaternion x, y, z, w with length 1.  Raises ConversionError if its length is 0, infinite or NaN."""
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.0 < length < math.inf:
        raise ConversionError(f"{place}: found quaternion {quaternion}, expected a finite length above 0")
    return x / length, y / length, z / length, w / length


def canonical_quaternion(q: Quaternion) -> Quaternion:
    """Return q or −q, which are the same rotation: the one whose last component other than 0 is positive."""
    for value in reversed(q):
        if value:
            return q if value > 0 else (-q[0], -q[1], -q[2], -q[3])
    return q


def rotation_matrix(q: tuple[Number, Number, Number, Number]) -> list[list[Number]]:
    """Return the rotation matrix of a unit quaternion x, y, z, w: four numbers, or four columns for many."""
    x, y, z, w = q
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def nearest_quaternion(r: Rows, place: str) -> Quaternion:
    """Return the unit quaternion (w ≥ 0) of a 3 × 3 matrix or, if it is not a rotation, of the nearest rotation.

    Raises ConversionError for a reflection or a singular matrix.
    """
    if distance_from_rotation(r) > ROUNDING:
        r = _nearest_rotation(r, place)
    elif determinant(r) < 0.0:
        raise _not_orthonormal(place, determinant(r))
    return rotation_quaternion(r)


def rotation_quaternion(r: Rows) -> Quaternion:
    """Return the unit quaternion (w ≥ 0) of a rotation matrix."""
    (a, b, c), (d, e, f), (g, h, i) = r
    # Shepperd's method: divide by the largest component, never by one near 0
    trace = a + e + i
    if trace >= max(a, e, i):
        q = (h - f, c - g, d - b, 1.0 + trace)
    elif a >= e and a >= i:
        q = (1.0 + a - e - i, b + d, c + g, h - f)
    elif e >= i:
        q = (b + d, 1.0 - a + e - i, f + h, c - g)
    else:
        q = (c + g, f + h, 1.0 - a - e + i, d - b)
    return canonical_quaternion(unit_quaternion(q))


def distance_from_rotation(r: Rows) -> float:
    """Return the largest deviation of RᵀR from the identity."""
    (a, b, c), (d, e, f), (g, h, i) = r
    return max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h),
        abs(a * c + d * f + g * i),
        abs(b * c + e * f + h * i),
    )


def determinant(r: Rows) -> float:
    (a, b, c), (d, e, f), (g, h, i) = r
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _nearest_rotation(r: Rows, place: str) -> Rows:
    """Return the nearest rotation: polar decomposition by Newton's iteration R ← (R + R⁻ᵀ) / 2 (Higham 1986)."""
    # scaled to size 1, so that large scales neither cost iterations nor overflow
    size = max(abs(value) for row in r for value in row)
    if not size > 0.0:
        raise _not_orthonormal(place, 0.0)
    r = [[value / size for value in row] for row in r]
    for _ in range(_MAX_ITERATIONS):
        det = determinant(r)
        if not det > 1e-12:
            raise _not_orthonormal(place, det)
        (a, b, c), (d, e, f), (g, h, i) = r
        inverse_transposed = [
            [(e * i - f * h) / det, (f * g - d * i) / det, (d * h - e * g) / det],
            [(c * h - b * i) / det, (a * i - c * g) / det, (b * g - a * h) / det],
            [(b * f - c * e) / det, (c * d - a * f) / det, (a * e - b * d) / det],
        ]
        r = [[(x + y) / 2.0 for x, y in zip(*rows, strict=True)] for rows in zip(r, inverse_transposed, strict=True)]
        if distance_from_rotation(r) < 1e-14:
            break
    return r


def _not_orthonormal(place: str, determinant: float) -> ConversionError:
    what = "a reflection" if determinant < 0 else "a singular matrix"
    return ConversionError(
        f"{place}: found {what} (determinant {determinant:.3g}), expected an orthonormal rotation matrix"
    )

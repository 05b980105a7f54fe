"""TRANSFORM and POSITION ⇄ geometry_msgs/TransformStamped.

All arithmetic is plain +, −, ×, ÷ and √ on Python floats: IEEE 754 fixes every bit of it, on every machine.
(LAPACK does not: an SVD would make byte-exact verification depend on the library that numpy was built with.)
"""

from __future__ import annotations

import math

from igtl_gateway.convert.context import Outgoing, ToIgtl, ToRos
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.transform import Position, Transform

Quaternion = tuple[float, float, float, float]
Rows = list[list[float]]

#: float32 rounding leaves a rotation matrix orthonormal to about 1e-6; beyond this we project it first …
_ROUNDING = 1e-5
#: … and beyond this we say that scale or shear was lost.
_NOTICEABLE = 1e-3
_MAX_ITERATIONS = 100


def transform_to_ros(content: Transform, to: ToRos) -> TransformStamped:
    """Raises ConversionError for matrices that no rotation and translation can express."""
    m = content.wire_matrix
    if not all(map(math.isfinite, m)):
        raise ConversionError(f"TRANSFORM {to.device_name!r}: found {list(m)}, expected finite numbers")
    rotation = quaternion_of([[m[row], m[row + 3], m[row + 6]] for row in range(3)], to)
    return _stamped(m[9:], rotation, to)


def position_to_ros(content: Position, to: ToRos) -> TransformStamped:
    """Raises ConversionError for a quaternion of no length or numbers that are not finite."""
    if not all(map(math.isfinite, (*content.position, *content.quaternion))):
        raise ConversionError(f"POSITION {to.device_name!r}: found {content}, expected finite numbers")
    return _stamped(content.position, _positive(unit(content.quaternion)), to)


def _stamped(translation: tuple[float, ...], rotation: Quaternion, to: ToRos) -> TransformStamped:
    x, y, z = (to.lengths.to_ros(value) for value in translation)
    return TransformStamped(Header(to.stamp_ns, to.frame_id), to.child_frame_id, (x, y, z), rotation)


def transform_to_igtl(message: TransformStamped, to: ToIgtl) -> Outgoing:
    """As TRANSFORM.  Raises ConversionError for a quaternion of no length."""
    translation, rotation = _finite(message, to)
    (a, b, c), (d, e, f), (g, h, i) = matrix_of(rotation)
    return Outgoing(Transform((a, d, g, b, e, h, c, f, i, *translation)), message.header.stamp_ns)


def position_to_igtl(message: TransformStamped, to: ToIgtl) -> Outgoing:
    """As POSITION with all seven numbers."""
    translation, rotation = _finite(message, to)
    return Outgoing(Position(translation, rotation), message.header.stamp_ns)


def _finite(message: TransformStamped, to: ToIgtl) -> tuple[tuple[float, ...], Quaternion]:
    x, y, z = message.translation
    to_igtl = to.lengths.to_igtl
    translation = to_igtl(x), to_igtl(y), to_igtl(z)
    if not all(map(math.isfinite, (*translation, *message.rotation))):
        raise ConversionError(f"TransformStamped: found {message}, expected finite numbers")
    return translation, unit(message.rotation)


def unit(quaternion: tuple[float, ...]) -> Quaternion:
    """The quaternion x, y, z, w at length 1.  Raises ConversionError where it has none, or one beyond all numbers."""
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.0 < length < math.inf:
        raise ConversionError(f"quaternion: found {quaternion}, expected a finite length above 0")
    return x / length, y / length, z / length, w / length


def _positive(q: Quaternion) -> Quaternion:
    """Of q and −q, which are the same rotation, the one whose last component that is not 0 is positive."""
    for value in reversed(q):
        if value:
            return q if value > 0 else (-q[0], -q[1], -q[2], -q[3])
    return q


def matrix_of(q: Quaternion) -> Rows:
    """Rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = q
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def quaternion_of(r: Rows, to: ToRos) -> Quaternion:
    """Unit quaternion (w ≥ 0) of a 3 × 3 matrix: of the nearest rotation where it is none.

    Warns where scale or shear is lost.  Raises ConversionError for a reflection or a singular matrix.
    """
    off = _distance_from_rotation(r)
    if off > _ROUNDING:
        if off > _NOTICEABLE:
            to.warnings.append(
                ("not_a_rotation", f"the matrix has scale or shear ({off:.3g}), which a pose cannot hold")
            )
        r = _nearest_rotation(r, to.device_name)
    elif _determinant(r) < 0.0:
        raise _no_rotation(to.device_name, _determinant(r))
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
    return _positive(unit(q))


def _distance_from_rotation(r: Rows) -> float:
    """Largest deviation of RᵀR from the identity."""
    (a, b, c), (d, e, f), (g, h, i) = r
    return max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h),
        abs(a * c + d * f + g * i),
        abs(b * c + e * f + h * i),
    )


def _determinant(r: Rows) -> float:
    (a, b, c), (d, e, f), (g, h, i) = r
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _nearest_rotation(r: Rows, name: str) -> Rows:
    """Polar decomposition by Newton's iteration R ← (R + R⁻ᵀ) / 2 (Higham 1986)."""
    # first to size 1, so that millimetre scales do not cost iterations or overflow
    size = max(abs(value) for row in r for value in row)
    if not size > 0.0:
        raise _no_rotation(name, 0.0)
    r = [[value / size for value in row] for row in r]
    for _ in range(_MAX_ITERATIONS):
        det = _determinant(r)
        if not det > 1e-12:
            raise _no_rotation(name, det)
        (a, b, c), (d, e, f), (g, h, i) = r
        inverse_transposed = [
            [(e * i - f * h) / det, (f * g - d * i) / det, (d * h - e * g) / det],
            [(c * h - b * i) / det, (a * i - c * g) / det, (b * g - a * h) / det],
            [(b * f - c * e) / det, (c * d - a * f) / det, (a * e - b * d) / det],
        ]
        r = [[(x + y) / 2.0 for x, y in zip(*rows, strict=True)] for rows in zip(r, inverse_transposed, strict=True)]
        if _distance_from_rotation(r) < 1e-14:
            break
    return r


def _no_rotation(name: str, determinant: float) -> ConversionError:
    what = "a reflection" if determinant < 0 else "a singular matrix"
    return ConversionError(f"TRANSFORM {name!r}: found {what} (determinant {determinant:.3g}), expected a rotation")

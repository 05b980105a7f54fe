"""A robot: its links, the joints between them, and what a link looks like.

Lengths are in metres, angles in radians, quaternions x, y, z, w.  Limits are not part of it: a position is drawn as it
was measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.addon import StrEnum

Xyz = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class JointKind(StrEnum):
    """How a joint moves."""

    FIXED = "fixed"
    REVOLUTE = "revolute"
    CONTINUOUS = "continuous"
    PRISMATIC = "prismatic"
    PLANAR = "planar"  #: two positions: drawn at zero
    FLOATING = "floating"  #: six positions: drawn at zero


ROTATING = (JointKind.REVOLUTE, JointKind.CONTINUOUS)
MOVING = (*ROTATING, JointKind.PRISMATIC)


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint.

    Attributes:
        name, kind, parent, child: as in the URDF.
        xyz, quaternion: the joint in the frame of the parent link.
        axis: unit vector in the frame of the joint.
        driver: the joint whose position this joint mimics, through all mimic joints between them; "" = none.
        multiplier, offset: position = multiplier · position of the driver + offset.
        travel: lower and upper limit, for prismatic joints: drawn as a line.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    xyz: Xyz
    quaternion: Quaternion
    axis: Xyz
    driver: str = ""
    multiplier: float = 1.0
    offset: float = 0.0
    travel: tuple[float, float] = (0.0, 0.0)

    def pose(self, position: float) -> tuple[float, ...]:
        """Return the pose of the child link in the parent link, x, y, z and quaternion, at a position in rad or m."""
        if self.kind in ROTATING:
            half = position / 2
            x, y, z = (part * math.sin(half) for part in self.axis)
            return *self.xyz, *multiply(self.quaternion, (x, y, z, math.cos(half)))
        if self.kind is JointKind.PRISMATIC:
            step = rotate(self.quaternion, scaled(self.axis, position))
            return *(a + b for a, b in zip(self.xyz, step, strict=True)), *self.quaternion
        return *self.xyz, *self.quaternion


@dataclass(frozen=True, slots=True)
class Visual:
    """One body of a link.

    Attributes:
        shape: "box" (size x, y, z), "cylinder" (radius, length along z), "sphere" (radius) or "mesh" (scale x, y, z).
        size: see ``shape``, m; without a unit for the scale of a mesh.
        xyz, quaternion: the body in the frame of the link.
        colour: red, green, blue, alpha, 0 … 1; None if the URDF has none.
        uri: file of a mesh.
    """

    shape: str
    size: tuple[float, ...]
    xyz: Xyz
    quaternion: Quaternion
    colour: tuple[float, float, float, float] | None
    uri: str = ""


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot.

    Attributes:
        name: as in the URDF.
        root: the link without a parent.
        joints: all joints, parents before children.
        visuals: link → its bodies; a link without bodies is missing.
    """

    name: str
    root: str
    joints: tuple[Joint, ...]
    visuals: dict[str, tuple[Visual, ...]]


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the product of two quaternions x, y, z, w: the right rotation first."""
    a, b, c, d = left
    e, f, g, h = right
    return (
        d * e + a * h + b * g - c * f,
        d * f - a * g + b * h + c * e,
        d * g + a * f - b * e + c * h,
        (d * h - a * e - b * f - c * g),
    )


def rotate(quaternion: Sequence[float], point: Xyz) -> Xyz:
    """Return a point rotated by a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    rotated = multiply(multiply((x, y, z, w), (*point, 0.0)), (-x, -y, -z, w))
    return rotated[0], rotated[1], rotated[2]


def scaled(vector: Xyz, factor: float) -> Xyz:
    return vector[0] * factor, vector[1] * factor, vector[2] * factor

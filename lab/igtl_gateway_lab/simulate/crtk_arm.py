"""The arms of the CRTK scenario: a joint table, from which both the URDF text and the closed-form inverse come.

Each arm is dVRK-like: a remote centre of motion, yaw and pitch about it, an insertion, and a wrist of roll, pitch and
yaw whose axes meet in one point.  Names are those of dvrk_model with the arm in front (``PSM1_yaw``), because one URDF
has both arms.
Lengths are metres, angles radians.  With q = (yaw, pitch, insertion, roll, wrist pitch, wrist yaw) the tip is

    base · Ry(q0) · Rx(q1) · T(0, 0, -q2) · Rz(-q3) · Rx(q4) · Ry(q5) · T(0, 0, -TIP)

The sizes are those of a large needle driver, rounded; the places of the bases are an assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from igtl_gateway_lab.simulate.star_arm import quaternion
from igtl_gateway_lab.simulate.star_numbers import Array, rounded

TIP_M = 0.0102  #: from the wrist to the tip
STEP = 1e-9  #: rounding of what is published: equal on every machine

WORLD = "world"
Pose = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint of an arm: axis in its parent's frame, range (rad or m), highest speed (rad/s or m/s)."""

    name: str
    kind: str
    axis: tuple[int, int, int]
    low: float
    high: float
    speed: float


JOINTS = (
    Joint("yaw", "revolute", (0, 1, 0), -1.5708, 1.5708, 1.5),
    Joint("pitch", "revolute", (1, 0, 0), -0.9250, 0.9250, 1.5),
    Joint("insertion", "prismatic", (0, 0, -1), 0.0, 0.24, 0.4),
    Joint("roll", "revolute", (0, 0, -1), -4.5378, 4.5378, 4.0),
    Joint("wrist_pitch", "revolute", (1, 0, 0), -1.3963, 1.3963, 4.0),
    Joint("wrist_yaw", "revolute", (0, 1, 0), -1.3963, 1.3963, 4.0),
)
JAW = Joint("jaw", "revolute", (0, 1, 0), -0.3490, 1.3963, 4.0)


@dataclass(frozen=True, slots=True)
class Arm:
    """An arm: its namespace, and the place of its remote centre in ``WORLD``: offset, and turn about y."""

    name: str
    offset: tuple[float, float, float]
    turn: float

    def joint_names(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{joint.name}" for joint in JOINTS)

    def tip(self, joints: Array, *, local: bool = False) -> Pose:
        """Pose of the tip in ``WORLD``, or in the frame of the remote centre."""
        q = joints.tolist()
        frame = _shift(_turn_x(_turn_y(_BASE, q[0]), q[1]), -q[2])
        frame = _shift(_turn_y(_turn_x(_turn_z(frame, -q[3]), q[4]), q[5]), -TIP_M)
        if not local:
            rotation = _rotation_y(self.turn)
            frame = np.concatenate(
                (_product(rotation, frame[:, :3]), _product(rotation, frame[:, 3:]) + np.array(self.offset)[:, None]),
                axis=1,
            )
        x, y, z = rounded(frame[:, 3], STEP).tolist()
        a, b, c, w = rounded(quaternion(frame[:, :3]), STEP).tolist()
        return x, y, z, a, b, c, w

    def joints_of(self, tip: Pose) -> Array:
        """The joints that bring the tip to a pose in ``WORLD``.  Raises ValueError where there are none."""
        back = _rotation_y(-self.turn)
        rotation = _product(back, _matrix(tip[3:]))
        at = _product(back, (np.array(tip[:3]) - np.array(self.offset))[:, None])[:, 0]
        x, y, z = (at + TIP_M * rotation[:, 2]).tolist()
        depth = math.sqrt(x * x + y * y + z * z)
        if depth < 1e-6:
            raise ValueError(f"found a tip at the remote centre of {self.name}, expected one beyond it")
        yaw, pitch = math.atan2(-x, -z), math.asin(y / depth)
        wrist = _product(_product(_rotation_x(-pitch), _rotation_y(-yaw)), rotation)
        roll = -math.atan2(-wrist[0, 1], wrist[1, 1])
        bend, swing = math.asin(max(-1.0, min(1.0, wrist[2, 1]))), math.atan2(-wrist[2, 0], wrist[2, 2])
        found = np.array([yaw, pitch, depth, roll, bend, swing])
        for joint, value in zip(JOINTS, found.tolist(), strict=True):
            if not joint.low <= value <= joint.high:
                raise ValueError(
                    f"{self.name}_{joint.name}: found {value:.4f}, expected {joint.low:.4f} to {joint.high:.4f}"
                )
        return found


ARMS = (Arm("PSM1", (0.06, 0.0, 0.15), 0.35), Arm("PSM2", (-0.06, 0.0, 0.15), -0.35))


#: Name of a joint → length of the cylinder of its link along z, in metres.  The shaft always reaches the remote centre.
_LENGTHS = {"insertion": 0.26, "wrist_yaw": -TIP_M, "jaw": 0.012}


def urdf() -> str:
    """The text of /robot_description: both arms, with spheres and cylinders and without meshes."""
    parts = ['<?xml version="1.0"?>', '<robot name="dvrk_like">', f'  <link name="{WORLD}"/>']
    for arm in ARMS:
        base = f"{arm.name}_base"
        parts += _joint(f"{base}_fixed", "fixed", (WORLD, base), arm.offset, arm.turn) + _link(base, 0.012)
        parent = base
        for joint in (*JOINTS, None, JAW):
            if joint is None:  # the tip: jaw and tool frame are there
                child, origin = f"{arm.name}_tip", (0.0, 0.0, -TIP_M)
                parts += _joint(f"{child}_fixed", "fixed", (parent, child), origin)
            else:
                child = f"{arm.name}_{joint.name}_link"
                parts += _joint(f"{arm.name}_{joint.name}", joint.kind, (parent, child), row=joint)
            parts += _link(child, 0.004, _LENGTHS.get(joint.name if joint else "", 0.0))
            parent = child
    return "\n".join((*parts, "</robot>", ""))


def _joint(
    name: str,
    kind: str,
    links: tuple[str, str],
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn: float = 0.0,
    row: Joint | None = None,
) -> list[str]:
    lines = [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{links[0]}"/>',
        f'    <child link="{links[1]}"/>',
        f'    <origin xyz="{" ".join(map(repr, origin))}" rpy="0 {turn!r} 0"/>',
    ]
    if row:
        lines += [
            f'    <axis xyz="{" ".join(map(str, row.axis))}"/>',
            f'    <limit lower="{row.low!r}" upper="{row.high!r}" velocity="{row.speed!r}" effort="10"/>',
        ]
    return [*lines, "  </joint>"]


def _link(name: str, radius: float, length: float = 0.0) -> list[str]:
    shapes = [f'    <visual><geometry><sphere radius="{radius}"/></geometry></visual>']
    if length:
        shapes.append(
            f'    <visual><origin xyz="0 0 {length / 2!r}"/><geometry>'
            f'<cylinder radius="{radius / 2}" length="{abs(length)!r}"/></geometry></visual>'
        )
    return [f'  <link name="{name}">', *shapes, "  </link>"]


_BASE = np.eye(3, 4)


def _rotation_x(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _rotation_y(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _rotation_z(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _product(a: Array, b: Array) -> Array:
    """A matrix product that is written out: no BLAS, so that its last bit is the same everywhere."""
    return np.asarray((a[:, :, None] * b[None]).sum(axis=1))


def _turned(frame: Array, rotation: Array) -> Array:
    return np.concatenate((_product(frame[:, :3], rotation), frame[:, 3:]), axis=1)


def _turn_x(frame: Array, angle: float) -> Array:
    return _turned(frame, _rotation_x(angle))


def _turn_y(frame: Array, angle: float) -> Array:
    return _turned(frame, _rotation_y(angle))


def _turn_z(frame: Array, angle: float) -> Array:
    return _turned(frame, _rotation_z(angle))


def _shift(frame: Array, along_z: float) -> Array:
    moved = frame.copy()
    moved[:, 3] += along_z * frame[:, 2]
    return moved


def _matrix(q: tuple[float, ...]) -> Array:
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

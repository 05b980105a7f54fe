"""The arm of the STAR scene: where it stands, how it holds the needle, and the path of the needle's tip.

A KUKA-LWR-like arm brings the needle to each planned stitch: a straight approach to the entry point, an arc
under the surface to the exit point, a pull up the shaft; all moves are minimum-jerk.  Lengths are metres,
angles radians, times seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igtl_gateway_lab.simulate.star_numbers import Array, Noise, dot, rounded, unit_vectors
from igtl_gateway_lab.simulate.star_tissue import SuturePlan

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

TOOL_STEP_M = 1e-6
ROTATION_STEP = 1e-9

APPROACH_S, DRIVE_S, PULL_S = 1.0, 1.2, 1.0
CYCLE_S = APPROACH_S + DRIVE_S + PULL_S
BITE_DEPTH_M = 0.0025  #: how deep below its chord the needle passes
RETRACT_M = 0.030

HOME = np.array([-0.015, 0.055, -0.045])  #: from the first entry point: out of the picture, towards the arm

#: Camera pose in the base frame of the arm: rotation by columns (x, y, z of the camera), and position.
#: The camera looks down on the table, tilted by 8°, its lower edge towards the arm.
_TILT = np.deg2rad(8)
BASE_FROM_CAMERA = np.array(
    [
        [0.0, -np.cos(_TILT), -np.sin(_TILT), 0.660],
        [-1.0, 0.0, 0.0, 0.040],
        [0.0, np.sin(_TILT), -np.cos(_TILT), 0.430],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
#: Direction from the needle up the shaft, in the camera frame: towards the arm and towards the camera.
SHAFT = np.array([0.12, 0.74, -0.66]) / np.sqrt(0.12**2 + 0.74**2 + 0.66**2)

#: Axes x, y, z of the tool in the camera frame when it does not move; z points down the shaft, into the tissue.
_ACROSS = np.array([0.0, SHAFT[2], -SHAFT[1]]) / np.sqrt(SHAFT[1] ** 2 + SHAFT[2] ** 2)
_TOOL_AXES = (_ACROSS, np.cross(-SHAFT, _ACROSS), -SHAFT)
_DRIVE_TURN = 0.30  #: the wrist helps the needle by this much to either side


@dataclass(frozen=True)
class ToolPath:
    """The needle tip in the base frame: positions (n, 3), unit quaternions (n, 4) x y z w of continuous sign."""

    position: Array
    rotation: Array


@dataclass(frozen=True)
class Waypoints:
    """Without tremor: needle tip (camera frame, (n, 3)), turn about the incision and turn about the shaft."""

    tip: Array
    roll: Array
    yaw: Array


def waypoints(start: Array, plan: SuturePlan, times: Array) -> Waypoints:
    """Where the needle is meant to be, ``times`` seconds after the arm sets off from ``start`` to the first stitch."""
    here, facing = start, 0.0
    tip = np.broadcast_to(here, (len(times), 3)).copy()
    roll, yaw = np.zeros(len(times)), np.zeros(len(times))
    for number, (entry, leave) in enumerate(zip(plan.entry, plan.exit, strict=True)):
        since = times - number * CYCLE_S
        approach, drive = minimum_jerk(since / APPROACH_S), minimum_jerk((since - APPROACH_S) / DRIVE_S)
        pull = minimum_jerk((since - APPROACH_S - DRIVE_S) / PULL_S)
        turn = 0.06 * np.sin(1.7 * number + 0.5)
        path = here + (entry - here) * approach[:, None] + _needle_arc(entry, leave, drive) - entry
        tip = np.where(since[:, None] >= 0, path + RETRACT_M * SHAFT * pull[:, None], tip)
        roll = np.where(since >= 0, _DRIVE_TURN * (2 * drive - approach - pull), roll)
        yaw = np.where(since >= 0, facing + (turn - facing) * approach, yaw)
        here, facing = leave + RETRACT_M * SHAFT, turn
    return Waypoints(tip, roll, yaw)


def tool_path(way: Waypoints, times: Array, noise: Noise) -> ToolPath:
    """How the arm holds the needle on its way, with a little tremor (below 0.05 mm an axis)."""
    tremor = np.zeros((len(times), 5))
    for hertz, terms in zip((8.3, 9.7, 11.9), noise.uniform(3, 5, 2), strict=True):
        tremor += (0.5 + terms[:, 0]) * np.sin(2 * np.pi * (hertz * times[:, None] + terms[:, 1]))
    position = to_base(way.tip + 0.00001 * tremor[:, :3])
    camera, hold = quaternion(BASE_FROM_CAMERA[:3, :3]), quaternion(np.stack(_TOOL_AXES, -1))
    # products of small turns about one fixed pose: the sign cannot jump, so it needs no repair
    turned = _product(camera, _turn(0, way.roll + 0.0004 * tremor[:, 3]))
    rotation = _product(_product(turned, hold), _turn(2, way.yaw + 0.0004 * tremor[:, 4]))
    return ToolPath(rounded(position, TOOL_STEP_M), rounded(rotation, ROTATION_STEP))


def held(position: Vector, rotation: Quaternion) -> tuple[Array, Array]:
    """Of a tool pose in the base frame the needle's tip and the direction up the shaft, both in the camera frame."""
    x, y, z, w = rotation
    down = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    return to_camera(np.array(position)), np.stack([-dot(down, BASE_FROM_CAMERA[:3, i]) for i in range(3)])


def _needle_arc(entry: Array, leave: Array, part: Array) -> Array:
    """Points of the circle from ``entry`` to ``leave`` that dips ``BITE_DEPTH_M`` below the chord."""
    chord = leave - entry
    half = np.sqrt(dot(chord, chord)) / 2
    ahead = chord / (2 * half)
    up = unit_vectors(np.array([0.0, 0.0, -1.0]) + ahead[2] * ahead)
    radius = (half**2 + BITE_DEPTH_M**2) / (2 * BITE_DEPTH_M)
    angle = (2 * part - 1)[:, None] * np.arcsin(half / radius)
    return np.asarray(
        (entry + leave) / 2 + (radius - BITE_DEPTH_M - radius * np.cos(angle)) * up + radius * np.sin(angle) * ahead
    )


def minimum_jerk(part: Array) -> Array:
    """Smooth 0 → 1 with no speed and no acceleration at both ends."""
    t = np.clip(part, 0, 1)
    return t * t * t * (10 + t * (6 * t - 15))


def to_base(points: Array) -> Array:
    """Camera-frame points in the base frame of the arm."""
    rotation = BASE_FROM_CAMERA[:3, :3]
    return np.asarray(np.stack([dot(points, rotation[i]) for i in range(3)], -1) + BASE_FROM_CAMERA[:3, 3])


def to_camera(points: Array) -> Array:
    """Base-frame points in the camera frame."""
    rotation = BASE_FROM_CAMERA[:3, :3]
    return np.stack([dot(points - BASE_FROM_CAMERA[:3, 3], rotation[:, i]) for i in range(3)], -1)


def quaternion(rotation: Array) -> Array:
    """(x, y, z, w) of a rotation matrix whose angle is below 180°, or about x or y where it is near that."""
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    largest = int(np.argmax([rotation[0, 0], rotation[1, 1], rotation[2, 2], trace]))
    q = np.empty(4)
    if largest == 3:
        q[3] = 1 + trace
        q[0], q[1] = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0]
        q[2] = rotation[1, 0] - rotation[0, 1]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i] = 1 - trace + 2 * rotation[i, i]
        q[j], q[k] = rotation[j, i] + rotation[i, j], rotation[k, i] + rotation[i, k]
        q[3] = rotation[k, j] - rotation[j, k]
    return np.asarray(q / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2))


def _product(a: Array, b: Array) -> Array:
    ax, ay, az, aw = (a[..., i] for i in range(4))
    bx, by, bz, bw = (b[..., i] for i in range(4))
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        -1,
    )


def _turn(axis: int, angle: Array) -> Array:
    q = np.zeros((*angle.shape, 4))
    q[..., axis], q[..., 3] = np.sin(angle / 2), np.cos(angle / 2)
    return q

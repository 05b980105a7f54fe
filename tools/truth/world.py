"""What is true: the things of a world, as functions of time, and what a value shows about its own moment.

Time is in seconds of the world, lengths in millimetres, frames are right-handed (RAS for pictures).  Every value
shows which thing it is of and at which moment, so a judge needs no order of messages: positions are linear in time,
and a thing has a kilometre of its own on the x axis.  Linear movement and a rotation about one axis make interpolation
exact, and all coordinates are positive or of one sign, so that a flipped axis is far from every truth.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: UTC of the beginning of every world, ns.
BEGIN_NS = 1_700_000_000 * 10**9
#: Speed along x, mm/s: a millimetre is 25 ms.
SPEED = 40.0
_AWAY, _START = 1000.0, 100.0
_ORIGIN, _STEP, _SLOPE = (_START, 400.0, 200.0), (_AWAY, 7.0, 3.0), (SPEED, -30.0, 20.0)
_AXIS = np.array([1.0, 2.0, 2.0]) / 3
_CROSS = np.array([[0.0, -2.0, 2.0], [2.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]) / 3
_CROSS_TWICE = _CROSS @ _CROSS
_EYE = np.eye(3)

#: Size of the pictures; blocks of 8 x 8 pixels carry bits that survive a video codec.
WIDTH, HEIGHT = 64, 40
_BLOCK, _BITS = 8, 32
_MAGIC = b"USTRUTH\0"
_EXACT = struct.Struct("<8sq12f")
_EXACT_ROW = 36
#: Placement of the pictures: axes times spacing and the position of the middle, RAS mm.
SPACING = (0.4, 0.5, 1.0)
MIDDLE = (31.0, 47.0, 59.0)

DEPTH_WIDTH, DEPTH_HEIGHT = 32, 24
POINTS = 8
#: Positions of the plan by name, mm.
PLAN = {f"P{number}": (100.0 * number, 10.0 * number, float(number)) for number in range(1, 5)}
#: The static frame of the camera in the base of the robot, mm.
CAMERA_IN_BASE = (100.0, 200.0, 300.0)


def position(thing: int, at: float | Array) -> Array:
    """The position of a thing at a time, mm."""
    return np.array(_ORIGIN) + np.array(_STEP) * thing + np.multiply.outer(np.asarray(at, float), _SLOPE)


def rotation(thing: int, at: float) -> Array:
    """The rotation of a thing about one axis (3, 3)."""
    angle = 0.3 * at + 0.1 * thing
    return _EYE + math.sin(angle) * _CROSS + (1 - math.cos(angle)) * _CROSS_TWICE


def quaternion(thing: int, at: float) -> Array:
    """The same as x, y, z, w."""
    half = (0.3 * at + 0.1 * thing) / 2
    return np.array([*(np.sin(half) * _AXIS), np.cos(half)])


def pose(thing: int, at: float) -> Array:
    """The pose of a thing (4, 4), mm."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(thing, at)
    matrix[:3, 3] = position(thing, at)
    return matrix


def moment(place: Array) -> tuple[int, float, float]:
    """Which thing is at a position (mm), when (s), and how far from the truth the other coordinates are (mm)."""
    x, y, z = map(float, place)
    if not math.isfinite(x + y + z):
        return -1, 0.0, float("inf")
    thing = math.floor(x / _AWAY)
    at = (x - _AWAY * thing - _START) / SPEED
    off = max(
        abs(y - (_ORIGIN[1] + _STEP[1] * thing + _SLOPE[1] * at)),
        abs(z - (_ORIGIN[2] + _STEP[2] * thing + _SLOPE[2] * at)),
    )
    return thing, at, float(off)


def moment_of_pose(matrix: Array) -> tuple[int, float, float]:
    """The same of a pose (3 or 4, 4); the rotation counts as millimetres at a lever of 100 mm."""
    thing, at, off = moment(np.asarray(matrix)[:3, 3])
    if np.isfinite(off):
        off = max(off, float(np.abs(np.asarray(matrix)[:3, :3] - rotation(thing, at)).max()) * 100)
    return thing, at, off


def joints(arm: int, count: int, at: float) -> Array:
    """Angles of the joints of an arm, rad: ten radians for each joint of each arm."""
    return 40.0 * arm + 10.0 * np.arange(count) + 1 + 0.5 * at


def moment_of_joint(value: float) -> tuple[int, int, float]:
    """Arm, number of the joint and time of an angle."""
    number = int(value // 10)
    return number // 4, number % 4, (value - 10 * number - 1) / 0.5


def picture(thing: int, at_ns: int) -> Array:
    """A grey picture (40, 64) that carries its time in ns since the beginning, its thing and its pose."""
    pixels = np.full((HEIGHT, WIDTH), 30, np.uint8)
    code = (at_ns // 100_000) << 8 | thing
    for bit in range(_BITS):
        row, column = bit // 8 * _BLOCK, bit % 8 * _BLOCK
        pixels[row : row + _BLOCK, column : column + _BLOCK] = 220 if code >> bit & 1 else 30
    exact = _EXACT.pack(_MAGIC, at_ns, *pose(thing, at_ns / 1e9)[:3].ravel())
    pixels[_EXACT_ROW, : len(exact)] = np.frombuffer(exact, np.uint8)
    return pixels


def moment_of_picture(pixels: Array) -> tuple[int, float, float]:
    """Thing and time that a picture carries, and how far its own pose is from the truth, mm (inf: no such picture)."""
    row = np.asarray(pixels, np.uint8)[_EXACT_ROW, : _EXACT.size].tobytes()
    magic, at_ns, *numbers = _EXACT.unpack(row)
    if magic != _MAGIC:
        return -1, 0.0, float("inf")
    thing, at, off = moment_of_pose(np.array(numbers).reshape(3, 4))
    blocks, at_blocks = moment_of_video(pixels)
    same = blocks == thing and abs(at_blocks - at_ns / 1e9) < 2e-4 and abs(at - at_ns / 1e9) < 1e-3
    return thing, at_ns / 1e9, off if same else float("inf")


def moment_of_video(pixels: Array) -> tuple[int, float]:
    """Thing and time by the blocks alone, which a video codec keeps."""
    rows = _BITS // 8
    blocks = np.asarray(pixels)[: rows * _BLOCK].reshape(rows, _BLOCK, 8, _BLOCK)[:, 2:6, :, 2:6].mean((1, 3))
    code = int.from_bytes(np.packbits(blocks.ravel() > 125, bitorder="little").tobytes(), "little")
    return code & 255, (code >> 8) / 1e4


def depth(at: float) -> Array:
    """A ramp (24, 32) uint16, mm, whose first pixel is the time in ms after 400."""
    rows, columns = np.mgrid[:DEPTH_HEIGHT, :DEPTH_WIDTH]
    return (400 + round(at * 1000) + 10 * columns + 3 * rows).astype(np.uint16)


def moment_of_depth(pixels: Array) -> tuple[float, float]:
    """Time of a ramp, and how far its pixels are from it, mm."""
    at = (float(pixels[0, 0]) - 400) / 1000
    wrong = pixels.shape != (DEPTH_HEIGHT, DEPTH_WIDTH)
    return at, float("inf") if wrong else float(np.abs(pixels.astype(float) - depth(at)).max())


def cloud(thing: int, at: float) -> Array:
    """Points of a thing (8, 3), mm, no two coordinates of which can be exchanged."""
    steps = np.arange(POINTS)[:, None] * np.array([1.0, 2.0, 5.0])
    return position(thing, at) + steps


def moment_of_cloud(points: Array) -> tuple[int, float, float]:
    """Thing and time of a cloud, and how far its points are from it, mm."""
    if points.shape != (POINTS, 3):
        return -1, 0.0, float("inf")
    thing, at, off = moment(points[0])
    return thing, at, max(off, float(np.abs(points - cloud(thing, at)).max())) if np.isfinite(off) else off


def placement() -> Array:
    """From indices of pixels (column, row, slice) to RAS mm (3, 4), as the pictures of peers have it."""
    matrix = np.zeros((3, 4))
    # i along +A, j along -S, k along -R
    matrix[1, 0], matrix[2, 1], matrix[0, 2] = SPACING[0], -SPACING[1], -SPACING[2]
    half = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2, 0.0])
    matrix[:, 3] = np.array(MIDDLE) - matrix[:, :3] @ half
    return matrix

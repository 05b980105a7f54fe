"""A synthetic suturing scene in the manner of the Smart Tissue Autonomous Robot (STAR): geometry as arrays.

Everything here is **synthetic**: no patient, no animal, no file; formulas and a seed make it.  A bowel-like
tube of 15 mm radius with folds and a 30 mm incision lies 250 mm under a light-field camera, two further
loops and a cloth behind it.  A KUKA-LWR-like arm brings the needle to eleven planned stitches.

Ground truth stays reachable: ``Scene`` holds the true surface, the true plan and markers, and every
``CloudFrame`` its true points, so that a reviewer's tools can be judged against what really was there.
As on the real system, the plan is made from the noisy cloud; a wet spot that reads 2 mm too deep puts one
stitch beside the tissue until an operator corrects it (``measured_plan``, ``corrected_plan``).

Surfaces are distance functions and pictures are made by stepping along each pixel's ray.  Lengths are metres,
angles radians, times seconds; the camera frame is optical: x right, y down, z forward.

Same bytes everywhere: random numbers are sums of raw generator words (no library function whose last bit or
stream may change), dot products are written out (no BLAS), and what leaves here is rounded to a sensor's
step, which swallows the last bits of exp and arctan2 that differ between processors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rgb = NDArray[np.uint8]

SEED = 2017
FOCUS_M = 0.250  #: camera to the top of the tube, where the lens is focused
SENSOR_STEP_M = 2.0**-15  #: coordinates of clouds are multiples of this (31 µm, a sixth of the noise)
MARKER_STEP_M = 2.0**-20
TOOL_STEP_M = 1e-6
ROTATION_STEP = 1e-9

STITCHES = 11
STITCH_SPACING_M = 0.003
BITE_M = 0.0035  #: entry and exit lie this far from the incision, measured along the surface
INCISION_M = 0.030
WET_STITCH = 8  #: the exit point of this stitch lies in the wet spot
WET_RADIUS_M = 0.0016
WET_ERROR_M = 0.0020

IDLE_S, APPROACH_S, DRIVE_S, PULL_S = 0.8, 1.2, 1.4, 1.1
CYCLE_S = APPROACH_S + DRIVE_S + PULL_S
BITE_DEPTH_M = 0.0025  #: how deep below its chord the needle passes
RETRACT_M = 0.030


class Noise:
    """Random numbers that depend on the seed and a key only, bit by bit, with any numpy."""

    def __init__(self, *key: int) -> None:
        self._bits = np.random.PCG64(np.random.SeedSequence(key))

    def uniform(self, *shape: int) -> Array:
        """Numbers in [0, 1)."""
        words = np.asarray(self._bits.random_raw(int(np.prod(shape))), dtype=np.uint64)
        return (words >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53

    def normal(self, *shape: int) -> Array:
        """Nearly normal numbers of mean 0 and deviation 1: each the sum of eight 16-bit ones, so within ±4.9."""
        words = np.asarray(self._bits.random_raw(2 * int(np.prod(shape))), dtype="<u8")
        total = words.view("<u2").reshape(-1, 8).sum(axis=1, dtype=np.int64)
        return np.asarray((total - 4 * 65535) / (65536 * np.sqrt(8 / 12))).reshape(shape)

    def smooth(self, height: int, width: int, cell: int) -> Array:
        """As ``normal``, but neighbours within ``cell`` pixels are alike."""
        grid = self.normal(height // cell + 2, width // cell + 2)
        row, down = np.divmod(np.arange(height) / cell, 1)
        column, right = np.divmod(np.arange(width) / cell, 1)
        i, j = row.astype(int)[:, None], column.astype(int)[None, :]
        v, u = down[:, None], right[None, :]
        mixed = (1 - v) * ((1 - u) * grid[i, j] + u * grid[i, j + 1])
        mixed += v * ((1 - u) * grid[i + 1, j] + u * grid[i + 1, j + 1])
        return np.asarray(mixed / np.sqrt(((1 - v) ** 2 + v**2) * ((1 - u) ** 2 + u**2)))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def _unit(a: Array) -> Array:
    return a / np.sqrt(_dot(a, a))[..., None]


def _round(a: Array, step: float) -> Array:
    return np.rint(a / step) * step


# ---------------------------------------------------------------- tissue


@dataclass(frozen=True, slots=True)
class Tube:
    """A bent bowel-like tube in the camera frame.

    A point on it is named by ``along`` (metres along the axis) and ``arc`` (metres across, measured on the
    mean radius from the line nearest to the camera).
    """

    origin: tuple[float, float, float]
    heading: float  #: direction of the axis in the picture, radians from x towards y
    radius: float
    bend: float  #: sideways offset of the axis is bend · along²
    phase: float  #: shifts the folds, so that no two loops look alike
    incised: bool = False

    def locate(self, points: Array) -> tuple[Array, Array, Array]:
        """``(along, arc, distance from the axis)`` of camera-frame points."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        x, y, z = (points[..., i] - self.origin[i] for i in range(3))
        along = cos * x + sin * y
        side = cos * y - sin * x - self.bend * along**2
        return along, np.arctan2(side, -z) * self.radius, np.hypot(side, z)

    def radius_at(self, along: Array, arc: Array) -> Array:
        """The true radius: mean, haustra, transverse folds, wrinkles, and the incision with its lips."""
        angle = arc / self.radius
        radius = self.radius + 0.0006 * np.cos(along / 0.0052 + 0.5 * np.sin(2 * angle) + self.phase)
        radius += 0.00035 * np.cos(along / 0.0019 + 0.9 * np.sin(3 * angle + self.phase) + 2 * angle)
        radius += 0.00010 * np.sin(along / 0.0007 + 4 * np.sin(angle + 90 * along)) * np.cos(7 * angle + self.phase)
        if self.incised:
            opening, across = incision_opening(along), arc - incision_line(along)
            radius -= 0.0020 * opening * np.exp(-((across / (0.0004 + 0.0005 * opening)) ** 4))
            radius += 0.0003 * opening * np.exp(-(((np.abs(across) - 0.0016) / 0.0007) ** 2))
        return radius

    def surface(self, along: Array, arc: Array) -> Array:
        """Camera-frame points on the tube."""
        radius, angle = self.radius_at(along, arc), arc / self.radius
        side = radius * np.sin(angle) + self.bend * along**2
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        x, y = cos * along - sin * side, sin * along + cos * side
        return np.stack([self.origin[0] + x, self.origin[1] + y, self.origin[2] - radius * np.cos(angle)], -1)


def incision_opening(along: Array) -> Array:
    """How far the incision gapes: 1 in the middle, 0 from the ends on."""
    return np.sqrt(np.clip(1 - (2 * along / INCISION_M) ** 2, 0, 1))


def incision_line(along: Array) -> Array:
    """The incision wavers a little: its ``arc`` at ``along``."""
    return 0.0003 * np.sin(along / 0.0025) + 0.0002 * np.sin(along / 0.0011)


MAIN = Tube((0.0, 0.0, FOCUS_M + 0.015), 0.05, 0.015, 1.2, 0.4, incised=True)
LOOPS = (
    Tube((0.006, -0.029, FOCUS_M + 0.024), -0.22, 0.014, -3.0, 2.1),
    Tube((0.022, 0.030, FOCUS_M + 0.025), 0.35, 0.013, 6.0, 4.4),
)
TUBES = (MAIN, *LOOPS)
CLOTH = len(TUBES)  #: number of the material behind the tubes


def _cloth_depth(points: Array) -> Array:
    x, y = points[..., 0], points[..., 1]
    waves = 0.0015 * np.sin(x / 0.008 + 2 * np.sin(y / 0.012)) + 0.001 * np.cos(y / 0.005 + x / 0.011)
    return np.asarray(0.290 + waves)


def surface_distances(points: Array) -> Array:
    """Signed distance (roughly, never too far) to each material: ``TUBES``, then the cloth.  Inside is negative."""
    found = []
    for tube in TUBES:
        along, arc, reach = tube.locate(points)
        found.append(0.7 * (reach - tube.radius_at(along, arc)))
    found.append(0.7 * (_cloth_depth(points) - points[..., 2]))
    return np.stack(found)


def surface_distance(points: Array) -> Array:
    """Signed distance (roughly) of camera-frame points to the true surface; its zeros are the surface, exactly."""
    return np.asarray(surface_distances(points).min(axis=0))


def surface_normals(points: Array) -> Array:
    """Outward unit normals of the true surface at points on it."""
    step = 2e-5
    slopes = []
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        slopes.append(surface_distance(points + offset) - surface_distance(points - offset))
    return _unit(np.stack(slopes, -1))


# ---------------------------------------------------------------- camera


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera at the origin."""

    width: int
    height: int

    @property
    def focal_px(self) -> float:
        """The field is 70 mm wide at the focus."""
        return self.width * FOCUS_M / 0.070

    def rays(self) -> Array:
        """Directions of all pixels, (height, width, 3), scaled to z = 1."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - (self.width - 1) / 2) / self.focal_px, (v - (self.height - 1) / 2) / self.focal_px
        return np.stack([x, y, np.ones_like(x)], -1)

    def project(self, points: Array) -> Array:
        """Pixel coordinates (column, row) of camera-frame points."""
        centre = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        return np.asarray(points[..., :2] / points[..., 2:] * self.focal_px + centre)


CLOUD_CAMERA = Camera(200, 150)
IMAGE_CAMERA = Camera(320, 240)


def cast(rays: Array) -> Array:
    """True depth (z) where each ray meets the surface."""
    flat = rays.reshape(-1, 3)
    depth = np.full(len(flat), FOCUS_M - 0.010)
    moving = np.arange(len(flat))
    for _ in range(2000):  # most rays need a dozen steps, the few that graze a loop some hundreds
        gap = surface_distance(flat[moving] * depth[moving, None])
        depth[moving] += gap
        moving = moving[gap > 1e-7]  # a tenth of a micrometre: far below the sensor's step
        if not len(moving):
            break
    return depth.reshape(rays.shape[:-1])


@dataclass(frozen=True)
class View:
    """What a camera would see without noise and without the tool.

    Attributes:
        rays: pixel directions, z = 1.
        depth: true z.
        facing: cosine between the surface normal and the direction to the camera (0 = grazing).
        gloss: 0 … 1, strength of the specular reflection.
        rgb: colours, 0 … 1.
    """

    rays: Array
    depth: Array
    facing: Array
    gloss: Array
    rgb: Array


def see(camera: Camera, markers: Array, wet_spot: Array) -> View:
    """Look at the scene: depth, shading, texture, glue dots and the wet spot."""
    rays = camera.rays()
    depth = cast(rays)
    points = rays * depth[..., None]
    material = surface_distances(points).argmin(axis=0)
    normals = surface_normals(points)
    sight = -_unit(points)
    facing = np.clip(_dot(normals, sight), 0, 1)
    lamp = _unit(np.array([0.035, -0.030, 0.02]) - points)
    gloss = np.clip(_dot(normals, _unit(lamp + sight)), 0, 1) ** 150
    off_spot = points - wet_spot
    gloss = np.maximum(gloss, 0.55 * np.exp(-_dot(off_spot, off_spot) / (0.6 * WET_RADIUS_M) ** 2))
    rgb = np.empty((*depth.shape, 3))
    for number, tube in enumerate(TUBES):
        mask = material == number
        along, arc, _ = tube.locate(points[mask])
        rgb[mask] = tissue_colour(tube, along, arc)
    mask = material == CLOTH
    weave = 0.04 * np.sin(points[mask][:, 0] / 0.00045) * np.sin(points[mask][:, 1] / 0.00045)
    rgb[mask] = np.array([0.10, 0.34, 0.36]) + weave[:, None]
    light = (0.20 + 0.80 * np.clip(_dot(normals, lamp), 0, 1)) * np.clip(1.15 - (depth - FOCUS_M) / 0.055, 0.15, 1)
    rgb *= light[..., None]
    gloss = np.where(material == CLOTH, 0, gloss)
    rgb += 0.80 * gloss[..., None] * np.array([1.0, 0.98, 0.95])
    for marker in markers:
        off = points - marker
        dot = np.exp(-((_dot(off, off) / 0.0009**2) ** 3))[..., None]
        rgb = rgb * (1 - dot) + dot * np.array([0.72, 0.93, 0.76]) * light[..., None]
    return View(rays, depth, facing, gloss, np.clip(rgb, 0, 1))


def tissue_colour(tube: Tube, along: Array, arc: Array) -> Array:
    """Serosa with vessels that come round from both sides and branch, capillaries, and the cut's raw flesh."""
    noise = Noise(SEED, round(tube.phase * 10))
    vessels = np.zeros_like(along)
    for number, (shift, sway, turn, fork, girth) in enumerate(noise.uniform(18, 5)):
        depth = arc if number % 2 else -arc  # grows from the top line down the flank where the vessel comes from
        centre = -0.055 + 0.0065 * number + 0.005 * shift + (sway - 0.5) * 0.6 * arc
        centre += 0.0012 * np.sin(arc / 0.004 + 6.3 * turn) + 0.0004 * np.sin(arc / 0.0013 + 9 * turn)
        width = 0.00016 + np.clip(depth, 0, 0.02) * (0.012 + 0.014 * girth)
        start = 0.002 + 0.007 * fork
        strength = np.clip((depth - start + 0.004) / 0.004, 0, 1)
        for side in (-1, 1):
            branch = centre + side * 0.55 * np.clip(start + 0.006 - depth, 0, None)
            vessels = np.maximum(vessels, strength * np.exp(-(((along - branch) / width) ** 2)))
    mottle, veins = np.zeros_like(along), np.zeros_like(along)
    for a, b, c, d in noise.uniform(6, 4):
        mottle += np.sin((a - 0.5) * along / 0.0012 + (b - 0.5) * arc / 0.0012 + 6.3 * c) / 6
        veins += np.sin((c - 0.5) * along / 0.0004 + (d - 0.5) * arc / 0.0004 + 6.3 * a + 2 * mottle) / 6
    capillaries = np.exp(-((veins / 0.035) ** 2))
    rgb = np.array([0.86, 0.56, 0.50]) + mottle[..., None] * np.array([0.04, 0.07, 0.06])
    rgb -= 0.15 * capillaries[..., None] * np.array([0.10, 0.22, 0.20])
    rgb += vessels[..., None] * (np.array([0.60, 0.16, 0.19]) - rgb) * 0.75
    if tube.incised:
        opening = incision_opening(along)
        wound = np.abs(arc - incision_line(along))
        lips = opening * np.exp(-((wound / 0.0017) ** 4))
        cut = np.where(opening > 0, np.exp(-((wound / (0.0002 + 0.0006 * opening)) ** 4)), 0)
        rgb += lips[..., None] * (np.array([0.80, 0.34, 0.30]) - rgb) * 0.5
        rgb += cut[..., None] * (np.array([0.30, 0.03, 0.04]) - rgb)
    return np.asarray(rgb)


def noise_sigma(depth: Array, facing: Array) -> Array:
    """Deviation of measured depth: 0.18 mm at the focus, growing with z² and towards grazing."""
    return np.asarray(0.00018 * (depth / FOCUS_M) ** 2 / np.clip(facing, 0.05, 1) ** 0.7)


# ---------------------------------------------------------------- arm

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


def to_base(points: Array) -> Array:
    """Camera-frame points in the base frame of the arm."""
    rotation = BASE_FROM_CAMERA[:3, :3]
    return np.asarray(np.stack([_dot(points, rotation[i]) for i in range(3)], -1) + BASE_FROM_CAMERA[:3, 3])


def to_camera(points: Array) -> Array:
    """Base-frame points in the camera frame."""
    rotation = BASE_FROM_CAMERA[:3, :3]
    return np.stack([_dot(points - BASE_FROM_CAMERA[:3, 3], rotation[:, i]) for i in range(3)], -1)


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


def minimum_jerk(part: Array) -> Array:
    """Smooth 0 → 1 with no speed and no acceleration at both ends."""
    t = np.clip(part, 0, 1)
    return t * t * t * (10 + t * (6 * t - 15))


# ---------------------------------------------------------------- the scene


@dataclass(frozen=True)
class Plan:
    """Stitches in the camera frame: ``entry[i]`` → ``exit[i]``, each (STITCHES, 3)."""

    entry: Array
    exit: Array


@dataclass(frozen=True)
class CloudFrame:
    """One shot of the depth camera.

    Attributes:
        points: measured, (150, 200, 3) float32, NaN where the camera gave no depth.
        rgb: (150, 200, 3) uint8.
        truth: the true points, the tool included.
        tool: where the tool is in the way.
        outlier: grossly wrong depth.
    """

    points: NDArray[np.float32]
    rgb: Rgb
    truth: Array
    tool: Mask
    outlier: Mask


@dataclass(frozen=True)
class ToolPath:
    """The needle tip in the base frame: positions (n, 3), unit quaternions (n, 4) x y z w of continuous sign."""

    position: Array
    rotation: Array


class Scene:
    """The whole synthetic scene of one seed.  Everything is computed on demand and equal on every call.

    Attributes:
        plan: the true plan, on the true surface.
        markers: the true centres of the six glue dots that shine in the near infrared.
    """

    def __init__(self, seed: int = SEED) -> None:
        self._seed = seed
        self.plan = _true_plan()
        self.markers = _true_markers()

    @property
    def cloud_view(self) -> View:
        """The undisturbed scene in the pixels of the depth camera."""
        return _undisturbed(CLOUD_CAMERA)

    @property
    def image_view(self) -> View:
        """The undisturbed scene in the pixels of the colour camera."""
        return _undisturbed(IMAGE_CAMERA)

    def cloud(self, number: int, time_s: float) -> CloudFrame:
        """Shot ``number`` of the depth camera, with the tool where it is at ``time_s``."""
        return self._measure(number, *self._tool_in_view(self.cloud_view, time_s))

    def _measure(self, number: int, hidden: Mask, near: Array, shade: Array) -> CloudFrame:
        """Shot ``number`` with a tool in view at ``hidden`` of depth ``near`` and grey level ``shade``."""
        view, noise = self.cloud_view, Noise(self._seed, 1, number)
        height, width = view.depth.shape
        shape = (height, width)
        depth = np.where(hidden, near, view.depth)
        facing = np.where(hidden, 0.5, view.facing)
        measured = depth + noise_sigma(depth, facing) * (
            0.8 * noise.normal(*shape) + 0.6 * noise.smooth(height, width, 5)
        )
        off_spot = view.rays * depth[..., None] - self.plan.exit[WET_STITCH]
        measured += np.where(_dot(off_spot, off_spot) < WET_RADIUS_M**2, WET_ERROR_M, 0)
        outlier = noise.uniform(*shape) < 0.002
        measured += np.where(outlier, 0.004 * noise.normal(*shape), 0)
        # what a light-field camera loses: steep flanks, glare, blur far from the focus, metal, and a little of all
        blur = np.clip((np.abs(depth - FOCUS_M) - 0.020) / 0.025, 0, 1)
        loss = np.clip(0.015 + 0.75 * blur + np.where(hidden, 0.6, 0), 0, 1)
        lost = (noise.uniform(*shape) < loss) | (facing < 0.28)
        lost |= ~hidden & (view.gloss > 0.6)
        lost |= noise.smooth(height, width, 6) < -2.9
        points = _round(view.rays * measured[..., None], SENSOR_STEP_M)
        points[lost] = np.nan
        rgb = np.where(hidden[..., None], shade[..., None], view.rgb)
        return CloudFrame(points.astype(np.float32), _bytes(rgb), view.rays * depth[..., None], hidden, outlier & ~lost)

    def image(self, number: int, time_s: float) -> Rgb:
        """Picture ``number`` of the colour camera, (240, 320, 3), with the tool where it is at ``time_s``."""
        view = self.image_view
        hidden, _, shade = self._tool_in_view(view, time_s)
        rgb = np.where(hidden[..., None], shade[..., None], view.rgb)
        return _bytes(rgb + 0.002 * Noise(self._seed, 2, number).normal(*rgb.shape))

    def detected_markers(self, number: int) -> Array:
        """Marker positions as found in the near-infrared picture ``number``: (6, 3), error mostly along the ray."""
        noise = Noise(self._seed, 3, number)
        across = 0.00005 * noise.normal(*self.markers.shape)
        along = 0.00015 * noise.normal(len(self.markers), 1) * self.markers / FOCUS_M
        return _round(self.markers + across + along, MARKER_STEP_M)

    @cached_property
    def measured_plan(self) -> Plan:
        """The plan as drawn in the picture and lifted by the first cloud: one stitch misses the tissue."""
        frame = self._measure(0, *_draw_tool(self.cloud_view, self.plan.entry[0] + _HOME, SHAFT))
        return Plan(_lift(frame, self.plan.entry), _lift(frame, self.plan.exit))

    @cached_property
    def corrected_plan(self) -> Plan:
        """The measured plan after the operator has put the stray exit point back on the tissue."""
        exit_points = self.measured_plan.exit.copy()
        exit_points[WET_STITCH] = _round(self.plan.exit[WET_STITCH], MARKER_STEP_M)
        return Plan(self.measured_plan.entry, exit_points)

    def tool(self, times: Array) -> ToolPath:
        """Where the arm holds the needle tip, in the base frame, ``times`` seconds after the start.

        Each stitch takes ``CYCLE_S``: a straight approach to the entry point, an arc under the surface to the
        exit point, a pull up the shaft; minimum-jerk moves with a little tremor (below 0.05 mm an axis).
        """
        tip, roll, yaw = self._waypoints(times)
        tremor = np.zeros((len(times), 5))
        for hertz, terms in zip((8.3, 9.7, 11.9), Noise(self._seed, 4).uniform(3, 5, 2), strict=True):
            tremor += (0.5 + terms[:, 0]) * np.sin(2 * np.pi * (hertz * times[:, None] + terms[:, 1]))
        position = to_base(tip + 0.00001 * tremor[:, :3])
        camera, hold = quaternion(BASE_FROM_CAMERA[:3, :3]), quaternion(np.stack(_TOOL_AXES, -1))
        # products of small turns about one fixed pose: the sign cannot jump, so there is none to mend
        turned = _product(camera, _turn(0, roll + 0.0004 * tremor[:, 3]))
        rotation = _product(_product(turned, hold), _turn(2, yaw + 0.0004 * tremor[:, 4]))
        return ToolPath(_round(position, TOOL_STEP_M), _round(rotation, ROTATION_STEP))

    def _waypoints(self, times: Array) -> tuple[Array, Array, Array]:
        """Needle tip (camera frame), turn about the incision and turn about the shaft, without tremor."""
        plan = self.corrected_plan
        here, facing = self.plan.entry[0] + _HOME, 0.0
        tip = np.broadcast_to(here, (len(times), 3)).copy()
        roll, yaw = np.zeros(len(times)), np.zeros(len(times))
        for number, (entry, leave) in enumerate(zip(plan.entry, plan.exit, strict=True)):
            since = times - IDLE_S - number * CYCLE_S
            approach, drive = minimum_jerk(since / APPROACH_S), minimum_jerk((since - APPROACH_S) / DRIVE_S)
            pull = minimum_jerk((since - APPROACH_S - DRIVE_S) / PULL_S)
            turn = 0.06 * np.sin(1.7 * number + 0.5)
            path = here + (entry - here) * approach[:, None] + _needle_arc(entry, leave, drive) - entry
            tip = np.where(since[:, None] >= 0, path + RETRACT_M * SHAFT * pull[:, None], tip)
            roll = np.where(since >= 0, _DRIVE_TURN * (2 * drive - approach - pull), roll)
            yaw = np.where(since >= 0, facing + (turn - facing) * approach, yaw)
            here, facing = leave + RETRACT_M * SHAFT, turn
        return tip, roll, yaw

    def _tool_in_view(self, view: View, time_s: float) -> tuple[Mask, Array, Array]:
        """Where the tool hides the scene at ``time_s``; its depth; its grey level."""
        tip, roll, _ = self._waypoints(np.array([time_s]))
        return _draw_tool(view, tip[0], _about_x(SHAFT, roll[0]))


def _true_plan() -> Plan:
    along = np.asarray(np.arange(STITCHES) - (STITCHES - 1) / 2, np.float64) * STITCH_SPACING_M
    bite: Array = np.full(STITCHES, BITE_M)
    return Plan(MAIN.surface(along, -bite), MAIN.surface(along, bite))


def _true_markers() -> Array:
    end = INCISION_M / 2
    return MAIN.surface(
        np.array([-end - 0.005, end + 0.005, -end, end, -end, end]),
        np.array([0, 0, -0.007, -0.007, 0.007, 0.007]),
    )


@cache
def _undisturbed(camera: Camera) -> View:
    """The same for all seeds, and the slow part: kept, and so not to be written to."""
    view = see(camera, _true_markers(), _true_plan().exit[WET_STITCH])
    for array in vars(view).values():
        array.flags.writeable = False
    return view


#: Axes x, y, z of the tool in the camera frame when it is held at rest; z points down the shaft, into the tissue.
_ACROSS = np.array([0.0, SHAFT[2], -SHAFT[1]]) / np.sqrt(SHAFT[1] ** 2 + SHAFT[2] ** 2)
_TOOL_AXES = (_ACROSS, np.cross(-SHAFT, _ACROSS), -SHAFT)
_HOME = np.array([-0.015, 0.055, -0.045])  #: from the first entry point: out of the picture, towards the arm
_DRIVE_TURN = 0.30  #: the wrist helps the needle by this much to either side


def _about_x(vector: Array, angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([vector[0], cos * vector[1] - sin * vector[2], sin * vector[1] + cos * vector[2]])


def _needle_arc(entry: Array, leave: Array, part: Array) -> Array:
    """Points of the circle from ``entry`` to ``leave`` that dips ``BITE_DEPTH_M`` below the chord."""
    chord = leave - entry
    half = np.sqrt(_dot(chord, chord)) / 2
    ahead = chord / (2 * half)
    up = _unit(np.array([0.0, 0.0, -1.0]) + ahead[2] * ahead)
    radius = (half**2 + BITE_DEPTH_M**2) / (2 * BITE_DEPTH_M)
    angle = (2 * part - 1)[:, None] * np.arcsin(half / radius)
    return np.asarray(
        (entry + leave) / 2 + (radius - BITE_DEPTH_M - radius * np.cos(angle)) * up + radius * np.sin(angle) * ahead
    )


def _draw_tool(view: View, tip: Array, shaft: Array) -> tuple[Mask, Array, Array]:
    """Jaw and shaft as round bars from ``tip`` along ``shaft``: where they show, their depth, their grey level."""
    sight = _unit(view.rays)
    depth, shade = np.full(view.depth.shape, np.inf), np.zeros(view.depth.shape)
    for first, last, radius in ((0.0005, 0.014, 0.0011), (0.014, 0.120, 0.0025)):
        lean, forward, along = _dot(sight, shaft), _dot(sight, tip), _dot(shaft, tip)
        place = np.clip((lean * forward - along) / (1 - lean**2), first, last)
        axis = tip + place[..., None] * shaft
        reach = _dot(sight, axis)
        bulge = np.sqrt(np.clip(1 - (_dot(axis, axis) - reach**2) / radius**2, 0, 1))
        front = np.where(bulge > 0, (reach - radius * bulge) * sight[..., 2], np.inf)
        shade = np.where(front < depth, 0.12 + 0.35 * bulge + 0.35 * bulge**12, shade)
        depth = np.minimum(depth, front)
    return depth < view.depth, depth, shade


def _lift(frame: CloudFrame, points: Array) -> Array:
    """Points drawn in the picture, at the median depth of the 5 by 5 pixels around them."""
    lifted = []
    for pixel, point in zip(CLOUD_CAMERA.project(points), points, strict=True):
        column, row = (int(value) for value in np.rint(pixel))
        depth = np.nanmedian(frame.points[row - 2 : row + 3, column - 2 : column + 3, 2].astype(np.float64))
        lifted.append(point / point[2] * depth)
    return _round(np.array(lifted), MARKER_STEP_M)


def _bytes(rgb: Array) -> Rgb:
    """As a sensor of seven bits gives it (the eighth would be noise, and noise is what makes recordings large)."""
    return 2 * np.rint(np.clip(rgb, 0, 1) * 127).astype(np.uint8)

"""The tissue of the STAR scene: tubes and a cloth as distance functions, their colours, the true plan and markers.

Lengths are metres, in the optical frame of the camera: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igtl_gateway_lab.simulate.star_numbers import SEED, Array, Noise, unit_vectors

FOCUS_M = 0.250  #: camera to the top of the tube, where the lens is focused

STITCHES = 11
STITCH_SPACING_M = 0.003
BITE_M = 0.0035  #: entry and exit lie this far from the incision, measured along the surface
INCISION_M = 0.030

#: Planted errors of the measured plan.  Stitches count from 0 here, from 1 wherever people read them.
GLINT_STITCH = 2  #: a glint lies on the entry point of this stitch: in the first shot, and in no other
GLINT_ERROR_M = -0.0020  #: the camera reads it too near
WET_STITCH = 8  #: the exit point of this stitch lies in a wet spot: in every shot
WET_ERROR_M = 0.0020  #: the camera reads it too far away
SPOT_RADIUS_M = 0.0016  #: of either
#: Numbers (from 1) of the stitches that the measured plan has at a wrong depth; all others lie on the tissue.
PLANTED = (GLINT_STITCH + 1, WET_STITCH + 1)


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
    return unit_vectors(np.stack(slopes, -1))


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


@dataclass(frozen=True)
class SuturePlan:
    """Stitches in the camera frame: ``entry[i]`` → ``exit[i]``, each (STITCHES, 3)."""

    entry: Array
    exit: Array


def true_plan() -> SuturePlan:
    """The stitches on the true surface."""
    along = np.asarray(np.arange(STITCHES) - (STITCHES - 1) / 2, np.float64) * STITCH_SPACING_M
    bite: Array = np.full(STITCHES, BITE_M)
    return SuturePlan(MAIN.surface(along, -bite), MAIN.surface(along, bite))


def true_markers() -> Array:
    """The centres of the six glue dots that shine in the near infrared, around the incision."""
    end = INCISION_M / 2
    return MAIN.surface(
        np.array([-end - 0.005, end + 0.005, -end, end, -end, end]),
        np.array([0, 0, -0.007, -0.007, 0.007, 0.007]),
    )

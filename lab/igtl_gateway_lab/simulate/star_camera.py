"""The cameras of the STAR scene: what they would see, the tool in the way, and what their sensors make of it.

Pictures are made by stepping along each pixel's ray until it meets the surface.  Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igtl_gateway_lab.simulate.star_numbers import Array, Mask, Noise, Rgb, dot, rounded, unit_vectors
from igtl_gateway_lab.simulate.star_tissue import (
    CLOTH,
    FOCUS_M,
    SPOT_RADIUS_M,
    TUBES,
    surface_distance,
    surface_distances,
    surface_normals,
    tissue_colour,
)

_ARRIVED_M = 1e-7  # a tenth of a micrometre: far below the sensor's step
_NEAR_M = 2e-4  # within a fifth of a millimetre the surface is nearly flat
SENSOR_STEP_M = 2.0**-15  #: coordinates of clouds are multiples of this (31 µm, a sixth of the noise)


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
    """True depth (z) where each ray meets the surface.

    A step as long as the distance never goes too far; near the surface the secant of the last two saves most of them.
    """
    flat = rays.reshape(-1, 3)
    depth = np.full(len(flat), FOCUS_M - 0.010)
    moving = np.arange(len(flat))
    last_gap, last_step = np.ones(len(flat)), np.zeros(len(flat))
    for _ in range(2000):  # most rays need a dozen steps, the few that graze a loop some hundreds
        gap = surface_distance(flat[moving] * depth[moving, None])
        far = np.abs(gap) > _ARRIVED_M
        moving, gap = moving[far], gap[far]
        if not len(moving):
            break
        nearer = last_gap[moving] - gap
        secant = gap * last_step[moving] / np.where(nearer == 0, 1, nearer)
        trusted = (np.abs(gap) < _NEAR_M) & (secant * gap > 0) & (np.abs(secant) < 20 * np.abs(gap))
        step = np.where(trusted, secant, gap)
        last_gap[moving], last_step[moving] = gap, step
        depth[moving] += step
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


def render_view(camera: Camera, markers: Array, wet_spot: Array) -> View:
    """Look at the scene: depth, shading, texture, glue dots and the wet spot."""
    rays = camera.rays()
    depth = cast(rays)
    points = rays * depth[..., None]
    material = surface_distances(points).argmin(axis=0)
    normals = surface_normals(points)
    sight = -unit_vectors(points)
    facing = np.clip(dot(normals, sight), 0, 1)
    lamp = unit_vectors(np.array([0.035, -0.030, 0.02]) - points)
    gloss = np.clip(dot(normals, unit_vectors(lamp + sight)), 0, 1) ** 150
    gloss = np.maximum(gloss, shine(points, wet_spot))
    rgb = np.empty((*depth.shape, 3))
    for number, tube in enumerate(TUBES):
        mask = material == number
        along, arc, _ = tube.locate(points[mask])
        rgb[mask] = tissue_colour(tube, along, arc)
    mask = material == CLOTH
    weave = 0.04 * np.sin(points[mask][:, 0] / 0.00045) * np.sin(points[mask][:, 1] / 0.00045)
    rgb[mask] = np.array([0.10, 0.34, 0.36]) + weave[:, None]
    light = (0.20 + 0.80 * np.clip(dot(normals, lamp), 0, 1)) * np.clip(1.15 - (depth - FOCUS_M) / 0.055, 0.15, 1)
    rgb *= light[..., None]
    gloss = np.where(material == CLOTH, 0, gloss)
    rgb += glare(gloss)
    for marker in markers:
        off = points - marker
        glue = np.exp(-((dot(off, off) / 0.0009**2) ** 3))[..., None]
        rgb = rgb * (1 - glue) + glue * np.array([0.72, 0.93, 0.76]) * light[..., None]
    return View(rays, depth, facing, gloss, np.clip(rgb, 0, 1))


def shine(points: Array, spot: Array) -> Array:
    """How strongly a wet spot reflects at points near it: less than what costs the camera its depth."""
    off_spot = points - spot
    return np.asarray(0.55 * np.exp(-dot(off_spot, off_spot) / (0.6 * SPOT_RADIUS_M) ** 2))


def glare(gloss: Array) -> Array:
    """The lamp's colour, as it is added to what reflects it."""
    return np.asarray(0.80 * gloss[..., None] * np.array([1.0, 0.98, 0.95]))


def noise_sigma(depth: Array, facing: Array) -> Array:
    """Deviation of measured depth: 0.18 mm at the focus, growing with z² and towards grazing."""
    return np.asarray(0.00018 * (depth / FOCUS_M) ** 2 / np.clip(facing, 0.05, 1) ** 0.7)


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
class ToolView:
    """Where the tool hides the scene; its depth (inf elsewhere); its grey level, 0 … 1."""

    hidden: Mask
    depth: Array
    shade: Array

    def over(self, rgb: Array) -> Array:
        """The colours with the tool in front."""
        return np.where(self.hidden[..., None], self.shade[..., None], rgb)


def draw_tool(view: View, tip: Array, shaft: Array) -> ToolView:
    """Jaw and shaft as round bars from ``tip`` along ``shaft``."""
    sight = unit_vectors(view.rays)
    depth, shade = np.full(view.depth.shape, np.inf), np.zeros(view.depth.shape)
    for first, last, radius in ((0.0005, 0.014, 0.0011), (0.014, 0.120, 0.0025)):
        lean, forward, along = dot(sight, shaft), dot(sight, tip), dot(shaft, tip)
        place = np.clip((lean * forward - along) / (1 - lean**2), first, last)
        axis = tip + place[..., None] * shaft
        reach = dot(sight, axis)
        bulge = np.sqrt(np.clip(1 - (dot(axis, axis) - reach**2) / radius**2, 0, 1))
        front = np.where(bulge > 0, (reach - radius * bulge) * sight[..., 2], np.inf)
        shade = np.where(front < depth, 0.12 + 0.35 * bulge + 0.35 * bulge**12, shade)
        depth = np.minimum(depth, front)
    return ToolView(depth < view.depth, depth, shade)


def depth_shot(
    view: View, rgb: Array, tool: ToolView, spots: Sequence[tuple[Array, float]], noise: Noise
) -> CloudFrame:
    """A shot of the depth camera: noise, outliers, spots that read too far or too near, and gaps.

    Args:
        view: the undisturbed scene.
        rgb: its colours in this shot.
        tool: what hides it.
        spots: places on the tissue, and the error of the depth there.
        noise: random numbers of this shot.
    """
    hidden, (height, width) = tool.hidden, view.depth.shape
    depth = np.where(hidden, tool.depth, view.depth)
    facing = np.where(hidden, 0.5, view.facing)
    grain = 0.8 * noise.normal(height, width) + 0.6 * noise.smooth(height, width, 5)
    measured = depth + noise_sigma(depth, facing) * grain
    truth = view.rays * depth[..., None]
    for spot, error in spots:
        off_spot = truth - spot
        measured += np.where(dot(off_spot, off_spot) < SPOT_RADIUS_M**2, error, 0)
    outlier = noise.uniform(height, width) < 0.002
    measured += np.where(outlier, 0.004 * noise.normal(height, width), 0)
    # what a light-field camera loses: steep flanks, glare, blur far from the focus, metal, and a little of all
    blur = np.clip((np.abs(depth - FOCUS_M) - 0.020) / 0.025, 0, 1)
    loss = np.clip(0.015 + 0.75 * blur + np.where(hidden, 0.6, 0), 0, 1)
    lost = (noise.uniform(height, width) < loss) | (facing < 0.28)
    lost |= ~hidden & (view.gloss > 0.6)
    lost |= noise.smooth(height, width, 6) < -2.9
    points = rounded(view.rays * measured[..., None], SENSOR_STEP_M)
    points[lost] = np.nan
    return CloudFrame(points.astype(np.float32), seven_bits(tool.over(rgb)), truth, hidden, outlier & ~lost)


def seven_bits(rgb: Array) -> Rgb:
    """Colours (0 … 1) of seven bits: the eighth would be noise, and noise is what makes recordings large."""
    return 2 * np.rint(np.clip(rgb, 0, 1) * 127).astype(np.uint8)

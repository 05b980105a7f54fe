"""Simulated depth cameras with a known true depth: five kinds of noise, three shapes of surface, any distance.

They share no code with the review, so that a mistake in its noise model is not repeated here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from igtl_gateway.addons.review.model import Array

#: Function of the true depth (height, width) in metres and a random source; returns the readings, NaN = no depth.
Sensor = Callable[[Array, np.random.Generator], Array]

_BLUR_PX = 2.0
_BASELINE_FOCAL_M = 0.045 * 600  # baseline × focal length, m · px: a short-range stereo head


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with the viewing direction z."""

    height: int = 120
    width: int = 160
    focal_px: float = 600.0

    def rays(self) -> Array:
        """Return (height, width, 2) x / z and y / z of each pixel."""
        u, v = np.meshgrid(np.arange(self.width) - self.width / 2, np.arange(self.height) - self.height / 2)
        return np.stack([u, v], -1) / self.focal_px


@dataclass(frozen=True)
class Sphere:
    """A sphere of tissue, or a plane if the curvature is 0, through ``(0, 0, distance)``.

    Attributes:
        distance: metres along z.
        normal: unit vector towards the camera.
        curvature: 1 / radius in 1 / metres; positive = convex towards the camera.
    """

    distance: float
    normal: tuple[float, float, float]
    curvature: float = 0.0

    def depth(self, rays: Array) -> Array:
        """Return z on (…, 2) rays.  With P = z (u, v, 1), O = (0, 0, distance), n the normal and k the curvature:
        k |P − O|² + 2 n · (P − O) = 0."""
        n, k, far = np.array(self.normal), self.curvature, self.distance
        way = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], -1)
        a = k * (way**2).sum(-1)
        b = 2 * (way @ n) - 2 * k * far
        c = k * far**2 - 2 * n[2] * far
        return np.asarray(2 * c / (-b + np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))))

    def normal_at(self, point: Array) -> Array:
        """Return the unit vector perpendicular to the surface, towards the camera."""
        found = np.array(self.normal) + self.curvature * (point - np.array([0, 0, self.distance]))
        return np.asarray(found / np.sqrt((found**2).sum()))


def surface(kind: str, distance: float) -> Sphere:
    """Return a surface: *flat*, *tilted* by 35°, or *curved* (radius: three tenths of the distance, 25 mm or more)."""
    tilt = np.radians(35.0)
    match kind:
        case "flat":
            return Sphere(distance, (0.0, 0.0, -1.0))
        case "tilted":
            return Sphere(distance, (float(np.sin(tilt) * 0.8), float(np.sin(tilt) * 0.6), float(-np.cos(tilt))))
        case _:
            return Sphere(distance, (0.2, 0.0, -float(np.sqrt(0.96))), 1 / max(0.025, 0.3 * distance))


def white(depth: Array, random: np.random.Generator) -> Array:
    """Independent Gaussian noise, 0.2 mm at 250 mm, growing linearly."""
    return np.asarray(depth + 0.0008 * depth * random.standard_normal(depth.shape))


def quantised(depth: Array, random: np.random.Generator) -> Array:
    """Gaussian noise of 0.25 mm, then integer millimetres, as in a 16-bit depth image."""
    return np.asarray(np.round((depth + 0.00025 * random.standard_normal(depth.shape)) * 1000) / 1000)


def disparity(depth: Array, random: np.random.Generator) -> Array:
    """Stereo: noise of 0.06 px and steps of 1/16 px in the disparity, so both grow with z²."""
    found = _BASELINE_FOCAL_M / depth + 0.06 * random.standard_normal(depth.shape)
    return np.asarray(_BASELINE_FOCAL_M / np.maximum(np.round(found * 16) / 16, 1 / 16))


def smoothed(depth: Array, random: np.random.Generator) -> Array:
    """Noise blurred over the image (Gaussian of 2 px), as after block matching and filters; 0.3 mm at 250 mm."""
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / _BLUR_PX) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    noise = random.standard_normal((*depth.shape[:-2], depth.shape[-2] + 16, depth.shape[-1] + 16))
    for axis in (-2, -1):
        length = noise.shape[axis] - 16
        noise = sum(
            weight * np.take(noise, np.arange(shift, shift + length), axis) for shift, weight in enumerate(kernel)
        )
    return np.asarray(depth + 0.0012 * depth * noise)


def speckle(depth: Array, random: np.random.Generator) -> Array:
    """Heavy tails (Student's t of 3 degrees), 3 % gross errors too deep (multipath), 15 % without depth."""
    found = depth + 0.0006 * depth * random.standard_t(3, depth.shape)
    wild = random.random(depth.shape) < 0.03
    found = np.where(wild, depth * (1 + 0.03 * random.random(depth.shape)), found)
    return np.asarray(np.where(random.random(depth.shape) < 0.15, np.nan, found))


SENSORS: dict[str, Sensor] = {
    "white": white,
    "quantised": quantised,
    "disparity": disparity,
    "smoothed": smoothed,
    "speckle": speckle,
}
SURFACES = ("flat", "tilted", "curved")
DISTANCES_MM = (60, 120, 250, 500, 745, 1000)


def shots(camera: Camera, depth: Array, sensor: Sensor, clouds: int, random: np.random.Generator) -> Array:
    """Return (clouds, height, width, 3) float32 points, as in messages."""
    read = sensor(np.broadcast_to(depth, (clouds, *depth.shape)), random)
    way = np.concatenate([camera.rays(), np.ones((camera.height, camera.width, 1))], -1)
    return np.asarray((way * read[..., None]).astype(np.float32))

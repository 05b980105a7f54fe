"""Distances of points on a known surface, as computed by the review, with their errors."""

from __future__ import annotations

import numpy as np

from igtl_gateway.addons.review.model import Array
from igtl_gateway.addons.review.scene import DepthCloud, DepthScene
from igtl_gateway.addons.review.surface import fit
from tests.addons.review.sensors import SENSORS, Camera, shots, surface

WINDOW = 0.004
_MM = 1000.0


def covered(sensor: str, kind: str, distance_mm: int, clouds: int, scenes: int, points: int, seed: int = 0) -> Array:
    """Return (scenes · points, 2): distance of a point of the true surface, and its standard error, mm."""
    camera, found = Camera(), []
    for number in range(scenes):
        random = np.random.default_rng([seed, number, distance_mm, *sensor.encode(), *kind.encode()])
        shape = surface(kind, distance_mm / _MM + random.uniform(-0.004, 0.004))
        seen = shots(camera, shape.depth(camera.rays()), SENSORS[sensor], clouds, random)
        scene = DepthScene.of([DepthCloud("/cloud", "camera", i + 1, i + 1, points) for i, points in enumerate(seen)])
        for _ in range(points):
            ray = random.uniform(-1, 1, 2) * np.array([0.3 * camera.width, 0.28 * camera.height]) / camera.focal_px
            point = np.append(ray, 1.0) * shape.depth(ray)
            fitted = fit(scene, point, WINDOW)
            if fitted is not None:
                slant = float(fitted.slant(ray[None])[0])
                found.append((_MM * float(fitted.distance(point[None])[0]), _MM * fitted.error / slant))
    return np.array(found).reshape(-1, 2)

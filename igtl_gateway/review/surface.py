"""The tissue around a point: depth as a quadric over the viewing rays, fitted so that gross errors do not count.

The error of a camera lies along its rays, so depth is fitted over the rays and the distance is then taken at a
right angle to the fitted surface.  The place itself has no say in the first rounds (``_SILENT``): whether its
reading is right is just the question, and a planned point was lifted from that very reading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.review import error, noise
from igtl_gateway.review.linear import Design
from igtl_gateway.review.scene import DepthScene
from igtl_gateway.review.steps import UNIFORM_VARIANCE

Array = npt.NDArray[Any]

_TUKEY = 4.685  # deviations; from here on a point has no weight
_FIRST_ROUNDS, _ROUNDS = 4, 6
_SILENT = (0.0, 0.5, 0.7)  # shares of the radius within which points have no say in the first rounds
_MIN_POINTS = 24
_WANTED_POINTS = 40  # with fewer the window is made wider, ...
_WIDENS, _WIDEST = 1.2, 3.0  # ... step by step, up to so many times
_ROUGH_M = 1.5e-4  # tissue that a quadric does not follow: wrinkles
_DOUBT = 3.0  # the figures of the noise may be too small by so much
_LEAST_SCALE_M = 1e-5  # a scatter below the steps of any sensor


@dataclass(frozen=True, slots=True)
class TissueSurface:
    """z = c₀ + c₁ p + c₂ q + c₃ p² + c₄ p q + c₅ q², with (p, q) = (ray − ``ray``) / ``radius``.

    Attributes:
        ray: (x / z, y / z) of the middle.
        radius: of the window, as x / z.
        coefficients: (6,) metres.
        error: standard error of the depth in the middle, metres: 1.96 of them hold the truth in 95 of 100 cases.
        reading: standard deviation of single readings of one cloud about the surface, metres.
    """

    ray: Array
    radius: float
    coefficients: Array
    error: float
    reading: float

    def depth(self, rays: Array) -> Array:
        """(n,) z of the surface on (n, 2) rays."""
        return _design((rays - self.ray) / self.radius).values(self.coefficients)

    def slant(self, rays: Array) -> Array:
        """(n,) length on the ray's own z for each unit at a right angle to the surface: 1 where it is looked at
        squarely, more where it is steep."""
        _, b, c, d, e, f = self.coefficients
        p, q = ((rays - self.ray) / self.radius).T
        along_u, along_v = (b + 2 * d * p + e * q) / self.radius, (c + e * p + 2 * f * q) / self.radius
        z = self.depth(rays)
        # normal of the surface z (u, v) · (u, v, 1), up to its length; its product with the ray is z
        forward = z + along_u * rays[:, 0] + along_v * rays[:, 1]
        slant: Array = np.sqrt(along_u**2 + along_v**2 + forward**2) / z
        return slant

    def distance(self, points: Array) -> Array:
        """(n,) signed distance of (n, 3) points, metres: + on the camera's side, − under the surface."""
        rays = points[:, :2] / points[:, 2:]
        distance: Array = (self.depth(rays) - points[:, 2]) / self.slant(rays)
        return distance


def fit(scene: DepthScene, point: Array, window: float) -> TissueSurface | None:
    """The tissue around a point (3,), from all clouds; None where there are too few points around.

    Args:
        scene: the clouds.
        point: metres; its depth gives the scale of the window and nothing else.
        window: radius, metres.
    """
    if not point[2] > 0:
        return None
    ray, radius = point[:2] / point[2], window / point[2]
    around, radius = _window(scene, ray, radius)
    if len(around) < _MIN_POINTS:
        return None
    places = (scene.rays[around] - ray) / radius
    z = scene.depth[around]
    design = _design(places)
    scale = _expected_scatter(scene, around)
    found = _robust(design, places, z, scale)
    if found is None:
        return None
    coefficients, weights = found
    if scale is not None and 2 * float(np.median(scene.steps.at(z))) > scale:
        # of readings that flip between two values the rarer one is no gross error: all that are kept count alike
        weights = (weights > 0).astype(np.float64)
        kept = design.solve(z, weights)
        if kept is None:
            return None
        coefficients = kept
    spread = design.influence(weights)
    if spread is None:
        return None
    fitted = design.values(coefficients)
    off = (scene.depths[:, around] - fitted)[:, weights > 0]
    step = scene.steps.at(fitted)
    reading = max(noise.deviation(off) ** 2, UNIFORM_VARIANCE * float((step**2).mean()), _LEAST_SCALE_M**2) ** 0.5
    return TissueSurface(
        ray, radius, coefficients, error.of_depth(scene, ray, radius, around, spread[0], fitted), reading
    )


def _window(scene: DepthScene, ray: Array, radius: float) -> tuple[Array, float]:
    """Pixels with a depth around a ray, and the radius that they lie within: more where pixels are few."""
    widest = _WIDEST * radius
    while True:
        around = scene.around(ray, radius)
        around = around[np.isfinite(scene.depth[around])]
        if len(around) >= _WANTED_POINTS or radius >= widest:
            return around, radius
        radius = min(radius * _WIDENS, widest)


def _expected_scatter(scene: DepthScene, pixels: Array) -> float | None:
    """Standard deviation of the picture at some pixels about a surface; None where unknown."""
    sigma = scene.noise[pixels]
    known = np.isfinite(sigma)
    if not known.any():
        return None
    variance = sigma[known] ** 2
    lasting = UNIFORM_VARIANCE * scene.steps.at(scene.depth[pixels][known]) ** 2
    picture = np.median((variance - lasting) / len(scene.depths) + lasting)
    return float(np.sqrt(picture + _ROUGH_M**2))


def _robust(design: Design, places: Array, z: Array, scale: float | None) -> tuple[Array, Array] | None:
    """(6,) coefficients and (n,) weights by iterated weighted least squares, Tukey's biweight.

    A place that reads wrong pulls the surface to itself if it is heard from the beginning.  So the first rounds are
    made several times, without larger and larger middles; the surface that most of the window lies on wins.

    Args:
        design: of the quadric at the places.
        places: (n, 2) in radii of the window.
        z: (n,) metres.
        scale: how far z may be expected off the surface, as standard deviation; None if unknown.
    """
    square = (places**2).sum(axis=1)
    all_heard = np.ones(len(z), np.bool_)
    starts = []
    for silent in _SILENT:
        counted = square >= silent**2
        if np.count_nonzero(counted) >= _MIN_POINTS:
            start = _iterated(design, z, counted.astype(np.float64), counted, None, _FIRST_ROUNDS)
            if start is not None:
                starts.append(start)
    if not starts:
        return None
    # of noise that neighbours share the camera's figures know too little
    scatter = min(_scatter(z - design.values(coefficients)) for coefficients, _ in starts)
    scale = scatter if scale is None else max(scale, scatter / _DOUBT)
    cut = _TUKEY * scale
    residuals = [z - design.values(coefficients) for coefficients, _ in starts]
    lost = [float((np.minimum(np.abs(off), cut) ** 2).sum()) for off in residuals]
    return _iterated(design, z, _weights(residuals[lost.index(min(lost))], scale), all_heard, scale, _ROUNDS)


def _iterated(
    design: Design, z: Array, weights: Array, counted: Array, scale: float | None, rounds: int
) -> tuple[Array, Array] | None:
    """Some rounds of reweighting, by ``scale`` or what the points show; who is not ``counted`` stays without weight."""
    coefficients = None
    for _ in range(rounds):
        coefficients = design.solve(z, weights)
        if coefficients is None:
            return None
        residuals = z - design.values(coefficients)
        weights = _weights(residuals, scale or _scatter(residuals[counted])) * counted
    return None if coefficients is None else (coefficients, weights)


def _scatter(residuals: Array) -> float:
    return max(noise.MAD * float(np.median(np.abs(residuals))), _LEAST_SCALE_M)


def _weights(residuals: Array, scale: float) -> Array:
    weights: Array = np.clip(1 - (residuals / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return weights


def _design(places: Array) -> Design:
    p, q = places[:, 0], places[:, 1]
    return Design(np.stack([np.ones_like(p), p, q, p * p, p * q, q * q]))

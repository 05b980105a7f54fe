"""The tissue around a point: depth as a quadric over the viewing rays, fitted robustly.

The error of a camera is along its rays, so depth is fitted over the rays, and the distance is perpendicular to the
fitted surface.  The fit also starts without the inner part of the window (``_LEFT_OUT``): the planned point was
computed from the reading that is to be judged, so the fit must not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review import error, noise
from igtl_gateway.addons.review.linear import Design
from igtl_gateway.addons.review.scene import DepthScene
from igtl_gateway.addons.review.steps import UNIFORM_VARIANCE

Array = npt.NDArray[Any]

_TUKEY = 4.685  # standard deviations from which a point has no weight
_FIRST_ROUNDS, _ROUNDS = 4, 6
_LEFT_OUT = (0.0, 0.5, 0.7)  # inner parts of the window, as shares of the radius, that the first rounds leave out
_MIN_POINTS = 24
_ENOUGH_POINTS = 40  # with fewer points the window is enlarged, …
_ENLARGE, _MAX_ENLARGE = 1.2, 3.0  # … by this factor each time, and at most by this factor in total
_ROUGH_M = 1.5e-4  # wrinkles that a quadric cannot represent, as standard deviation
_NOISE_MARGIN = 3.0  # factor by which the known noise might be too small
_LEAST_SCALE_M = 1e-5  # minimum of a scatter: below the steps of any sensor


@dataclass(frozen=True, slots=True)
class TissueSurface:
    """The quadric z = c₀ + c₁ p + c₂ q + c₃ p² + c₄ p q + c₅ q², with (p, q) = (ray − ``ray``) / ``radius``.

    Attributes:
        ray: (x / z, y / z) of the centre.
        radius: of the window, as x / z.
        coefficients: (6,) metres.
        error: standard error of the depth in the centre, metres: the true depth is within 1.96 standard errors in 95
            of 100 cases.
        reading: standard deviation of single readings of one cloud about the surface, metres.
    """

    ray: Array
    radius: float
    coefficients: Array
    error: float
    reading: float

    def depth(self, rays: Array) -> Array:
        """Return the (n,) z of the surface on (n, 2) rays, metres."""
        return _design((rays - self.ray) / self.radius).values(self.coefficients)

    def slant(self, rays: Array) -> Array:
        """Return the (n,) ratios of a difference in z along the ray to the distance perpendicular to the surface.

        The ratio is 1 on the optical axis if the surface is perpendicular to it, and grows with the slope.
        """
        _, b, c, d, e, f = self.coefficients
        p, q = ((rays - self.ray) / self.radius).T
        along_u, along_v = (b + 2 * d * p + e * q) / self.radius, (c + e * p + 2 * f * q) / self.radius
        z = self.depth(rays)
        # the normal of the surface z(u, v) · (u, v, 1), not normalised; its product with the ray is z
        forward = z + along_u * rays[:, 0] + along_v * rays[:, 1]
        slant: Array = np.sqrt(along_u**2 + along_v**2 + forward**2) / z
        return slant

    def distance(self, points: Array) -> Array:
        """Return the (n,) distances of (n, 3) points, metres: positive on the camera's side, negative below."""
        rays = points[:, :2] / points[:, 2:]
        distance: Array = (self.depth(rays) - points[:, 2]) / self.slant(rays)
        return distance


def fit(scene: DepthScene, point: Array, window: float) -> TissueSurface | None:
    """Return the tissue around a point, from all clouds; None if there are too few readings around it.

    Args:
        scene: the clouds.
        point: (3,) metres, in optical axes; its depth only scales the window.
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
        # if readings alternate between two steps, the rarer one is not a gross error: equal weights
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
    """Return the pixels with a depth around a ray, and the radius, which is enlarged if there are few pixels."""
    largest = _MAX_ENLARGE * radius
    while True:
        around = scene.around(ray, radius)
        around = around[np.isfinite(scene.depth[around])]
        if len(around) >= _ENOUGH_POINTS or radius >= largest:
            return around, radius
        radius = min(radius * _ENLARGE, largest)


def _expected_scatter(scene: DepthScene, pixels: Array) -> float | None:
    """Return the expected standard deviation of the depth image about a surface, metres; None if unknown."""
    sigma = scene.noise[pixels]
    known = np.isfinite(sigma)
    if not known.any():
        return None
    variance = sigma[known] ** 2
    constant = UNIFORM_VARIANCE * scene.steps.at(scene.depth[pixels][known]) ** 2
    expected = np.median((variance - constant) / len(scene.depths) + constant)
    return float(np.sqrt(expected + _ROUGH_M**2))


def _robust(design: Design, places: Array, z: Array, scale: float | None) -> tuple[Array, Array] | None:
    """Return (6,) coefficients and (n,) weights, from iterated least squares with Tukey's biweight.

    A wrong reading in the centre attracts the surface if the first rounds include it.  Therefore there are several
    starts, which leave out larger and larger inner parts of the window.  The iteration continues from the surface that
    most of the window supports.

    Args:
        design: of the quadric at the places.
        places: (n, 2) positions in radii of the window.
        z: (n,) metres.
        scale: expected standard deviation of z about the surface, metres; None if unknown.
    """
    square = (places**2).sum(axis=1)
    starts = []
    for inner in _LEFT_OUT:
        counted = square >= inner**2
        if np.count_nonzero(counted) >= _MIN_POINTS:
            start = _iterated(design, z, counted.astype(np.float64), counted, None, _FIRST_ROUNDS)
            if start is not None:
                starts.append(start)
    if not starts:
        return None
    # the known noise can be too small if neighbours share it
    scatter = min(_scatter(z - design.values(coefficients)) for coefficients, _ in starts)
    scale = scatter if scale is None else max(scale, scatter / _NOISE_MARGIN)
    cut = _TUKEY * scale
    residuals = [z - design.values(coefficients) for coefficients, _ in starts]
    costs = [float((np.minimum(np.abs(off), cut) ** 2).sum()) for off in residuals]
    best = residuals[costs.index(min(costs))]
    return _iterated(design, z, _weights(best, scale), np.ones(len(z), np.bool_), scale, _ROUNDS)


def _iterated(
    design: Design, z: Array, weights: Array, counted: Array, scale: float | None, rounds: int
) -> tuple[Array, Array] | None:
    """Return coefficients and weights after some rounds of reweighting.

    Without a ``scale`` the scatter of the ``counted`` points is used.  Other points have no weight.
    """
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

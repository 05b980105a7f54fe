"""Standard error of the fitted depth: of the surface from the tissue, in the centre of the window.

There is no assumption about the correlation between neighbouring pixels.  The fit is linear: its depth is a weighted
sum of the readings.  The same weights are applied at positions around the point, where they give the result that the
fit would have there:

* applied to the difference between each cloud and the depth image, they show the random part of the error, with all
  correlation between pixels;
* applied with half the width to the residuals of a surface of fourth order, they also show what is equal in every
  cloud: patterns of the sensor, and wrinkles that the surface cannot represent.  Half the width, because in a larger
  window the shape of the tissue itself would count as a pattern.

The part of quantised depth is computed by formula (``steps.bias``), because a window between two steps does not show
it.  Pixels are averaged in cells of a tenth of the window first, so the time does not depend on the resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review import noise, steps
from igtl_gateway.addons.review.linear import Design, times
from igtl_gateway.addons.review.scene import DepthScene

Array = npt.NDArray[Any]

#: Half of the interval that contains the true value in 95 of 100 cases, in standard errors.
SURE_95 = 1.96
_CELL = 0.1  # side of a cell, in radii of the applied weights
_RANDOM_REACH = 2.5  # radius of the area for the random part, in radii of the window
_NARROW, _NARROW_PX = 0.5, 6.0  # radius of the weights for patterns: in radii of the window, and at least in pixels
_PATTERN_REACH, _PATTERN_PX = 3.0, 18.0  # radius of their area: in their radii, and at least in pixels (sensor grain)
_MAX_REACH = 7.0  # its maximum, in their radii
_RANDOM_RINGS = ((0.0, 1), (0.6, 5), (1.0, 8))  # positions: share of the largest offset of the weights, count
_DEGREES_PER_CLOUD = 6  # degrees of freedom that each cloud adds: positions that do not overlap
_PATTERN_RINGS = ((0.0, 1), (0.35, 5), (0.7, 8), (1.0, 11))
_MIN_PLACES = 8
_ROUNDS = 5
_TUKEY = 4.685
_LEAST_M = 1e-7
_NOTABLE = 1.5  # a pattern counts from this ratio of its variance to the expected one
_CHANCE = 4.0  # divided by √pixels: excess of a variance that chance explains, as share of the variance
_MISFIT = 0.25  # share of the excess scatter that is the variance of the misfit in the centre: found by experiment
_MIN_LEFT = 0.1  # share of a variance that the wider surface must not absorb
_LOPSIDED = 1.0  # sum of squared weights above which a position is at an edge
_CENTRE = np.array([1.0, 0, 0, 0, 0, 0])
_SHIFTS = np.arange(16) / 16  # positions between two steps


@dataclass(frozen=True, slots=True)
class DepthCells:
    """Readings around a position, averaged in cells.

    Attributes:
        number: (cells,) number of pixels.
        places: (cells, 2) mean offset of their rays, in radii.
        depth: (cells,) mean z of the depth image, metres.
        changes: (clouds, cells) contribution of each cloud to the error of that mean, metres.
    """

    number: Array
    places: Array
    depth: Array
    changes: Array

    @classmethod
    def around(cls, scene: DepthScene, ray: Array, radius: float, reach: float) -> DepthCells:
        """Return the cells of the pixels within ``reach`` radii of a ray."""
        pixels = scene.around(ray, reach * radius)
        pixels = pixels[np.isfinite(scene.depth[pixels])]
        off = (scene.rays[pixels] - ray) / radius
        side = 2 * int(reach / _CELL) + 3
        column, row = (np.floor(off / _CELL).astype(np.int64) + side // 2).T
        _, cell = np.unique(row * side + column, return_inverse=True)
        number = np.bincount(cell).astype(np.float64)
        counted, depth = scene.counted[:, pixels], scene.depth[pixels]
        share = 1 / np.maximum(counted.sum(axis=0), 1)
        changes = np.where(counted, scene.depths[:, pixels] - depth, 0.0) * share
        return cls(
            number,
            np.stack([np.bincount(cell, off[:, axis]) / number for axis in (0, 1)], axis=1),
            np.bincount(cell, depth - depth.mean()) / number,
            np.stack([np.bincount(cell, change) / number for change in changes]),
        )


def of_depth(scene: DepthScene, ray: Array, radius: float, pixels: Array, influence: Array, fitted: Array) -> float:
    """Return the standard error of a surface's depth in the centre, metres.

    The true depth is within 1.96 standard errors in 95 of 100 cases.

    Args:
        scene: the clouds.
        ray: (x / z, y / z) of the centre.
        radius: of the window, as x / z.
        pixels: (n,) numbers of the pixels that the surface was fitted to.
        influence: (n,) weight of each of them in the depth of the centre.
        fitted: (n,) z of the surface at these pixels, metres.
    """
    off = scene.depth[pixels] - fitted
    single = max(noise.deviation(off[influence != 0]), _LEAST_M)
    white = float((influence**2).sum())
    random = _random_variance(DepthCells.around(scene, ray, radius, _RANDOM_REACH))
    pitch = sqrt(np.pi / len(pixels))  # of the pixels, in radii
    narrow = min(max(_NARROW, _NARROW_PX * pitch), 1.0)
    reach = min(max(_PATTERN_REACH, _PATTERN_PX * pitch / narrow), _MAX_REACH)
    pattern, bias = _pattern(DepthCells.around(scene, ray, narrow * radius, reach), reach, 1 / narrow)
    rounding = _rounding(scene, pixels, influence, fitted)
    base = white * (single**2 if random is None else random * _student_factor(len(scene.depths)))
    excess = _excess_variance(scene, pixels, np.where(influence != 0, off, np.nan))
    misfit = max(bias**2, _MISFIT * excess)
    expected = base + misfit + float((rounding**2).mean())
    if pattern is not None and white * pattern > _NOTABLE * expected:
        return sqrt(white * pattern + bias**2)
    return _half_width(rounding, sqrt(base + misfit)) / SURE_95


def _random_variance(cells: DepthCells) -> float | None:
    """Return the variance of a pixel of the depth image from changes between clouds; None for one cloud.

    Correlated noise counts with the share that a fit does not average out.
    """
    clouds = len(cells.changes)
    found = expected = 0.0
    for place in _places(_RANDOM_RINGS, _RANDOM_REACH - 1.0):
        applied = _weights_at(cells, place, cells.number, 1.0)
        if applied is not None:
            inside, weight = applied
            found += float((times(cells.changes[:, inside], weight) ** 2).sum())
            expected += float((weight**2 / cells.number[inside]).sum())
    return clouds / (clouds - 1) * found / expected if clouds > 1 and expected > 0 else None


def _student_factor(clouds: int) -> float:
    """Return the factor for a variance from few readings, so that 1.96 of its roots still cover 95 %.

    For n degrees of freedom the 95 % point of Student's t is about 1.96 + 2.4 / n.
    """
    return (1 + 2.4 / SURE_95 / (_DEGREES_PER_CLOUD * (clouds - 1))) ** 2


def _excess_variance(scene: DepthScene, pixels: Array, off: Array) -> float:
    """Return the variance of the depth image about the surface beyond its noise, or 0 if chance explains it.

    The excess is the shape of the tissue that a quadric cannot represent.

    Args:
        scene: the clouds.
        pixels: (n,) numbers of the pixels of the window.
        off: (n,) z of the depth image minus z of the surface, metres; NaN for pixels that do not count.
    """
    counts = np.isfinite(off) & np.isfinite(scene.noise[pixels])
    if not counts.any():
        return 0.0
    step = scene.steps.at(scene.depth[pixels[counts]])
    clouds = np.maximum(scene.counted[:, pixels[counts]].sum(axis=0), 1)
    constant = steps.UNIFORM_VARIANCE * step**2
    noisy = float(((scene.noise[pixels[counts]] ** 2 - constant) / clouds + constant).mean())
    found = noise.deviation(off) ** 2
    return found - noisy if found > noisy * (1 + _CHANCE / sqrt(np.count_nonzero(counts))) else 0.0


def _pattern(cells: DepthCells, reach: float, window: float) -> tuple[float | None, float]:
    """Return the variance of a pixel from the residuals of a wider surface, and the bias of the quadric.

    The variance is None if too few positions determine it.  The bias is the difference between a quadric over the
    window and the wider surface in the centre, metres.

    Args:
        cells: around the point.
        reach: radius of their area, in radii of the cells.
        window: radius of the window, in radii of the cells.
    """
    wide = Design(_quartic(cells.places / reach))
    fit = _wider_fit(wide, cells)
    if fit is None:
        return None, 0.0
    left, weights, coefficients = fit
    found, expected, bias = [], [], 0.0
    applied = _weights_at(cells, np.zeros(2), weights, min(window, reach))
    if applied is not None:
        inside, weight = applied
        bias = float((weight * wide.values(coefficients)[inside]).sum() - coefficients[0])
    places = [_weights_at(cells, place, weights, 1.0) for place in _places(_PATTERN_RINGS, reach - 1.0)]
    fitted = [applied for applied in places if applied is not None]
    functionals = [times(wide.columns[:, inside], weight) for inside, weight in fitted]
    absorbed = wide.variances(np.stack(functionals), weights) if fitted else None
    if absorbed is None:
        return None, bias
    for (inside, weight), lost in zip(fitted, absorbed.tolist(), strict=True):
        alone = float((weight**2 / cells.number[inside]).sum())
        if alone - lost > _MIN_LEFT * alone:
            found.append(float((weight * left[inside]).sum()) ** 2)
            expected.append(alone - lost)
    return (sum(found) / sum(expected) if len(found) >= _MIN_PLACES else None), bias


def _weights_at(cells: DepthCells, place: Array, weights: Array, radius: float) -> tuple[Array, Array] | None:
    """Return the cells around a position, and the weight of each of them in a quadric's depth there.

    Returns None at an edge, where the fit would be lopsided.
    """
    off = (cells.places - place) / radius
    inside = np.flatnonzero((off**2).sum(axis=1) <= 1.0)
    weight = Design(_quadric(off[inside])).weights_of(_CENTRE, weights[inside]) if len(inside) else None
    if weight is None or float((weight**2).sum()) > _LOPSIDED:
        return None
    return inside, weight


def _wider_fit(wide: Design, cells: DepthCells) -> tuple[Array, Array, Array] | None:
    """Fit the wider surface robustly; return its residuals, the weight of each cell, and its coefficients."""
    weights = cells.number
    coefficients: Array | None = None
    left = cells.depth
    for _ in range(_ROUNDS):
        coefficients = wide.solve(cells.depth, weights)
        if coefficients is None:
            return None
        left = cells.depth - wide.values(coefficients)
        # the noise of a cell's mean decreases with the number of its pixels, but not below the correlated part
        scale = max(noise.MAD * float(np.median(np.abs(left))), _LEAST_M)
        weights = cells.number * np.clip(1 - (left / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return None if coefficients is None else (left, weights, coefficients)


def _rounding(scene: DepthScene, pixels: Array, influence: Array, fitted: Array) -> Array:
    """Return the (16,) biases of the centre by quantised depth, metres, for 16 positions between two steps."""
    step = scene.steps.at(fitted)
    if not (step > 0).all():
        return np.zeros(len(_SHIFTS))
    middle = float(np.median(step))
    phase = (fitted - fitted.mean()) * 2 / (step + middle)
    return steps.bias(step, scene.before_rounding * step, phase, influence, _SHIFTS)


def _half_width(shifts: Array, sigma: float) -> float:
    """Return h such that a normal number plus one of the shifts is within ±h in 95 of 100 cases."""
    sigma = max(sigma, _LEAST_M)
    low, high = 0.0, float(np.abs(shifts).max()) + 3 * sigma
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        inside = sum(
            erf((middle - shift) / (sigma * sqrt(2))) + erf((middle + shift) / (sigma * sqrt(2))) for shift in shifts
        ) / (2 * len(shifts))
        low, high = (middle, high) if inside < 0.95 else (low, middle)
    return high


def _places(rings: tuple[tuple[float, int], ...], reach: float) -> list[Array]:
    """Return the offsets of the positions of all rings from the centre, in radii."""
    places = []
    for share, number in rings:
        angle = 2 * np.pi * (np.arange(number) + share) / number
        places += list(share * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return places


def _quadric(places: Array) -> Array:
    p, q = places[:, 0], places[:, 1]
    return np.stack([np.ones_like(p), p, q, p * p, p * q, q * q])


def _quartic(places: Array) -> Array:
    p, q = places[:, 0], places[:, 1]
    return np.stack(
        [p**i * q**j for order in range(5) for i, j in zip(range(order, -1, -1), range(order + 1), strict=True)]
    )

"""Standard error of the fitted depth: how far the surface in the middle of the window may be off the tissue.

Nothing is assumed of how the noise of neighbouring pixels hangs together.  The fit is linear in its readings, with
one weight for each, so the same weights are laid over places all around, where they give what the fit would have
given there:

* over what each cloud has besides the picture they show how much the fit changes by chance, grain and all;
* laid half as wide over what a surface of fourth order leaves of the picture, they show what is the same in every
  cloud as well: patterns of the sensor, and wrinkles that the surface does not follow.  Half as wide, because the
  tissue's own shape looks like a pattern to whoever looks too widely.

Steps of depth come in by formula (``steps.bias``), as a window may well lie between two of them and show nothing.
Pixels are put together in cells of a tenth of the window first, so that a fine picture costs no more than a coarse one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.review import noise, steps
from igtl_gateway.review.linear import Design, times
from igtl_gateway.review.scene import DepthScene

Array = npt.NDArray[Any]

#: Half of an interval that holds the truth in 95 cases of 100, in standard errors.
SURE_95 = 1.96
_CELL = 0.1  # radii of what is laid
_CHANCE_REACH = 2.5  # radii of the window
_NARROW, _NARROW_PX = 0.5, 6.0  # radii of the window, and pixels: a pattern is looked for so wide
_PATTERN_REACH, _PATTERN_PX = 3.0, 18.0  # times that, or so many pixels: the grain of a sensor is some pixels wide
_WIDEST = 7.0
_CHANCE_RINGS = ((0.0, 1), (0.6, 5), (1.0, 8))  # of places: share of what the weights may be moved by, number
_FREE = 6  # of these places do not overlap: degrees of freedom that each cloud adds
_PATTERN_RINGS = ((0.0, 1), (0.35, 5), (0.7, 8), (1.0, 11))
_LEAST_PLACES = 8
_ROUNDS = 5
_TUKEY = 4.685
_LEAST_M = 1e-7
_NOTABLE = 1.5  # from here on a pattern counts, as variance against what is expected without
_DOUBT = 4.0  # over the root of the number of pixels: as share of the noise what may be more of it by chance
_MISSED = 0.25  # of what a quadric misses of the tissue, as variance in the middle: experience, docs/review.md
_SOME = 0.1  # of a variance has to be left by the wider surface
_LOPSIDED = 1.0  # sum of squared weights: the place lies at an edge
_MIDDLE = np.array([1.0, 0, 0, 0, 0, 0])
_TURNS = np.arange(16) / 16  # places between two steps


@dataclass(frozen=True, slots=True)
class DepthCells:
    """Readings around a place, put together.

    Attributes:
        number: (cells,) of pixels.
        places: (cells, 2) mean offset of their rays, in radii.
        depth: (cells,) mean z of the picture, metres.
        besides: (clouds, cells) what each cloud adds to the error of that mean.
    """

    number: Array
    places: Array
    depth: Array
    besides: Array

    @classmethod
    def around(cls, scene: DepthScene, ray: Array, radius: float, reach: float) -> DepthCells:
        """Within ``reach`` radii of a ray."""
        pixels = scene.around(ray, reach * radius)
        pixels = pixels[np.isfinite(scene.depth[pixels])]
        off = (scene.rays[pixels] - ray) / radius
        side = 2 * int(reach / _CELL) + 3
        column, row = (np.floor(off / _CELL).astype(np.int64) + side // 2).T
        _, cell = np.unique(row * side + column, return_inverse=True)
        number = np.bincount(cell).astype(np.float64)
        counted, depth = scene.counted[:, pixels], scene.depth[pixels]
        share = 1 / np.maximum(counted.sum(axis=0), 1)
        besides = np.where(counted, scene.depths[:, pixels] - depth, 0.0) * share
        return cls(
            number,
            np.stack([np.bincount(cell, off[:, axis]) / number for axis in (0, 1)], axis=1),
            np.bincount(cell, depth - depth.mean()) / number,
            np.stack([np.bincount(cell, each) / number for each in besides]),
        )


def of_depth(scene: DepthScene, ray: Array, radius: float, pixels: Array, influence: Array, fitted: Array) -> float:
    """The standard error of a surface's depth in the middle, metres: 1.96 of them hold the truth in 95 of 100 cases.

    Args:
        scene: the clouds.
        ray: (x / z, y / z) of the middle.
        radius: of the window, as x / z.
        pixels: (n,) that the surface was fitted to.
        influence: (n,) weight of each of them in the depth in the middle.
        fitted: (n,) z of the surface there.
    """
    off = scene.depth[pixels] - fitted
    single = max(noise.deviation(off[influence != 0]), _LEAST_M)
    white = float((influence**2).sum())
    chance = _chance(DepthCells.around(scene, ray, radius, _CHANCE_REACH))
    pitch = sqrt(np.pi / len(pixels))  # of the pixels, in radii
    narrow = min(max(_NARROW, _NARROW_PX * pitch), 1.0)
    reach = min(max(_PATTERN_REACH, _PATTERN_PX * pitch / narrow), _WIDEST)
    pattern, bent = _pattern(DepthCells.around(scene, ray, narrow * radius, reach), reach, 1 / narrow)
    turned = _rounding(scene, pixels, influence, fitted)
    base = white * (single**2 if chance is None else chance * _student(len(scene.depths)))
    uneven = _uneven(scene, pixels, np.where(influence != 0, off, np.nan))
    missed = max(bent**2, _MISSED * uneven)
    expected = base + missed + float((turned**2).mean())
    if pattern is not None and white * pattern > _NOTABLE * expected:
        return sqrt(white * pattern + bent**2)
    return _half_width(turned, sqrt(base + missed)) / SURE_95


def _chance(cells: DepthCells) -> float | None:
    """Variance of a pixel of the picture by what changes from cloud to cloud, as far as a fit does not average it
    out; None of one cloud."""
    clouds = len(cells.besides)
    found = expected = 0.0
    for place in _places(_CHANCE_RINGS, _CHANCE_REACH - 1.0):
        laid = _laid(cells, place, cells.number, 1.0)
        if laid is not None:
            inside, weight = laid
            found += float((times(cells.besides[:, inside], weight) ** 2).sum())
            expected += float((weight**2 / cells.number[inside]).sum())
    return clouds / (clouds - 1) * found / expected if clouds > 1 and expected > 0 else None


def _student(clouds: int) -> float:
    """By how much a variance of so few readings has to be larger for 1.96 of its roots to hold 95 %: of n degrees of
    freedom Student's t is 1.96 + 2.4 / n."""
    return (1 + 2.4 / SURE_95 / (_FREE * (clouds - 1))) ** 2


def _uneven(scene: DepthScene, pixels: Array, off: Array) -> float:
    """Variance of the picture about the surface beyond its noise, where it is beyond doubt: what a quadric misses.

    Args:
        scene: the clouds.
        pixels: (n,) of the window.
        off: (n,) z of the picture above the surface; NaN where it does not count.
    """
    counts = np.isfinite(off) & np.isfinite(scene.noise[pixels])
    if not counts.any():
        return 0.0
    step = scene.steps.at(scene.depth[pixels[counts]])
    clouds = np.maximum(scene.counted[:, pixels[counts]].sum(axis=0), 1)
    lasting = steps.UNIFORM_VARIANCE * step**2
    noisy = float(((scene.noise[pixels[counts]] ** 2 - lasting) / clouds + lasting).mean())
    found = noise.deviation(off) ** 2
    return found - noisy if found > noisy * (1 + _DOUBT / sqrt(np.count_nonzero(counts))) else 0.0


def _pattern(cells: DepthCells, reach: float, window: float) -> tuple[float | None, float]:
    """The same by what a wider surface leaves of the picture (None where there is too little to tell), and how far a
    quadric over the window (radius in units of the cells) is off that surface in the middle, metres."""
    wide = Design(_quartic(cells.places / reach))
    held = _held(wide, cells)
    if held is None:
        return None, 0.0
    left, weights, coefficients = held
    found, expected, bent = [], [], 0.0
    laid = _laid(cells, np.zeros(2), weights, min(window, reach))
    if laid is not None:
        inside, weight = laid
        bent = float((weight * wide.values(coefficients)[inside]).sum() - coefficients[0])
    for place in _places(_PATTERN_RINGS, reach - 1.0):
        laid = _laid(cells, place, weights, 1.0)
        if laid is None:
            continue
        inside, weight = laid
        alone = float((weight**2 / cells.number[inside]).sum())
        absorbed = wide.variance(times(wide.columns[:, inside], weight), weights)
        if absorbed is not None and alone - absorbed > _SOME * alone:
            found.append(float((weight * left[inside]).sum()) ** 2)
            expected.append(alone - absorbed)
    return (sum(found) / sum(expected) if len(found) >= _LEAST_PLACES else None), bent


def _laid(cells: DepthCells, place: Array, weights: Array, radius: float) -> tuple[Array, Array] | None:
    """Cells around a place, and what each of them would count in a quadric's depth there."""
    off = (cells.places - place) / radius
    inside = np.flatnonzero((off**2).sum(axis=1) <= 1.0)
    weight = Design(_quadric(off[inside])).weights_of(_MIDDLE, weights[inside]) if len(inside) else None
    if weight is None or float((weight**2).sum()) > _LOPSIDED:
        return None
    return inside, weight


def _held(wide: Design, cells: DepthCells) -> tuple[Array, Array, Array] | None:
    """What the wider surface leaves, the weight of each cell, and its coefficients."""
    weights = cells.number
    coefficients: Array | None = None
    left = cells.depth
    for _ in range(_ROUNDS):
        coefficients = wide.solve(cells.depth, weights)
        if coefficients is None:
            return None
        left = cells.depth - wide.values(coefficients)
        # a cell's mean has less noise the more pixels are in it, and no less than its grain
        scale = max(noise.MAD * float(np.median(np.abs(left))), _LEAST_M)
        weights = cells.number * np.clip(1 - (left / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return None if coefficients is None else (left, weights, coefficients)


def _rounding(scene: DepthScene, pixels: Array, influence: Array, fitted: Array) -> Array:
    """(16,) what the steps of depth do in the middle, wherever between two steps the tissue may lie."""
    step = scene.steps.at(fitted)
    if not (step > 0).all():
        return np.zeros(len(_TURNS))
    middle = float(np.median(step))
    phase = (fitted - fitted.mean()) * 2 / (step + middle)
    return steps.bias(step, scene.before_rounding * step, phase, influence, _TURNS)


def _half_width(shifts: Array, sigma: float) -> float:
    """h so that a normal number plus one of the shifts lies within ±h in 95 of 100 cases."""
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
    """Offsets from the middle, in radii."""
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

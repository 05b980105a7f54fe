"""Paired-point rigid registration: landmarks of an image and the places where a tool has touched them.

The rotation is Horn's (*Closed-form solution of absolute orientation using unit quaternions*, 1987): the eigenvector
of a symmetric 4 × 4 matrix, so it is a rotation and never a reflection, even of landmarks that lie in one plane.
Eigenvectors come from Jacobi's method and sums from ``math.fsum``: plain arithmetic, the same bits on every machine,
which LAPACK and BLAS do not promise.

Lengths have the unit of the points; the names of the errors are those of Fitzpatrick, West and Maurer (1998):

* FRE: root mean square distance of the landmarks from their counterparts after registration,
* FLE: error of touching one landmark; FRE² = (1 − 2/N) · FLE² on average,
* TRE: the same at a place that took no part in the registration, which is what a surgeon wants to know.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.star_numbers import Array, dot

MIN_PAIRS = 3
#: Landmarks nearer to a line than this part of their extent hold nothing about the turn around it.
_ON_A_LINE = 1e-3
_SWEEPS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Rigid:
    """A rotation (3, 3) and a translation (3,): where points of one frame are in another."""

    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """(…, 3) points in the other frame."""
        return np.stack([dot(points, self.rotation[row]) + self.translation[row] for row in range(3)], -1)

    def inverse(self) -> Rigid:
        turned = np.array([-_fdot(self.rotation[:, row], self.translation) for row in range(3)])
        return Rigid(self.rotation.T.copy(), turned)

    @property
    def rows(self) -> list[list[float]]:
        """As three rows of four."""
        return [[*row, shift] for row, shift in zip(self.rotation.tolist(), self.translation.tolist(), strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Result of ``register``.

    Attributes:
        transform: moving → fixed.
        residuals: (n,) distances of each landmark from its counterpart after registration.
    """

    transform: Rigid
    residuals: Array

    @property
    def fre(self) -> float:
        """Root mean square of the residuals."""
        return rms(self.residuals)


def register(moving: Array, fixed: Array) -> Registration:
    """The rigid transform that takes ``moving`` (n, 3) onto ``fixed`` (n, 3) with the least squares.

    Raises ConfigError for fewer than three pairs, unequal numbers, numbers that are not finite, and points that lie
    on a line: they have no single answer.
    """
    moving, fixed = np.asarray(moving, np.float64), np.asarray(fixed, np.float64)
    if moving.shape != fixed.shape or moving.ndim != 2 or moving.shape[1] != 3 or len(moving) < MIN_PAIRS:
        raise ConfigError(
            f"registration: found points of shape {moving.shape} and {fixed.shape}, "
            f"expected {MIN_PAIRS} or more pairs (n, 3)"
        )
    for side, points in (("moving", moving), ("fixed", fixed)):
        if not np.isfinite(points).all():
            raise ConfigError(f"registration, {side} points: found numbers that are not finite, expected finite ones")
        moments, _ = eigen(_scatter(points, points))
        if not math.sqrt(max(moments[1], 0.0)) > _ON_A_LINE * math.sqrt(max(moments[0], 0.0)):
            raise ConfigError(f"registration, {side} points: found all on a line, expected a plane or more")
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _scatter(moving, fixed)
    _, vectors = eigen(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = vectors[0]
    rotation = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w + y * y - x * x - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w + z * z - x * x - y * y],
        ]
    )
    start, end = centre(moving), centre(fixed)
    translation = np.array([end[row] - _fdot(rotation[row], start) for row in range(3)])
    transform = Rigid(rotation, translation)
    return Registration(transform, distances(transform.apply(moving), fixed))


def register_in_order(landmarks: Array, stops: Array) -> tuple[Registration, int]:
    """Register ``stops`` onto ``landmarks`` that were touched in this order, with pauses around them, not between.

    Of all runs of as many stops as there are landmarks the best is taken: returned are the registration (tool →
    landmarks) and the number of the first stop.  Raises ConfigError where there are fewer stops than landmarks, or
    where no run of them can be registered.
    """
    count = len(landmarks)
    if len(stops) < count:
        raise ConfigError(f"registration: found {len(stops)} stops of the tool, expected {count}, one a landmark")
    best: tuple[Registration, int] | None = None
    fault: ConfigError | None = None
    for first in range(len(stops) - count + 1):
        try:
            found = register(stops[first : first + count], landmarks)
        except ConfigError as error:
            fault = error
            continue
        if best is None or found.fre < best[0].fre:
            best = found, first
    if best is None:
        raise fault or ConfigError("registration: found no stops, expected one a landmark")
    return best


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A time in which a tool did not move.

    Attributes:
        begin, end: first sample, and the one behind the last.
        position: (3,) mean of the tip.
        spread: root mean square distance of the samples from it.
    """

    begin: int
    end: int
    position: Array
    spread: float


def stops(times_s: Array, positions: Array, *, slowest: float, shortest_s: float, window_s: float = 0.2) -> list[Stop]:
    """Where a tool stood: samples that move less than ``slowest`` (units a second), ``shortest_s`` or longer.

    The speed at a sample is that between the first and the last sample of a window of ``window_s`` around it, so
    that the noise of a tracker is not taken for motion.
    """
    times_s = np.asarray(times_s)
    if len(times_s) < 2:
        return []
    first = np.searchsorted(times_s, times_s - window_s / 2)
    last = np.maximum(np.searchsorted(times_s, times_s + window_s / 2, "right") - 1, 0)
    first, last = np.minimum(first, len(times_s) - 2), np.maximum(last, 1)
    last = np.maximum(last, first + 1)
    way = np.asarray(positions)[last] - np.asarray(positions)[first]
    still = np.sqrt(dot(way, way)) < slowest * (times_s[last] - times_s[first])
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    found = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if times_s[end - 1] - times_s[begin] >= shortest_s:
            samples = np.asarray(positions)[begin:end]
            middle = centre(samples)
            found.append(Stop(begin, end, middle, rms(distances(samples, middle))))
    return found


def expected_fle(count: int, fre: float) -> float:
    """The error of touching one landmark that an FRE over ``count`` of them lets expect (root mean square)."""
    if count < MIN_PAIRS:
        raise ConfigError(f"expected FLE: found {count} landmarks, expected {MIN_PAIRS} or more")
    return fre * math.sqrt(count / (count - 2))


def expected_tre(landmarks: Array, fre: float, target: Array) -> float:
    """The TRE at ``target`` (3,) that landmarks with this FRE let expect (root mean square).

    TRE² = FLE²/N · (1 + ⅓ Σ d²/f²) over the three principal axes of the landmarks; d is the distance of the target
    from an axis, f the root mean square of that of the landmarks.
    """
    fle = expected_fle(len(landmarks), fre)
    _, axes = eigen(_scatter(landmarks, landmarks))
    middle = centre(landmarks)
    total = 0.0
    for axis in axes:
        along = np.array(axis)
        away = _beside(np.asarray(target) - middle, along)
        spread = _beside(np.asarray(landmarks) - middle, along)
        total += float(dot(away, away)) / rms(np.sqrt(dot(spread, spread))) ** 2
    return fle * math.sqrt((1.0 + total / 3.0) / len(landmarks))


def distances(points: Array, others: Array) -> Array:
    """(n,) distances of points from their counterparts, or from one point."""
    way = np.asarray(points) - np.asarray(others)
    return np.asarray(np.sqrt(dot(way, way)))


def rms(values: Array) -> float:
    """Root mean square."""
    numbers = np.asarray(values).tolist()
    return math.sqrt(math.fsum(value * value for value in numbers) / len(numbers))


def centre(points: Array) -> Array:
    """Mean of (n, 3) points."""
    return np.array([math.fsum(points[:, axis].tolist()) / len(points) for axis in range(3)])


def eigen(matrix: Sequence[Sequence[float]]) -> tuple[list[float], list[list[float]]]:
    """Eigenvalues of a symmetric matrix, the largest first, and their unit vectors: Jacobi's rotations."""
    size = len(matrix)
    a = [[float(value) for value in row] for row in matrix]
    v = [[float(row == column) for column in range(size)] for row in range(size)]
    scale = max(abs(value) for row in a for value in row)
    for _ in range(_SWEEPS):
        if max(abs(a[p][q]) for p in range(size) for q in range(p)) <= 1e-17 * scale:
            break
        for p in range(size - 1):
            for q in range(p + 1, size):
                _turn(a, v, p, q)
    order = sorted(range(size), key=lambda index: -a[index][index])
    return [a[index][index] for index in order], [[v[row][index] for row in range(size)] for index in order]


def _turn(a: list[list[float]], v: list[list[float]], p: int, q: int) -> None:
    """Make a[p][q] zero by a rotation of these two axes, kept in ``v``."""
    if a[p][q] == 0.0:
        return
    theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q])
    tangent = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    cos = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sin = tangent * cos
    for row in a:
        row[p], row[q] = cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]
    a[p], a[q] = (
        [cos * x - sin * y for x, y in zip(a[p], a[q], strict=True)],
        [sin * x + cos * y for x, y in zip(a[p], a[q], strict=True)],
    )
    a[p][q] = a[q][p] = 0.0
    for row in v:
        row[p], row[q] = cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]


def _scatter(a: Array, b: Array) -> list[list[float]]:
    """Sums of products of the coordinates of ``a`` and ``b``, each about its centre."""
    from_a, from_b = a - centre(a), b - centre(b)
    return [[math.fsum((from_a[:, row] * from_b[:, column]).tolist()) for column in range(3)] for row in range(3)]


def _beside(points: Array, axis: Array) -> Array:
    """The part of (…, 3) vectors that is not along the unit vector ``axis``."""
    return np.asarray(points - dot(points, axis)[..., None] * axis)


def _fdot(a: Array, b: Array) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])

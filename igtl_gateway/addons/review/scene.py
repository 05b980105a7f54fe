"""The clouds combined to one depth image: the ray of each pixel, its depth and its noise.

The median over the clouds removes a passing tool and fills temporary holes.  The depth image is the mean of the
readings near that median.  The mean has less noise than the median if the noise is Gaussian, and it resolves
positions between the steps of quantised depth, which a median does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.review import noise
from igtl_gateway.addons.review.axes import CameraAxes, axes_of
from igtl_gateway.addons.review.linear import Design
from igtl_gateway.addons.review.steps import Steps, share_before_rounding, steps_of

Array = npt.NDArray[Any]

_SPATIAL_CLOUDS = 6  # clouds for the spatial noise
_BLOCK = 10  # pixels: side of the squares whose mean is a position between two steps
_SAME_M, _SAME = 5e-7, 5e-7  # tolerance of equal readings: metres, plus share of the depth
_NEAR = 3.5  # a reading counts within this number of standard deviations from the median


@dataclass(frozen=True, slots=True)
class DepthCloud:
    """One cloud of the session.

    Attributes:
        topic, frame_id: of its message.
        stamp_ns: gateway time, UTC.
        source_ns: stamp in the message, UTC; 0 = unset.
        points: (height, width, 3) metres, NaN without a depth; height 1 if unorganised.
    """

    topic: str
    frame_id: str
    stamp_ns: int
    source_ns: int
    points: Array


@dataclass(frozen=True, slots=True)
class DepthScene:
    """The combined clouds; pixels in one dimension, as (height · width,).

    Attributes:
        clouds: the clouds that are used, in order of time.
        rays: (pixels, 2) ray of each pixel, as x / z and y / z.
        depth: (pixels,) the depth image: mean of those z that are near their median, metres; NaN if no cloud has any.
        depths: (clouds, pixels) z of each cloud, metres.
        counted: (clouds, pixels) whether ``depth`` includes this reading.
        temporal: (pixels,) standard deviation of z from the changes between clouds, with the part of quantised depth,
            metres; NaN if unknown, None for one cloud.
        spatial: (pixels,) the standard deviation from the changes between pixels; None if the cloud is unorganised.
        steps: of quantised depth.
        before_rounding: standard deviation of the noise before depth was quantised, in steps.
        axes: viewing direction in the frame of the clouds; all other attributes are in optical axes, z forward.
        note: note on the axes; "" if the frame is an optical one.
    """

    clouds: tuple[DepthCloud, ...]
    rays: Array
    depth: Array
    depths: Array
    counted: Array
    temporal: Array | None
    spatial: Array | None
    steps: Steps
    before_rounding: float
    axes: CameraAxes
    note: str

    @classmethod
    def of(cls, clouds: Sequence[DepthCloud]) -> DepthScene:
        """Combine clouds of one size and frame; of unorganised clouds only the last one is used.

        Raises GatewayError if most points are behind the camera.
        """
        height, width, _ = clouds[-1].points.shape
        organised = height > 1 and width > 1
        used = tuple(clouds) if organised else (clouds[-1],)
        axes, note = axes_of(used[-1].points, used[-1].frame_id)
        x, y, z = np.moveaxis(axes.to_optical(np.stack([cloud.points for cloud in used]).astype(np.float64)), -1, 0)
        behind = np.isfinite(z) & (z <= 0)
        if 2 * np.count_nonzero(behind) > np.count_nonzero(np.isfinite(z)):
            raise GatewayError(
                f"{used[0].topic}, frame {used[0].frame_id!r}: found most points behind the camera (z below 0), "
                "expected a cloud in the optical frame of its camera (z forward)"
            )
        z[behind] = np.nan
        rays = np.stack([_median_slope(x / z), _median_slope(y / z)], axis=-1)
        steps = steps_of(z)
        median = _median(z)
        step = steps.at(median)
        changing = noise.between_clouds(z, step) if len(used) > 1 else None
        differing = noise.within_clouds(z[:_SPATIAL_CLOUDS], step) if organised else None
        temporal, spatial = (
            None if found is None else noise.total_noise(found, step) for found in (changing, differing)
        )
        near = np.isfinite(z) if temporal is None else _near(z, median, temporal)
        depth = _mean(z, near, median)
        return cls(
            used,
            rays.reshape(-1, 2),
            depth.reshape(-1),
            z.reshape(len(used), -1),
            near.reshape(len(used), -1),
            None if temporal is None else temporal.reshape(-1),
            None if spatial is None else spatial.reshape(-1),
            steps,
            _before_rounding(differing if changing is None else changing, depth, step),
            axes,
            note,
        )

    @property
    def noise(self) -> Array:
        """(pixels,) standard deviation of z, metres: temporal if known, otherwise spatial, otherwise NaN."""
        found = self.spatial if self.temporal is None else self.temporal
        return np.full(len(self.depth), np.nan) if found is None else found

    def holds(self, point: Array) -> bool:
        """Return whether a point (3,) in optical axes is one of the readings, up to single precision."""
        if not point[2] > 0:
            return False
        near = _SAME_M + _SAME * point[2]
        pixels = self.around(point[:2] / point[2], near / point[2])
        return bool((np.abs(self.depths[:, pixels] - point[2]) <= near).any())

    def around(self, ray: Array, radius: float) -> Array:
        """Return the numbers of the pixels within ``radius`` (as x / z) of a ray."""
        off = self.rays - ray
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(off[:, 0] ** 2 + off[:, 1] ** 2 <= radius**2)


def _before_rounding(observed: Array | None, depth: Array, step: Array) -> float:
    """Return the noise before rounding, in steps, from the observed noise; 0, the worst case, if it is unknown."""
    if observed is None or not (step > 0).any():
        return 0.0
    median = np.median(step[step > 0])
    # depth in steps: exact for steps of depth, approximate for steps of disparity
    inside = (step > 0) & np.isfinite(observed) & np.isfinite(depth)
    blocks = [
        _sums(np.where(inside, each, 0.0)) for each in (np.ones_like(depth), (observed / median) ** 2, depth / median)
    ]
    number, variance, phase = (block[blocks[0] > _BLOCK**2 // 2] for block in blocks)
    return share_before_rounding(variance / number, phase / number) if len(number) else 0.0


def _sums(values: Array) -> Array:
    """Return the (blocks,) sums over squares of pixels; incomplete squares at the edges are left out."""
    rows, columns = values.shape[0] // _BLOCK, values.shape[1] // _BLOCK
    squares = values[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    total: Array = squares.sum(axis=(1, 3)).reshape(-1)
    return total


def _near(z: Array, median: Array, sigma: Array) -> Array:
    """Return (clouds, …) whether a reading counts; with unknown noise only the readings nearest to the median."""
    off = np.abs(z - median)
    least = np.min(np.where(np.isfinite(off), off, np.inf), axis=0)
    return np.asarray(off <= np.maximum(np.nan_to_num(_NEAR * sigma), least))  # False for NaN


def _mean(z: Array, counted: Array, median: Array) -> Array:
    """Return the mean of the counted readings along the first axis."""
    number = counted.sum(axis=0)
    # relative to the median, so that the mean of equal readings is exactly their value
    total = np.where(counted, z - median, 0.0).sum(axis=0)
    mean: Array = median + total / np.maximum(number, 1)
    return mean


def _median(values: Array) -> Array:
    """Return the median along the first axis without NaN; NaN if all are NaN.  (``np.nanmedian`` is slow and warns.)"""
    ordered = np.sort(values, axis=0)  # NaN last
    number = np.isfinite(values).sum(axis=0)
    low, high = np.maximum(number - 1, 0) // 2, number // 2
    high = np.minimum(high, len(values) - 1)
    picked = np.take_along_axis(ordered, low[None], 0)[0] + np.take_along_axis(ordered, high[None], 0)[0]
    median: Array = np.where(number > 0, picked / 2, np.nan)
    return median


def _median_slope(slopes: Array) -> Array:
    """Return the (height, width) median over the clouds; for pixels without a depth the slope of a pinhole camera."""
    median = _median(slopes)
    known = np.isfinite(median)
    height, width = median.shape
    if height == 1 or known.all():
        return median
    row, column = np.mgrid[0:height, 0:width]
    pinhole = Design(np.stack([np.ones(median.size), column.reshape(-1) / width, row.reshape(-1) / height]))
    line = pinhole.solve(np.nan_to_num(median.reshape(-1)), known.reshape(-1).astype(np.float64))
    if line is not None:
        median[~known] = pinhole.values(line).reshape(height, width)[~known]
    return median

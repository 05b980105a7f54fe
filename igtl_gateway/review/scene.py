"""The clouds as one depth picture: which ray each pixel looks along, its usual depth, its noise.

The median over the clouds takes the tool out that comes by, and fills the holes that come and go.  The picture is
the mean of the readings near that median: of Gaussian noise it keeps less than the median does, and where depth has
steps it finds the places between them, which a median cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.errors import GatewayError
from igtl_gateway.review import noise
from igtl_gateway.review.axes import CameraAxes, axes_of
from igtl_gateway.review.linear import Design
from igtl_gateway.review.steps import Steps, share_before_rounding, steps_of

Array = npt.NDArray[Any]

_SPATIAL_CLOUDS = 6  # a few tell what differs between neighbours
_BLOCK = 10  # pixels: squares that tell the place between two steps
_SAME_M, _SAME = 5e-7, 5e-7  # metres, and share of the depth
_NEAR = 3.5  # deviations from the median, within which a reading counts


@dataclass(frozen=True, slots=True)
class DepthCloud:
    """A cloud as it came.

    Attributes:
        topic, frame_id: of its message.
        stamp_ns: gateway time.
        source_ns: stamp in the message; 0 = unset.
        points: (height, width, 3) metres, NaN where the camera gave no depth; height 1 if not organised.
    """

    topic: str
    frame_id: str
    stamp_ns: int
    source_ns: int
    points: Array


@dataclass(frozen=True, slots=True)
class DepthScene:
    """What the clouds say together; pixels in one row, as (height · width,).

    Attributes:
        clouds: what it was made of, in order of time.
        rays: (pixels, 2): x / z and y / z of what a pixel sees.
        depth: (pixels,) usual z, metres: mean of the readings near the median; NaN where no cloud has any.
        depths: (clouds, pixels) z of each.
        counted: (clouds, pixels) which of them ``depth`` is the mean of.
        temporal: (pixels,) standard deviation of z by what changes from cloud to cloud, with the share of the
            sensor's steps, metres; NaN where unknown, None of one cloud.
        spatial: the same from pixel to pixel; None where the cloud is no picture.
        steps: of the sensor's depth.
        before_rounding: standard deviation of the noise before depth was rounded to them, in steps.
        axes: which way the camera looks in the frame of the clouds; all else here is in optical axes, z forward.
        note: what a reader should know of that; "" where the frame is an optical one.
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
        """From clouds of one size and frame; of clouds that are not organised the last one only.

        Raises GatewayError where the points do not lie in front of a camera.
        """
        height, width, _ = clouds[-1].points.shape
        organised = height > 1 and width > 1
        used = tuple(clouds) if organised else (clouds[-1],)
        axes, note = axes_of(used[-1].points, used[-1].frame_id)
        x, y, z = np.moveaxis(axes.optical(np.stack([cloud.points for cloud in used]).astype(np.float64)), -1, 0)
        behind = np.isfinite(z) & (z <= 0)
        if 2 * np.count_nonzero(behind) > np.count_nonzero(np.isfinite(z)):
            raise GatewayError(
                f"{used[0].topic}, frame {used[0].frame_id!r}: found most points behind the camera (z below 0), "
                "expected a cloud in the optical frame of its camera (z forward)"
            )
        z[behind] = np.nan
        rays = np.stack([_usual_ray(x / z), _usual_ray(y / z)], axis=-1)
        steps = steps_of(z)
        median = _median(z)
        step = steps.at(median)
        changing = noise.between_clouds(z, step) if len(used) > 1 else None
        differing = noise.within_clouds(z[:_SPATIAL_CLOUDS], step) if organised else None
        temporal, spatial = (None if seen is None else noise.total_noise(seen, step) for seen in (changing, differing))
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
        """(pixels,) the best that is known of the noise, metres: temporal, else spatial, else NaN."""
        found = self.spatial if self.temporal is None else self.temporal
        return np.full(len(self.depth), np.nan) if found is None else found

    def holds(self, point: Array) -> bool:
        """Whether a point (3,) in optical axes is one of the readings, up to single precision."""
        if not point[2] > 0:
            return False
        near = _SAME_M + _SAME * point[2]
        pixels = self.around(point[:2] / point[2], near / point[2])
        return bool((np.abs(self.depths[:, pixels] - point[2]) <= near).any())

    def around(self, ray: Array, radius: float) -> Array:
        """Numbers of the pixels within ``radius`` (as x / z) of a ray."""
        off = self.rays - ray
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(off[:, 0] ** 2 + off[:, 1] ** 2 <= radius**2)


def _before_rounding(seen: Array | None, depth: Array, step: Array) -> float:
    """In steps; 0 where nothing is known, which is the worst."""
    if seen is None or not (step > 0).any():
        return 0.0
    usual = np.median(step[step > 0])
    # depth in steps: on a grid of depths exactly, on one that grows near enough
    inside = (step > 0) & np.isfinite(seen) & np.isfinite(depth)
    blocks = [_sums(np.where(inside, each, 0.0)) for each in (np.ones_like(depth), (seen / usual) ** 2, depth / usual)]
    number, variance, phase = (block[blocks[0] > _BLOCK**2 // 2] for block in blocks)
    return share_before_rounding(variance / number, phase / number) if len(number) else 0.0


def _sums(values: Array) -> Array:
    """(blocks,) over squares of pixels; what is left at the edges is left out."""
    rows, columns = values.shape[0] // _BLOCK, values.shape[1] // _BLOCK
    squares = values[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    total: Array = squares.sum(axis=(1, 3)).reshape(-1)
    return total


def _near(z: Array, median: Array, sigma: Array) -> Array:
    """(clouds, …) whether a reading counts; the median's own neighbours where the noise is not known."""
    off = np.abs(z - median)
    own = np.min(np.where(np.isfinite(off), off, np.inf), axis=0)
    return np.asarray(off <= np.maximum(np.nan_to_num(_NEAR * sigma), own))  # NaN is not


def _mean(z: Array, counted: Array, median: Array) -> Array:
    """Along the first axis, of what counts."""
    number = counted.sum(axis=0)
    # from the median on, so that equal readings have their own value as mean
    total = np.where(counted, z - median, 0.0).sum(axis=0)
    mean: Array = median + total / np.maximum(number, 1)
    return mean


def _median(values: Array) -> Array:
    """Along the first axis, without the NaNs; NaN of none.  (numpy's is slow, and warns of those.)"""
    ordered = np.sort(values, axis=0)  # NaN last
    number = np.isfinite(values).sum(axis=0)
    low, high = np.maximum(number - 1, 0) // 2, number // 2
    high = np.minimum(high, len(values) - 1)
    picked = np.take_along_axis(ordered, low[None], 0)[0] + np.take_along_axis(ordered, high[None], 0)[0]
    median: Array = np.where(number > 0, picked / 2, np.nan)
    return median


def _usual_ray(slopes: Array) -> Array:
    """(height, width) median over the clouds; where no cloud knows, what a pinhole camera would have there."""
    usual = _median(slopes)
    known = np.isfinite(usual)
    height, width = usual.shape
    if height == 1 or known.all():
        return usual
    row, column = np.mgrid[0:height, 0:width]
    pinhole = Design(np.stack([np.ones(usual.size), column.reshape(-1) / width, row.reshape(-1) / height]))
    line = pinhole.solve(np.nan_to_num(usual.reshape(-1)), known.reshape(-1).astype(np.float64))
    if line is not None:
        usual[~known] = pinhole.values(line).reshape(height, width)[~known]
    return usual

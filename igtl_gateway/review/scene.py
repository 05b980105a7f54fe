"""The clouds as one depth picture: which ray each pixel looks along, its median depth, its noise.

The median over the clouds takes the tool out that comes by, fills the holes that come and go, and leaves the
noise of one cloud divided by nearly the root of their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.errors import GatewayError
from igtl_gateway.review import noise
from igtl_gateway.review.linear import Design

Array = npt.NDArray[Any]

#: Clouds from which on scatter between them tells more than a formula.
SEVERAL = 4
_SPATIAL_CLOUDS = 6  # a few tell what differs between neighbours


@dataclass(frozen=True, slots=True)
class Cloud:
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
class Scene:
    """What the clouds say together; pixels in one row, as (height · width,).

    Attributes:
        clouds: what it was made of, in order of time.
        rays: (pixels, 2): x / z and y / z of what a pixel sees.
        depth: (pixels,) median z, metres; NaN where no cloud has any.
        depths: (clouds, pixels) z of each.
        temporal: (pixels,) standard deviation of z from cloud to cloud, metres; NaN where unknown, None of one cloud.
        spatial: the same from pixel to pixel; None where the cloud is no picture.
    """

    clouds: tuple[Cloud, ...]
    rays: Array
    depth: Array
    depths: Array
    temporal: Array | None
    spatial: Array | None

    @classmethod
    def of(cls, clouds: Sequence[Cloud]) -> Scene:
        """From clouds of one size and frame; of clouds that are not organised the last one only.

        Raises GatewayError where the points do not lie in front of a camera.
        """
        height, width, _ = clouds[-1].points.shape
        organised = height > 1 and width > 1
        used = tuple(clouds) if organised else (clouds[-1],)
        x, y, z = (np.stack([cloud.points[..., axis] for cloud in used]).astype(np.float64) for axis in range(3))
        behind = np.isfinite(z) & (z <= 0)
        if 2 * np.count_nonzero(behind) > np.count_nonzero(np.isfinite(z)):
            raise GatewayError(
                f"{used[0].topic}, frame {used[0].frame_id!r}: found most points behind the camera (z below 0), "
                "expected a cloud in the optical frame of its camera (z forward)"
            )
        z[behind] = np.nan
        rays = np.stack([_usual_ray(x / z), _usual_ray(y / z)], axis=-1)
        temporal = noise.between_clouds(z).reshape(-1) if len(used) > 1 else None
        spatial = noise.within_clouds(z[:_SPATIAL_CLOUDS]).reshape(-1) if organised else None
        return cls(
            used,
            rays.reshape(-1, 2),
            _median(z).reshape(-1),
            z.reshape(len(used), -1),
            temporal,
            spatial,
        )

    @property
    def noise(self) -> Array:
        """(pixels,) the best that is known of the noise, metres: temporal, else spatial, else NaN."""
        found = self.spatial if self.temporal is None else self.temporal
        return np.full(len(self.depth), np.nan) if found is None else found

    def around(self, ray: Array, radius: float) -> Array:
        """Numbers of the pixels within ``radius`` (as x / z) of a ray."""
        off = self.rays - ray
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(off[:, 0] ** 2 + off[:, 1] ** 2 <= radius**2)


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

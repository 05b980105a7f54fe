"""Viewing direction of a camera in the frame of its cloud, detected from the points and the name of the frame.

A review needs depth along z, x to the right and y down: the *optical* frame of REP 103.  Drivers and simulators also
publish clouds in the frame of the camera's body (x forward, y left, z up).
Three facts distinguish them.  All points are in front of a camera.  In an organised cloud x / z grows with the column
and y / z with the row, in equal steps.  And by REP 103 the names of optical frames end in ``_optical``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review.linear import Design

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class CameraAxes:
    """A convention for the axes of a camera frame.

    Attributes:
        name: in the terms of REP 103; begins with the axis of the depth.
        rows: (3, 3) optical x, y and z in the axes of the frame.
    """

    name: str
    rows: tuple[tuple[int, int, int], ...]

    def to_optical(self, points: Array) -> Array:
        """Return (…, 3) points of the frame in optical axes."""
        return np.stack([sum(sign * points[..., i] for i, sign in enumerate(row) if sign) for row in self.rows], -1)

    def from_optical(self, points: Array) -> Array:
        """Return (…, 3) points in optical axes in the axes of the frame."""
        back = np.array(self.rows).T
        return np.stack([sum(int(sign) * points[..., i] for i, sign in enumerate(row) if sign) for row in back], -1)


OPTICAL = CameraAxes("z forward", ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
BODY = CameraAxes("x forward", ((0, -1, 0), (0, 0, -1), (1, 0, 0)))
CONVENTIONS = (OPTICAL, BODY)

_IN_FRONT = 0.98  # minimum share of points in front of a camera
_TAN_HALF_VIEW = 1.75  # tangent of half a field of view of 120°
_MAX_BEND = 0.01  # maximum deviation of a camera's rays from equal steps, as share of the image width
_MOSTLY = 0.5  # z forward is assumed above this share in front, if no convention fits
_MAX_POINTS = 20_000  # points that are checked
_EXPECTED = "expected a cloud in the camera's optical frame (REP 103: z forward, x right, y down)"


def axes_of(points: Array, frame_id: str) -> tuple[CameraAxes, str]:
    """Return the convention of a cloud, and a note if it is not certain or not optical.

    Args:
        points: (height, width, 3) metres, NaN without a depth; height 1 if unorganised.
        frame_id: of the cloud.
    """
    shares = {axes: _share_in_front(axes.to_optical(points)) for axes in CONVENTIONS}
    possible = [axes for axes, share in shares.items() if share >= _IN_FRONT]
    frame = f"frame {frame_id!r}"
    if not possible:
        return (OPTICAL if shares[OPTICAL] > _MOSTLY else max(shares, key=lambda axes: shares[axes])), (
            f"{frame}: its points are around the origin, not in front of a camera: distances are not along the "
            f"camera's depth; {_EXPECTED}"
        )
    if points.shape[0] > 1 and points.shape[1] > 1:
        bends = {axes: _bend(axes.to_optical(points)) for axes in possible}
        best = min(possible, key=lambda axes: bends[axes])
        if bends[best] > _MAX_BEND:
            return possible[0], (
                f"{frame}: the rows and columns of the cloud do not fit a camera with viewing direction "
                f"{possible[0].name[0]}: the cloud might have been transformed to this frame; distances are not "
                f"along the camera's depth; {_EXPECTED}"
            )
        return best, _note(best, frame, "by its rows and columns")
    if len(possible) == 1:
        return possible[0], _note(possible[0], frame, "by the positions of its points")
    if frame_id.rstrip("/").endswith(("_optical", "_optical_frame")):
        return OPTICAL, ""
    return OPTICAL, (
        f"{frame}: its points fit a camera with viewing direction z as well as x; reviewed as z forward; {_EXPECTED}"
    )


def _note(axes: CameraAxes, frame: str, how: str) -> str:
    if axes is OPTICAL:
        return ""
    return f"{frame}: found {axes.name} {how}, {_EXPECTED}; reviewed along {axes.name[0]}"


def _share_in_front(optical: Array) -> float:
    """Return the share of the points within the field of view of a camera with 120°."""
    flat = optical.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    flat = flat[:: max(len(flat) // _MAX_POINTS, 1)]
    if not len(flat):
        return 1.0
    x, y, z = flat.T
    return float(np.mean((z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= _TAN_HALF_VIEW * z)))


def _bend(optical: Array) -> float:
    """Return the median deviation of the rays from equal steps along rows and columns, as share of the image width."""
    height, width, _ = optical.shape
    row, column = np.mgrid[0:height, 0:width]
    known = np.isfinite(optical).all(axis=-1) & (optical[..., 2] > 0)
    chosen = np.flatnonzero(known)
    chosen = chosen[:: max(len(chosen) // _MAX_POINTS, 1)]
    if len(chosen) < 6:
        return 0.0
    flat = optical.reshape(-1, 3)[chosen]
    places = np.stack([np.ones(len(chosen)), column.flat[chosen] / width, row.flat[chosen] / height])
    design = Design(places)
    worst, span = 0.0, 0.0
    for slope in (flat[:, 0] / flat[:, 2], flat[:, 1] / flat[:, 2]):
        line = design.solve(slope, np.ones(len(chosen)))
        if line is None:
            return 0.0
        worst = max(worst, float(np.median(np.abs(slope - design.values(line)))))
        span = max(span, float(np.abs(line[1:]).max()))
    return worst / max(span, 1e-9)

"""Which way a camera looks in the frame of its cloud: found by the points, confirmed or doubted by the frame's name.

A review needs depth along z, x to the right and y down: the *optical* frame of REP 103.  Drivers and simulators also
give clouds in the frame of the camera's body (x forward, y left, z up).
Three facts tell them apart.  All points lie in front of a camera; in a picture x / z grows with the column and y / z
with the row, in equal steps; and REP 103 lets the names of optical frames end in ``_optical``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.review.linear import Design

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class CameraAxes:
    """A convention.

    Attributes:
        name: as REP 103 or its users call it.
        rows: (3, 3): optical x, y and z in the frame's own axes.
    """

    name: str
    rows: tuple[tuple[int, int, int], ...]

    def optical(self, points: Array) -> Array:
        """(…, 3) points of the frame in optical axes."""
        return np.stack([sum(sign * points[..., i] for i, sign in enumerate(row) if sign) for row in self.rows], -1)

    def own(self, points: Array) -> Array:
        """(…, 3) the way back."""
        back = np.array(self.rows).T
        return np.stack([sum(int(sign) * points[..., i] for i, sign in enumerate(row) if sign) for row in back], -1)


OPTICAL = CameraAxes("z forward", ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
BODY = CameraAxes("x forward", ((0, -1, 0), (0, 0, -1), (1, 0, 0)))
CONVENTIONS = (OPTICAL, BODY)

_IN_FRONT = 0.98  # share of points that lie in front of a camera
_WIDE = 1.75  # tangent of half a view of 120°
_STRAIGHT = 0.01  # of the picture's width: by so much the rays of a camera leave equal steps
_MOSTLY = 0.5
_MOST = 20_000  # points that are looked at
_EXPECTED = "expected a cloud in the camera's optical frame (REP 103: z forward, x right, y down)"


def axes_of(points: Array, frame_id: str) -> tuple[CameraAxes, str]:
    """The convention of a cloud, and a note where a reader should know of it.

    Args:
        points: (height, width, 3) metres, NaN where there is none; height 1 of a list.
        frame_id: of the cloud.
    """
    seen = {axes: _in_front(axes.optical(points)) for axes in CONVENTIONS}
    possible = [axes for axes, share in seen.items() if share >= _IN_FRONT]
    frame = f"frame {frame_id!r}"
    if not possible:
        return (OPTICAL if seen[OPTICAL] > _MOSTLY else max(seen, key=lambda axes: seen[axes])), (
            f"{frame}: its points lie around the origin, not in front of a camera: distances are not along the "
            f"camera's depth; {_EXPECTED}"
        )
    if points.shape[0] > 1 and points.shape[1] > 1:
        bends = {axes: _bend(axes.optical(points)) for axes in possible}
        best = min(possible, key=lambda axes: bends[axes])
        if bends[best] > _STRAIGHT:
            return possible[0], (
                f"{frame}: the rows and columns of the cloud are not those of a camera that looks along its "
                f"{possible[0].name[0]} axis, so it may have been moved to this frame: distances are not along the "
                f"camera's depth; {_EXPECTED}"
            )
        return best, _note(best, frame, "by its rows and columns")
    if len(possible) == 1:
        return possible[0], _note(possible[0], frame, "by where its points lie")
    if frame_id.rstrip("/").endswith(("_optical", "_optical_frame")):
        return OPTICAL, ""
    return OPTICAL, (
        f"{frame}: its points fit a camera that looks along z as well as one along x; taken as z forward; {_EXPECTED}"
    )


def _note(axes: CameraAxes, frame: str, how: str) -> str:
    if axes is OPTICAL:
        return ""
    return f"{frame}: found {axes.name} {how}, {_EXPECTED}; reviewed along {axes.name[0]}"


def _in_front(optical: Array) -> float:
    """Share of the points that a camera of 120° could see."""
    flat = optical.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    flat = flat[:: max(len(flat) // _MOST, 1)]
    if not len(flat):
        return 1.0
    x, y, z = flat.T
    return float(np.mean((z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= _WIDE * z)))


def _bend(optical: Array) -> float:
    """By how much the rays leave equal steps along rows and columns: median, as share of the picture's width."""
    height, width, _ = optical.shape
    row, column = np.mgrid[0:height, 0:width]
    known = np.isfinite(optical).all(axis=-1) & (optical[..., 2] > 0)
    chosen = np.flatnonzero(known)
    chosen = chosen[:: max(len(chosen) // _MOST, 1)]
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

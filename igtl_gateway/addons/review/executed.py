"""Comparison of the plan with the path of the tool: where the tool passed each planned point."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review.frames import FramePath
from igtl_gateway.addons.review.model import Executed
from igtl_gateway.addons.review.surface import TissueSurface

Array = npt.NDArray[Any]

MM = 1000.0


def approaches(path: FramePath, points: Array, reach_mm: float) -> list[Executed]:
    """Return the closest approach of the tool to each of the planned points (n, 3) of one version of the plan.

    The tool is assumed to move on straight lines between samples, where its path is known.  A point is *reached* if the
    tool came within ``reach_mm`` of it while no other planned point was nearer.  So a passage on the way to a neighbour
    does not count.
    """
    return [_approach(path, points, number, reach_mm) for number in range(len(points))]


def _approach(path: FramePath, points: Array, number: int, reach_mm: float) -> Executed:
    positions, point = path.positions, points[number]
    off = positions - point
    nearest = int(np.argmin((off**2).sum(axis=1)))
    at, stamp_ns = positions[nearest], int(path.stamps_ns[nearest])
    best = float(((at - point) ** 2).sum())
    for first in (nearest - 1, nearest):
        if 0 <= first < len(positions) - 1 and path.joined[first]:
            step = positions[first + 1] - positions[first]
            length = float((step**2).sum())
            share = min(max(float(-(off[first] * step).sum()) / length, 0.0), 1.0) if length else 0.0
            place = positions[first] + share * step
            square = float(((place - point) ** 2).sum())
            if square < best:
                best, at = square, place
                step_ns = int(path.stamps_ns[first + 1]) - int(path.stamps_ns[first])
                stamp_ns = int(path.stamps_ns[first]) + round(share * step_ns)
    distance_mm = float(np.sqrt(best)) * MM
    owner = int(np.argmin(((points - at) ** 2).sum(axis=1)))
    x, y, z = (float(value) for value in at)
    return Executed(distance_mm, stamp_ns, (x, y, z), distance_mm <= reach_mm and owner == number)


def driven_depth_mm(path: FramePath, entry: Executed, leave: Executed, surface: TissueSurface) -> float | None:
    """Return the largest depth of the tool below the tissue between entry and exit.

    None if it did not reach both, or where its path between them is not known.
    """
    if not (entry.reached and leave.reached and entry.stamp_ns < leave.stamp_ns):
        return None
    inside = (path.stamps_ns[1:] > entry.stamp_ns) & (path.stamps_ns[:-1] < leave.stamp_ns)
    if not path.joined[inside].all():
        return None
    between = (path.stamps_ns >= entry.stamp_ns) & (path.stamps_ns <= leave.stamp_ns)
    between &= path.positions[:, 2] > 0  # rays exist only in front of the camera
    if not between.any():
        return None
    return -MM * float(surface.distance(path.positions[between]).min())

"""The sheet of the LEGO scenario: a slice of the head printed in true size, crosses on it, and what is to be drawn.

The "2D phantom" of the paper.  Everything is in coordinates of the image (mm, RAS), where the sheet is the axial plane
``HEIGHT_MM`` above the origin; its place in front of the robot follows from the registration only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from igtl_gateway_lab.simulate.star_numbers import Array, dot, rounded
from igtl_gateway_lab.simulate.volume import LESION

HEIGHT_MM = 20.0

#: Printed crosses: those that register, and those that test the registration, in the order of touching.
LANDMARKS = {
    "front": (0.0, 82.0),
    "right front": (58.0, 50.0),
    "right back": (66.0, -70.0),
    "back": (0.0, -118.0),
    "left back": (-62.0, -72.0),
    "left front": (-58.0, 46.0),
}
AT_LESION = "lesion"
CHECKS = {"centre": (0.0, -20.0), AT_LESION: (36.0, -48.0), "left": (-40.0, -48.0)}

_STEP_MM = 1.5  #: between points of a plan
_MARGIN_MM = 19.0  #: from the middle of the lesion to the line around it
_STROKES = ("approach", "margin")


def on_sheet(crosses: dict[str, tuple[float, float]]) -> Array:
    """(n, 3) points of the crosses."""
    return np.array([(x, y, HEIGHT_MM) for x, y in crosses.values()])


def strokes() -> dict[str, Array]:
    """What is to be drawn, name → (n, 3) points: a straight way in from the skin, and the margin around the lesion."""
    turns = np.linspace(0.0, 2 * np.pi, round(2 * np.pi * _MARGIN_MM / _STEP_MM) + 1)
    radius = _MARGIN_MM * (1.0 + 0.10 * np.cos(3 * turns) + 0.05 * np.sin(2 * turns))
    turns -= math.radians(40)  # it begins where the way in ends
    margin = np.stack([radius * np.cos(turns), radius * np.sin(turns), np.zeros(len(turns))], -1) + LESION
    outside = margin[0] + 0.85 * (margin[0] - LESION)
    steps = np.linspace(0.0, 1.0, 13)[:, None]
    lines = outside + steps * (margin[0] - outside), margin
    return {name: rounded(line, 0.01) for name, line in zip(_STROKES, lines, strict=True)}


@dataclass(frozen=True, slots=True)
class LineError:
    """How far a drawn line is from the planned one, mm.

    Attributes:
        mean, largest: of the distances of the drawn points from the plan.
        hausdorff: the largest distance of any point of either line from the other: it sees what is missing, too.
        planned, drawn: lengths.
    """

    mean: float
    largest: float
    hausdorff: float
    planned: float
    drawn: float


def line_error(plan: Sequence[Array], drawn: Array) -> LineError:
    """Compare strokes (n, 3) with drawn segments (m, 2, 3); both are looked at every quarter of a millimetre."""
    planned = np.concatenate([np.stack([stroke[:-1], stroke[1:]], 1) for stroke in plan])
    off, missed = _distances(_samples(drawn), planned), _distances(_samples(planned), drawn)
    return LineError(
        math.fsum(off.tolist()) / len(off),
        float(off.max()),
        float(max(off.max(), missed.max())),
        _length(planned),
        _length(drawn),
    )


def _length(segments: Array) -> float:
    way = segments[:, 1] - segments[:, 0]
    return math.fsum(np.sqrt(dot(way, way)).tolist())


def _samples(segments: Array) -> Array:
    """Points on segments, 0.25 mm apart or less."""
    way = segments[:, 1] - segments[:, 0]
    counts = np.ceil(np.sqrt(dot(way, way)) / 0.25).astype(int) + 1
    return np.concatenate(
        [a + np.linspace(0, 1, n)[:, None] * (b - a) for (a, b), n in zip(segments, counts, strict=True)]
    )


def _distances(points: Array, segments: Array) -> Array:
    """(n,) distance of each point from the nearest segment."""
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    square = np.maximum(dot(way, way), 1e-12)
    nearest = np.empty(len(points))
    for number, point in enumerate(points):
        along = np.clip(dot(point - start, way) / square, 0.0, 1.0)
        beside = point - start - along[:, None] * way
        nearest[number] = np.sqrt(dot(beside, beside).min())
    return nearest
